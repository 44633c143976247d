//! The ground of a fleet, made from the run's parameters as its own processes make it: map, paths,
//! vehicle. Planning the paths takes seconds, so it is done beside everything else.

use std::error::Error;
use std::sync::mpsc::{Receiver, channel};
use std::thread;

use hil_core::case_study::ParameterError;
use hil_fleet::FleetParameters;
use hil_fleet::geometry::{Bounds, Footprint};
use hil_fleet::path::{Path, PathId};
use hil_fleet::scenario::{Scenario, Scene};
use serde::Serialize;
use serde_json::Value;

use super::rounded;
use super::sections::{Areas, Point};

/// Points of all paths that are shown: more would be a picture of megabytes.
const POINTS_MAX: usize = 20_000;
/// Conflict areas that are shown.
const AREAS_MAX: usize = 400;

/// The ground, once it is known.
#[derive(Debug)]
pub(crate) struct Ground {
    /// World, starts, partners.
    pub(crate) scene: Scene,
    /// What was set.
    pub(crate) parameters: FleetParameters,
    /// What is shown of it.
    pub(crate) map: MapPicture,
}

/// `/live/map`.
#[derive(Debug, Serialize)]
pub(crate) struct MapPicture {
    case: &'static str,
    scenario: Scenario,
    pub(crate) bounds: Bounds,
    pub(crate) obstacles: Vec<Bounds>,
    pub(crate) bays: Vec<BayPicture>,
    pub(crate) footprint: Footprint,
    paths: Vec<PathPicture>,
    pub(crate) conflict_areas: Vec<Vec<Point>>,
    pub(crate) fleet_count: u32,
    robot_count: usize,
}

/// A way from bay to bay.
#[derive(Debug, Serialize)]
struct PathPicture {
    id: u32,
    from: usize,
    to: usize,
    points: Vec<Point>,
}

/// Where a vehicle parks.
#[derive(Debug, Serialize)]
pub(crate) struct BayPicture {
    pub(crate) id: usize,
    pub(crate) x_m: f64,
    pub(crate) y_m: f64,
    pub(crate) heading_rad: f64,
}

/// Begins to make the ground of the fleet with these `[case.parameters]`; it comes, or why not.
pub(crate) fn make(parameters: Value) -> Receiver<Result<Box<Ground>, String>> {
    let (give, result) = channel();
    thread::spawn(move || {
        let made = || -> Result<Box<Ground>, Box<dyn Error>> {
            let parameters: FleetParameters = serde_json::from_value(parameters)?;
            let scene = parameters.world.build()?;
            Ok(Box::new(Ground {
                map: map(&parameters, &scene)?,
                scene,
                parameters,
            }))
        };
        // Nobody may be there any more to take it.
        let _is_wanted = give.send(made().map_err(|error| error.to_string())).is_ok();
    });
    result
}

fn map(parameters: &FleetParameters, scene: &Scene) -> Result<MapPicture, ParameterError> {
    let known = parameters.world.map()?;
    let world = &scene.world;
    let vehicle = &world.vehicle.footprint;
    let bounds = known.as_ref().map(|map| map.bounds);
    let bays = world.bays.iter().enumerate();
    let bays = bays.map(|(id, bay)| BayPicture {
        id,
        x_m: rounded(bay.pose.x_m),
        y_m: rounded(bay.pose.y_m),
        heading_rad: rounded(bay.pose.heading_rad),
    });
    let forward = world.routes.iter().filter(|route| route.path.0 % 2 == 0);
    let each = POINTS_MAX / forward.clone().count().max(1);
    let paths: Vec<_> = forward
        .map(|route| {
            let path = world.path(route.path);
            PathPicture {
                id: route.path.0,
                from: route.from,
                to: route.to,
                points: points(path, 0, path.last_index(), each.clamp(2, 200)),
            }
        })
        .collect();
    Ok(MapPicture {
        case: "fleet",
        scenario: parameters.world.scenario,
        bounds: bounds.unwrap_or_else(|| around(scene)),
        obstacles: known.map_or_else(Vec::new, |map| map.obstacles),
        bays: bays.collect(),
        footprint: *vehicle,
        paths,
        conflict_areas: conflict_areas(scene, vehicle),
        fleet_count: parameters.fleets,
        robot_count: scene.starts.len(),
    })
}

/// The ground on which vehicles of two shuttle lines can meet.
fn conflict_areas(scene: &Scene, vehicle: &Footprint) -> Vec<Vec<Point>> {
    let world = &scene.world;
    let line = |start: &usize| -> Option<PathId> {
        let partner = scene.partners[*start]?;
        let routes = world.routes_from(*start).iter();
        let mut routes = routes.filter(|route| route.to == partner);
        routes.next().map(|route| route.path)
    };
    let lines: Vec<_> = scene.starts.iter().filter_map(line).collect();
    let mut areas = Areas::new(*vehicle);
    let mut shown = Vec::new();
    for (index, one) in lines.iter().enumerate() {
        for other in &lines[index + 1..] {
            for section in 0..world.sections.between(*one, *other).len() {
                if shown.len() == AREAS_MAX {
                    return shown;
                }
                let area = areas.of(world, *one, *other, section);
                if !area.is_empty() {
                    shown.push(area.to_vec());
                }
            }
        }
    }
    shown
}

/// A rectangle around all paths, where the ground has no edge.
fn around(scene: &Scene) -> Bounds {
    let world = &scene.world;
    let radius_m = 2.0 * world.vehicle.footprint.radius_m();
    let poses = world.paths.ids().filter_map(|id| world.paths.get(id));
    let poses = poses.flat_map(|path| path.poses());
    let each = poses.map(|pose| Bounds {
        x_min_m: pose.x_m - radius_m,
        x_max_m: pose.x_m + radius_m,
        y_min_m: pose.y_m - radius_m,
        y_max_m: pose.y_m + radius_m,
    });
    let joined = each.reduce(|one, other| one.joined(&other));
    joined.unwrap_or(Bounds {
        x_min_m: 0.0,
        x_max_m: 1.0,
        y_min_m: 0.0,
        y_max_m: 1.0,
    })
}

/// At most about `count_max` points of `path` from one pose to another, both ends among them.
pub(crate) fn points(path: &Path, from: usize, to: usize, count_max: usize) -> Vec<Point> {
    let to = to.min(path.last_index());
    let from = from.min(to);
    let step = (to - from).div_ceil(count_max.max(1)).max(1);
    let poses = path.poses();
    let at = |index: usize| [rounded(poses[index].x_m), rounded(poses[index].y_m)];
    let mut points: Vec<_> = (from..to).step_by(step).map(at).collect();
    points.push(at(to));
    points
}
