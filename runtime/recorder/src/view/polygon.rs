//! Convex polygons in the plane: the hull of points, and what two hulls share. Corners go
//! counter-clockwise.

/// A point, metres.
pub(crate) type Point = [f64; 2];

/// Twice the area of the triangle; above 0 when it goes counter-clockwise.
fn turn(a: Point, b: Point, c: Point) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

/// The convex hull of `points` (Andrew's monotone chain); fewer than three corners when they lie on
/// a line.
pub(crate) fn hull(mut points: Vec<Point>) -> Vec<Point> {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let mut corners: Vec<Point> = Vec::with_capacity(points.len());
    let half = |corners: &mut Vec<Point>, point: Point, floor: usize| {
        while corners.len() >= floor + 2
            && turn(
                corners[corners.len() - 2],
                corners[corners.len() - 1],
                point,
            ) <= 0.0
        {
            corners.pop();
        }
        corners.push(point);
    };
    for point in &points {
        half(&mut corners, *point, 0);
    }
    let floor = corners.len() - 1;
    for point in points.iter().rev().skip(1) {
        half(&mut corners, *point, floor);
    }
    corners.pop();
    corners
}

/// What two convex polygons share (Sutherland and Hodgman 1974); empty when they do not meet.
pub(crate) fn shared(one: &[Point], other: &[Point]) -> Vec<Point> {
    let mut left = one.to_vec();
    for (index, from) in other.iter().enumerate() {
        let to = other[(index + 1) % other.len()];
        let corners = core::mem::take(&mut left);
        for (index, corner) in corners.iter().enumerate() {
            let next = corners[(index + 1) % corners.len()];
            let (here, there) = (turn(*from, to, *corner), turn(*from, to, next));
            if here >= 0.0 {
                left.push(*corner);
            }
            if (here > 0.0 && there < 0.0) || (here < 0.0 && there > 0.0) {
                let share = here / (here - there);
                left.push([0, 1].map(|axis| corner[axis] + share * (next[axis] - corner[axis])));
            }
        }
    }
    if left.len() < 3 { Vec::new() } else { left }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(corners: &[Point]) -> f64 {
        let count = corners.len();
        let parts = 1..count.saturating_sub(1);
        0.5 * parts
            .map(|index| turn(corners[0], corners[index], corners[index + 1]))
            .sum::<f64>()
    }

    #[test]
    fn a_hull_has_the_corners_only() {
        let inside =
            (0..50).map(|n| [f64::from(n % 7) / 7.0 + 0.05, f64::from(n % 5) / 5.0 + 0.05]);
        let mut points: Vec<Point> = inside.collect();
        points.extend([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.0]]);
        let corners = hull(points);
        assert_eq!(corners.len(), 4);
        assert!((area(&corners) - 1.0).abs() < 1e-12);
        assert_eq!(hull(vec![[1.0, 1.0]; 9]).len(), 1);
    }

    #[test]
    fn squares_share_their_overlap() {
        let square =
            |x: f64, y: f64| hull(vec![[x, y], [x + 2.0, y], [x + 2.0, y + 2.0], [x, y + 2.0]]);
        let both = shared(&square(0.0, 0.0), &square(1.5, 1.0));
        assert!((area(&both) - 0.5).abs() < 1e-12, "{both:?}");
        assert!(shared(&square(0.0, 0.0), &square(5.0, 0.0)).is_empty());
        assert!((area(&shared(&square(0.0, 0.0), &square(0.0, 0.0))) - 4.0).abs() < 1e-12);
    }
}
