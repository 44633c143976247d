//! `replay` of an MCAP file: hands over to `hil-recorder`, because what reads such files must not
//! get into the real-time binary.

use std::env;
use std::io;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;

use super::exit;
use crate::cli::arguments::ReplayArgs;
use crate::engine::process::own_program;
use crate::platform::console::Console;

/// The program that reads and plays recordings.
const PROGRAM: &str = "hil-recorder";

/// True when a recording is to be played, and not a run's robot to be run again.
pub(super) fn is_recording(args: &ReplayArgs) -> bool {
    let asks_to_play =
        !args.only.is_empty() || args.speed.is_some() || args.is_looped || args.into.is_some();
    let is_mcap = args.run.extension().is_some_and(|ending| ending == "mcap");
    asks_to_play || is_mcap || args.run.is_file()
}

/// Becomes `hil-recorder play`; returns only when that fails.
pub(super) fn play(args: &ReplayArgs, console: &mut Console) -> u8 {
    if args.run.is_dir() {
        console.error(&format!(
            "{} is a run's folder, which is run again as a whole; --only, --speed, --loop and --into \
             are for an MCAP file, which `{PROGRAM} convert` makes of it",
            args.run.display()
        ));
        return exit::USAGE;
    }
    let program = match recorder() {
        Ok(program) => program,
        Err(error) => {
            console.error(&format!(
                "{PROGRAM}, which reads MCAP files, is neither beside this program nor on the search \
                 path ({error}); build it with `cargo build --release -p {PROGRAM}`"
            ));
            return exit::FAILED;
        }
    };
    let error = command(&program, args).exec();
    console.error(&format!("cannot start {}: {error}", program.display()));
    exit::FAILED
}

fn command(program: &PathBuf, args: &ReplayArgs) -> Command {
    let mut command = Command::new(program);
    command.arg("play").arg(&args.run);
    for channel in &args.only {
        command.arg("--only").arg(channel);
    }
    if let Some(speed) = args.speed {
        command.arg("--speed").arg(speed.to_string());
    }
    if args.is_looped {
        command.arg("--loop");
    }
    if let Some(run) = &args.into {
        command.arg("--into").arg(run);
    }
    command
}

/// Beside this program, or where the shell would find it.
fn recorder() -> io::Result<PathBuf> {
    let beside = env::current_exe()?.with_file_name(PROGRAM);
    let beside = beside.to_string_lossy().into_owned();
    own_program::find(&beside).or_else(|_absent| own_program::find(PROGRAM))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_word_is_handed_on() {
        let args = ReplayArgs {
            run: PathBuf::from("a b.mcap"),
            json: false,
            only: vec!["x/y".to_owned(), "z".to_owned()],
            speed: Some(2.5),
            is_looped: true,
            into: Some("run-1".to_owned()),
        };
        let command = command(&PathBuf::from("/r"), &args);
        let words: Vec<_> = command
            .get_args()
            .map(|word| word.to_str().unwrap())
            .collect();
        assert_eq!(
            words,
            [
                "play", "a b.mcap", "--only", "x/y", "--only", "z", "--speed", "2.5", "--loop",
                "--into", "run-1"
            ]
        );
        assert!(is_recording(&args));
    }
}
