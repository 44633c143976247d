//! Tests of sections against trying all pose pairs, and of what the guarded footprint promises.

use super::*;
use crate::geometry::{Pose, floor_index, wrap_angle};
use crate::section::sections_between;
use crate::world::guarded_footprint;
use hil_core::random::RandomStream;

const CART: Footprint = Footprint {
    length_m: 2.0,
    width_m: 0.7,
};

/// A wandering way of some 30 m that turns by at most 1/3 rad per metre; one in four goes sideways.
fn random_path(random: &mut RandomStream) -> Path {
    let mut pose = Pose::new(
        12.0 * random.uniform(),
        12.0 * random.uniform(),
        core::f64::consts::TAU * random.uniform(),
    );
    let crab_rad = if random.chance(0.25) { 0.6 } else { 0.0 };
    let mut poses = vec![pose];
    let mut turn = 0.0;
    for step in 0..300 {
        if step % 40 == 0 {
            turn = (random.uniform() - 0.5) / 15.0;
        }
        let course = pose.heading_rad + 0.5 * turn + crab_rad;
        pose.x_m += 0.1 * course.cos();
        pose.y_m += 0.1 * course.sin();
        pose.heading_rad = wrap_angle(pose.heading_rad + turn);
        poses.push(pose);
    }
    Path::new(&poses, 0.3).unwrap()
}

/// All overlapping pose pairs, gathered by flooding, joined while any two are near, as the ranges
/// of partners per pose of the first path.
fn by_trying_all(first: &Path, second: &Path, merge: MergePolicy) -> Vec<Vec<(usize, usize)>> {
    let boxes = |path: &Path| -> Vec<_> { path.poses().iter().map(|pose| CART.at(pose)).collect() };
    let (rows, columns) = (boxes(first), boxes(second));
    let mut open = std::collections::BTreeSet::new();
    for (i, row) in rows.iter().enumerate() {
        open.extend(
            (0..columns.len())
                .filter(|&j| row.overlaps(&columns[j]))
                .map(|j| (i, j)),
        );
    }
    let mut sets: Vec<Vec<(usize, usize)>> = Vec::new();
    while let Some(seed) = open.pop_first() {
        let (mut set, mut next) = (Vec::new(), vec![seed]);
        while let Some((i, j)) = next.pop() {
            set.push((i, j));
            for pair in (0..9).map(|k| ((i + k / 3).wrapping_sub(1), (j + k % 3).wrapping_sub(1))) {
                next.extend(open.take(&pair));
            }
        }
        sets.push(set);
    }
    let range = |set: &[(usize, usize)], pick: fn(&(usize, usize)) -> usize| {
        let picked = set.iter().map(pick);
        (picked.clone().min().unwrap(), picked.max().unwrap())
    };
    let gaps = [first, second].map(|path| floor_index(CART.length_m / path.spacing_m()));
    let near = |a: (usize, usize), b: (usize, usize), gap| a.0 <= b.1 + gap && b.0 <= a.1 + gap;
    let next_two = |sets: &[Vec<(usize, usize)>]| {
        let pairs = (0..sets.len()).flat_map(|a| (a + 1..sets.len()).map(move |b| (a, b)));
        let mut near = pairs.filter(|&(a, b)| {
            near(range(&sets[a], |p| p.0), range(&sets[b], |p| p.0), gaps[0])
                && near(range(&sets[a], |p| p.1), range(&sets[b], |p| p.1), gaps[1])
        });
        near.next().filter(|_| merge == MergePolicy::WithinVehicle)
    };
    while let Some((a, b)) = next_two(&sets) {
        let mut other = sets.swap_remove(b);
        sets[a].append(&mut other);
    }
    for set in &mut sets {
        set.sort_unstable();
    }
    sets.sort();
    sets
}

/// Start of a section's side, and the partners from there on.
type Said = (usize, Vec<Option<(usize, usize)>>);

/// What a section says about both sides.
fn said(section: &Section) -> [Said; 2] {
    [Side::First, Side::Second].map(|side| {
        let range = section.start(side)..=section.end(side);
        let partners = range.map(|index| section.partners(side, index)).collect();
        (section.start(side), partners)
    })
}

fn expected(set: &[(usize, usize)]) -> [Said; 2] {
    [false, true].map(|is_second| {
        let pairs: Vec<_> = set
            .iter()
            .map(|&(i, j)| if is_second { (j, i) } else { (i, j) })
            .collect();
        let start = pairs.iter().map(|pair| pair.0).min().unwrap();
        let end = pairs.iter().map(|pair| pair.0).max().unwrap();
        let partners = (start..=end).map(|index| {
            let own = pairs
                .iter()
                .filter(|pair| pair.0 == index)
                .map(|pair| pair.1);
            own.clone().min().zip(own.max())
        });
        (start, partners.collect())
    })
}

#[test]
fn sections_are_those_of_trying_all_pose_pairs() {
    let mut random = RandomStream::new(21, "sections");
    let mut count = 0;
    for _ in 0..150 {
        let (first, second) = (random_path(&mut random), random_path(&mut random));
        for merge in [MergePolicy::Never, MergePolicy::WithinVehicle] {
            let sections = sections_between(&first, &second, &CART, merge);
            let mut found: Vec<_> = sections.iter().map(said).collect();
            let sets = by_trying_all(&first, &second, merge);
            let mut tried: Vec<_> = sets.iter().map(|set| expected(set)).collect();
            found.sort();
            tried.sort();
            assert_eq!(found, tried);
            count += found.len();
        }
    }
    assert!(count > 100, "{count}");
}

#[test]
fn every_direction_and_order_of_two_paths_has_the_sections_computed_for_it() {
    let mut random = RandomStream::new(22, "sections");
    let mut paths = PathLibrary::default();
    for _ in 0..5 {
        paths.add(random_path(&mut random));
    }
    for merge in [MergePolicy::Never, MergePolicy::WithinVehicle] {
        let library = SectionLibrary::new(paths.clone(), CART, merge);
        for first in paths.ids() {
            for second in paths.ids() {
                let path = |id| paths.get(id).unwrap();
                let computed = sections_between(path(first), path(second), &CART, merge);
                assert_eq!(library.between(first, second)[..], computed[..]);
            }
        }
    }
}

#[test]
fn positions_between_poses_that_do_not_overlap_guarded_do_not_overlap() {
    let mut random = RandomStream::new(23, "guarded");
    let (mut close_count, mut apart_count) = (0, 0);
    for _ in 0..60 {
        let mut paths = PathLibrary::default();
        let ids = [(); 2].map(|()| paths.add(random_path(&mut random)));
        let guarded = guarded_footprint(&CART, &paths);
        let [first, second] = ids.map(|id| paths.get(id).unwrap().clone());
        for _ in 0..2000 {
            let ways = [&first, &second].map(|path| random.uniform() * path.length_m());
            let poses = [first.pose_at(ways[0]), second.pose_at(ways[1])];
            if poses[0].distance_m(&poses[1]) > 3.0 {
                continue;
            }
            let around = |path: &Path, way_m: f64| {
                let index = path.index_at(way_m).min(path.last_index() - 1);
                [path.poses()[index], path.poses()[index + 1]].map(|pose| guarded.at(&pose))
            };
            let (rows, columns) = (around(&first, ways[0]), around(&second, ways[1]));
            let meets = rows
                .iter()
                .any(|row| columns.iter().any(|column| row.overlaps(column)));
            let overlaps = CART.at(&poses[0]).overlaps(&CART.at(&poses[1]));
            assert!(meets || !overlaps, "{poses:?}");
            close_count += u32::from(overlaps);
            apart_count += u32::from(!meets);
        }
    }
    assert!(
        close_count > 200 && apart_count > 200,
        "{close_count} {apart_count}"
    );
}
