//! Rust source as text for the tidy tests: which part of a file is code and which is comment or literal.
//! It is a scanner and no parser: macros are taken as they stand.

use std::fs;
use std::path::{Path, PathBuf};

use crate::binary::workspace_folder;

/// One source file of this workspace, or a snippet made up by a test.
#[derive(Debug, Clone)]
pub struct SourceFile {
    /// The path below the workspace folder, with `/` between its parts.
    pub path: String,
    /// The text with comments and the contents of literals blanked out.
    pub code: String,
}

impl SourceFile {
    /// A file of this text.
    pub fn new(path: &str, text: &str) -> Self {
        Self {
            path: path.to_owned(),
            code: code_of(text),
        }
    }
}

/// Lines of `text`, from 1, in which `word` stands by itself.
pub fn lines_with_word(text: &str, word: &str) -> Vec<usize> {
    let has_word = |line: &str| find_word(line, word).is_some();
    text.lines()
        .enumerate()
        .filter(|(_, line)| has_word(line))
        .map(|(i, _)| i + 1)
        .collect()
}

/// Every `.rs` file of the workspace's packages, sorted by path.
///
/// # Panics
/// When a folder or file cannot be read: an unread file must not pass for a tidy one.
pub fn workspace_sources() -> Vec<SourceFile> {
    let root = workspace_folder();
    let mut files = Vec::new();
    for package in ["models", "gateways", "runtime", "tests", "benches"] {
        collect(&root.join(package), &root, &mut files);
    }
    files.sort_by(|a, b| a.path.cmp(&b.path));
    files
}

fn collect(folder: &Path, root: &Path, files: &mut Vec<SourceFile>) {
    let entries = fs::read_dir(folder)
        .unwrap_or_else(|error| panic!("cannot list {}: {error}", folder.display()));
    for entry in entries {
        let path: PathBuf = entry
            .unwrap_or_else(|error| panic!("cannot list {}: {error}", folder.display()))
            .path();
        if path.is_dir() {
            if path.file_name().is_some_and(|name| name != "target") {
                collect(&path, root, files);
            }
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = fs::read_to_string(&path)
                .unwrap_or_else(|error| panic!("cannot read {}: {error}", path.display()));
            let below = path.strip_prefix(root).unwrap_or(&path);
            files.push(SourceFile::new(&below.to_string_lossy(), &text));
        }
    }
}

fn is_word(character: char) -> bool {
    character.is_alphanumeric() || character == '_'
}

fn find_word(text: &str, word: &str) -> Option<usize> {
    text.match_indices(word)
        .map(|(index, _)| index)
        .find(|&index| {
            let before = text[..index].chars().next_back();
            let after = text[index + word.len()..].chars().next();
            // A searched word that ends in punctuation (`std::io::`) bounds itself.
            let bounds_itself = word.ends_with(|c: char| !is_word(c));
            !before.is_some_and(is_word) && (bounds_itself || !after.is_some_and(is_word))
        })
}

/// `text` with its comments and literals blanked out, line by line as before.
fn code_of(text: &str) -> String {
    let bytes = text.as_bytes();
    let mut is_code = vec![true; bytes.len()];
    let mut index = 0;
    while index < bytes.len() {
        let blank = blank_length(bytes, index);
        is_code[index..index + blank].fill(false);
        index += blank.max(1);
    }
    let keep = |(index, character): (usize, char)| {
        let is_kept = character == '\n' || is_code[index];
        if is_kept { character } else { ' ' }
    };
    text.char_indices().map(keep).collect()
}

/// The length of the comment or literal that begins at `index`; 0 for code.
fn blank_length(bytes: &[u8], index: usize) -> usize {
    let rest = &bytes[index..];
    let is_inside_word = index > 0 && is_word(char::from(bytes[index - 1]));
    match rest {
        [b'/', b'/', ..] => length_until(rest, b"\n"),
        [b'/', b'*', ..] => block_comment_length(rest),
        [b'"', ..] => quoted_length(rest, b'"'),
        [b'r', b'"' | b'#', ..] if !is_inside_word => raw_string_length(rest),
        [b'b', b'r', b'"' | b'#', ..] if !is_inside_word => match raw_string_length(&rest[1..]) {
            0 => 0,
            length => length + 1,
        },
        // A quote opens a character when one closes right behind it, otherwise a lifetime.
        [b'\'', b'\\', ..] => quoted_length(rest, b'\''),
        [b'\'', ..] => character_length(rest).unwrap_or(0),
        _ => 0,
    }
}

fn length_until(rest: &[u8], end: &[u8]) -> usize {
    rest.windows(end.len())
        .position(|window| window == end)
        .unwrap_or(rest.len())
}

fn block_comment_length(rest: &[u8]) -> usize {
    let (mut depth, mut index) = (0_i32, 0);
    while index + 1 < rest.len() {
        match &rest[index..index + 2] {
            b"/*" => (depth, index) = (depth + 1, index + 2),
            b"*/" => (depth, index) = (depth - 1, index + 2),
            _ => index += 1,
        }
        if depth == 0 {
            return index;
        }
    }
    rest.len()
}

/// Length of a literal in plain quotes, its backslash escapes skipped.
fn quoted_length(rest: &[u8], quote: u8) -> usize {
    let mut index = 1;
    while index < rest.len() {
        match rest[index] {
            b'\\' => index += 2,
            byte if byte == quote => return index + 1,
            _ => index += 1,
        }
    }
    rest.len()
}

/// 0 for a raw identifier, `r#name`.
fn raw_string_length(rest: &[u8]) -> usize {
    let hashes = rest[1..].iter().take_while(|byte| **byte == b'#').count();
    if rest.get(1 + hashes) != Some(&b'"') {
        return 0;
    }
    let mut end = vec![b'"'];
    end.resize(1 + hashes, b'#');
    let opening = hashes + 2;
    let length = opening + length_until(&rest[opening..], &end) + end.len();
    length.min(rest.len())
}

/// Length of `'x'`, with `x` of one to four bytes.
fn character_length(rest: &[u8]) -> Option<usize> {
    let width = match rest.get(1)? {
        0..=0x7f => 1,
        0xc0..=0xdf => 2,
        0xe0..=0xef => 3,
        _ => 4,
    };
    (rest.get(1 + width) == Some(&b'\'')).then_some(width + 2)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn code(text: &str) -> String {
        SourceFile::new("x.rs", text).code
    }

    #[test]
    fn comments_and_literals_are_not_code() {
        for (text, expected) in [
            ("a // b", "a     "),
            ("a /* b /* c */ d */ e", "a                   e"),
            (r#"f("a // b", x)"#, "f(        , x)"),
            (r#""\"" y"#, "     y"),
            (r##"r#"a " b"# y"##, "           y"),
            ("br\"a\" y", "      y"),
            ("r#type y", "r#type y"),
            ("'a' y", "    y"),
            ("'\\'' y", "     y"),
            ("'ß' y", "    y"),
            ("<'a> y", "<'a> y"),
            ("'{' && '\"' y", "    &&     y"),
        ] {
            assert_eq!(code(text), expected, "{text}");
        }
    }

    #[test]
    fn words_are_found_whole() {
        let text = code("unsafe_code\nunsafe {}\n// unsafe\nstd::io::Write\nstd::io2");
        assert_eq!(lines_with_word(&text, "unsafe"), [2]);
        assert_eq!(lines_with_word(&text, "std::io::"), [4]);
        assert_eq!(lines_with_word(&text, "std::io"), [4]);
    }

    #[test]
    fn this_workspace_is_found_whole() {
        let files = workspace_sources();
        for folder in ["models/", "gateways/", "runtime/", "tests/src/", "benches/"] {
            let mut paths = files.iter().map(|file| &file.path);
            assert!(paths.any(|path| path.starts_with(folder)), "{folder}");
        }
    }
}
