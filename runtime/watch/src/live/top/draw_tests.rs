//! `top` drawn from a made-up run: exact pages at several widths, on a terminal that is none.

use std::path::PathBuf;

use ratatui::Terminal;
use ratatui::backend::TestBackend;

use super::*;
use crate::live::top::view::{
    ClockRow, LinkRow, LinkState, PeerStatusRow, RunState, RunView, SegmentRow,
};
use hil_rundir::event::ProcessKind;
use hil_rundir::status::{HostHearing, ProcessState};

fn quantiles(p50_ns: i64, p99_ns: i64) -> Quantiles {
    Quantiles { p50_ns, p99_ns }
}

fn process(name: &str, state: ProcessState, restart_count: u32) -> ProcessRow {
    let is_running = state == ProcessState::Running;
    ProcessRow {
        name: name.to_owned(),
        host: "control-pc".to_owned(),
        kind: ProcessKind::Component,
        role: Some(name.to_owned()),
        state,
        pid: is_running.then_some(4711),
        cpu_ratio: is_running.then_some(0.0312),
        cpus: is_running.then(|| "1".to_owned()),
        scheduling: is_running.then(|| "fifo 40".to_owned()),
        overrun_count: is_running.then_some(2),
        restart_count,
    }
}

fn heard(host: &str, silent_s: Option<f64>, overruns: &[(&str, u64)]) -> PeerStatusRow {
    let overruns = overruns.iter();
    PeerStatusRow {
        hearing: HostHearing {
            host: host.to_owned(),
            is_heard: silent_s.is_some_and(|silent_s| silent_s < 3.0),
            silent_s,
            left_out_count: usize::from(host == "camera-pc"),
        },
        overruns: overruns
            .map(|(name, count)| ((*name).to_owned(), *count))
            .collect(),
    }
}

fn peer_status_rows() -> Vec<PeerStatusRow> {
    vec![
        heard("robot-pc", Some(0.4), &[]),
        heard("camera-pc", Some(0.4), &[("tracker", 12), ("writer", 3)]),
        heard("spare-pc", Some(7.2), &[("robot", 4)]),
        heard("late-pc", None, &[]),
    ]
}

fn view() -> View {
    let segment = |name: &str, time| SegmentRow {
        name: name.to_owned(),
        time,
    };
    View {
        run: RunView {
            name: "teleop-1".to_owned(),
            folder: PathBuf::from("/runs/teleop-1"),
            hosts_here: vec!["control-pc".to_owned()],
            state: RunState::Running,
            elapsed_s: Some(15.0),
            duration_s: Some(60.0),
            window_s: 1.0,
        },
        processes: vec![
            process("controller", ProcessState::Running, 1),
            process(
                "human",
                ProcessState::Ended("killed by signal 9".to_owned()),
                0,
            ),
        ],
        elsewhere: peer_status_rows(),
        channels: vec![
            ChannelRow {
                name: "egm/right/command".to_owned(),
                via: "hop".to_owned(),
                rate_hz: Some(249.96),
                lost_count: Some(3),
                delay: Some(quantiles(310_000, 1_250_000)),
                why_no_delay: None,
                bound_ns: Some(12_000),
                segments: vec![
                    segment(
                        "published → taken by gateway",
                        Some(quantiles(21_000, 80_000)),
                    ),
                    segment("TX stamp → RX stamp", None),
                ],
                history_ns: vec![Some(1_000), None, Some(500), Some(800), Some(0)],
            },
            ChannelRow {
                name: "egm/right/feedback".to_owned(),
                via: "hop".to_owned(),
                rate_hz: None,
                lost_count: None,
                delay: None,
                why_no_delay: Some("clocks not aligned".to_owned()),
                bound_ns: None,
                segments: Vec::new(),
                history_ns: Vec::new(),
            },
        ],
        links: vec![LinkRow {
            name: "hop".to_owned(),
            via: "emulated".to_owned(),
            state: LinkState::Carries,
            condition: Some("delay 2 ms, loss 1 %".to_owned()),
            loss_ratio: Some(0.012),
        }],
        clocks: vec![ClockRow {
            from: "control-pc".to_owned(),
            to: "robot-pc".to_owned(),
            rung: "exchanges beside the data".to_owned(),
            exchange_count: Some(204),
            offset_ns: Some(-1_500_000),
            bound_ns: Some(12_000),
        }],
        problems: vec!["x.rec: cut short".to_owned()],
    }
}

/// The page that a terminal of this size shows.
fn on_terminal(columns: u16, rows: u16, frame: Frame) -> String {
    let mut terminal = Terminal::new(TestBackend::new(columns, rows)).unwrap();
    let view = view();
    terminal
        .draw(|page| draw(&view, frame, page.area(), page.buffer_mut()))
        .unwrap();
    let buffer = terminal.backend().buffer();
    let row = |y: u16| {
        let cells = (0..columns).map(|x| buffer[(x, y)].symbol());
        cells.collect::<String>().trim_end().to_owned()
    };
    (0..rows).map(|y| row(y) + "\n").collect()
}

const CHOSEN_SECOND: Frame = Frame {
    detail: Detail::Chosen(1),
    is_paused: true,
    shows_help: false,
};

/// Holds `page` against the file; `HIL_BLESS=1` writes it.
fn check_golden(page: &str, file: &str, expected: &str) {
    if std::env::var_os("HIL_BLESS").is_some() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/src/live/top");
        std::fs::write(format!("{folder}/{file}"), page).unwrap();
        return;
    }
    assert_eq!(page, expected, "{page}");
}

#[test]
fn plain_text_of_a_hundred_columns_has_every_segment() {
    let page = plain(&view(), 100);
    check_golden(&page, "draw_100.txt", include_str!("draw_100.txt"));
}

#[test]
fn a_narrow_page_cuts_its_rows() {
    let page = plain(&view(), 60);
    check_golden(&page, "draw_60.txt", include_str!("draw_60.txt"));
    assert!(page.lines().all(|row| row.chars().count() <= 60));
}

#[test]
fn a_terminal_shows_the_chosen_channel_and_the_keys() {
    let page = on_terminal(120, 24, CHOSEN_SECOND);
    check_golden(&page, "draw_120x24.txt", include_str!("draw_120x24.txt"));
}

#[test]
fn what_the_links_do_stands_above_the_channels() {
    let page = plain(&view(), 100);
    let place = |words: &str| page.find(words).unwrap();
    assert!(
        place("delay 2 ms, loss 1 %") < place("egm/right/command"),
        "{page}"
    );
}

#[test]
fn a_low_terminal_keeps_the_chosen_channel_in_sight() {
    for rows in [6, 9, 12] {
        let page = on_terminal(80, rows, CHOSEN_SECOND);
        assert!(page.contains("egm/right/feedback"), "{rows}:\n{page}");
        assert!(page.starts_with("teleop-1  running"), "{rows}:\n{page}");
        assert!(page.contains("more rows"), "{rows}:\n{page}");
    }
    // Too low for anything, and no panic.
    for rows in 1..6 {
        on_terminal(20, rows, CHOSEN_SECOND);
    }
}

#[test]
fn a_run_that_is_over_keeps_its_last_figures_and_says_so() {
    let mut over = view();
    over.run.state = RunState::Ended;
    let page = plain(&over, 100);
    assert!(page.contains("ended"), "{page}");
    assert!(page.contains("over; the figures are the last"), "{page}");
    assert!(
        page.contains("egm/right/command") && page.contains("4711"),
        "{page}"
    );
    over.run.elapsed_s = None;
    let page = plain(&over, 100);
    assert!(
        page.contains("\n  over\n") && !page.contains("not begun"),
        "{page}"
    );
}

#[test]
fn the_help_names_the_keys() {
    let frame = Frame {
        shows_help: true,
        ..CHOSEN_SECOND
    };
    let page = on_terminal(80, 20, frame);
    for word in ["Keys", "space", "choose the channel", "Figures"] {
        assert!(page.contains(word), "{page}");
    }
}
