//! `hil-runtime channel`: which question is asked of which run, and the list of its channels.

use std::time::Duration;

use serde::Serialize;

use super::cli::{ChannelArgs, ChannelCommand, WindowArgs};
use super::observer::{ObserveError, Observer};
use super::top::via;
use super::{delay, echo, hz};
use hil_platform::console::{CommandEnd, Console};
use hil_platform::signals::Signals;
use hil_present::terminal::canvas::{Canvas, Style};
use hil_present::{Cell, Table, terminal};
use hil_rundir::layout::PathFault;
use hil_rundir::manifest::ChannelDescription;
use hil_shm::Census;
use hil_topology::registry::Registry;

/// Why a question has no answer.
#[derive(Debug, thiserror::Error)]
pub enum ChannelError {
    /// The run or the channel.
    #[error(transparent)]
    Observe(#[from] ObserveError),
    /// The field.
    #[error(transparent)]
    Field(#[from] PathFault),
    /// The fields of its messages.
    #[error("the fields of {channel} cannot be shown: {why}; --raw shows its bytes")]
    Layout {
        /// The channel.
        channel: String,
        /// What is wrong.
        why: String,
    },
    /// Nothing came where one answer was asked for.
    #[error("{channel}: {why} within {window_s} s")]
    Nothing {
        /// The channel.
        channel: String,
        /// What did not happen.
        why: &'static str,
        /// The window.
        window_s: f64,
    },
    /// The run ended before all that was asked for had come.
    #[error("{channel}: the run ended after {shown_count} of {wanted_count} messages")]
    Ended {
        /// The channel.
        channel: String,
        /// Shown.
        shown_count: u64,
        /// Asked for.
        wanted_count: u64,
    },
    /// The channel broke while the run went on.
    #[error("cannot read on: {0}")]
    Broken(#[source] hil_shm::ChannelError),
    /// An answer that is no JSON.
    #[error("cannot write JSON: {0}")]
    Json(#[from] serde_json::Error),
}

impl ChannelError {
    /// True when another command line would have had an answer.
    pub const fn is_usage(&self) -> bool {
        !matches!(
            self,
            Self::Nothing { .. } | Self::Ended { .. } | Self::Broken(_) | Self::Json(_)
        )
    }
}

/// The messages that an answer is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Scope {
    /// Those of the last window.
    Window,
    /// All of them.
    Total,
}

/// What is said of the messages of one scope.
pub(super) struct Said {
    pub(super) text: String,
    pub(super) message_count: u64,
}

/// Says what `answer` gives of each window, until one is enough, the run is over or a signal comes, and of
/// all messages then. What lies further back than `kept` is forgotten; `nothing` says what did not happen
/// where the only window has no message.
pub(super) fn by_windows(
    mut observer: Observer,
    args: &WindowArgs,
    kept: Duration,
    nothing: &'static str,
    signals: &Signals,
    console: &mut Console,
    answer: &mut dyn FnMut(&mut Observer, Scope) -> Result<Said, ChannelError>,
) -> Result<CommandEnd, ChannelError> {
    let mut told_count = 0;
    let mut tell = |observer: &Observer, console: &mut Console| {
        for problem in observer.problems().iter().skip(told_count) {
            console.warn(problem);
        }
        told_count = observer.problems().len();
    };
    tell(&observer, console);
    loop {
        let is_whole = observer.poll_for(args.window, signals);
        tell(&observer, console);
        let is_last = !is_whole || observer.is_over();
        if is_whole {
            let said = answer(&mut observer, Scope::Window)?;
            let is_heard = console.result(&said.text);
            if is_heard && args.once && said.message_count == 0 {
                return Err(ChannelError::Nothing {
                    channel: args.which.channel.clone(),
                    why: nothing,
                    window_s: args.window.as_secs_f64(),
                });
            }
            if !is_heard || args.once {
                return Ok(CommandEnd::Done);
            }
        }
        if is_last {
            console.result(&answer(&mut observer, Scope::Total)?.text);
            return Ok(end_of(is_whole));
        }
        observer.trim(kept);
    }
}

/// How a command ends whose last window is whole, or was cut short by a signal.
const fn end_of(is_whole: bool) -> CommandEnd {
    if is_whole {
        CommandEnd::Done
    } else {
        CommandEnd::Interrupted
    }
}

/// Answers.
///
/// # Errors
/// When the run or the channel cannot be found, or output cannot be written.
pub fn run(
    args: ChannelArgs,
    registry: &Registry,
    signals: &Signals,
    console: &mut Console,
) -> Result<CommandEnd, ChannelError> {
    let open = |run: Option<&str>| Observer::open(run, registry);
    match args.command {
        ChannelCommand::List { run, json, window } => {
            let observer = open(run.as_deref())?;
            Ok(list(observer, window, json, signals, console))
        }
        ChannelCommand::Hz(args) => {
            hz::run(open(args.which.run.as_deref())?, &args, signals, console)
        }
        ChannelCommand::Echo(args) => {
            echo::run(open(args.which.run.as_deref())?, &args, signals, console)
        }
        ChannelCommand::Delay(args) => {
            delay::run(open(args.which.run.as_deref())?, &args, signals, console)
        }
    }
}

/// One channel of the list.
#[derive(Debug, Serialize)]
struct Row {
    name: String,
    message: String,
    size_bytes: usize,
    is_typed: bool,
    from_host: Option<String>,
    to_host: Option<String>,
    via: String,
    rate_hz: Option<f64>,
    ends: Vec<HostEnds>,
}

/// Who has the channel open in the shared memory of one host.
#[derive(Debug, Serialize)]
struct HostEnds {
    host: String,
    writer_count: usize,
    reader_count: usize,
}

fn list(
    mut observer: Observer,
    window: Duration,
    is_json: bool,
    signals: &Signals,
    console: &mut Console,
) -> CommandEnd {
    let channels = observer.manifest().channels.clone();
    // Before this program becomes a reader of some.
    let ends: Vec<Vec<HostEnds>> = channels
        .iter()
        .map(|one| ends(&mut observer, one))
        .collect();
    observer.count_all_unrecorded();
    let is_whole = observer.poll_for(window, signals);
    let rows = channels.iter().zip(ends).map(|(one, ends)| {
        let topology = observer.topology();
        Row {
            name: one.name.clone(),
            message: one.message.clone(),
            size_bytes: one.size_bytes,
            is_typed: !one.fields.is_empty(),
            from_host: one.from_host.clone(),
            to_host: one.to_host.clone(),
            via: via(topology, topology.and_then(|all| all.channel(&one.name))),
            rate_hz: observer.rate_hz(&one.name),
            ends,
        }
    });
    let rows: Vec<Row> = rows.collect();
    let run = &observer.run().name;
    let text = if is_json {
        let all = serde_json::json!({ "run": run, "channels": rows });
        format!("{all}\n")
    } else {
        format!("{run}\n\n{}", table(&rows))
    };
    console.result(&text);
    for problem in observer.problems() {
        console.warn(problem);
    }
    end_of(is_whole)
}

fn ends(observer: &mut Observer, channel: &ChannelDescription) -> Vec<HostEnds> {
    let hosts: Vec<String> = observer.run().hosts().map(str::to_owned).collect();
    let is_end = |host: &String| {
        channel.from_host.as_ref() == Some(host) || channel.to_host.as_ref() == Some(host)
    };
    // What is only recorded is in no shared memory.
    let hosts = hosts
        .into_iter()
        .filter(|host| channel.to_host.is_some() && is_end(host));
    hosts
        .filter_map(|host| {
            let domain = observer.domain(&host).ok()?;
            let census = Census::of(domain, &channel.name).ok()?;
            Some(HostEnds {
                host,
                writer_count: census.writer_count,
                reader_count: census.reader_count,
            })
        })
        .collect()
}

fn table(rows: &[Row]) -> String {
    let columns = [
        "channel",
        "message",
        "bytes",
        "way",
        "via",
        "rate, Hz",
        "writers/readers",
    ];
    let mut table = Table::new("", &columns);
    for row in rows {
        let ends = row.ends.iter();
        let ends =
            ends.map(|end| format!("{}/{} on {}", end.writer_count, end.reader_count, end.host));
        let ends = ends.collect::<Vec<_>>().join(", ");
        table.push([
            row.name.as_str().into(),
            row.message.as_str().into(),
            Cell::Count(row.size_bytes as u64),
            way(row).into(),
            row.via.as_str().into(),
            Cell::number(row.rate_hz, 1),
            if ends.is_empty() {
                Cell::Missing
            } else {
                ends.into()
            },
        ]);
    }
    let mut canvas = Canvas::new(0, Style::Plain).with_whole_tables();
    terminal::table(&mut canvas, &table);
    canvas.finish()
}

fn way(row: &Row) -> String {
    let host = |host: &Option<String>| host.clone().unwrap_or_else(|| "?".to_owned());
    match &row.to_host {
        None => format!("{} → record", host(&row.from_host)),
        to => format!("{} → {}", host(&row.from_host), host(to)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_is_a_table_with_a_dash_for_what_is_not_known() {
        let row = |name: &str, to_host: Option<&str>| Row {
            name: name.to_owned(),
            message: "hil.X.v1".to_owned(),
            size_bytes: 16,
            is_typed: true,
            from_host: Some("a".to_owned()),
            to_host: to_host.map(str::to_owned),
            via: "hop".to_owned(),
            rate_hz: to_host.map(|_| 250.04),
            ends: to_host
                .map(|host| HostEnds {
                    host: host.to_owned(),
                    writer_count: 1,
                    reader_count: 2,
                })
                .into_iter()
                .collect(),
        };
        let rows = [row("x/command", Some("b")), row("truth", None)];
        assert_eq!(
            table(&rows),
            "  channel    message   bytes  way         via  rate, Hz  writers/readers\n  \
             x/command  hil.X.v1     16  a → b       hop     250.0  1/2 on b\n  \
             truth      hil.X.v1     16  a → record  hop         –  –\n"
        );
    }
}
