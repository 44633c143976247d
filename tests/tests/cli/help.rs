//! The help of every command of both programs, nested ones too: it shows how the command is used.

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
        self.run_at(words, None)
    }

    /// On a terminal so wide.
    fn run_at(&self, words: &[&str], columns: Option<usize>) -> Finished {
        let mut command = Command::new(self.path);
        command.args(words).env_remove("COLUMNS");
        if let Some(columns) = columns {
            command.env("COLUMNS", columns.to_string());
        }
        let mut child = ChildGuard::spawn(&mut command).unwrap();
        child.wait_within(LIMIT).unwrap()
    }

    fn help(&self, command: &[String]) -> String {
        self.help_at(command, None)
    }

    fn help_at(&self, command: &[String], columns: Option<usize>) -> String {
        let words = command.iter().map(String::as_str);
        let words: Vec<&str> = words.chain(["--help"]).collect();
        let help = self.run_at(&words, columns);
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
        assert!(commands.len() > 5, "{}: {commands:?}", program.name);
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

/// What is behind the list of options, which the program sets as it was written.
fn behind_options(help: &str) -> &str {
    help.find("\nExample").map_or("", |at| &help[at..])
}

/// The program breaks a line that is too wide wherever it is, so that examples and tables fall apart.
#[test]
fn a_help_fits_a_narrow_terminal_without_a_break_that_nobody_meant() {
    const NARROW: usize = 80;
    const WIDE: usize = 400;
    for program in Program::both() {
        for (command, usual) in program.commands() {
            let name = [&[program.name.to_owned()], command.as_slice()].concat();
            let name = name.join(" ");
            let narrow = program.help_at(&command, Some(NARROW));
            let wide = program.help_at(&command, Some(WIDE));
            for (help, limit) in [(&narrow, NARROW), (&usual, 100)] {
                for line in help.lines() {
                    // The program sets its usage on one line, whatever the width.
                    let limit = if line.starts_with("Usage:") {
                        100
                    } else {
                        limit
                    };
                    assert!(line.chars().count() <= limit, "{name}: {line}");
                }
                assert_eq!(behind_options(help), behind_options(&wide), "{name}");
            }
            assert_ne!(behind_options(&narrow), "", "{name}");
            for (what, why) in [
                ("..=", "a range is said in words"),
                ("[default: \"", "a value stands without quotes"),
            ] {
                assert!(!usual.contains(what), "{name}: {why}: {usual}");
            }
        }
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
