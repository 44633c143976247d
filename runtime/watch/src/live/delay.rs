//! `channel delay`: the latency account of a channel, window by window, as far as the records of
//! this host go.

use std::time::Duration;

use hil_account::{ChannelAccount, Closing, MessageFate, SegmentMetrics};
use hil_core::time::duration_ns;
use hil_stats::histogram::Distribution;
use serde_json::{Value, json};

use super::channel::{ChannelError, Said, Scope, by_windows};
use super::cli::WindowArgs;
use super::observer::{ClockFigures, Observer};
use hil_platform::console::{CommandEnd, Console};
use hil_platform::signals::Signals;
use hil_platform::text::grouped;
use hil_platform::words::counted;
use hil_present::terminal::canvas::Style;
use hil_present::terminal::render;
use hil_present::units::{duration, unsigned_duration};
use hil_present::{Section, Tone};
use hil_report::clock_summary::ClockRung;
use hil_report::quantile_table;

/// The totals reach back no further: they are of messages that are kept in memory.
const TOTAL_MAX: Duration = Duration::from_mins(10);

/// Width of an answer.
const COLUMNS: usize = 100;

pub(super) fn run(
    mut observer: Observer,
    args: &WindowArgs,
    signals: &Signals,
    console: &mut Console,
) -> Result<CommandEnd, ChannelError> {
    let name = observer.channel(&args.which.channel)?.name.clone();
    let settling = observer.longest_settling();
    observer.poll_for(settling, signals);
    let answer = &mut |observer: &mut Observer, of| {
        let window = match of {
            Scope::Window => args.window,
            Scope::Total => TOTAL_MAX,
        };
        let account = observer.account(&name, window);
        let hosts = observer.hosts_of(&name);
        let clock = hosts.map_or(ClockFigures::ONE_CLOCK, |(from, to)| {
            observer.clock(&from, &to)
        });
        Ok(Said {
            text: answer(&name, of, window, account.as_ref(), &clock, args.json)?,
            message_count: account.map_or(0, |account| account.published_count),
        })
    };
    let nothing = "no message was recorded here";
    by_windows(observer, args, TOTAL_MAX, nothing, signals, console, answer)
}

fn answer(
    channel: &str,
    of: Scope,
    window: Duration,
    account: Option<&ChannelAccount>,
    clock: &ClockFigures,
    is_json: bool,
) -> Result<String, ChannelError> {
    if is_json {
        let figures = account.map(|account| metrics(account, clock));
        let all = json!({
            "channel": channel,
            "of": of,
            "window_s": window.as_secs_f64(),
            "account": figures,
        });
        return Ok(format!("{}\n", serde_json::to_string(&all)?));
    }
    let of = match of {
        Scope::Total => "in all".to_owned(),
        Scope::Window => format!("the last {}", duration(duration_ns(window))),
    };
    let Some(account) = account else {
        return Ok(format!("{channel}, {of}: no message was recorded here\n"));
    };
    Ok(text(&format!("{channel}, {of}"), account, clock))
}

fn metrics(account: &ChannelAccount, clock: &ClockFigures) -> Value {
    let each = account.segments.iter();
    let segments: Vec<Value> = each
        .map(|segment| {
            let mut one = quantiles(&segment.distribution);
            one["from"] = json!(segment.from);
            one["to"] = json!(segment.to);
            one["is_combined"] = json!(segment.is_combined);
            one
        })
        .collect();
    let fates = account.fates.iter();
    let fates: serde_json::Map<String, Value> = fates
        .filter_map(|(fate, count)| {
            let name = serde_json::to_value(fate).ok()?;
            Some((name.as_str()?.to_owned(), count.into()))
        })
        .collect();
    let closing = match &account.closing {
        Closing::Checked(figures) => json!({
            "checked_count": figures.checked_count,
            "closed_count": figures.closed_count,
        }),
        Closing::Unavailable { reason } => json!({ "unavailable": reason }),
    };
    json!({
        "message_count": account.published_count,
        "fates": fates,
        "end_to_end": quantiles(&account.end_to_end.distribution),
        "bound_ns": account.end_to_end.alignment_bound_ns(),
        "clock": {
            "relation": match clock.rung {
                ClockRung::Exchanges => "exchanges",
                rung => rung.label(),
            },
            "exchange_count": clock.exchange_count,
            "offset_ns": clock.offset_ns,
        },
        "segments": segments,
        "closing": closing,
    })
}

fn quantiles(distribution: &Distribution) -> Value {
    match distribution {
        Distribution::Measured(summary) => json!({
            "count": summary.count,
            "min_ns": summary.min_ns,
            "p50_ns": summary.p50_ns,
            "p99_ns": summary.p99_ns,
            "p999_ns": summary.p999_ns,
            "max_ns": summary.max_ns,
        }),
        Distribution::Unavailable { reason } => json!({ "unavailable": reason }),
    }
}

fn text(head: &str, account: &ChannelAccount, clock: &ClockFigures) -> String {
    let mut section = Section::new("delay", head, counted(account.published_count, "message"));
    let fates = account.fates.iter().filter_map(|(fate, count)| {
        let words = match fate {
            MessageFate::Taken => return None,
            // The account speaks of runs that are over.
            MessageFate::InFlight => "still under way",
            fate => fate.label(),
        };
        Some(format!("{} {words}", grouped(count)))
    });
    let fates: Vec<String> = fates.collect();
    if !fates.is_empty() {
        section.fact("not taken", Tone::Plain, fates.join(", "));
    }
    let end_to_end = &account.end_to_end;
    section.fact(
        "clock",
        Tone::Plain,
        match (clock.rung, end_to_end.alignment_bound_ns()) {
            (ClockRung::OneClock, _) => "both ends read one clock".to_owned(),
            (_, Some(bound_ns)) => {
                let bound = unsigned_duration(bound_ns);
                let count = clock.exchange_count.unwrap_or(0);
                format!("within ±{bound}, by the {count} exchanges so far")
            }
            _ => "not aligned".to_owned(),
        },
    );
    section.fact(
        "closing",
        Tone::Plain,
        match &account.closing {
            Closing::Checked(closing) => format!(
                "{} of {} messages add up",
                grouped(closing.closed_count),
                grouped(closing.checked_count)
            ),
            Closing::Unavailable { reason } => format!("unavailable ({reason})"),
        },
    );
    let names: Vec<String> = account.segments.iter().map(SegmentMetrics::name).collect();
    let segments = names.iter().zip(&account.segments);
    let mut rows: Vec<_> = segments
        .map(|(name, one)| (name.as_str(), &one.distribution))
        .collect();
    rows.push((
        "published → taken by consumer, whole",
        &end_to_end.distribution,
    ));
    section.table(quantile_table(&rows));
    render(&[section], COLUMNS, Style::Plain)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hil_account::{AccountContext, ChannelPath, ChannelRecords, account};
    use hil_core::record::{PublishedRecord, TakenRecord, UNAVAILABLE};

    fn sample() -> ChannelAccount {
        let published: Vec<PublishedRecord> = (0..10)
            .map(|sequence| PublishedRecord {
                sequence,
                published_ns: 1_000_000 * sequence.cast_signed(),
                epoch: 1,
                reserved: 0,
            })
            .collect();
        let taken: Vec<TakenRecord> = published
            .iter()
            .filter(|one| one.sequence != 4)
            .map(|one| TakenRecord {
                sequence: one.sequence,
                published_ns: one.published_ns,
                forwarded_ns: UNAVAILABLE,
                taken_ns: one.published_ns + 20_000,
                epoch: 1,
                reserved: 0,
            })
            .collect();
        let records = ChannelRecords {
            published: Some(&published),
            taken: Some(&taken),
            ..ChannelRecords::default()
        };
        account(&records, &AccountContext::new(ChannelPath::SharedMemory))
    }

    #[test]
    fn a_page_has_a_row_per_segment_the_clock_and_the_closing() {
        let text = answer(
            "x",
            Scope::Window,
            Duration::from_secs(1),
            Some(&sample()),
            &ClockFigures::ONE_CLOCK,
            false,
        );
        let text = text.unwrap().replace('\u{a0}', " ");
        for words in [
            "x, the last 1.00 s  10 messages",
            "not taken     1 superseded at the consumer",
            "clock         both ends read one clock",
            "closing       9 of 9 messages add up",
            "p50      p99    p99.9      max",
            "published → taken by consumer         20.0 µs  20.0 µs  20.0 µs  20.0 µs  20.0 µs",
            "published → taken by consumer, whole  20.0 µs  20.0 µs  20.0 µs  20.0 µs  20.0 µs",
        ] {
            assert!(text.contains(words), "{words}: {text}");
        }
    }

    #[test]
    fn what_this_host_has_not_is_unavailable_with_the_reason() {
        let nothing = ChannelRecords::default();
        let path = ChannelPath::Gateway { alignment: None };
        let account = account(&nothing, &AccountContext::new(path));
        let clock = ClockFigures {
            rung: ClockRung::None,
            exchange_count: None,
            offset_ns: None,
            bound_ns: None,
        };
        let of_account = |account: Option<&ChannelAccount>, is_json| {
            let second = Duration::from_secs(1);
            answer("x", Scope::Total, second, account, &clock, is_json).unwrap()
        };
        let text = of_account(Some(&account), false);
        assert!(text.contains("unavailable: clocks not aligned"), "{text}");
        let json: Value = serde_json::from_str(&of_account(Some(&account), true)).unwrap();
        assert_eq!(
            json["account"]["end_to_end"]["unavailable"],
            "clocks not aligned"
        );
        assert!(json["account"]["bound_ns"].is_null());
        assert!(of_account(None, true).contains("\"account\":null"));
    }
}
