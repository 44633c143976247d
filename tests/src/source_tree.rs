//! Rust source as text for the tidy tests: which part of a file is code, which is comment, and how
//! long its functions are. It is a scanner and no parser: macros are taken as they stand.

use std::fs;
use std::path::{Path, PathBuf};

use crate::binary::workspace_folder;

/// One source file of this workspace, or a snippet made up by a test.
#[derive(Debug, Clone)]
pub struct SourceFile {
    /// The path below the workspace folder, with `/` between its parts.
    pub path: String,
    /// The whole text.
    pub text: String,
    /// The text with comments and the contents of literals blanked out.
    pub code: String,
    /// The text with everything but comments blanked out.
    pub comments: String,
}

/// A function with the lines of its body that are neither blank nor comment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FunctionLength {
    /// The function's name.
    pub name: String,
    /// Line of the `fn`, from 1.
    pub line: usize,
    /// Lines of code in the body, braces not counted.
    pub line_count: usize,
}

impl SourceFile {
    /// A file of this text.
    pub fn new(path: &str, text: &str) -> Self {
        let classes = classify(text);
        let keep = |wanted: Class| blank_except(text, &classes, wanted);
        Self {
            path: path.to_owned(),
            text: text.to_owned(),
            code: keep(Class::Code),
            comments: keep(Class::Comment),
        }
    }

    /// Whether the file lies in `folder`, or is it.
    pub fn is_under(&self, folder: &str) -> bool {
        Path::new(&self.path).starts_with(folder)
    }

    /// Lines of the code, from 1, in which `word` occurs with no letter, digit or `_` beside it.
    pub fn lines_with_word(&self, word: &str) -> Vec<usize> {
        lines_with_word(&self.code, word)
    }

    /// The functions with a body.
    pub fn functions(&self) -> Vec<FunctionLength> {
        let code = self.code.as_str();
        let mut functions = Vec::new();
        let mut offset = 0;
        while let Some(found) = find_word(&code[offset..], "fn") {
            let start = offset + found;
            offset = start + 2;
            let name: String = code[offset..]
                .trim_start()
                .chars()
                .take_while(|c| is_word(*c))
                .collect();
            let Some(open) = body_start(&code[offset..]).map(|open| offset + open) else {
                continue;
            };
            // `fn(u32) -> u32` is a type and has neither name nor body of its own.
            if name.is_empty() {
                continue;
            }
            let end = open + matching_brace(&code[open..]);
            let body = &code[open + 1..end];
            functions.push(FunctionLength {
                name,
                line: code[..start].matches('\n').count() + 1,
                line_count: body.lines().filter(|line| !line.trim().is_empty()).count(),
            });
        }
        functions
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

/// Where the body after a signature opens; `None` for a declaration that ends in `;`.
fn body_start(signature: &str) -> Option<usize> {
    let mut depth = 0_i32;
    for (index, character) in signature.char_indices() {
        match character {
            '(' | '[' => depth += 1,
            ')' | ']' => depth -= 1,
            '{' if depth == 0 => return Some(index),
            ';' | ',' | '}' | '=' if depth <= 0 && ends_signature(character, depth) => return None,
            _ => {}
        }
    }
    None
}

/// A `;` ends a declaration; a closing bracket too many ends the type the `fn` was part of.
fn ends_signature(character: char, depth: i32) -> bool {
    character == ';' || depth < 0
}

/// The offset of the brace that closes the one at the start of `code`.
fn matching_brace(code: &str) -> usize {
    let mut depth = 0_i32;
    for (index, character) in code.char_indices() {
        match character {
            '{' => depth += 1,
            '}' => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return index;
        }
    }
    code.len()
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Class {
    Code,
    Comment,
    Literal,
}

/// The class of every byte of `text`.
fn classify(text: &str) -> Vec<Class> {
    let bytes = text.as_bytes();
    let mut classes = vec![Class::Code; bytes.len()];
    let mut index = 0;
    while index < bytes.len() {
        let (class, length) = token_at(bytes, index);
        classes[index..index + length].fill(class);
        index += length;
    }
    classes
}

/// The class and length of the comment, literal or single byte at `index`.
fn token_at(bytes: &[u8], index: usize) -> (Class, usize) {
    let rest = &bytes[index..];
    let is_inside_word = index > 0 && is_word(char::from(bytes[index - 1]));
    match rest {
        [b'/', b'/', ..] => (Class::Comment, length_until(rest, b"\n")),
        [b'/', b'*', ..] => (Class::Comment, block_comment_length(rest)),
        [b'"', ..] => (Class::Literal, quoted_length(rest, b'"')),
        [b'r', b'"' | b'#', ..] if !is_inside_word => raw_string(rest),
        [b'b', b'r', b'"' | b'#', ..] if !is_inside_word => {
            let (class, length) = raw_string(&rest[1..]);
            (class, length + 1)
        }
        // A quote opens a character when one closes right behind it, otherwise a lifetime.
        [b'\'', b'\\', ..] => (Class::Literal, quoted_length(rest, b'\'')),
        [b'\'', ..] if character_length(rest).is_some() => {
            (Class::Literal, character_length(rest).unwrap_or(1))
        }
        _ => (Class::Code, 1),
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

fn raw_string(rest: &[u8]) -> (Class, usize) {
    let hashes = rest[1..].iter().take_while(|byte| **byte == b'#').count();
    if rest.get(1 + hashes) != Some(&b'"') {
        // `r#name` is a raw identifier.
        return (Class::Code, 1);
    }
    let mut end = vec![b'"'];
    end.resize(1 + hashes, b'#');
    let opening = hashes + 2;
    let length = opening + length_until(&rest[opening..], &end) + end.len();
    (Class::Literal, length.min(rest.len()))
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

fn blank_except(text: &str, classes: &[Class], wanted: Class) -> String {
    let keep = |(index, character): (usize, char)| {
        if character == '\n' || classes[index] == wanted {
            character
        } else {
            ' '
        }
    };
    text.char_indices().map(keep).collect()
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
    fn comments_keep_their_lines() {
        let file = SourceFile::new("x.rs", "let a = \"no\"; // yes\n/* and\nthis */ b");
        assert_eq!(lines_with_word(&file.comments, "yes"), [1]);
        assert_eq!(lines_with_word(&file.comments, "this"), [3]);
        assert!(lines_with_word(&file.comments, "no").is_empty());
    }

    #[test]
    fn words_are_found_whole() {
        let file = SourceFile::new("x.rs", "unsafe_code\nunsafe {}\nstd::io::Write\nstd::io2");
        assert_eq!(file.lines_with_word("unsafe"), [2]);
        assert_eq!(file.lines_with_word("std::io::"), [3]);
        assert_eq!(file.lines_with_word("std::io"), [3]);
    }

    #[test]
    fn function_lengths_leave_out_blanks_and_comments() {
        let text = "impl A {\n    fn long<T: Fn(u8) -> [u8; 4]>(&self) -> [u8; 4]\n    where T: B {\n\
                    \n        // why\n        if x { y() }\n        \"}\";\n    }\n    fn none(&self);\n\
                    fn one() { 1 } }\nlet f: fn(u8) -> u8 = g;\n";
        let functions = SourceFile::new("x.rs", text).functions();
        let found: Vec<(&str, usize, usize)> = functions
            .iter()
            .map(|f| (f.name.as_str(), f.line, f.line_count))
            .collect();
        assert_eq!(found, [("long", 2, 2), ("one", 10, 1)]);
    }

    #[test]
    fn this_workspace_is_found_whole() {
        let files = workspace_sources();
        for path in [
            "models/src/time.rs",
            "runtime/src/main.rs",
            "tests/src/source_tree.rs",
        ] {
            assert!(
                files.iter().any(|file| file.path == path),
                "{path} is missing"
            );
        }
    }
}
