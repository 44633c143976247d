//! The small scenarios: worlds of straight lines without obstacles, whose critical sections,
//! waiting points and times have a closed form. All lengths follow from the vehicle's.

use crate::geometry::Pose;
use crate::world::Vehicle;

/// What a small scenario lays out for one robot: the way from its start to its goal, as corner
/// poses.
pub(crate) type Line = Vec<Pose>;

/// Half the way of the crossing and the way before and beyond the triangle, in vehicle lengths.
const APPROACH: f64 = 10.0;
/// Half the corridor of the head-on scenario, in vehicle lengths.
const CORRIDOR: f64 = 5.0;
/// From a bay of the head-on scenario to where the vehicle bears away, in vehicle lengths.
const RUN_UP: f64 = 3.0;
/// From the corridor's axis to a bay's, in vehicle widths.
const BEARING_AWAY: f64 = 3.0;
/// From the follower's start to the leader's, in vehicle lengths.
const HEADWAY: f64 = 3.0;

/// Robot 0 drives east, robot 1 north; the lines cross at the origin, half way of both.
pub(crate) fn crossing(vehicle: &Vehicle) -> Vec<Line> {
    let way_m = APPROACH * vehicle.footprint.length_m;
    let north = core::f64::consts::FRAC_PI_2;
    vec![
        vec![Pose::new(-way_m, 0.0, 0.0), Pose::new(way_m, 0.0, 0.0)],
        vec![Pose::new(0.0, -way_m, north), Pose::new(0.0, way_m, north)],
    ]
}

/// Two robots swap sides through a corridor for one: both bear to their left at its end, into
/// bays beside each other. They keep their heading while they bear away (all wheels steered), so
/// that all footprints stay upright and overlap has a closed form.
pub(crate) fn head_on(vehicle: &Vehicle) -> Vec<Line> {
    let corridor_m = CORRIDOR * vehicle.footprint.length_m;
    let aside_m = BEARING_AWAY * vehicle.footprint.width_m;
    let end_m = corridor_m + aside_m + RUN_UP * vehicle.footprint.length_m;
    let along = |side: f64, heading_rad: f64| {
        [
            (-end_m, aside_m),
            (-corridor_m - aside_m, aside_m),
            (-corridor_m, 0.0),
            (corridor_m, 0.0),
            (corridor_m + aside_m, aside_m),
            (end_m, aside_m),
        ]
        .map(|(x_m, y_m)| Pose::new(side * x_m, side * y_m, heading_rad))
        .to_vec()
    };
    vec![along(1.0, 0.0), along(-1.0, core::f64::consts::PI)]
}

/// Robot 1 follows robot 0 along one line and stops as far behind it as it began.
pub(crate) fn following(vehicle: &Vehicle) -> Vec<Line> {
    let headway_m = HEADWAY * vehicle.footprint.length_m;
    let way_m = 2.0 * APPROACH * vehicle.footprint.length_m;
    let from = |x_m| vec![Pose::new(x_m, 0.0, 0.0), Pose::new(x_m + way_m, 0.0, 0.0)];
    vec![from(headway_m), from(0.0)]
}

/// Three robots, each along one side of a triangle and beyond. The sides are one vehicle long, so
/// a robot stands in its first section as long as it waits for its second: when each goes first
/// at its first corner, none can leave.
pub(crate) fn three_cycle(vehicle: &Vehicle) -> Vec<Line> {
    let side_m = vehicle.footprint.length_m;
    let way_m = APPROACH * side_m;
    (0..3)
        .map(|side| {
            let heading_rad = f64::from(side) * core::f64::consts::TAU / 3.0;
            let (sine, cosine) = heading_rad.sin_cos();
            // The middle of the side lies to the right of the centre, an inradius away.
            let inradius_m = side_m / 12.0_f64.sqrt();
            let middle = [inradius_m * sine, -inradius_m * cosine];
            [-1.0, 1.0]
                .map(|end| {
                    let way_m = end * (0.5 * side_m + way_m);
                    let (x_m, y_m) = (middle[0] + way_m * cosine, middle[1] + way_m * sine);
                    Pose::new(x_m, y_m, crate::geometry::wrap_angle(heading_rad))
                })
                .to_vec()
        })
        .collect()
}
