//! Claims about the accounts of a finished run that several tests make. It starts nothing and
//! reads no file.

use std::fmt::Write;

use hil_account::{ChannelAccount, ClosingMetrics, MessageFate, RESIDUAL_LIMIT_NS};
use hil_report::summary::{ChannelSummary, LinkKind, RunSummary};

/// Share of messages whose account must close.
pub const CLOSED_RATIO_MIN: f64 = 0.999;
/// Share of messages that must carry each software stamp.
pub const STAMPED_RATIO_MIN: f64 = 0.99;

/// Fates that explain nothing: with the records of all hosts at hand none may occur.
const UNEXPLAINED: [MessageFate; 3] = [
    MessageFate::Unexplained,
    MessageFate::UnknownPeerRecordsUnavailable,
    MessageFate::RefusedAtIngress,
];

/// The channels that carry messages to someone: the others have no account.
pub fn carried(summary: &RunSummary) -> impl Iterator<Item = &ChannelSummary> {
    let channels = summary.channels.iter();
    channels.filter(|channel| channel.link != LinkKind::RecordOnly)
}

/// The channel called `name`.
///
/// # Panics
/// When the summary has no such channel.
pub fn channel<'a>(summary: &'a RunSummary, name: &str) -> &'a ChannelSummary {
    let found = summary.channels.iter().find(|one| one.name == name);
    found.unwrap_or_else(|| panic!("{} has no channel {name}", summary.run.name))
}

/// The account of the channel called `name`.
///
/// # Panics
/// When there is none.
pub fn account<'a>(summary: &'a RunSummary, name: &str) -> &'a ChannelAccount {
    let account = channel(summary, name).account.as_ref();
    account.unwrap_or_else(|| panic!("{name} has no account"))
}

/// Checks that every message of every channel has a fate, and one that explains it.
///
/// # Panics
/// With the fates when one has not.
pub fn assert_every_message_is_accounted_for(summary: &RunSummary) {
    for channel in carried(summary) {
        let account = account(summary, &channel.name);
        let said = describe(&channel.name, account);
        assert!(account.published_count > 0, "{said}");
        assert_eq!(account.fates.total(), account.published_count, "{said}");
        for fate in UNEXPLAINED {
            assert_eq!(account.fates.of(fate), 0, "{fate:?} in {said}");
        }
    }
}

/// Checks that the segments of at least 99.9 % of the taken messages add up to within 1 µs.
///
/// # Panics
/// With the figures when they do not.
pub fn assert_accounts_close(summary: &RunSummary) {
    for channel in carried(summary) {
        assert_account_closes(summary, &channel.name);
    }
}

/// The same of the channel called `name`.
///
/// # Panics
/// With the figures when it does not close.
pub fn assert_account_closes(summary: &RunSummary, name: &str) {
    let account = account(summary, name);
    let said = describe(name, account);
    let closing = closing(name, account);
    assert_eq!(closing.residual_limit_ns, RESIDUAL_LIMIT_NS, "{said}");
    assert_eq!(RESIDUAL_LIMIT_NS, 1_000);
    let taken_count = account.fates.of(MessageFate::Taken);
    assert_eq!(closing.checked_count, taken_count, "{said}");
    let ratio = closing.closed_ratio().unwrap_or(0.0);
    assert!(ratio >= CLOSED_RATIO_MIN, "{ratio} closed in {said}");
}

/// The closing check of an account on one clock.
///
/// # Panics
/// When it was not checked.
pub fn closing<'a>(name: &str, account: &'a ChannelAccount) -> &'a ClosingMetrics {
    let checked = account.closing.checked();
    checked.unwrap_or_else(|| panic!("{name} was not checked: {:?}", account.closing))
}

/// Checks that more than 99 % of the messages of a gateway's channel carry the kernel's software
/// stamps, at both ends.
///
/// # Panics
/// With the coverage when they do not.
pub fn assert_both_ends_are_stamped(name: &str, account: &ChannelAccount) {
    let coverage = &account.coverage;
    for (end, coverage) in [
        ("transmit", coverage.tx_software),
        ("receive", coverage.rx_software),
    ] {
        let ratio = coverage.and_then(|coverage| coverage.ratio());
        assert!(
            ratio.is_some_and(|ratio| ratio > STAMPED_RATIO_MIN),
            "{end} stamps of {name}: {coverage:?}"
        );
    }
}

/// The figures of an account in one line, for the output of a test.
pub fn describe(name: &str, account: &ChannelAccount) -> String {
    let mut text = format!("{name}: {} published", account.published_count);
    for (fate, count) in account.fates.iter() {
        append(&mut text, format_args!(", {count} {fate:?}"));
    }
    if let Some(closing) = account.closing.checked() {
        let residual_max_ns = closing.residual.measured().map(|residual| residual.max_ns);
        append(
            &mut text,
            format_args!(
                "; closes for {} of {}, largest residual {residual_max_ns:?} ns, missing stages \
                 {}, negative segments {}",
                closing.closed_count,
                closing.checked_count,
                closing.missing_stage_count,
                closing.negative_segment_count
            ),
        );
    }
    for (end, coverage) in [
        ("TX", account.coverage.tx_software),
        ("RX", account.coverage.rx_software),
    ] {
        if let Some(ratio) = coverage.and_then(|coverage| coverage.ratio()) {
            append(
                &mut text,
                format_args!("; {end} stamps {:.2} %", ratio * 100.0),
            );
        }
    }
    if let Some(summary) = account.end_to_end.distribution.measured() {
        let microseconds = |ns: i64| ns / 1000;
        append(
            &mut text,
            format_args!(
                "; end to end p50 {} µs, p99 {} µs, max {} µs",
                microseconds(summary.p50_ns),
                microseconds(summary.p99_ns),
                microseconds(summary.max_ns)
            ),
        );
    }
    text
}

fn append(text: &mut String, arguments: std::fmt::Arguments<'_>) {
    let _infallible = text.write_fmt(arguments);
}
