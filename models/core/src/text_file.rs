//! Text as people's programs write it, for every reader of such files: byte order marks, the line ends of three
//! systems, other encodings, quoted cells (RFC 4180), other separators. It says of each line where it is in the
//! file, and opens none.

use std::borrow::Cow;

/// The text of a file, and where its bytes are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TextFile {
    text: String,
    /// Bytes of a byte order mark.
    mark_bytes: usize,
    /// One byte a letter in the file.
    is_latin1: bool,
}

/// What is wrong with a text, and where.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("line {line}, byte {offset}: {what}")]
pub struct TextFault {
    /// Line, from 1.
    pub line: u64,
    /// Offset in the file, bytes from 0: of the line, or of the byte where one byte is at fault.
    pub offset: u64,
    /// What is wrong there.
    pub what: String,
}

/// A line without its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Line<'a> {
    /// From 1.
    pub number: u64,
    /// Where it begins in the file.
    pub offset: u64,
    /// What stands there.
    pub content: &'a str,
}

impl Line<'_> {
    /// A fault of this line.
    pub fn fault(&self, what: impl Into<String>) -> TextFault {
        TextFault {
            line: self.number,
            offset: self.offset,
            what: what.into(),
        }
    }
}

impl From<&str> for TextFile {
    fn from(text: &str) -> Self {
        Self {
            text: text.to_owned(),
            mark_bytes: 0,
            is_latin1: false,
        }
    }
}

impl TextFile {
    /// Reads UTF-8 with or without a mark, and anything else of one byte a letter as ISO 8859-1, in which all bytes
    /// are letters: names may come out wrong, and ASCII does not.
    ///
    /// # Errors
    /// Text of two or four bytes a letter, by its name, and bytes that are no text.
    pub fn decode(bytes: &[u8]) -> Result<Self, TextFault> {
        const UTF8_MARK: &[u8] = b"\xef\xbb\xbf";
        let refuse = |line, offset, what: String| Err(TextFault { line, offset, what });
        let marks: [(&[u8], &str); 4] = [
            (b"\xff\xfe\0\0", "UTF-32 (little-endian)"),
            (b"\0\0\xfe\xff", "UTF-32 (big-endian)"),
            (b"\xff\xfe", "UTF-16 (little-endian)"),
            (b"\xfe\xff", "UTF-16 (big-endian)"),
        ];
        for (mark, name) in marks {
            if bytes.starts_with(mark) {
                return refuse(
                    1,
                    0,
                    format!("its byte order mark says {name}; save it as UTF-8"),
                );
            }
        }
        // Two programs may each have put one.
        let marks = bytes.chunks(UTF8_MARK.len());
        let mark_bytes = marks.take_while(|bytes| *bytes == UTF8_MARK).count() * UTF8_MARK.len();
        let bytes = without_filling(&bytes[mark_bytes..]);
        if let Some(zero) = bytes.iter().position(|byte| *byte == 0) {
            let before = &bytes[..zero];
            let line = before.split(|byte| *byte == b'\n').count() as u64;
            let what =
                "a zero byte: no text, or UTF-16 without a byte order mark; save it as UTF-8";
            return refuse(line, (mark_bytes + zero) as u64, what.to_owned());
        }
        let utf8 = str::from_utf8(bytes);
        let mut text = utf8.map_or_else(
            |_latin1| bytes.iter().map(|byte| char::from(*byte)).collect(),
            str::to_owned,
        );
        if text.contains('\r') {
            text = with_line_feeds(&text);
        }
        Ok(Self {
            text,
            mark_bytes,
            is_latin1: utf8.is_err(),
        })
    }

    /// The text without its mark; each line ends with a line feed.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The lines, which end with a line feed, with or without a carriage return before it.
    pub fn lines(&self) -> impl Iterator<Item = Line<'_>> {
        let mut offset = self.mark_bytes as u64;
        let raw = self.text.split_inclusive('\n');
        raw.zip(1..).map(move |(raw, number)| {
            let line = Line {
                number,
                offset,
                content: raw.trim_end_matches(['\n', '\r']),
            };
            offset += self.bytes_of(raw) as u64;
            line
        })
    }

    /// The place behind the last line.
    pub fn end(&self) -> Line<'static> {
        Line {
            number: self.lines().count() as u64 + 1,
            offset: (self.mark_bytes + self.bytes_of(&self.text)) as u64,
            content: "",
        }
    }

    /// Bytes that a part of the text has in the file.
    fn bytes_of(&self, part: &str) -> usize {
        if self.is_latin1 {
            part.chars().count()
        } else {
            part.len()
        }
    }
}

/// Without what fills a file behind its text: control-Z of older systems, and zeros behind a whole line.
fn without_filling(bytes: &[u8]) -> &[u8] {
    let is_filling = |byte: &u8| matches!(byte, 0 | 0x1a | b'\r' | b'\n' | b' ');
    let tail = bytes.iter().rposition(|byte| !is_filling(byte));
    let tail = tail.map_or(0, |last| last + 1);
    let filling = bytes[tail..]
        .iter()
        .position(|byte| matches!(byte, 0 | 0x1a));
    let Some(end) = filling.map(|place| tail + place) else {
        return bytes;
    };
    let text = &bytes[..end];
    if bytes[end] == 0x1a || text.ends_with(b"\n") || text.ends_with(b"\r") {
        text
    } else {
        bytes
    }
}

/// With a line feed for each line that ends with a carriage return alone: as long, and known to readers of the
/// whole text.
fn with_line_feeds(text: &str) -> String {
    let mut letters = text.chars().peekable();
    let mut ended = String::with_capacity(text.len());
    let mut returns = 0;
    while let Some(letter) = letters.next() {
        if letter != '\r' {
            ended.push(letter);
            continue;
        }
        returns += 1;
        let next = letters.peek();
        if next == Some(&'\r') {
            continue;
        }
        let ends = if next == Some(&'\n') { "\r" } else { "\n" };
        ended.extend(core::iter::repeat_n(ends, returns));
        returns = 0;
    }
    ended
}

/// What separates the cells of a table whose first line is `line`: the most frequent of comma, semicolon and
/// tabulator outside quotes.
pub fn separator_of(line: &str) -> char {
    let count = |wanted: char| {
        let mut is_quoted = false;
        let is_outside = |letter: &char| {
            is_quoted ^= *letter == '"';
            *letter == wanted && !is_quoted
        };
        line.chars().filter(is_outside).count()
    };
    // Of equal counts the last one wins.
    [';', '\t', ',']
        .into_iter()
        .max_by_key(|one| count(*one))
        .unwrap_or(',')
}

/// The cells of a line without the blanks around them; a quoted one ends in its line.
///
/// # Errors
/// A quote that is not closed, or text beside a quoted cell.
pub fn cells(line: &str, separator: char) -> Result<Vec<Cow<'_, str>>, String> {
    let is_blank = |letter: char| letter.is_whitespace() && letter != separator;
    let mut cells = Vec::new();
    let mut rest = line;
    loop {
        let trimmed = rest.trim_start_matches(is_blank);
        let (cell, behind) = match trimmed.strip_prefix('"') {
            None => {
                let end = trimmed.find(separator).unwrap_or(trimmed.len());
                let cell = trimmed[..end].trim_end_matches(is_blank);
                (Cow::Borrowed(cell), &trimmed[end..])
            }
            Some(quoted) => {
                let (cell, behind) = unquoted(quoted)?;
                (cell, behind.trim_start_matches(is_blank))
            }
        };
        cells.push(cell);
        match behind.strip_prefix(separator) {
            Some(next) => rest = next,
            None if behind.is_empty() => return Ok(cells),
            None => return Err(format!("text behind a quoted cell: \"{}\"", short(behind))),
        }
    }
}

/// A cell behind its opening quote, and what is behind its closing one.
fn unquoted(quoted: &str) -> Result<(Cow<'_, str>, &str), String> {
    let mut from = 0;
    loop {
        let Some(found) = quoted[from..].find('"') else {
            return Err(format!("a quote is not closed: \"{}\"", short(quoted)));
        };
        let end = from + found;
        if quoted[end + 1..].starts_with('"') {
            from = end + 2;
            continue;
        }
        let cell = &quoted[..end];
        let cell = if cell.contains('"') {
            Cow::Owned(cell.replace("\"\"", "\""))
        } else {
            Cow::Borrowed(cell)
        };
        return Ok((cell, &quoted[end + 1..]));
    }
}

/// The first letters of what is told of.
pub fn short(text: &str) -> &str {
    let end = text.char_indices().nth(40);
    end.map_or(text, |(end, _)| &text[..end])
}

/// True for a number with a comma where a point is expected.
pub fn has_decimal_comma(text: &str) -> bool {
    let digits = |part: &str| !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit());
    let halves = text.trim_start_matches(['-', '+']).split_once(',');
    halves.is_some_and(|(whole, rest)| {
        let (rest, _exponent) = rest.split_once(['e', 'E']).unwrap_or((rest, ""));
        digits(whole) && digits(rest)
    })
}

/// A whole number, also where a program wrote it with decimals that are all zero.
pub fn whole<T: core::str::FromStr>(text: &str) -> Option<T> {
    let number = match text.split_once('.') {
        Some((number, decimals)) if decimals.bytes().all(|byte| byte == b'0') => number,
        _ => text,
    };
    number.parse().ok()
}

/// True for what programs write in the place of a value that is missing.
pub fn is_missing(text: &str) -> bool {
    let words = ["", "nan", "na", "n/a", "<na>", "nat", "null", "none"];
    words.iter().any(|word| text.eq_ignore_ascii_case(word))
}

/// Why `text` is not the whole number that was `expected`, with what may be meant by it.
pub fn not_whole(text: &str, expected: &str) -> String {
    let found = short(text);
    match text.split_once([',', '.']) {
        Some((number, _)) if has_decimal_comma(text) => {
            format!("\"{found}\" has a decimal comma, expected {expected}, e.g. {number}")
        }
        _ if text.contains(['e', 'E']) && text.parse::<f64>().is_ok() => {
            format!("\"{found}\" is not {expected} with all its digits")
        }
        Some((number, _)) if text.parse::<f64>().is_ok() => {
            format!("\"{found}\" is not {expected}, e.g. {number}")
        }
        _ => format!("\"{found}\" is not {expected}"),
    }
}

/// Why `text` is not the number that was `expected`, with what may be meant by it.
pub fn not_a_number(text: &str, expected: &str) -> String {
    let found = short(text);
    if has_decimal_comma(text) {
        let point = found.replacen(',', ".", 1);
        format!("\"{found}\" has a decimal comma, expected {expected}, e.g. {point}")
    } else {
        format!("\"{found}\" is not {expected}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn places(bytes: &[u8]) -> Vec<(u64, u64, String)> {
        let file = TextFile::decode(bytes).unwrap();
        let lines = file.lines();
        let lines = lines.map(|line| (line.number, line.offset, line.content.to_owned()));
        lines.collect()
    }

    #[test]
    fn lines_have_their_place_in_the_file_whatever_its_mark_ends_and_encoding() {
        let place = |number, offset, content: &str| (number, offset, content.to_owned());
        for bytes in [
            &b"a\nb\n"[..],
            b"a\r\nb\r\n",
            b"a\rb\r",
            b"a\rb\n",
            b"a\nb\r",
            b"\xef\xbb\xbfa\nb",
            b"\xef\xbb\xbf\xef\xbb\xbfa\nb",
            b"a\nb\n\0\0\0",
            b"a\nb\x1a\0",
            b"a\nb\r\n\x1a\r\n",
        ] {
            let [first, second] = [b'a', b'b'].map(|letter| {
                let found = bytes.iter().position(|byte| *byte == letter);
                found.unwrap() as u64
            });
            assert_eq!(places(bytes), [place(1, first, "a"), place(2, second, "b")]);
        }
        assert_eq!(
            places(b"\xe4\xf6\nb"),
            [place(1, 0, "äö"), place(2, 3, "b")]
        );
        assert_eq!(
            places("ä\nb".as_bytes()),
            [place(1, 0, "ä"), place(2, 3, "b")]
        );
        let end = |bytes: &[u8]| {
            let end = TextFile::decode(bytes).unwrap().end();
            (end.number, end.offset)
        };
        assert_eq!(
            (end(b""), end(b"a\r\nb\r\n"), end(b"\xe4")),
            ((1, 0), (3, 6), (2, 1))
        );
    }

    #[test]
    fn text_of_more_bytes_a_letter_is_refused_by_name() {
        let refused = |bytes: &[u8]| TextFile::decode(bytes).unwrap_err().to_string();
        assert!(refused(b"\xff\xfea\0").contains("UTF-16 (little-endian)"));
        assert!(refused(b"\xfe\xff\0a").contains("UTF-16 (big-endian)"));
        assert!(refused(b"\xff\xfe\0\0a\0\0\0").contains("UTF-32 (little-endian)"));
        let unmarked = refused(b"a\nb\0");
        assert!(
            unmarked.starts_with("line 2, byte 3: a zero byte"),
            "{unmarked}"
        );
    }

    #[test]
    fn cells_are_found_by_any_separator_and_in_quotes() {
        assert_eq!(separator_of("a;b;\"c,d,e,f\""), ';');
        assert_eq!(separator_of("a\tb"), '\t');
        assert_eq!(separator_of("a,b"), ',');
        assert_eq!(separator_of("a"), ',');
        let found = cells(" 1 ,\"2, \"\"b\"\"\" ,, x", ',').unwrap();
        assert_eq!(found, ["1", "2, \"b\"", "", "x"]);
        assert_eq!(cells("a\t\tb", '\t').unwrap(), ["a", "", "b"]);
        assert!(cells("\"a", ',').unwrap_err().contains("not closed"));
        assert!(
            cells("\"a\"b,c", ',')
                .unwrap_err()
                .contains("behind a quoted")
        );
    }

    #[test]
    fn whole_numbers_may_have_decimals_of_zero_and_what_is_told_of_others_can_be_written() {
        let numbers = ["4", "4.0", "-4000000.000", "+4.", "0.0"].map(whole::<i64>);
        assert_eq!(numbers, [4, 4, -4_000_000, 4, 0].map(Some));
        for text in ["4.5", "4.0.0", "4,0", ".0", "", "4e3", "4.0 "] {
            assert_eq!(whole::<i64>(text), None, "{text}");
        }
        assert_eq!(whole::<u8>("256.0"), None);
        let told = not_whole("-4,25", "a whole number");
        assert_eq!(
            told,
            "\"-4,25\" has a decimal comma, expected a whole number, e.g. -4"
        );
        assert_eq!(
            not_whole("4.25", "a whole number"),
            "\"4.25\" is not a whole number, e.g. 4"
        );
        assert_eq!(
            not_whole("1.7e18", "a whole number"),
            "\"1.7e18\" is not a whole number with all its digits"
        );
        assert_eq!(
            not_whole("1.2.3", "a whole number"),
            "\"1.2.3\" is not a whole number"
        );
        assert!(
            ["NaN", "NA", "null", "None", ""]
                .into_iter()
                .all(is_missing)
        );
        assert!(!is_missing("nano") && !is_missing("-1"));
    }

    #[test]
    fn a_decimal_comma_is_named() {
        let told = not_a_number("-12,5", "a number");
        assert!(
            told.contains("decimal comma") && told.contains("-12.5"),
            "{told}"
        );
        assert_eq!(not_a_number("west", "a number"), "\"west\" is not a number");
        assert!(!not_a_number("1,2,3", "a number").contains("decimal comma"));
        assert_eq!(TextFile::decode(b"a\rb\r").unwrap().text(), "a\nb\n");
        let mixed = TextFile::decode(b"a\r\r\nb\rc\r\nd\r\re").unwrap();
        assert_eq!(mixed.text(), "a\r\r\nb\nc\r\nd\n\ne");
    }
}
