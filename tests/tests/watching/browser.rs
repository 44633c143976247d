//! Our pages in a browser, with the network cable pulled: the live page of `hil-recorder serve` beside a run
//! that goes on, pages of others that may not look on, and the pages of `hil-runtime report`, on the screen and
//! on paper. Clicks and keys go through the browser's own input, figures are read off the page.
//!
//! Needs Chromium; without one the tests say so and are skipped, and in CI they fail. `HIL_BROWSER` names
//! another one, and empty leaves them out. Pictures go to `HIL_SCREENSHOTS`, else to the target folder.

use std::path::Path;
use std::process::Command;
use std::thread;
use std::time::Duration;

use hil_tests::binary::hil_runtime_binary;
use hil_tests::browser::{Browser, Page, screenshot_folder};
use hil_tests::child::{ChildGuard, run};
use hil_tests::lab::LabHost;
use hil_tests::run_folder::RunFolder;
use hil_tests::shown::{DESKTOP, Shown, assert_clean, serve, settle, with_the_cable_pulled};
use hil_tests::trial::Trial;
use nix::sys::signal::{Signal, kill};
use serde_json::Value;

const LIMIT: Duration = Duration::from_mins(2);
const PHONE: (u32, u32) = (390, 844);
/// All that a report may have to lay out: with its size, what makes it open fast on any machine.
const ELEMENT_COUNT_MAX: f64 = 8_000.0;

/// Pictures as on a desk, in the dark and on a phone, where nothing may stick out sideways.
fn take_pictures(page: &mut Page<'_>, name: &str) {
    let folder = screenshot_folder();
    page.value("scrollTo(0, 0)");
    settle(page);
    page.screenshot(&folder.join(format!("{name}-desktop.png")));
    page.set_dark(true);
    settle(page);
    page.screenshot(&folder.join(format!("{name}-dark.png")));
    page.set_dark(false);
    page.set_size(PHONE.0, PHONE.1);
    settle(page);
    page.screenshot(&folder.join(format!("{name}-phone.png")));
    let width = page.value("document.documentElement.scrollWidth");
    assert_eq!(width, PHONE.0, "{name} on a phone");
    page.set_size(DESKTOP.0, DESKTOP.1);
    settle(page);
}

/// A stage without an area, as before the first layout, is drawn on without a complaint.
fn vanish(page: &mut Page<'_>) {
    let stage = "document.getElementById('stage')";
    page.value(&format!("void ({stage}.style.display = 'none')"));
    page.wait_until(&format!("{stage}.width === 0"));
    settle(page);
    page.value(&format!("void ({stage}.style.display = '')"));
    page.wait_until(&format!("{stage}.width > 0"));
}

/// Keeps an expression's value on the page under a name, to compare with later.
fn keep(page: &mut Page<'_>, name: &str, expression: &str) {
    page.value(&format!("void (window.{name} = {expression})"));
}

fn number(page: &mut Page<'_>, expression: &str) -> f64 {
    let value = page.value(expression);
    value
        .as_f64()
        .unwrap_or_else(|| panic!("{expression} is {value}"))
}

/// Pauses with the mouse, goes back with keys and slider, and returns to what is now.
fn check_past(page: &mut Page<'_>, scene: &str) {
    page.wait_until("hil.snapshot().kept_s > 4");
    page.click("#pause");
    page.wait_until("document.body.dataset.paused === 'true'");
    settle(page);
    let drawn = format!("JSON.stringify([hil.snapshot().moment, hil.snapshot().{scene}])");
    keep(page, "drawnThen", &drawn);
    keep(page, "keptThen", "hil.snapshot().kept_s");
    page.wait_until("hil.snapshot().kept_s > keptThen + 1.5");
    assert_eq!(
        page.value(&format!("{drawn} === drawnThen")),
        true,
        "a pause holds"
    );
    let paused_at = number(page, "hil.snapshot().moment");
    // Off the button, where keys mean the page.
    page.value("document.activeElement.blur()");
    for _press in 0..4 {
        page.press("ArrowLeft");
    }
    settle(page);
    let earlier = number(page, "hil.snapshot().moment");
    assert!(
        (paused_at - earlier - 2.0).abs() < 0.01,
        "{paused_at} {earlier}"
    );
    assert_eq!(page.value(&format!("{drawn} === drawnThen")), false);
    page.value("(() => { scrub.value = scrub.min; scrub.dispatchEvent(new Event('input')); })()");
    settle(page);
    assert!(number(page, "hil.snapshot().moment") < earlier);
    page.press(" ");
    page.wait_until("document.body.dataset.paused === 'false'");
    assert!(
        number(page, "hil.snapshot().moment") > paused_at + 1.0,
        "now is now"
    );
    page.press(" ");
    page.wait_until("document.body.dataset.paused === 'true'");
    page.click("#live");
    page.wait_until("document.body.dataset.paused === 'false'");
}

/// Rates, counts and delays are numbers with units, and they grow or change.
fn check_numbers(page: &mut Page<'_>, channel: &str) {
    let cell = |label: &str| format!("tr[data-channel='{channel}'] [data-label='{label}']");
    let published = format!(
        "Number((document.querySelector({:?})?.textContent ?? '').replaceAll(',', ''))",
        cell("published")
    );
    page.wait_until(&format!("{published} > 0"));
    let before = number(page, &published);
    page.wait_until(&format!("{published} > {before}"));
    for (label, unit) in [("rate", "Hz"), ("p50", "s"), ("p99", "s"), ("max", "s")] {
        let text = page.text(&cell(label));
        let (figure, found) = text.split_once(' ').unwrap_or((&text, ""));
        assert!(
            figure.parse::<f64>().is_ok() && found.ends_with(unit),
            "{label}: {text}"
        );
    }
}

/// Types a delay of a link's way; the server says that it is set, and the run feels it.
fn check_condition(page: &mut Page<'_>, way: &str, channel: &str) {
    let parameter = format!("link.{way}.delay_ms");
    let field = format!("[id='set-{parameter}']");
    page.wait_until(&format!(
        "document.querySelector(\"{field}\") && hil.snapshot().conditions['{parameter}'] !== undefined"
    ));
    assert_eq!(
        page.value(&format!(
            "document.querySelector(\"{field}\").matches(':disabled')"
        )),
        false
    );
    page.click(&field);
    page.value("document.activeElement.select()");
    for key in ["8", "0", "Enter"] {
        page.press(key);
    }
    page.wait_until(&format!(
        "document.querySelector(\"[data-parameter='{parameter}']\").textContent === '80 ms, confirmed'"
    ));
    let (link, direction) = way.split_once('.').unwrap();
    page.wait_until(&format!(
        "hil.snapshot().run.links.find(one => one.name === '{link}').directions\
         .find(one => one.way === '{direction}').condition.delay_ms === 80"
    ));
    page.wait_until(&format!(
        "hil.snapshot().channels.channels.find(one => one.name === '{channel}').one_way?.p50_us > 79000"
    ));
}

/// The recorder goes and comes back: the page says so, and goes on by itself.
fn check_return(page: &mut Page<'_>, shown: &mut Shown, root: &Path, host: &LabHost) {
    let socket = page
        .addresses()
        .into_iter()
        .find(|one| one.starts_with("ws://"))
        .unwrap();
    let port = |address: &str| {
        address
            .trim_end_matches('/')
            .rsplit(':')
            .next()
            .unwrap()
            .to_owned()
    };
    let (socket, http) = (port(&socket), port(&shown.address));
    shown.recorder.signal(Signal::SIGINT).unwrap();
    shown.recorder.wait_within(LIMIT).unwrap();
    page.wait_until("document.body.dataset.state === 'lost' && !lost.hidden");
    let (recorder, _) = serve(root, host, &["--port", &socket, "--http-port", &http]);
    shown.recorder = recorder;
    page.wait_until("document.body.dataset.state === 'live' && lost.hidden");
    keep(page, "movedSince", "hil.snapshot().moment");
    page.wait_until("hil.snapshot().moment > movedSince + 1");
}

#[test]
fn the_live_page_shows_a_fleet_and_changes_its_links() {
    let Some(lab) = with_the_cable_pulled() else {
        return;
    };
    let host = lab.host(0);
    let Some(mut browser) = Browser::start_on_or_skip(host) else {
        return;
    };
    let folder = RunFolder::new("browser-fleet");
    // Another test may begin a run of that topology in the same second.
    let trial = Trial::shipped("fleet-emulated.toml", folder.path())
        .set("name=\"shown-fleet\"")
        .set("case.parameters.fleets=2")
        .set("run.duration=\"10 min\"");
    let mut shown = Shown::start(&trial, folder, host);
    let root = trial.folder("", LIMIT).root().to_owned();
    let mut page = browser.page(DESKTOP.0, DESKTOP.1);
    page.go(&shown.address);
    page.wait_until("document.body.dataset.state === 'live' && hil.snapshot().robots.length === 7");
    keep(&mut page, "robotsThen", "hil.snapshot().robots");
    page.wait_until(
        "hil.snapshot().robots.some((one, index) => \
         Math.hypot(one.x_px - robotsThen[index].x_px, one.y_px - robotsThen[index].y_px) > 4)",
    );
    assert_eq!(
        page.value("document.querySelectorAll('[data-robot]').length"),
        7
    );
    page.wait_until("document.querySelectorAll('#event-list li').length > 0");
    check_numbers(&mut page, "fleet/state");
    check_past(&mut page, "robots");
    page.click("#fleet-choice button:nth-child(2)");
    page.wait_until("hil.snapshot().robots.length === 7 && hil.snapshot().robots[0].fleet === 1");
    take_pictures(&mut page, "live-fleet");
    check_condition(&mut page, "commands.forward", "fleet/authority");
    vanish(&mut page);
    assert_clean(&mut page, "the live page of a fleet");
    // From here on the browser itself complains of the lost connection.
    check_return(&mut page, &mut shown, &root, host);
    drop(page);
    shown.end();
}

#[test]
fn a_host_that_overran_is_said_at_the_head_of_the_page() {
    let Some(lab) = with_the_cable_pulled() else {
        return;
    };
    let host = lab.host(0);
    let Some(mut browser) = Browser::start_on_or_skip(host) else {
        return;
    };
    let folder = RunFolder::new("page-overrun");
    let trial = Trial::shipped("shuttle-local.toml", folder.path()).set("run.duration=\"2 min\"");
    let shown = Shown::start(&trial, folder, host);
    let mut page = browser.page(DESKTOP.0, DESKTOP.1);
    page.go(&shown.address);
    page.wait_until("document.getElementById('run-state').textContent === 'running'");
    let files = trial.folder("", LIMIT);
    let robot = files.process("robot", 0).unwrap();
    // Its ticks pass without it, as on a host that has no time for it.
    kill(robot, Signal::SIGSTOP).unwrap();
    thread::sleep(Duration::from_millis(500));
    kill(robot, Signal::SIGCONT).unwrap();
    page.wait_until("/overran.*robot [1-9]/.test(document.getElementById('warnings').innerText)");
    shown.end();
}

#[test]
fn the_live_page_shows_arms() {
    let Some(lab) = with_the_cable_pulled() else {
        return;
    };
    let host = lab.host(0);
    let Some(mut browser) = Browser::start_on_or_skip(host) else {
        return;
    };
    let folder = RunFolder::new("browser-arms");
    let trial = Trial::shipped("emulated.toml", folder.path())
        .set("name=\"shown-arms\"")
        .set("run.duration=\"10 min\"");
    let shown = Shown::start(&trial, folder, host);
    let mut page = browser.page(DESKTOP.0, DESKTOP.1);
    page.go(&shown.address);
    page.wait_until("document.body.dataset.state === 'live' && hil.snapshot().tools.length === 2");
    keep(&mut page, "toolsThen", "hil.snapshot().tools");
    page.wait_until(
        "hil.snapshot().tools.some((one, index) => \
         Math.hypot(one.x_px - toolsThen[index].x_px, one.y_px - toolsThen[index].y_px) > 2)",
    );
    let points =
        "Number(document.querySelector(\"[data-strip^='egm/right/command']\")?.dataset.points)";
    page.wait_until(&format!("{points} > 3"));
    let before = number(&mut page, points);
    page.wait_until(&format!("{points} > {before} + 10"));
    check_numbers(&mut page, "egm/right/command");
    check_past(&mut page, "tools");
    page.click("tr[data-channel='egm/right/command'] button");
    page.wait_until("document.querySelectorAll('.strip').length >= 7");
    take_pictures(&mut page, "live-arms");
    vanish(&mut page);
    assert_clean(&mut page, "the live page of arms");
    drop(page);
    shown.end();
}

/// What comes of opening the socket from the page that is shown.
fn looked_on(page: &mut Page<'_>, port: &str) -> Value {
    page.value(&format!(
        "new Promise(done => {{ const socket = new WebSocket('ws://127.0.0.1:{port}', 'foxglove.sdk.v1'); \
         socket.onmessage = () => done('looks on'); socket.onerror = () => done('refused'); }})"
    ))
}

#[test]
fn a_browser_gets_our_page_to_the_socket_and_no_other() {
    let Some(lab) = with_the_cable_pulled() else {
        return;
    };
    let host = lab.host(0);
    let Some(mut browser) = Browser::start_on_or_skip(host) else {
        return;
    };
    let folder = RunFolder::new("browser-foreign");
    let unknown = folder.join("no-run-is-called-so");
    let free = ["--port", "0", "--http-port", "0"];
    let (mut recorder, own) = serve(&unknown, host, &free);
    let said = recorder.stdout_so_far();
    let port = said.trim_end().rsplit(':').next().unwrap().to_owned();
    let (_other, foreign) = serve(&unknown, host, &free);
    let file = folder.join("foreign.html");
    std::fs::write(&file, "<!doctype html><title>foreign</title>").unwrap();
    let mut page = browser.page(DESKTOP.0, DESKTOP.1);
    page.go(&own);
    assert_eq!(looked_on(&mut page, &port), "looks on");
    let by_name = own.replace("127.0.0.1", "localhost");
    for other in [foreign, by_name, format!("file://{}", file.display())] {
        page.go(&other);
        assert_eq!(looked_on(&mut page, &port), "refused", "{other}");
    }
    recorder.signal(Signal::SIGINT).unwrap();
    let finished = recorder.wait_within(LIMIT).unwrap();
    assert!(
        finished.stderr.contains("a page without an origin"),
        "{finished:?}"
    );
}

fn made_report(trial: &Trial, started: &mut ChildGuard, output: &Path) {
    started.wait_within(LIMIT).unwrap().assert_success();
    let root = trial.folder("", LIMIT).root().to_owned();
    let mut command = Command::new(hil_runtime_binary());
    command.arg("report").arg(root).arg("-o").arg(output);
    run(&mut command, LIMIT).unwrap();
}

fn look_at_report(browser: &mut Browser, report: &Path, name: &str) {
    let mut page = browser.page(DESKTOP.0, DESKTOP.1);
    page.go(&format!("file://{}", report.display()));
    let timing = "performance.getEntriesByType('navigation')[0].loadEventEnd";
    page.wait_until(&format!("{timing} > 0"));
    let loaded_ms = number(&mut page, timing);
    let elements = number(&mut page, "document.getElementsByTagName('*').length");
    eprintln!("{name}: loaded after {loaded_ms:.0} ms, {elements} elements");
    assert!(elements < ELEMENT_COUNT_MAX, "{name}: {elements} elements");
    let figures = "[...document.querySelectorAll('table.figures td.n')]\
                   .filter(cell => /[0-9]/.test(cell.textContent)).length";
    assert!(
        number(&mut page, figures) >= 10.0,
        "{name}: tables have numbers"
    );
    let drawings: Value = page.value("document.querySelectorAll('svg.figure path').length");
    assert!(
        drawings.as_u64().unwrap() > 5,
        "{name}: {drawings} lines drawn"
    );
    take_pictures(&mut page, name);
    assert_clean(&mut page, name);
    check_on_paper(&mut page, name);
}

/// What is folded on the screen.
const FOLDED: &str = "details";

/// Paper cannot be unfolded: what is folded is printed whole, by the style alone and by the script where a
/// browser does not know that style, and is folded again afterwards.
fn check_on_paper(page: &mut Page<'_>, name: &str) {
    // A quiet run has few rows and warnings, and folds nothing: one more part, so that there is always one.
    page.value(
        "document.querySelector('main, body').insertAdjacentHTML('beforeend', '<details><summary>added</summary>\
         <div>' + [...Array(300).keys()].map(row => `<p>row ${row} of ${row * row}</p>`).join('') + \
         '</div></details>')",
    );
    let parts = format!("[...document.querySelectorAll('{FOLDED} > :not(summary)')]");
    let all = number(page, &format!("{parts}.length"));
    assert!(all > 0.0, "{name}: nothing is folded");
    let visible = format!("{parts}.filter(one => one.checkVisibility()).length");
    assert_eq!(number(page, &visible).to_bits(), 0.0_f64.to_bits());
    page.set_paper(true);
    settle(page);
    assert_eq!(number(page, &visible).to_bits(), all.to_bits(), "{name}");
    let open = "document.querySelectorAll('details[open]').length === 0";
    assert_eq!(page.value(open), true, "{name}: by the style alone");
    page.set_paper(false);
    keep(page, "foldedOnPaper", "[]");
    page.value(
        "addEventListener('beforeprint', () => foldedOnPaper.push(\
         document.querySelectorAll('details:not([open])').length))",
    );
    let whole = page.printed().len();
    assert_eq!(
        page.value("foldedOnPaper"),
        serde_json::json!([0]),
        "{name}"
    );
    page.wait_until(open);
    page.value(&format!("{parts}.forEach(one => one.remove())"));
    let without = page.printed().len();
    eprintln!("{name}: {all} folded parts, {whole} bytes printed, {without} without them");
    assert!(whole > without + 500, "{name}: {whole} and {without} bytes");
}

#[test]
fn reports_of_fleet_and_arms_open_without_a_complaint() {
    let Some(lab) = with_the_cable_pulled() else {
        return;
    };
    let Some(mut browser) = Browser::start_on_or_skip(lab.host(0)) else {
        return;
    };
    let fleet = RunFolder::new("browser-report-fleet");
    let arms = RunFolder::new("browser-report-arms");
    let trials = [
        Trial::shipped("fleet-emulated.toml", fleet.path())
            .set("case.parameters.fleets=1")
            .on_own_ports(&["commands", "states"]),
        Trial::shipped("emulated.toml", arms.path()).on_own_ports(&["hop"]),
    ];
    let trials = trials.map(|trial| trial.set("run.duration=\"6 s\""));
    let mut runs = trials.each_ref().map(Trial::start_here);
    let pages = [&fleet, &arms].map(|folder| folder.join("report.html"));
    for (index, page) in pages.iter().enumerate() {
        made_report(&trials[index], &mut runs[index], page);
    }
    for (page, name) in pages.iter().zip(["report-fleet", "report-arms"]) {
        look_at_report(&mut browser, page, name);
    }
}
