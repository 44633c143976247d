//! What the live page draws of a fleet, held against the state that it was sent: robots that have not been heard
//! of are grey, collisions are marked, critical sections have the colour of who may pass. The robots of
//! this run stop late, as the original's do under delay, and report seldom, so all of that happens.
//!
//! Pixels are read off the canvas of a paused page, moment by moment; the colours that are expected
//! are those of the list below the drawing and of the style sheet. Needs Chromium, as `browser.rs` does.

use std::collections::BTreeMap;

use hil_tests::browser::{Browser, Page, screenshot_folder};
use hil_tests::run_folder::RunFolder;
use hil_tests::shown::{DESKTOP, Shown, assert_clean, settle, with_the_cable_pulled};
use hil_tests::trial::Trial;
use serde_json::Value;

/// Moments looked at: half a minute of the past.
const MOMENT_COUNT_MAX: usize = 60;
/// A colour that is drawn is at most so far from what it should be, per part: edges are smoothed.
const APART_MAX: f64 = 30.0;
/// So far it is at most within an area, which is of one colour over a known ground.
const SAME_MAX: f64 = 4.0;
/// Shades of the ground that are told apart.
const GROUND_COUNT: usize = 6;
/// An area with fewer pixels that nothing else is drawn over says nothing.
const PIXELS_MIN: u64 = 12;
/// Beside the seven robots: who has the colour of a section.
const CONTESTED: usize = 7;
const NOBODYS: usize = 8;
/// Of each kind, so many must have been seen and looked at.
const SEEN_MIN: usize = 3;

/// What is drawn where, as numbers: colours as `[red, green, blue]`. Things that something else is drawn over
/// are left out.
const LOOK: &str = r#"(() => {
  const { fleet, robots } = hil.snapshot();
  const stage = document.getElementById("stage");
  const box = stage.getBoundingClientRect();
  const ratio = stage.width / box.width;
  // A copy: reading the page's own canvas would change how the browser draws it.
  const copy = document.createElement("canvas");
  [copy.width, copy.height] = [stage.width, stage.height];
  const pen = copy.getContext("2d", { willReadFrequently: true });
  pen.drawImage(stage, 0, 0);
  const picture = pen.getImageData(0, 0, copy.width, copy.height).data;
  const isIn = (x, y) => x > 20 && y > 20 && x < box.width - 20 && y < box.height - 20;
  const pixel = (x, y) => {
    const at = 4 * (Math.round(y * ratio - 0.5) * copy.width + Math.round(x * ratio - 0.5));
    return [...picture.slice(at, at + 3)];
  };
  const style = getComputedStyle(document.documentElement);
  const named = (name) => style.getPropertyValue(`--${name}`).trim().match(/[0-9a-f]{2}/g).map((two) => parseInt(two, 16));
  const [bad, faint, panel, paper, ink] = ["bad", "faint", "panel", "paper", "ink"].map(named);
  const chip = (id) => document.querySelector(`[data-robot="0/${id}"]`).parentElement;
  const own = (id) => chip(id).querySelector("b").style.background.match(/\d+/g).map(Number);
  const near = (list, x, y, reach) => list.filter((one) => Math.hypot(one.x_px - x, one.y_px - y) < reach).length;
  const drawn = robots.map((one) => ({ ...one, state: fleet.robots.find((two) => two.fleet === 0 && two.id === one.id) }));
  // Metres to pixels, from the two robots that are farthest apart.
  const pairs = drawn.flatMap((one) => drawn.map((two) => [one, two, Math.hypot(one.x_px - two.x_px, one.y_px - two.y_px)]));
  const [one, two, apart_px] = pairs.reduce((best, pair) => (pair[2] > best[2] ? pair : best));
  const scale = apart_px / Math.hypot(one.state.x_m - two.state.x_m, one.state.y_m - two.state.y_m);
  const place = (x_m, y_m) => [one.x_px + (x_m - one.state.x_m) * scale, one.y_px - (y_m - one.state.y_m) * scale];
  const hits = fleet.collisions.filter((hit) => hit.fleet === 0).map((hit) => {
    const [x_px, y_px] = place(hit.x_m, hit.y_m);
    return { ...hit, x_px, y_px, is_fresh: fleet.at_s - hit.at_s < 5 };
  });
  const long = 2 * scale;

  const vehicles = drawn.filter(({ x_px, y_px }) => isIn(x_px, y_px) && near(drawn, x_px, y_px, 80) === 1 && near(hits, x_px, y_px, 30) === 0)
    .map(({ id, x_px, y_px, state }) => {
      const bow = [x_px + Math.cos(state.heading_rad) * long * 0.33, y_px - Math.sin(state.heading_rad) * long * 0.33];
      return { id, is_stale: state.is_stale, age_s: state.age_s, body: pixel(x_px, y_px), bow: pixel(...bow), own: own(id) };
    });

  // Two of the referee's checkers may have found the same one.
  const isAlone = (hit) => near(hits, hit.x_px, hit.y_px, 40) === near(hits, hit.x_px, hit.y_px, 3)
    && hits.every((one) => one.is_fresh === hit.is_fresh || Math.hypot(one.x_px - hit.x_px, one.y_px - hit.y_px) > 40);
  const collisions = hits.filter((hit) => isIn(hit.x_px, hit.y_px) && isAlone(hit) && (hit.is_fresh || near(drawn, hit.x_px, hit.y_px, 60) === 0))
    .map((hit) => {
      const { x_px, y_px } = hit;
      const ring = [...Array(16).keys()].map((step) => pixel(x_px + 15 * Math.cos(step * Math.PI / 8), y_px + 15 * Math.sin(step * Math.PI / 8)));
      return { is_fresh: hit.is_fresh, robots: hit.robots, middle: pixel(x_px, y_px), ring };
    });

  const areas = (fleet.sections ?? []).filter((section) => section.fleet === 0).map((section) => {
    const polygon = section.polygon.map(([x, y]) => place(x, y));
    const [xs, ys] = [0, 1].map((axis) => polygon.map((point) => point[axis]));
    return { section, polygon, left: Math.min(...xs), right: Math.max(...xs), top: Math.min(...ys), bottom: Math.max(...ys) };
  });
  const touch = (a, b) => a.left < b.right + 4 && b.left < a.right + 4 && a.top < b.bottom + 4 && b.top < a.bottom + 4;
  const sections = areas.filter((area) => isIn(area.left, area.top) && isIn(area.right, area.bottom)
    && areas.filter((other) => touch(area, other)).length === 1).map((area) => {
    const shape = new Path2D();
    area.polygon.forEach(([x, y], index) => (index ? shape.lineTo(x, y) : shape.moveTo(x, y)));
    shape.closePath();
    // The colours that most of the area has.
    const tally = new Map();
    for (let x = Math.ceil(area.left); x < area.right; x += 1) {
      for (let y = Math.ceil(area.top); y < area.bottom; y += 1) {
        if (!pen.isPointInPath(shape, x, y)) continue;
        const key = pixel(x, y).join();
        tally.set(key, (tally.get(key) ?? 0) + 1);
      }
    }
    const most = [...tally].sort((one, two) => two[1] - one[1]).slice(0, 12);
    const { id, may_pass, is_contested } = area.section;
    return { id, may_pass, is_contested, area: most.map(([key, count]) => ({ colour: key.split(",").map(Number), count })) };
  });

  const chips = drawn.map(({ id, state }) => ({ id, is_stale: state.is_stale, is_shown_stale: chip(id).classList.contains("stale"),
    is_shown_bad: chip(id).classList.contains("bad"), has_collided: hits.some((hit) => hit.is_fresh && hit.robots.includes(id)),
    text: chip(id).textContent, mark: getComputedStyle(chip(id).querySelector("b")).backgroundColor.match(/\d+/g).map(Number) }));
  const others = Object.fromEntries([...Array(7).keys()].map((id) => [id, own(id)]));
  return { moment: hil.snapshot().moment, vehicles, collisions, sections, chips, others, colours: { bad, faint, panel, paper, ink } };
})()"#;

type Colour = [f64; 3];

fn colour(value: &Value) -> Colour {
    let part = |index: usize| value[index].as_f64().unwrap();
    [part(0), part(1), part(2)]
}

/// `share` of one colour over another.
fn over(top: Colour, share: f64, below: Colour) -> Colour {
    core::array::from_fn(|part| top[part] * share + below[part] * (1.0 - share))
}

/// How far two colours are apart in the part in which they differ most.
fn apart(one: Colour, other: Colour) -> f64 {
    let parts = one.iter().zip(other);
    parts.fold(0.0, |most, (one, other)| (one - other).abs().max(most))
}

fn is_like(one: Colour, other: Colour) -> bool {
    apart(one, other) <= APART_MAX
}

/// How often each kind of thing was looked at.
type Seen = BTreeMap<&'static str, usize>;

fn check_vehicles(look: &Value, seen: &mut Seen) {
    let [faint, panel] = ["faint", "panel"].map(|name| colour(&look["colours"][name]));
    for robot in look["vehicles"].as_array().unwrap() {
        let [body, bow, own] = ["body", "bow", "own"].map(|name| colour(&robot[name]));
        // The bow is a wedge of the other colour.
        let (kind, wanted_body, wanted_bow) = if robot["is_stale"] == true {
            ("stale robot", panel, over(faint, 0.85, panel))
        } else {
            ("robot", own, over(panel, 0.85, own))
        };
        assert!(is_like(body, wanted_body), "{kind}: {robot}");
        // It is a few pixels wide: it need only be nearer to its colour than to the body's.
        let is_wedge = apart(bow, wanted_bow) < apart(bow, wanted_body);
        assert!(is_wedge, "bow of {kind}: {robot}");
        *seen.entry(kind).or_default() += 1;
    }
}

fn check_chips(look: &Value, seen: &mut Seen) {
    let faint = colour(&look["colours"]["faint"]);
    for chip in look["chips"].as_array().unwrap() {
        assert_eq!(chip["is_stale"], chip["is_shown_stale"], "{chip}");
        assert_eq!(chip["has_collided"], chip["is_shown_bad"], "{chip}");
        let is_stale = chip["is_stale"] == true;
        let says_so = chip["text"].as_str().unwrap().contains("stale, ");
        assert_eq!(says_so, is_stale, "{chip}");
        let is_grey = is_like(colour(&chip["mark"]), faint);
        assert!(is_grey || !is_stale, "{chip}");
        if chip["has_collided"] == true {
            *seen.entry("marked chip").or_default() += 1;
        }
    }
}

fn check_collisions(look: &Value, seen: &mut Seen) {
    let [bad, paper] = ["bad", "paper"].map(|name| colour(&look["colours"][name]));
    for hit in look["collisions"].as_array().unwrap() {
        let ring = hit["ring"].as_array().unwrap().iter().map(colour);
        let drawn_count = ring.filter(|one| is_like(*one, bad)).count();
        let middle = colour(&hit["middle"]);
        // Labels of the robots may cover some of it.
        if hit["is_fresh"] == true {
            assert!(drawn_count >= 6, "{drawn_count} of the ring: {hit}");
            *seen.entry("new collision").or_default() += 1;
        } else {
            assert!(drawn_count < 4, "{drawn_count} of the ring: {hit}");
            let is_marked = apart(middle, over(bad, 0.45, paper)) < apart(middle, paper);
            assert!(is_marked, "{hit}");
            *seen.entry("old collision").or_default() += 1;
        }
    }
}

/// Pixels of an area in the colour of each: robots by number, then of two that contest it, then of nobody.
/// A pixel may count for two, as the ground is of several shades and two blues differ in theirs alone.
fn pixels_of(look: &Value, area: &[Value]) -> [u64; 9] {
    let colours = &look["colours"];
    let [bad, faint, paper, ink] =
        ["bad", "faint", "paper", "ink"].map(|name| colour(&colours[name]));
    // Where vehicles of many lanes can meet, the ground is darker.
    let shades: Vec<Colour> =
        core::iter::successors(Some(paper), |shade| Some(over(ink, 0.045, *shade)))
            .take(GROUND_COUNT)
            .collect();
    core::array::from_fn(|who| {
        let (top, share) = match who {
            CONTESTED => (bad, 0.26),
            NOBODYS => (faint, 0.08),
            robot => (colour(&look["others"][robot.to_string()]), 0.26),
        };
        let is_of = |found: &&Value| {
            let found = colour(&found["colour"]);
            let mut shades = shades.iter();
            shades.any(|shade| apart(found, over(top, share, *shade)) <= SAME_MAX)
        };
        let pixels = area.iter().filter(is_of);
        pixels.filter_map(|found| found["count"].as_u64()).sum()
    })
}

fn check_sections(look: &Value, seen: &mut Seen) {
    for section in look["sections"].as_array().unwrap() {
        let pixels = pixels_of(look, section["area"].as_array().unwrap());
        let most = pixels.into_iter().max().unwrap();
        if most < PIXELS_MIN {
            continue;
        }
        let first = section["may_pass"][0].as_u64();
        let (kind, wanted) = match first {
            _ if section["is_contested"] == true => ("contested section", CONTESTED),
            Some(robot) => ("section to pass", usize::try_from(robot).unwrap()),
            None => ("section of nobody", NOBODYS),
        };
        assert!(pixels[wanted] * 2 > most, "{kind}: {pixels:?} in {section}");
        let mut others = (0..pixels.len()).filter(|who| *who != wanted);
        if others.all(|who| pixels[who] * 2 < pixels[wanted]) {
            *seen.entry(kind).or_default() += 1;
        }
    }
}

/// Every kind of thing has been looked at often enough.
fn is_enough(seen: &Seen) -> bool {
    let kinds = [
        "robot",
        "stale robot",
        "new collision",
        "old collision",
        "marked chip",
        "section to pass",
    ];
    kinds
        .iter()
        .all(|kind| seen.get(kind).is_some_and(|count| *count >= SEEN_MIN))
}

/// Goes back from the moment shown, and holds each moment against its state.
fn check_moments(page: &mut Page<'_>) -> Seen {
    let mut seen = Seen::new();
    let mut moment = Value::Null;
    for _moment in 0..MOMENT_COUNT_MAX {
        page.press("ArrowLeft");
        settle(page);
        let look = page.value(LOOK);
        if look["moment"] == moment {
            // That is all of the past.
            break;
        }
        moment = look["moment"].clone();
        check_vehicles(&look, &mut seen);
        check_chips(&look, &mut seen);
        check_collisions(&look, &mut seen);
        check_sections(&look, &mut seen);
        if is_enough(&seen) {
            break;
        }
    }
    seen
}

#[test]
fn stale_robots_are_grey_collisions_marked_and_sections_of_the_passers_colour() {
    let Some(lab) = with_the_cable_pulled() else {
        return;
    };
    let host = lab.host(0);
    let Some(mut browser) = Browser::start_on_or_skip(host) else {
        return;
    };
    let folder = RunFolder::new("browser-collisions");
    let trial = Trial::shipped("fleet-emulated.toml", folder.path())
        .set("name=\"shown-collisions\"")
        .set("case.parameters.fleets=1")
        .set("case.parameters.coordinator.mode=\"legacy\"")
        .set("case.parameters.robot.tracker=\"legacy-rk4\"")
        .set("case.parameters.robot.step_inflation=true")
        .set("case.parameters.robot.inflation_delay_ms=3000.0")
        .set("run.duration=\"10 min\"");
    let shown = Shown::start(&trial, folder, host);
    let mut page = browser.page(DESKTOP.0, DESKTOP.1);
    page.go(&shown.address);
    page.wait_until("document.body.dataset.state === 'live' && hil.snapshot().robots.length === 7");
    // An old collision, and some of the past to go back to.
    page.wait_until(
        "hil.snapshot().fleet.collisions.some(hit => hil.snapshot().fleet.at_s - hit.at_s > 8)",
    );
    let hits = "document.querySelectorAll('#event-list li.bad').length";
    page.wait_until(&format!("{hits} > 0"));
    let named = page.text("#event-list li.bad");
    assert!(named.contains("collision of robots "), "{named}");
    page.click("#pause");
    page.wait_until("document.body.dataset.paused === 'true'");
    page.click("#zoom-in");
    // Off the button, where keys mean the page.
    page.value("document.activeElement.blur()");
    settle(&mut page);
    page.screenshot(&screenshot_folder().join("live-collisions.png"));
    let seen = check_moments(&mut page);
    eprintln!("looked at {seen:?}");
    assert!(is_enough(&seen), "{seen:?}");
    assert_clean(&mut page, "the live page of a fleet that collides");
    drop(page);
    shown.end();
}
