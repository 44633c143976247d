//! Text that fits a terminal: counts with grouped digits, text of others that steers nothing, and lines cut
//! to a width.

use std::borrow::Cow;

/// A count with its thousands grouped.
pub fn grouped(count: u64) -> String {
    let digits = count.to_string();
    let mut text = String::with_capacity(digits.len() * 4 / 3);
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// Columns a text takes. Names are taken to be one column per character.
pub fn columns(text: &str) -> usize {
    text.chars().count()
}

/// `text` of others as it may be shown: what steers a terminal or turns the direction of a line (control
/// characters but line breaks and tabulators, marks of direction, other line separators) is written out as
/// `\x1b` or `\u{202e}`. Whatever this program shows of a component, a peer, a name or a file goes
/// through here, for the terminal, the journal and every form of a report.
pub fn visible(text: &str) -> Cow<'_, str> {
    if !text.contains(steers) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        match u8::try_from(c) {
            _ if !steers(c) => out.push(c),
            // As Rust, C and shells write it.
            Ok(byte) => {
                let digit = |value: u8| char::from_digit(value.into(), 16).unwrap_or('?');
                out.extend(['\\', 'x', digit(byte >> 4), digit(byte & 15)]);
            }
            Err(_) => out.extend(c.escape_unicode()),
        }
    }
    Cow::Owned(out)
}

/// As [`visible`], of text that this program has laid out: colours (`ESC [ … m`) stay.
pub fn visible_laid_out(text: &str) -> Cow<'_, str> {
    if !text.contains(steers) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 8);
    let mut rest = text;
    while let Some(at) = rest.find('\u{1b}') {
        out.push_str(&visible(&rest[..at]));
        let length = colour_bytes(&rest[at..]);
        if length == 0 {
            out.push_str("\\x1b");
        } else {
            out.push_str(&rest[at..at + length]);
        }
        rest = &rest[at + length.max(1)..];
    }
    out.push_str(&visible(rest));
    Cow::Owned(out)
}

/// Bytes of the colour sequence that `text` begins with; 0 when it begins with another one.
fn colour_bytes(text: &str) -> usize {
    let Some(parameters) = text.strip_prefix("\u{1b}[") else {
        return 0;
    };
    let end = parameters.find(|c: char| !c.is_ascii_digit() && c != ';');
    let end = end.filter(|end| parameters[*end..].starts_with('m'));
    end.map_or(0, |end| 2 + end + 1)
}

fn steers(c: char) -> bool {
    (c.is_control() && !matches!(c, '\n' | '\t'))
        || matches!(
            c,
            '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}'
        )
}

/// As [`visible`], in one line.
pub fn clean(text: &str) -> String {
    // The two characters of a line's end on other systems are no message.
    let lines = text.replace("\r\n", " ");
    visible(&lines).replace(['\n', '\t'], " ")
}

/// At most `width` columns, with an ellipsis where something is missing.
pub fn shortened(text: &str, width: usize) -> String {
    let text = clean(text);
    if columns(&text) <= width {
        return text;
    }
    let mut short: String = text.chars().take(width.saturating_sub(1)).collect();
    if width > 0 {
        short.push('…');
    }
    short
}

/// A word of a command as a POSIX shell reads it back (POSIX.1-2017, 2.2.2).
pub fn shell_word(text: &str) -> String {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"/._-=:@%,+".contains(&byte);
    if !text.is_empty() && text.bytes().all(is_plain) {
        return text.to_owned();
    }
    format!("'{}'", text.replace('\'', r"'\''"))
}

/// A command line that a shell reads back as it was.
pub fn shell_words(words: &[impl AsRef<str>]) -> String {
    let quoted = words.iter().map(|word| shell_word(word.as_ref()));
    quoted.collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_steers_a_terminal_is_written_out_and_the_rest_stays() {
        for (text, shown) in [
            (
                "plain µ→ text\n\tof two lines",
                "plain µ→ text\n\tof two lines",
            ),
            ("\u{1b}]0;title\u{7}", "\\x1b]0;title\\x07"),
            ("\u{9b}31m\u{7f}\r\u{0}", "\\x9b31m\\x7f\\x0d\\x00"),
            (
                "a\u{202e}b\u{2069}\u{2028}",
                "a\\u{202e}b\\u{2069}\\u{2028}",
            ),
        ] {
            assert_eq!(visible(text), shown);
        }
        assert_eq!(clean("a\r\nb\tc\u{1b}"), "a b c\\x1b");
        assert_eq!(
            visible_laid_out("\u{1b}[1;31mred\u{1b}[0m \u{1b}[2J\u{1b}]0;t\u{7}\u{1b}"),
            "\u{1b}[1;31mred\u{1b}[0m \\x1b[2J\\x1b]0;t\\x07\\x1b"
        );
        for code in 0..0x1_1000 {
            let Some(c) = char::from_u32(code) else {
                continue;
            };
            let text = format!("x{c}y");
            let cleaned = clean(&text);
            assert!(!cleaned.contains(char::is_control), "{code:x}");
            assert_eq!(visible(&visible(&text)), visible(&text));
        }
    }

    #[test]
    fn counts_are_grouped() {
        assert_eq!(grouped(0), "0");
        assert_eq!(grouped(999), "999");
        assert_eq!(grouped(1_234_567), "1,234,567");
    }

    #[test]
    fn a_shell_takes_a_word_of_a_command_as_it_was() {
        assert_eq!(shell_word("/srv/runs/a-1.dist"), "/srv/runs/a-1.dist");
        for text in ["/my runs/a", "it's", "$HOME `x` \"y\"", "", "a;b", "~", "µ"] {
            let script = format!("printf %s {}", shell_word(text));
            let printed = std::process::Command::new("sh")
                .args(["-c", &script])
                .output();
            assert_eq!(printed.unwrap().stdout, text.as_bytes(), "{script}");
        }
    }
}
