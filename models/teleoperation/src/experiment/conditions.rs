//! The conditions of the motion-loss table: channel, robot and policy of each. It runs nothing.

use core::time::Duration;

use crate::experiment::drive::{Channel, Sending, Setup};
use crate::{SendPolicy, Teleoperation};
use hil_arm::egm::parameters::{ControllerSettings, QueuePolicy, RestartPolicy};
use hil_link::outages::Outages;
use hil_link::wifi::WifiPreset;

/// One row of the table.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Condition {
    /// Short name, also for the filter.
    pub(crate) name: &'static str,
    /// Channel and what differs from the case's settings, in words.
    pub(crate) text: String,
    pub(crate) setup: Setup,
    pub(crate) expected: Expected,
}

/// What a row is held against.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Expected {
    /// Not a single loop lost, as published over Ethernet, and no session ended.
    Ethernet,
    /// Not a single loop lost; and no session ended, if so.
    NothingLost { nor_tripped: bool },
    /// A published motion loss rate: so many of the published loops, and the range for the mean.
    Published {
        lost: u32,
        mean_low: f64,
        mean_high: f64,
    },
    /// Nothing.
    Open,
}

/// Loops the seed paper played.
pub(crate) const PUBLISHED_LOOPS: u32 = 890;

/// Outages of the short range: they reproduce the published 0.008.
pub(crate) const SHORT_RANGE: Outages = Outages {
    mean_s: 0.5,
    per_hour: 100.0,
    buffered: false,
};

/// Outages of the long range: as long, three times as many; they reproduce the published 0.03.
pub(crate) const LONG_RANGE: Outages = Outages {
    mean_s: 0.5,
    per_hour: 300.0,
    buffered: false,
};

/// Loops lost over the short range: 0.008 of those played.
pub(crate) const SHORT_RANGE_LOST: u32 = 7;

/// Over the long range: 0.03.
pub(crate) const LONG_RANGE_LOST: u32 = 27;

/// 0.008 of the loops, and where our mean must lie.
const SHORT_RANGE_PUBLISHED: Expected = Expected::Published {
    lost: SHORT_RANGE_LOST,
    mean_low: 0.006,
    mean_high: 0.011,
};

/// 0.03 of the loops.
const LONG_RANGE_PUBLISHED: Expected = Expected::Published {
    lost: LONG_RANGE_LOST,
    mean_low: 0.022,
    mean_high: 0.035,
};

/// Longer than any run.
const NEVER_S: f64 = 1e6;

/// The robot of the case with a change.
pub(crate) fn changed(base: &Setup, change: impl FnOnce(&mut Setup)) -> Setup {
    let mut setup = *base;
    change(&mut setup);
    setup
}

/// A session that nothing ends: the arm holds until commands are back.
pub(crate) fn without_time_out(settings: &mut ControllerSettings) {
    settings.comm_timeout_s = NEVER_S;
    settings.condition_time_s = NEVER_S;
}

/// The program waits so long in all until guided motion runs again.
pub(crate) fn back_after(settings: &mut ControllerSettings, reactivation_s: f64) {
    settings.restart = RestartPolicy::WaitThenRestart;
    settings.activation_s = settings.activation_s.min(reactivation_s);
    settings.restart_wait_s = reactivation_s - settings.activation_s;
}

/// What all rows start from: the robot of the case, with what the controller asks for.
pub(crate) fn base(case: &Teleoperation) -> Setup {
    let parameters = &case.parameters;
    let asked_for = parameters.egm_start.message();
    let nanoseconds = |duration| hil_core::time::duration_ns(duration);
    Setup {
        settings: case
            .settings
            .with(&asked_for)
            .expect("what is asked for was checked with the parameters"),
        channel: Channel::Perfect,
        sending: match parameters.send {
            SendPolicy::Frame => Sending::Frame,
            SendPolicy::Coupled => Sending::Coupled,
            SendPolicy::Free => {
                let period = Duration::from_secs_f64(1.0 / parameters.send_hz());
                Sending::Free(nanoseconds(period))
            }
        },
        trigger_after_ns: nanoseconds(Duration::from_secs_f64(parameters.trigger_after_s)),
    }
}

/// All rows.
pub(crate) fn conditions(base: &Setup) -> Vec<Condition> {
    let mut rows = static_rows(base);
    rows.extend(outage_rows(base));
    rows.extend(wifi_rows(base));
    rows.extend(queue_rows(base));
    rows.extend(policy_rows(base));
    rows
}

fn row(name: &'static str, text: impl Into<String>, setup: Setup, expected: Expected) -> Condition {
    Condition {
        name,
        text: text.into(),
        setup,
        expected,
    }
}

/// The channels a static model can describe.
fn static_rows(base: &Setup) -> Vec<Condition> {
    let mut rows = vec![row("perfect", "perfect channel", *base, Expected::Ethernet)];
    let losses = [
        ("loss-0.01", 0.01),
        ("loss-0.1", 0.1),
        ("loss-0.3", 0.3),
        ("loss-0.5", 0.5),
    ];
    let expected = Expected::NothingLost { nor_tripped: false };
    for (name, ratio) in losses {
        let setup = changed(base, |setup| setup.channel = Channel::Loss(ratio));
        let text = format!("independent losses, ratio {ratio}");
        rows.push(row(name, text, setup, expected));
    }
    rows
}

fn text_of(outages: &Outages) -> String {
    let fate = if outages.buffered { "buffered " } else { "" };
    format!(
        "{fate}outages of {} s, {} per hour",
        outages.mean_s, outages.per_hour
    )
}

/// A row with outages and what else is changed; `note` is added to the text.
fn outage_row(
    base: &Setup,
    name: &'static str,
    outages: Outages,
    note: &str,
    expected: Expected,
    change: impl FnOnce(&mut Setup),
) -> Condition {
    let setup = changed(base, |setup| {
        setup.channel = Channel::Outages(outages);
        change(setup);
    });
    row(name, text_of(&outages) + note, setup, expected)
}

fn outage_rows(base: &Setup) -> [Condition; 4] {
    let range = |name, outages, expected| outage_row(base, name, outages, "", expected, |_| {});
    let hold = |name, per_hour| {
        let outages = Outages {
            mean_s: 2.0,
            per_hour,
            buffered: false,
        };
        outage_row(
            base,
            name,
            outages,
            "; no time-out",
            Expected::Open,
            |setup| {
                without_time_out(&mut setup.settings);
            },
        )
    };
    [
        range("short-range", SHORT_RANGE, SHORT_RANGE_PUBLISHED),
        range("long-range", LONG_RANGE, LONG_RANGE_PUBLISHED),
        hold("hold-30", 30.0),
        hold("hold-100", 100.0),
    ]
}

/// The Wi-Fi 6 model, whose outages were fitted to the published rates.
fn wifi_rows(base: &Setup) -> [Condition; 2] {
    let ranges = [
        (WifiPreset::ShortRange, SHORT_RANGE_PUBLISHED),
        (WifiPreset::LongRange, LONG_RANGE_PUBLISHED),
    ];
    ranges.map(|(preset, expected)| {
        let spec = preset.spec();
        let text = format!(
            "Wi-Fi 6 model, {} m; {}",
            spec.distance_m,
            text_of(&spec.outages)
        );
        let setup = changed(base, |setup| setup.channel = Channel::Wifi(preset));
        row(preset.name(), text, setup, expected)
    })
}

/// What the queue makes of messages that are late instead of lost.
fn queue_rows(base: &Setup) -> [Condition; 5] {
    let buffered = |name, note, change: fn(&mut Setup)| {
        let outages = Outages {
            buffered: true,
            ..SHORT_RANGE
        };
        outage_row(base, name, outages, note, Expected::Open, change)
    };
    let slow_cycle = |setup: &mut Setup| setup.settings.cycle = Duration::from_micros(4032);
    [
        buffered("buffered", "", |_| {}),
        buffered(
            "buffered-coupled-fifo1",
            "; one command per feedback, oldest first",
            |setup| {
                setup.sending = Sending::Coupled;
                setup.settings.queue = QueuePolicy::Fifo1;
            },
        ),
        buffered(
            "buffered-coupled-latest",
            "; one command per feedback, newest",
            |setup| {
                setup.sending = Sending::Coupled;
                setup.settings.queue = QueuePolicy::Latest;
            },
        ),
        row(
            "cycle-4032",
            "perfect channel; cycle of 4.032 ms",
            changed(base, slow_cycle),
            Expected::NothingLost { nor_tripped: true },
        ),
        row(
            "cycle-4032-free-250",
            "perfect channel; cycle of 4.032 ms, sender of 250 Hz, oldest first",
            changed(base, |setup| {
                slow_cycle(setup);
                setup.sending = Sending::Free(4_000_000);
                setup.settings.queue = QueuePolicy::Fifo1;
            }),
            Expected::Open,
        ),
    ]
}

/// The short range with other ways to come back.
fn policy_rows(base: &Setup) -> [Condition; 6] {
    let policy = |name, note, change: fn(&mut ControllerSettings)| {
        outage_row(base, name, SHORT_RANGE, note, Expected::Open, |setup| {
            change(&mut setup.settings);
        })
    };
    [
        policy("back-1s", "; back after 1 s", |s| back_after(s, 1.0)),
        policy("back-3s", "; back after 3 s", |s| back_after(s, 3.0)),
        policy("auto-retry", "; restart at once", |s| {
            s.restart = RestartPolicy::AutoRetry;
        }),
        policy("external-trigger", "; restart when asked", |s| {
            s.restart = RestartPolicy::ExternalTrigger;
        }),
        policy("go-home-first", "; home first", |s| {
            s.restart = RestartPolicy::GoHomeFirst;
        }),
        policy("gain-5", "; position gain 5 per s", |s| {
            s.position_gain_per_s = 5.0;
        }),
    ]
}
