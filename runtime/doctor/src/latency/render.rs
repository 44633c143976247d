//! The measurement as text: what was measured and how, the figures side by side, what else went on,
//! what may be claimed.

use core::fmt::Write as _;

use super::claims;
use super::{Gaps, LatencyReport, Standing, Wakeups};
use crate::render::{Tone, mark, wrapped};
use hil_platform::host_facts::Fact;

impl LatencyReport {
    /// The measurement for a terminal.
    pub fn to_text(&self, has_colour: bool) -> String {
        let mut text = String::new();
        self.push_wakeups(&mut text);
        self.push_gaps(&mut text);
        self.push_surroundings(&mut text);
        self.push_claims(&mut text, has_colour);
        text
    }

    fn push_wakeups(&self, text: &mut String) {
        let (period, duration) = (self.period_ns as f64 / 1e6, self.duration_ns as f64 / 1e9);
        let ended = if self.is_interrupted {
            ", INTERRUPTED: this is what there was so far"
        } else {
            ""
        };
        push(
            text,
            &format!("Wake-ups: absolute sleeps of {period} ms for {duration} s{ended}"),
        );
        push(
            text,
            &row(
                "",
                [
                    "count",
                    "skipped",
                    "preempted",
                    "p50",
                    "p99",
                    "p99.9",
                    "max us",
                ],
            ),
        );
        for one in &self.wakeups {
            push(text, &wakeup_row(one));
        }
        for line in self.scheduling() {
            push_hanging(text, "  ", &line);
        }
    }

    /// How the threads ran, said once where they agree.
    fn scheduling(&self) -> Vec<String> {
        let mut lines: Vec<String> = Vec::new();
        for words in self.wakeups.iter().flat_map(|one| &one.scheduling) {
            if !lines.contains(words) {
                lines.push(words.clone());
            }
        }
        let (refused, granted): (Vec<String>, Vec<String>) = lines
            .into_iter()
            .partition(|line| line.contains(" refused"));
        let mut shown = Vec::new();
        if !granted.is_empty() {
            shown.push(granted.join(", "));
        }
        shown.extend(refused);
        shown
    }

    fn push_gaps(&self, text: &mut String) {
        if self.gaps.is_empty() {
            return;
        }
        let seconds = self.gaps.iter().map(|one| one.measured_ns).max();
        let seconds = seconds.unwrap_or(0) as f64 / 1e9;
        push(text, "");
        push(
            text,
            &format!(
                "Gaps over 10 us of a busy poller, {seconds:.1} s per CPU, one after the other"
            ),
        );
        push(
            text,
            &row(
                "",
                [
                    "gaps/s",
                    "ms/s lost",
                    "as throttle",
                    "p50",
                    "p99",
                    "p99.9",
                    "max us",
                ],
            ),
        );
        for one in &self.gaps {
            push(text, &gap_row(one));
        }
    }

    fn push_surroundings(&self, text: &mut String) {
        let around = &self.surroundings;
        let short = |load: &Fact<String>| {
            let words = load.to_text();
            words.split(' ').next().unwrap_or_default().to_owned()
        };
        let load = match (&around.load_before, &around.load_after) {
            (Fact::Available(_), Fact::Available(_)) => {
                format!(
                    "load {} to {}",
                    short(&around.load_before),
                    short(&around.load_after)
                )
            }
            (Fact::Unavailable(reason), _) | (_, Fact::Unavailable(reason)) => {
                format!("load unavailable ({reason})")
            }
        };
        let ticks = match &around.ticks {
            Fact::Available(ticks) => {
                let share = |part: u64| 100.0 * part as f64 / ticks.total.max(1) as f64;
                let busy = 100.0 - share(ticks.idle);
                format!(
                    "CPUs {busy:.0} % busy, this measurement included, steal {:.1} %",
                    share(ticks.steal)
                )
            }
            Fact::Unavailable(reason) => format!("steal time unavailable ({reason})"),
        };
        let machine = around.virtual_machine.to_text();
        push(text, "");
        push(
            text,
            &format!("Meanwhile: {load}; {ticks}; virtual machine: {machine}"),
        );
    }

    fn push_claims(&self, text: &mut String, has_colour: bool) {
        push(text, "");
        push(text, "What this host supports, as it is now");
        let width = self
            .claims
            .iter()
            .map(|one| one.claim.chars().count())
            .max();
        let width = width.unwrap_or(0);
        for claim in &self.claims {
            let (word, tone) = match claim.standing {
                Standing::Supportable => ("yes", Tone::Good),
                Standing::NotSupportable => ("no ", Tone::Bad),
                Standing::NotMeasured => ("?  ", Tone::Unknown),
            };
            let word = mark(word, tone, has_colour);
            let room = WIDTH.saturating_sub(7 + width + 2).max(30);
            for (index, line) in wrapped(&claim.why, room).iter().enumerate() {
                if index == 0 {
                    push(text, &format!("  {word}  {:width$}  {line}", claim.claim));
                } else {
                    push(text, &format!("       {:width$}  {line}", ""));
                }
            }
        }
        let mut rules: Vec<&str> = Vec::new();
        for claim in &self.claims {
            if !rules.contains(&claim.rule.as_str()) {
                rules.push(&claim.rule);
            }
        }
        push(text, "  Rules, in the order of the lines:");
        for rule in rules {
            push_hanging(text, "  - ", rule);
        }
    }
}

/// Columns of a page.
const WIDTH: usize = 100;

/// Wrapped words, all but the first line below the first word.
fn push_hanging(text: &mut String, lead: &str, words: &str) {
    let indent = lead.chars().count();
    for (index, line) in wrapped(words, WIDTH - indent).iter().enumerate() {
        let lead = if index == 0 { lead } else { "" };
        push(text, &format!("{lead:indent$}{line}"));
    }
}

fn push(text: &mut String, line: &str) {
    writeln!(text, "{}", line.trim_end()).expect("a string takes every write");
}

fn row(name: &str, cells: [&str; 7]) -> String {
    let mut line = format!("  {name:18}");
    for cell in cells {
        write!(line, "{cell:>12}").expect("a string takes every write");
    }
    line
}

fn place(cpu: Option<usize>) -> String {
    cpu.map_or("any CPU".to_owned(), |cpu| format!("CPU {cpu}"))
}

/// As the claims round, so that a figure is the same in both.
fn us(ns: i64) -> String {
    claims::us(ns).to_string()
}

const NONE: &str = "-";

fn wakeup_row(one: &Wakeups) -> String {
    let figures = one
        .lateness
        .map(|of| [of.p50_ns, of.p99_ns, of.p999_ns, of.max_ns].map(us));
    let [p50, p99, p999, max] = figures.unwrap_or_else(|| [NONE; 4].map(str::to_owned));
    let (count, skipped) = (one.count.to_string(), one.skipped_count.to_string());
    let preempted = one
        .preempted_count
        .map_or(NONE.to_owned(), |count| count.to_string());
    row(
        &place(one.cpu),
        [&count, &skipped, &preempted, &p50, &p99, &p999, &max],
    )
}

fn gap_row(one: &Gaps) -> String {
    let figures = one
        .length
        .map(|of| [of.p50_ns, of.p99_ns, of.p999_ns, of.max_ns].map(us));
    let [p50, p99, p999, max] = figures.unwrap_or_else(|| [NONE; 4].map(str::to_owned));
    let (rate, lost) = (
        format!("{:.0}", one.per_second()),
        format!("{:.1}", one.lost_ms_per_s()),
    );
    let throttled = one
        .throttle_like_count
        .map_or(NONE.to_owned(), |count| count.to_string());
    row(
        &place(one.cpu),
        [&rate, &lost, &throttled, &p50, &p99, &p999, &max],
    )
}
