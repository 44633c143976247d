//! The help of every command of both programs, nested ones too: it shows how the command is used.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use hil_tests::binary::{hil_recorder_binary, hil_runtime_binary};
use hil_tests::child::{ChildGuard, Finished};

const LIMIT: Duration = Duration::from_mins(1);

/// A program with its name, as examples write it.
struct Program {
    path: &'static Path,
    name: &'static str,
}

impl Program {
    fn both() -> [Self; 2] {
        let of = |path, name| Self { path, name };
        [
            of(hil_runtime_binary(), "hil-runtime"),
            of(hil_recorder_binary(), "hil-recorder"),
        ]
    }

    fn run(&self, words: &[&str]) -> Finished {
        let mut command = Command::new(self.path);
        command.args(words).env_remove("COLUMNS");
        let mut child = ChildGuard::spawn(&mut command).unwrap();
        child.wait_within(LIMIT).unwrap()
    }

    fn help(&self, command: &[String]) -> String {
        let words = command.iter().map(String::as_str);
        let words: Vec<&str> = words.chain(["--help"]).collect();
        let help = self.run(&words);
        assert_eq!(help.status.code(), Some(0), "{help:?}");
        help.stdout
    }

    /// Every command with its help, those before it in front; the program itself is the first.
    fn commands(&self) -> Vec<(Vec<String>, String)> {
        let mut found = vec![(Vec::new(), self.help(&[]))];
        let mut next = 0;
        while let Some((command, help)) = found.get(next) {
            let nested: Vec<Vec<String>> = listed(help)
                .map(|name| [command.as_slice(), &[name.to_owned()]].concat())
                .collect();
            for command in nested {
                let help = self.help(&command);
                found.push((command, help));
            }
            next += 1;
        }
        found
    }
}

/// The commands that a help lists.
fn listed(help: &str) -> impl Iterator<Item = &str> {
    let after = help.split("Commands:\n").nth(1).unwrap_or_default();
    let list = after.split("\n\n").next().unwrap_or_default();
    let names = list.lines().filter_map(|line| {
        let is_name = line.starts_with("  ") && !line.starts_with("   ");
        is_name.then(|| line.split_whitespace().next()).flatten()
    });
    names.filter(|name| *name != "help")
}

#[test]
fn the_help_of_every_command_has_an_example_of_it() {
    for program in Program::both() {
        let commands = program.commands();
        let depth = commands.iter().map(|(command, _)| command.len()).max();
        assert!(commands.len() > 6, "{}: {commands:?}", program.name);
        assert_eq!(depth > Some(1), program.name == "hil-runtime");
        for (command, help) in &commands {
            let usage = [&[program.name.to_owned()], command.as_slice()].concat();
            let usage = usage.join(" ");
            let example = help.split("Example").nth(1).unwrap_or_default();
            assert!(example.contains(&usage), "{usage}: {help}");
        }
        let (_, help) = &commands[0];
        assert!(help.contains("Exit codes:"), "{help}");
    }
}

#[test]
fn a_program_without_a_word_says_how_it_is_used() {
    for program in Program::both() {
        let nothing = program.run(&[]);
        assert_eq!(nothing.status.code(), Some(2), "{nothing:?}");
        for words in ["Usage:", "Examples:"] {
            assert!(nothing.stderr.contains(words), "{nothing:?}");
        }
    }
}
