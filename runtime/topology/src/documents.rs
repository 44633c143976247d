//! The command line as documents for a package: a manual page of every command, and completions for
//! the shells. They are made from the same definitions that `--help` is, so they cannot differ from
//! it. The schema of topology files and the description of the robot are laid beside them.

use std::path::{Path, PathBuf};
use std::{fs, io};

use clap::{Command, Parser};
use clap_complete::Shell;
use clap_mangen::Man;
use clap_mangen::roff::Roff;
use hil_arm::yumi::description::Urdf;

use super::schema::{reference, schema};

/// Begins the list of exit codes in the help of a program.
const EXIT_CODES: &str = "Exit codes:";

/// Shells with the folder of each below the one that is written to.
const SHELLS: [(Shell, &str); 3] = [
    (Shell::Bash, "bash"),
    (Shell::Zsh, "zsh"),
    (Shell::Fish, "fish"),
];

/// The command line of this process. What is wrong with it is told, and ends the process.
///
/// # Errors
/// The help or the version, where that is what was asked for: a result like any other.
pub fn command_line<C: Parser>() -> Result<C, String> {
    C::try_parse().map_err(|asked| {
        if asked.use_stderr() {
            asked.exit();
        }
        asked.render().ansi().to_string()
    })
}

/// Writes the documents of `command` below `folder`: `man1/*.1`, and a folder of completions per
/// shell. Gives back what it wrote.
///
/// # Errors
/// When a file cannot be written.
pub fn write(command: Command, folder: &Path) -> io::Result<Vec<PathBuf>> {
    let name = command.get_name().to_owned();
    let mut command = without_help_command(command);
    command.build();
    let mut written = Vec::new();
    let pages = folder.join("man1");
    fs::create_dir_all(&pages)?;
    write_pages(&command, &exit_codes(&command), &pages, &mut written)?;
    for (shell, part) in SHELLS {
        let folder = folder.join(part);
        fs::create_dir_all(&folder)?;
        let path = clap_complete::generate_to(shell, &mut command, &name, folder)?;
        written.push(path);
    }
    Ok(written)
}

/// Writes what can stand in a topology file below `folder`: `schema/topology.schema.json`, and the page of all
/// keys as `schema/topology.md`.
///
/// # Errors
/// When one cannot be written.
pub fn write_keys(folder: &Path) -> io::Result<()> {
    let folder = folder.join("schema");
    fs::create_dir_all(&folder)?;
    let mut text = serde_json::to_string_pretty(&schema())?;
    text.push('\n');
    fs::write(folder.join("topology.schema.json"), text)?;
    fs::write(folder.join("topology.md"), reference())
}

/// Writes the description of the robot below `folder`: `robots/yumi.urdf`.
///
/// # Errors
/// When it cannot be written.
pub fn write_robot(folder: &Path) -> io::Result<PathBuf> {
    let folder = folder.join("robots");
    fs::create_dir_all(&folder)?;
    let path = folder.join("yumi.urdf");
    fs::write(&path, Urdf.to_string())?;
    Ok(path)
}

/// `help` is a way to ask for a page, not a command with one.
fn without_help_command(command: Command) -> Command {
    let names: Vec<String> = command
        .get_subcommands()
        .map(|one| one.get_name().to_owned())
        .collect();
    let command = command.disable_help_subcommand(true);
    names.into_iter().fold(command, |command, name| {
        command.mut_subcommand(name, without_help_command)
    })
}

fn write_pages(
    command: &Command,
    exit_codes: &str,
    folder: &Path,
    written: &mut Vec<PathBuf>,
) -> io::Result<()> {
    let name = command.get_display_name().unwrap_or(command.get_name());
    let path = folder.join(format!("{name}.1"));
    fs::write(&path, page(command, exit_codes)?)?;
    written.push(path);
    let shown = command.get_subcommands().filter(|one| !one.is_hide_set());
    for one in shown {
        write_pages(one, exit_codes, folder, written)?;
    }
    Ok(())
}

fn page(command: &Command, exit_codes: &str) -> io::Result<Vec<u8>> {
    let mut page = Vec::new();
    let man = Man::new(command.clone()).manual("hil-runtime");
    man.render_title(&mut page)?;
    man.render_name_section(&mut page)?;
    man.render_synopsis_section(&mut page)?;
    man.render_description_section(&mut page)?;
    man.render_options_section(&mut page)?;
    if command.get_subcommands().any(|one| !one.is_hide_set()) {
        man.render_subcommands_section(&mut page)?;
    }
    let after = command.get_after_help().map(ToString::to_string);
    let after = after.unwrap_or_default();
    let (own, _) = after.split_once(EXIT_CODES).unwrap_or((&after, ""));
    as_written("EXAMPLES", own, &mut page)?;
    as_written("EXIT STATUS", exit_codes, &mut page)?;
    Ok(page)
}

/// The list of exit codes at the end of a program's help.
fn exit_codes(command: &Command) -> String {
    let after = command.get_after_help().map(ToString::to_string);
    let after = after.unwrap_or_default();
    let codes = after.split_once(EXIT_CODES).map(|(_, codes)| codes);
    codes.unwrap_or_default().to_owned()
}

/// A section whose lines stay lines.
fn as_written(title: &str, text: &str, page: &mut Vec<u8>) -> io::Result<()> {
    let text = text.trim_matches('\n').trim_end();
    if text.is_empty() {
        return Ok(());
    }
    let mut section = Roff::new();
    section.control("SH", [title]).control("nf", []);
    for line in text.lines() {
        section.text([line.into()]);
    }
    section.control("fi", []);
    section.to_writer(page)
}
