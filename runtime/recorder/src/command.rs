//! What each command of the command line does, and the exit code it ends with.

use std::fs;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use clap::CommandFactory as _;
use hil_platform::console::Console;
use hil_platform::open_files;
use hil_platform::own_process;
use hil_platform::progress::Progress;
use hil_platform::signals::Signals;
use hil_platform::words::counted_plainly;
use hil_topology::documents;

use crate::cli::{Cli, Command, PlayOptions, RecordOptions};
use crate::convert::convert;
use crate::failure::{Exit, Failure};
use crate::play::{PlayEnd, play};
use crate::record::{Progress as RecordProgress, Recorded, record};
use crate::recover::{loss_words, recover};
use crate::serve::serve;
use crate::writer::{check_target, partial};

/// How long a conversion may take to end by itself after a signal.
const END_WITHIN: Duration = Duration::from_millis(400);

/// Does what the command line of this process says, and tells the exit code.
pub fn run() -> ExitCode {
    if let Err(error) = own_process::begin() {
        Console::new(false).error(&format!("cannot begin: {error}"));
        return ExitCode::from(Exit::Internal as u8);
    }
    let cli: Cli = match documents::command_line() {
        Ok(cli) => cli,
        Err(help) => {
            let mut console = Console::new(false);
            console.result(&help);
            return ExitCode::from(console.exit_code(Exit::Done as u8));
        }
    };
    let mut console = Console::new(cli.quiet);
    // A run and each viewer have files open; where the kernel refuses, the limit stays.
    let _is_raised = open_files::raise_limit().is_ok();
    let exit = match Signals::install() {
        Ok(signals) => work(cli.command, &signals, &mut console).unwrap_or_else(|failure| {
            console.error(&failure.words);
            failure.exit
        }),
        Err(error) => {
            console.error(&format!("cannot handle signals: {error}"));
            Exit::Internal
        }
    };
    ExitCode::from(console.exit_code(exit as u8))
}

fn work(command: Command, signals: &Signals, console: &mut Console) -> Result<Exit, Failure> {
    match command {
        Command::Convert {
            run,
            output,
            force,
            no_scene,
        } => {
            check_target(&output, &run, force).map_err(Failure::usage)?;
            convert_run(&run, &output, !no_scene, signals, console)
        }
        Command::Record(options) => record_run(&options, signals, console),
        Command::Recover {
            broken,
            output,
            force,
        } => {
            check_target(&output, &broken, force).map_err(Failure::usage)?;
            recover_file(&broken, &output, signals, console)
        }
        Command::Documents { folder } => match documents::write(Cli::command(), &folder) {
            Ok(_) => Ok(Exit::Done),
            Err(error) => Err(Failure::failed(format!("{}: {error}", folder.display()))),
        },
        Command::Serve(options) => serve(&options, signals, console),
        Command::Play(options) => play_file(&options, signals, console),
    }
}

fn convert_run(
    run: &Path,
    output: &Path,
    has_scene: bool,
    signals: &Signals,
    console: &mut Console,
) -> Result<Exit, Failure> {
    let progress = Progress::begin();
    // Much of the work is done in one piece, of a large run for seconds.
    let unfinished = partial(output);
    let ending = signals.end_program_after(END_WITHIN, move |signal| {
        let removed = fs::remove_file(&unfinished);
        match removed.err().filter(|_| unfinished.exists()) {
            Some(error) => {
                let path = unfinished.display();
                format!("ended by {signal}; what was written so far is in {path}: {error}")
            }
            None => format!("ended by {signal}; no file was written"),
        }
    });
    let converted = convert(run, output, has_scene, &mut |share, words| {
        progress.show(console, share, words);
        signals.received()
    });
    drop(ending);
    let gaps = "the run's folder has gaps, see above; the file says so too";
    tell(&converted?, "", gaps, console)
}

/// Says what was written, with `missed` behind it, and what of the run is not in it.
fn tell(
    recorded: &Recorded,
    missed: &str,
    gaps: &str,
    console: &mut Console,
) -> Result<Exit, Failure> {
    for words in &recorded.words {
        console.warn(words);
    }
    for (channel, count) in &recorded.missed {
        let count = counted_plainly(*count, "message");
        console.warn(&format!("{channel}: missed {count}"));
    }
    console.result(&format!(
        "{}, {} in all on {}{missed}\n",
        recorded.files(),
        recorded.written_count,
        counted_plainly(recorded.topic_count as u64, "topic")
    ));
    match recorded.signal {
        Some(_) => Ok(Exit::Interrupted),
        None if recorded.has_gaps => Err(Failure::failed(gaps)),
        None => Ok(Exit::Done),
    }
}

fn record_run(
    options: &RecordOptions,
    signals: &Signals,
    console: &mut Console,
) -> Result<Exit, Failure> {
    let recorded = record(options, &mut |progress| {
        console.progress(&progress_words(progress));
        signals.received()
    })?;
    let missed = format!("; missed {}", recorded.missed.values().sum::<u64>());
    let gaps = "something of the run is not in the file, see above; the file says so too";
    tell(&recorded, &missed, gaps, console)
}

fn progress_words(progress: &RecordProgress<'_>) -> String {
    if progress.run.is_empty() {
        return "waiting for a run".to_owned();
    }
    let file = match progress.file_count {
        1 => String::new(),
        count => format!("  file {count}"),
    };
    format!(
        "{}  {:.0} messages/s  {:.1} MiB{file}  missed {}",
        progress.run,
        progress.rate_hz,
        progress.size_bytes as f64 / f64::from(1 << 20),
        progress.missed_count
    )
}

fn recover_file(
    broken: &Path,
    output: &Path,
    signals: &Signals,
    console: &mut Console,
) -> Result<Exit, Failure> {
    let progress = Progress::begin();
    let size_bytes = fs::metadata(broken).map_or(0, |file| file.len());
    let recovered = recover(broken, output, &mut |offset| {
        let share = (size_bytes > 0).then(|| offset as f64 / size_bytes as f64);
        progress.show(console, share, &format!("{} MiB read", offset >> 20));
        signals.received()
    })?;
    for loss in &recovered.end.losses {
        console.warn(&format!("lost: {}", loss_words(loss)));
    }
    if recovered.homeless_count > 0 {
        let count = counted_plainly(recovered.homeless_count, "message");
        console.warn(&format!("lost: {count} whose topic is nowhere described"));
    }
    let lost = match recovered.lost_count() {
        Some(0) => "none is known to be lost".to_owned(),
        Some(count) => format!("{count} are known to be lost"),
        None => "how many were lost nobody counted".to_owned(),
    };
    console.result(&format!(
        "{}: {} in {:.3} s recovered; {lost}\n",
        output.display(),
        counted_plainly(recovered.message_count, "message"),
        recovered.span_s()
    ));
    Ok(Exit::Done)
}

fn play_file(
    options: &PlayOptions,
    signals: &Signals,
    console: &mut Console,
) -> Result<Exit, Failure> {
    Ok(match play(options, signals, console)? {
        PlayEnd::Done => Exit::Done,
        PlayEnd::Interrupted(signal) => {
            console.say(&format!("ended by {signal}"));
            Exit::Interrupted
        }
    })
}
