//! `hil-runtime top`: a running run at a glance, on a terminal until `q`, or once as plain text.

mod draw;
mod gather;
mod robot;
mod screen;
mod view;

use std::io::{self, IsTerminal};

use super::cli::TopArgs;
use super::observer::{ObserveError, Observer};
use hil_platform::console::{CommandEnd, Console};
use hil_platform::signals::Signals;
use hil_topology::registry::Registry;

pub(crate) use gather::via;
use robot::RobotWatch;

/// Why there is no view.
#[derive(Debug, thiserror::Error)]
pub enum TopError {
    /// The run.
    #[error(transparent)]
    Observe(#[from] ObserveError),
    /// The terminal.
    #[error("cannot use this terminal: {0}; --once prints plain text")]
    Terminal(#[source] io::Error),
    /// A view that is no JSON.
    #[error("cannot write the view: {0}")]
    Json(#[from] serde_json::Error),
}

/// Shows the run until the user leaves or it ends; once where nobody looks at a terminal.
///
/// # Errors
/// When no run can be found, or the terminal cannot be written.
pub fn run(
    args: &TopArgs,
    columns: usize,
    registry: &Registry,
    signals: &Signals,
    console: &mut Console,
) -> Result<CommandEnd, TopError> {
    let mut observer = Observer::open(args.run.as_deref(), registry)?;
    observer.count_all_unrecorded();
    let case = observer
        .topology()
        .and_then(|topology| registry.make_case(topology).ok()?);
    let events = case.and_then(|(_, case)| case.live_events());
    let records = observer.run().run_folder().records();
    let robot = events.map(|events| RobotWatch::new(&records, events));
    let mut gatherer = gather::Gatherer::of(robot);
    let settling = observer.longest_settling();
    observer.poll_for_beside(settling, signals, &mut || gatherer.read());
    // What processes used is a difference of two looks.
    gatherer.look(&observer, args.window);
    if !args.json && !args.once && io::stdout().is_terminal() {
        return screen::run(observer, gatherer, args.window, signals).map_err(TopError::Terminal);
    }
    loop {
        let is_whole = observer.poll_for_beside(args.window, signals, &mut || gatherer.read());
        observer.trim(args.window);
        let view = gatherer.look(&observer, args.window);
        let text = if args.json {
            format!("{}\n", serde_json::to_string(&view)?)
        } else {
            draw::plain(&view, columns)
        };
        let is_heard = console.result(&text);
        if !is_whole {
            return Ok(CommandEnd::Interrupted);
        }
        if args.once || !args.json || !is_heard || observer.is_over() {
            return Ok(CommandEnd::Done);
        }
    }
}
