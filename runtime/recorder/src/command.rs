//! What each command of the command line does, and the exit code it ends with.

use std::fs;
use std::path::Path;
use std::process::ExitCode;

use clap::{CommandFactory as _, Parser};
use hil_platform::console::Console;
use hil_platform::progress::Progress;
use hil_platform::signals::{EXIT_INTERRUPTED, Signals};
use hil_platform::words::counted_plainly;
use hil_topology::documents;

use crate::cli::{Cli, Command, PlayOptions, ServeOptions};
use crate::convert::{ConvertError, convert};
use crate::ending::Ending;
use crate::play::{PlayEnd, PlayError, SourceError, TargetError, play};
use crate::record::{Progress as RecordProgress, RecordError, Request, Which, record};
use crate::recover::{RecoverError, loss_words, recover};
use crate::scan::ScanError;
use crate::serve::{ServeError, serve};
use crate::writer::{WriteError, check_target, partial};

/// Exit codes, as `--help` lists them; those of `hil-runtime`.
mod exit {
    pub(super) const DONE: u8 = 0;
    pub(super) const FAILED: u8 = 1;
    pub(super) const USAGE: u8 = 2;
    pub(super) const INTERNAL: u8 = 70;
}

/// Does what the command line of this process says, and tells the exit code.
pub fn run() -> ExitCode {
    let cli = Cli::parse();
    let mut console = Console::new(cli.quiet);
    let signals = match Signals::install() {
        Ok(signals) => signals,
        Err(error) => {
            console.error(&format!("cannot handle signals: {error}"));
            return ExitCode::from(exit::INTERNAL);
        }
    };
    ExitCode::from(work(cli.command, &signals, &mut console))
}

fn work(command: Command, signals: &Signals, console: &mut Console) -> u8 {
    match command {
        Command::Convert {
            run,
            output,
            force,
            no_scene,
        } => {
            if let Err(error) = check_target(&output, &run, force) {
                console.error(&error.to_string());
                return exit::USAGE;
            }
            convert_run(&run, &output, !no_scene, signals, console)
        }
        Command::Record {
            run,
            output,
            wait,
            below,
            from_now,
            split_size,
            flush,
            force,
            no_scene,
        } => {
            let request = Request {
                run: Which::Named(run),
                output,
                waits: wait,
                below,
                from_now,
                split_bytes: split_size,
                flush,
                force,
                has_scene: !no_scene,
            };
            record_run(&request, signals, console)
        }
        Command::Recover {
            broken,
            output,
            force,
        } => {
            if let Err(error) = check_target(&output, &broken, force) {
                console.error(&error.to_string());
                return exit::USAGE;
            }
            recover_file(&broken, &output, signals, console)
        }
        Command::Documents { folder } => write_documents(&folder, console),
        Command::Serve(options) => serve_run(&options, signals, console),
        Command::Play(options) => play_file(&options, signals, console),
    }
}

fn write_documents(folder: &Path, console: &mut Console) -> u8 {
    match documents::write(Cli::command(), folder) {
        Ok(_) => exit::DONE,
        Err(error) => {
            console.error(&format!("{}: {error}", folder.display()));
            exit::FAILED
        }
    }
}

fn serve_run(options: &ServeOptions, signals: &Signals, console: &mut Console) -> u8 {
    match serve(options, signals, console) {
        Ok(code) => u8::try_from(code).unwrap_or(exit::FAILED),
        Err(error) => {
            console.error(&error.to_string());
            match error {
                ServeError::Run(_)
                | ServeError::Select(_)
                | ServeError::Over { .. }
                | ServeError::Record(WriteError::Exists { .. } | WriteError::Unfinished { .. }) => {
                    exit::USAGE
                }
                _ => exit::FAILED,
            }
        }
    }
}

fn interrupted() -> u8 {
    u8::try_from(EXIT_INTERRUPTED).unwrap_or(exit::FAILED)
}

fn convert_run(
    run: &Path,
    output: &Path,
    has_scene: bool,
    signals: &Signals,
    console: &mut Console,
) -> u8 {
    let progress = Progress::begin();
    // Much of the work is done in one piece, of a large run for seconds.
    let ending = Ending::watch(signals, partial(output));
    let converted = convert(run, output, has_scene, &mut |share, words| {
        progress.show(console, share, words);
        signals.received()
    });
    drop(ending);
    match converted {
        Ok(converted) => {
            for words in &converted.words {
                console.warn(words);
            }
            console.result(&format!(
                "{}: {} of the run, {} in all on {}\n",
                output.display(),
                counted_plainly(converted.message_count, "message"),
                converted.written_count,
                counted_plainly(converted.topic_count as u64, "topic")
            ));
            if converted.has_gaps {
                console.error("the run's folder has gaps, see above; the file says so too");
                return exit::FAILED;
            }
            exit::DONE
        }
        Err(error) => {
            console.error(&error.to_string());
            match error {
                ConvertError::Run(_) => exit::USAGE,
                ConvertError::Write(_) => exit::FAILED,
                ConvertError::Interrupted(_) => interrupted(),
            }
        }
    }
}

fn record_run(request: &Request, signals: &Signals, console: &mut Console) -> u8 {
    let recorded = record(request, &mut |progress| {
        console.progress(&progress_words(progress));
        signals.received()
    });
    let recorded = match recorded {
        Ok(recorded) => recorded,
        Err(error) => {
            console.error(&error.to_string());
            return match error {
                RecordError::Select(_)
                | RecordError::NotYet(_)
                | RecordError::Write(WriteError::Exists { .. } | WriteError::Unfinished { .. }) => {
                    exit::USAGE
                }
                RecordError::Interrupted(_) => interrupted(),
                RecordError::Feed(_) | RecordError::Gone { .. } | RecordError::Write(_) => {
                    exit::FAILED
                }
            };
        }
    };
    for words in &recorded.words {
        console.warn(words);
    }
    for (channel, count) in &recorded.missed {
        let count = counted_plainly(*count, "message");
        console.warn(&format!("{channel}: missed {count}"));
    }
    let files: Vec<String> = recorded
        .paths
        .iter()
        .map(|path| path.display().to_string())
        .collect();
    console.result(&format!(
        "{}: {} of the run, {} in all on {}; missed {}\n",
        files.join(", "),
        counted_plainly(recorded.message_count, "message"),
        recorded.written_count,
        counted_plainly(recorded.topic_count as u64, "topic"),
        recorded.missed.values().sum::<u64>()
    ));
    if recorded.signal.is_some() {
        return interrupted();
    }
    if recorded.has_gaps {
        console.error("something of the run is not in the file, see above; the file says so too");
        return exit::FAILED;
    }
    exit::DONE
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

fn recover_file(broken: &Path, output: &Path, signals: &Signals, console: &mut Console) -> u8 {
    let progress = Progress::begin();
    let size_bytes = fs::metadata(broken).map_or(0, |file| file.len());
    let recovered = recover(broken, output, &mut |offset| {
        let share = (size_bytes > 0).then(|| offset as f64 / size_bytes as f64);
        progress.show(console, share, &format!("{} MiB read", offset >> 20));
        signals.received()
    });
    let recovered = match recovered {
        Ok(recovered) => recovered,
        Err(error) => {
            console.error(&error.to_string());
            return match error {
                RecoverError::Scan(ScanError::Foreign { .. }) => exit::USAGE,
                RecoverError::Interrupted(_) => interrupted(),
                _ => exit::FAILED,
            };
        }
    };
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
    exit::DONE
}

fn play_file(options: &PlayOptions, signals: &Signals, console: &mut Console) -> u8 {
    match play(options, signals, console) {
        Ok(PlayEnd::Done) => exit::DONE,
        Ok(PlayEnd::Interrupted(signal)) => {
            console.say(&format!("ended by {signal}"));
            interrupted()
        }
        Err(error) => {
            console.error(&error.to_string());
            match error {
                PlayError::Source(SourceError::Message { .. })
                | PlayError::Target(TargetError::Domain(_) | TargetError::Channel(_)) => {
                    exit::FAILED
                }
                PlayError::NoneChosen { .. } | PlayError::Source(_) | PlayError::Target(_) => {
                    exit::USAGE
                }
            }
        }
    }
}
