//! Motion files in the BVH text format (Biovision hierarchy): reader and writer on text. It opens
//! no file, and it does not interpret the motion: see [`super::motion`].
//!
//! Numbers and keywords may be spread over lines at will; every error names the line it was found
//! on. No input makes the reader panic, recurse or reserve more memory than the text's own size.

use core::fmt::Write as _;

use crate::teleoperation::skeleton::{Channel, Skeleton};

/// More joints than any capture suit has; a bound against nonsense.
pub const JOINT_COUNT_MAX: usize = 1024;

/// A skeleton and its frames.
#[derive(Debug, Clone, PartialEq)]
pub struct Bvh {
    /// The joints and what their channels mean.
    pub skeleton: Skeleton,
    /// Time from one frame to the next, seconds; above zero.
    pub frame_time_s: f64,
    /// Frames one after another, [`Skeleton::channel_count`] values each.
    pub values: Vec<f64>,
}

/// Why a text is not a motion file.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("line {line}: {problem}")]
pub struct BvhError {
    /// Line of the offending word, counted from 1; the last line when the text ended early.
    pub line: usize,
    /// What was wrong with it.
    pub problem: BvhProblem,
}

/// What was wrong.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BvhProblem {
    /// Another word was due.
    #[error("expected {expected}, found {found:?}")]
    Unexpected {
        /// What was due.
        expected: &'static str,
        /// What stood there, shortened to 40 characters.
        found: String,
    },
    /// The text ended.
    #[error("expected {expected}, found the end of the text")]
    Ended {
        /// What was due.
        expected: &'static str,
    },
    /// A number outside its bound.
    #[error("{what} {value} is outside {allowed}")]
    OutOfRange {
        /// Which number.
        what: &'static str,
        /// Its value as written.
        value: String,
        /// What it may be.
        allowed: &'static str,
    },
    /// The frame count does not fit the numbers that follow.
    #[error("{frame_count} frames of {channel_count} values announced, {value_count} values found")]
    FrameCount {
        /// Announced frames.
        frame_count: usize,
        /// Values per frame.
        channel_count: usize,
        /// Values in the text.
        value_count: usize,
    },
}

impl Bvh {
    /// Number of frames.
    pub fn frame_count(&self) -> usize {
        self.values.len() / self.skeleton.channel_count().max(1)
    }

    /// The frames in order.
    pub fn frames(&self) -> impl Iterator<Item = &[f64]> {
        self.values
            .chunks_exact(self.skeleton.channel_count().max(1))
    }

    /// Reads a motion file's text.
    ///
    /// # Errors
    /// The first line that is not as the format says.
    pub fn parse(text: &str) -> Result<Self, BvhError> {
        let mut words = Words::new(text);
        words.keyword("HIERARCHY", "the keyword HIERARCHY")?;
        words.keyword("ROOT", "the keyword ROOT")?;
        let skeleton = parse_hierarchy(&mut words)?;
        words.keyword("MOTION", "the keyword MOTION")?;
        words.keyword("Frames:", "the keyword Frames:")?;
        let count_line = words.line;
        let frame_count: usize = words.number("a frame count")?;
        words.keyword("Frame", "the keywords Frame Time:")?;
        words.keyword("Time:", "the keywords Frame Time:")?;
        let frame_time_s = words.finite("a frame time in seconds")?;
        if !(1e-6..=10.0).contains(&frame_time_s) {
            return Err(words.error(BvhProblem::OutOfRange {
                what: "frame time",
                value: frame_time_s.to_string(),
                allowed: "0.000001..=10 s",
            }));
        }
        let mut values = Vec::new();
        while words.peek().is_some() {
            values.push(words.finite("a channel value")?);
        }
        let channel_count = skeleton.channel_count();
        if frame_count.checked_mul(channel_count) != Some(values.len()) || values.is_empty() {
            return Err(BvhError {
                line: count_line,
                problem: BvhProblem::FrameCount {
                    frame_count,
                    channel_count,
                    value_count: values.len(),
                },
            });
        }
        Ok(Self {
            skeleton,
            frame_time_s,
            values,
        })
    }

    /// The motion file's text; [`Bvh::parse`] reads it back with six decimals.
    pub fn to_text(&self) -> String {
        let mut text = String::from("HIERARCHY\n");
        write_joint(&mut text, &self.skeleton, 0, 0);
        let frame_count = self.frame_count();
        // Writing to a String cannot fail.
        let _infallible = write!(
            text,
            "MOTION\nFrames: {frame_count}\nFrame Time: {:.9}\n",
            self.frame_time_s
        );
        for frame in self.frames() {
            for (index, value) in frame.iter().enumerate() {
                let separator = if index == 0 { "" } else { " " };
                let _infallible = write!(text, "{separator}{value:.6}");
            }
            text.push('\n');
        }
        text
    }
}

/// Reads from the root's name to the brace that closes the root.
fn parse_hierarchy(words: &mut Words<'_>) -> Result<Skeleton, BvhError> {
    let mut skeleton = Skeleton::default();
    let mut open: Vec<usize> = Vec::new();
    open.push(parse_joint(words, &mut skeleton, None)?);
    while let Some(&parent) = open.last() {
        let word = words.next("JOINT, End Site or a closing brace")?;
        if word == "}" {
            open.pop();
        } else if word.eq_ignore_ascii_case("JOINT") {
            open.push(parse_joint(words, &mut skeleton, Some(parent))?);
        } else if word.eq_ignore_ascii_case("End") {
            words.keyword("Site", "the keyword Site")?;
            words.keyword("{", "an opening brace")?;
            words.keyword("OFFSET", "the keyword OFFSET")?;
            for _ in 0..3 {
                words.finite("an offset")?;
            }
            words.keyword("}", "a closing brace")?;
        } else {
            return Err(words.unexpected("JOINT, End Site or a closing brace", word));
        }
    }
    Ok(skeleton)
}

/// Reads a joint's name, offset and channels; its children and closing brace come after.
fn parse_joint(
    words: &mut Words<'_>,
    skeleton: &mut Skeleton,
    parent: Option<usize>,
) -> Result<usize, BvhError> {
    let name = words.next("a joint name")?;
    if skeleton.joints().len() >= JOINT_COUNT_MAX {
        return Err(words.error(BvhProblem::OutOfRange {
            what: "joint count",
            value: (JOINT_COUNT_MAX + 1).to_string(),
            allowed: "1..=1024",
        }));
    }
    words.keyword("{", "an opening brace")?;
    words.keyword("OFFSET", "the keyword OFFSET")?;
    let mut offset = [0.0; 3];
    for part in &mut offset {
        *part = words.finite("an offset")?;
    }
    words.keyword("CHANNELS", "the keyword CHANNELS")?;
    let count: usize = words.number("a channel count")?;
    if count > 6 {
        return Err(words.error(BvhProblem::OutOfRange {
            what: "channel count",
            value: count.to_string(),
            allowed: "0..=6",
        }));
    }
    let mut channels = Vec::with_capacity(count);
    for _ in 0..count {
        let word = words.next("a channel name")?;
        let channel = Channel::from_name(word)
            .ok_or_else(|| words.unexpected("a channel name such as Xrotation", word))?;
        channels.push(channel);
    }
    Ok(skeleton.push(name, parent, offset, &channels))
}

/// The text's words with the line each stands on.
struct Words<'a> {
    rest: &'a str,
    line: usize,
}

impl<'a> Words<'a> {
    fn new(text: &'a str) -> Self {
        Self {
            rest: text.trim_start_matches('\u{feff}'),
            line: 1,
        }
    }

    /// Skips white space, counting lines; true when a word follows.
    fn peek(&mut self) -> Option<&'a str> {
        let word_start = self.rest.trim_start();
        let skipped = &self.rest[..self.rest.len() - word_start.len()];
        self.line += skipped.bytes().filter(|byte| *byte == b'\n').count();
        self.rest = word_start;
        word_start.split_whitespace().next()
    }

    fn next(&mut self, expected: &'static str) -> Result<&'a str, BvhError> {
        let word = self
            .peek()
            .ok_or_else(|| self.error(BvhProblem::Ended { expected }))?;
        self.rest = &self.rest[word.len()..];
        Ok(word)
    }

    fn keyword(&mut self, keyword: &str, expected: &'static str) -> Result<(), BvhError> {
        let word = self.next(expected)?;
        if word.eq_ignore_ascii_case(keyword) {
            Ok(())
        } else {
            Err(self.unexpected(expected, word))
        }
    }

    fn number<T: core::str::FromStr>(&mut self, expected: &'static str) -> Result<T, BvhError> {
        let word = self.next(expected)?;
        word.parse()
            .ok()
            .ok_or_else(|| self.unexpected(expected, word))
    }

    fn finite(&mut self, expected: &'static str) -> Result<f64, BvhError> {
        let word = self.next(expected)?;
        word.parse()
            .ok()
            .filter(|value: &f64| value.is_finite())
            .ok_or_else(|| self.unexpected(expected, word))
    }

    fn unexpected(&self, expected: &'static str, word: &str) -> BvhError {
        self.error(BvhProblem::Unexpected {
            expected,
            found: word.chars().take(40).collect(),
        })
    }

    fn error(&self, problem: BvhProblem) -> BvhError {
        BvhError {
            line: self.line,
            problem,
        }
    }
}

/// Writes joint `index` and everything below it. The depth is that of a skeleton in memory, at
/// most [`JOINT_COUNT_MAX`] when it was read.
fn write_joint(text: &mut String, skeleton: &Skeleton, index: usize, depth: usize) {
    let Some(joint) = skeleton.joints().get(index) else {
        return;
    };
    let indent = "\t".repeat(depth);
    let keyword = if joint.parent.is_none() {
        "ROOT"
    } else {
        "JOINT"
    };
    let [x, y, z] = joint.offset.into();
    // Writing to a String cannot fail.
    let _infallible = write!(
        text,
        "{indent}{keyword} {}\n{indent}{{\n{indent}\tOFFSET {x:.6} {y:.6} {z:.6}\n{indent}\tCHANNELS {}",
        joint.name,
        joint.channels.len()
    );
    for channel in &joint.channels {
        let _infallible = write!(text, " {}", channel.name());
    }
    text.push('\n');
    let mut is_leaf = true;
    for (child, candidate) in skeleton.joints().iter().enumerate().skip(index + 1) {
        if candidate.parent == Some(index) {
            is_leaf = false;
            write_joint(text, skeleton, child, depth + 1);
        }
    }
    if is_leaf {
        let _infallible = write!(
            text,
            "{indent}\tEnd Site\n{indent}\t{{\n{indent}\t\tOFFSET 0.000000 0.000000 0.000000\n{indent}\t}}\n"
        );
    }
    let _infallible = writeln!(text, "{indent}}}");
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::RandomStream;

    const SMALL: &str = "HIERARCHY\nROOT Hips\n{\n  OFFSET 0 0 0\n  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n  JOINT RightHand\n  {\n    OFFSET -50 40 0\n    CHANNELS 3 Yrotation Xrotation Zrotation\n    End Site\n    {\n      OFFSET -10 0 0\n    }\n  }\n}\nMOTION\nFrames: 2\nFrame Time: 0.008\n0 95 0 0 0 0 1 2 3\n0 95 0 0 0 0 1.5 -2e1 3\n";

    fn check_error(text: &str, line: usize, message: &str) {
        let error = Bvh::parse(text).unwrap_err();
        assert_eq!(error.line, line, "{error}");
        assert!(error.to_string().contains(message), "{error}");
    }

    #[test]
    fn a_small_file_is_read_as_written() {
        let bvh = Bvh::parse(SMALL).unwrap();
        assert_eq!(bvh.frame_count(), 2);
        assert_eq!(bvh.skeleton.channel_count(), 9);
        assert_eq!(bvh.skeleton.joints()[1].parent, Some(0));
        assert_eq!(bvh.frames().count(), 2);
        assert!((bvh.values[16] + 20.0).abs() < 1e-15);
        assert_eq!(Bvh::parse(&bvh.to_text()).unwrap(), bvh);
    }

    #[test]
    fn windows_line_ends_and_a_byte_order_mark_change_nothing() {
        let windows = format!("\u{feff}{}", SMALL.replace('\n', "\r\n"));
        assert_eq!(Bvh::parse(&windows), Bvh::parse(SMALL));
    }

    #[test]
    fn errors_name_line_and_cause() {
        check_error("", 1, "expected the keyword HIERARCHY");
        check_error(&SMALL.replace("-50", "west"), 8, "found \"west\"");
        check_error(&SMALL.replace("Yrotation X", "Yaw X"), 9, "channel name");
        check_error(&SMALL.replace("0.008", "0"), 18, "frame time 0 is outside");
        check_error(&SMALL.replace("-2e1", "NaN"), 20, "a channel value");
        check_error(&SMALL.replace(": 2", ": 3"), 17, "18 values found");
        check_error(&SMALL.replace("CHANNELS 3", "CHANNELS 7"), 9, "0..=6");
        check_error(&SMALL[..60], 5, "the end of the text");
        let huge = SMALL.replace(": 2", ": 18446744073709551615");
        check_error(&huge, 17, "frames of 9 values");
    }

    #[test]
    fn deep_nesting_ends_in_an_error_not_in_an_overflow() {
        let joint = "JOINT a { OFFSET 0 0 0 CHANNELS 0 ";
        let deep = format!(
            "HIERARCHY\nROOT{}",
            joint[5..].to_owned() + &joint.repeat(5000)
        );
        check_error(&deep, 2, "joint count 1025 is outside 1..=1024");
    }

    #[test]
    fn a_hundred_thousand_mutations_never_panic() {
        let mut stream = RandomStream::new(20, "bvh mutation");
        let pieces = [
            "{", "}", "\n", " ", "-", "1e999", "End Site", "JOINT x", "\u{e9}", "0",
        ];
        let below = |stream: &mut RandomStream, bound: usize| {
            usize::try_from(stream.next_u64() % bound as u64).unwrap()
        };
        let mut refused_count = 0;
        for _ in 0..100_000 {
            let mut bytes = SMALL.as_bytes().to_vec();
            for _ in 0..=below(&mut stream, 4) {
                let at = below(&mut stream, bytes.len());
                match below(&mut stream, 4) {
                    0 => bytes[at] = (stream.next_u64() & 0x7f) as u8,
                    1 => bytes.truncate(at + 1),
                    2 => drop(bytes.drain(at..(at + below(&mut stream, 30)).min(bytes.len()))),
                    _ => {
                        let piece = pieces[below(&mut stream, pieces.len())].bytes();
                        drop(bytes.splice(at..at, piece));
                    }
                }
                bytes.push(b'\n');
            }
            let text = String::from_utf8_lossy(&bytes);
            match Bvh::parse(&text) {
                Ok(bvh) => assert_eq!(bvh.values.len() % bvh.skeleton.channel_count(), 0),
                Err(error) => {
                    assert!(error.line <= 1 + text.lines().count());
                    refused_count += 1;
                }
            }
        }
        assert!(refused_count > 50_000, "{refused_count} refused");
    }
}
