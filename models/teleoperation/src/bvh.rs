//! Motion files in the BVH text format (Biovision hierarchy): reader and writer on text. It opens
//! no file, and it does not interpret the motion: see [`super::motion`].
//!
//! Numbers and keywords may be spread over lines at will, and a name is the rest of its line; where lines hold one
//! frame each, every one has to. Lines that begin with `#` say nothing. Every
//! error names the line it was found on and where that begins in the file. No input makes the reader
//! panic, recurse or reserve more memory than the text's own size.

use core::fmt::Write as _;

use hil_core::text_file::{Line, TextFile, not_a_number, whole};

use crate::skeleton::{Channel, Skeleton};

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
    /// Frames that the file announces, which may be more or fewer.
    pub announced_count: usize,
    /// Values behind the last whole frame, which are not among `values`.
    pub cut_count: usize,
}

/// Why a text is not a motion file.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("line {line}, byte {offset}: {problem}")]
pub struct BvhError {
    /// Line of the offending word, counted from 1; the last line when the text ended early.
    pub line: u64,
    /// Where that line begins in the file.
    pub offset: u64,
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
    /// A word is no number.
    #[error("{0}")]
    NotANumber(String),
    /// A line of a frame has values too few or too many.
    #[error(
        "{value_count} values on a line, where a line is a frame of {channel_count}: this frame and those behind \
         it would be shifted"
    )]
    FrameLine {
        /// Values per frame.
        channel_count: usize,
        /// Values on the line.
        value_count: usize,
    },
    /// Another figure after the first.
    #[error("a second ROOT: one skeleton is read, and this file has more")]
    SecondRoot,
    /// There is not one whole frame.
    #[error("no whole frame: {channel_count} values make one, {value_count} found")]
    NoFrame {
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

    /// What is unusual about the number of frames, in words without full stop.
    pub fn remark(&self) -> Option<String> {
        let (announced, found, cut) = (self.announced_count, self.frame_count(), self.cut_count);
        let behind = if cut > 0 {
            format!("; {cut} values behind the last one are no whole frame and not played")
        } else {
            String::new()
        };
        (announced != found || cut > 0).then(|| {
            format!(
                "{announced} frames are announced, {found} whole ones are there and played{behind}"
            )
        })
    }

    /// Reads a motion file's text. Of frames, as many are read as are whole.
    ///
    /// # Errors
    /// The first line that is not as the format says.
    pub fn parse(file: &TextFile) -> Result<Self, BvhError> {
        let mut words = Words::new(file);
        words.keyword("HIERARCHY", "the keyword HIERARCHY")?;
        words.keyword("ROOT", "the keyword ROOT")?;
        let skeleton = parse_hierarchy(&mut words)?;
        words.next("the keyword MOTION")?;
        if words.is("ROOT") {
            return Err(words.error(BvhProblem::SecondRoot));
        }
        words.present_keyword("MOTION", "the keyword MOTION")?;
        words.keyword("Frames:", "the keyword Frames:")?;
        let announced_count: usize = words.whole("a frame count")?;
        words.keyword("Frame", "the keywords Frame Time:")?;
        words.keyword("Time:", "the keywords Frame Time:")?;
        let frame_time_s = words.number("a frame time in seconds")?;
        if !(1e-6..=10.0).contains(&frame_time_s) {
            return Err(words.error(BvhProblem::OutOfRange {
                what: "frame time",
                value: frame_time_s.to_string(),
                allowed: "0.000001 to 10 s",
            }));
        }
        let channel_count = skeleton.channel_count();
        let mut values = Vec::new();
        let mut lines = FrameLines::new(channel_count);
        while words.advance() {
            values.push(words.present_number("a channel value")?);
            lines.count(words.line);
        }
        let value_count = values.len();
        if channel_count == 0 || value_count < channel_count {
            return Err(words.error(BvhProblem::NoFrame {
                channel_count,
                value_count,
            }));
        }
        if let Some((line, value_count)) = lines.other(announced_count) {
            return Err(BvhError {
                line: line.number,
                offset: line.offset,
                problem: BvhProblem::FrameLine {
                    channel_count,
                    value_count,
                },
            });
        }
        let cut_count = value_count % channel_count;
        values.truncate(value_count - cut_count);
        Ok(Self {
            skeleton,
            frame_time_s,
            values,
            announced_count,
            cut_count,
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

/// Whether the lines of values hold one frame each.
struct FrameLines<'a> {
    channel_count: usize,
    /// The newest line and its values so far.
    newest: Option<(Line<'a>, usize)>,
    line_count: usize,
    /// Lines before the newest of one whole frame.
    whole_count: usize,
    /// The first line before the newest of another count.
    other: Option<(Line<'a>, usize)>,
}

impl<'a> FrameLines<'a> {
    const fn new(channel_count: usize) -> Self {
        Self {
            channel_count,
            newest: None,
            line_count: 0,
            whole_count: 0,
            other: None,
        }
    }

    /// Counts a value on `line`.
    fn count(&mut self, line: Line<'a>) {
        if let Some((newest, count)) = &mut self.newest
            && newest.number == line.number
        {
            *count += 1;
            return;
        }
        self.end_line();
        self.line_count += 1;
        self.newest = Some((line, 1));
    }

    fn end_line(&mut self) {
        match self.newest {
            Some((_, count)) if count == self.channel_count => self.whole_count += 1,
            other => self.other = self.other.or(other),
        }
    }

    /// The first line of another count than a frame's, where lines hold one frame each. The last one may be cut.
    fn other(mut self, announced_count: usize) -> Option<(Line<'a>, usize)> {
        let is_cut = self
            .newest
            .is_some_and(|(_, count)| count < self.channel_count);
        if !is_cut {
            self.end_line();
        }
        let is_frame_each =
            self.line_count == announced_count || self.whole_count * 2 >= self.line_count;
        self.other.filter(|_| is_frame_each)
    }
}

/// Reads from the root's name to the brace that closes the root.
fn parse_hierarchy(words: &mut Words<'_>) -> Result<Skeleton, BvhError> {
    const EXPECTED: &str = "JOINT, End Site or a closing brace";
    let mut skeleton = Skeleton::default();
    let mut open: Vec<usize> = Vec::new();
    open.push(parse_joint(words, &mut skeleton, None)?);
    while let Some(&parent) = open.last() {
        words.next(EXPECTED)?;
        if words.is("}") {
            open.pop();
        } else if words.is("JOINT") {
            open.push(parse_joint(words, &mut skeleton, Some(parent))?);
        } else if words.is("End") || words.is("EndSite") {
            if words.is("End") {
                words.keyword("Site", "the keyword Site")?;
            }
            // Some programs give it a name.
            words.next("an opening brace")?;
            if !words.is("{") {
                words.present_name("an opening brace")?;
                words.keyword("{", "an opening brace")?;
            }
            words.keyword("OFFSET", "the keyword OFFSET")?;
            for _ in 0..3 {
                words.number("an offset")?;
            }
            words.keyword("}", "a closing brace")?;
        } else {
            return Err(words.unexpected(EXPECTED));
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
    let name = words.name("a joint name")?.to_owned();
    if skeleton.joints().len() >= JOINT_COUNT_MAX {
        return Err(words.error(BvhProblem::OutOfRange {
            what: "joint count",
            value: (JOINT_COUNT_MAX + 1).to_string(),
            allowed: "1 to 1024",
        }));
    }
    words.keyword("{", "an opening brace")?;
    words.keyword("OFFSET", "the keyword OFFSET")?;
    let mut offset = [0.0; 3];
    for part in &mut offset {
        *part = words.number("an offset")?;
    }
    words.keyword("CHANNELS", "the keyword CHANNELS")?;
    let count: usize = words.whole("a channel count")?;
    if count > 6 {
        return Err(words.error(BvhProblem::OutOfRange {
            what: "channel count",
            value: count.to_string(),
            allowed: "0 to 6",
        }));
    }
    let mut channels = Vec::with_capacity(count);
    for _ in 0..count {
        const EXPECTED: &str = "a channel name such as Xrotation";
        words.next("a channel name")?;
        let channel =
            Channel::from_name(words.present).ok_or_else(|| words.unexpected(EXPECTED))?;
        channels.push(channel);
    }
    Ok(skeleton.push(&name, parent, offset, &channels))
}

/// The words of a text, one after the other.
struct Words<'a> {
    lines: Box<dyn Iterator<Item = Line<'a>> + 'a>,
    /// The one of the present word.
    line: Line<'a>,
    /// The rest of the line behind the present word.
    rest: &'a str,
    present: &'a str,
}

impl<'a> Words<'a> {
    fn new(file: &'a TextFile) -> Self {
        Self {
            lines: Box::new(file.lines()),
            line: Line {
                number: 1,
                offset: 0,
                content: "",
            },
            rest: "",
            present: "",
        }
    }

    /// Goes to the next word; false at the end.
    fn advance(&mut self) -> bool {
        loop {
            let trimmed = self.rest.trim_start();
            if let Some(word) = trimmed.split_whitespace().next() {
                (self.present, self.rest) = (word, &trimmed[word.len()..]);
                return true;
            }
            let Some(next) = self.lines.next() else {
                return false;
            };
            let is_remark = next.content.trim_start().starts_with('#');
            self.rest = if is_remark { "" } else { next.content };
            self.line = next;
        }
    }

    /// The next word and the rest of its line, up to a brace that opens there.
    fn name(&mut self, expected: &'static str) -> Result<&'a str, BvhError> {
        self.next(expected)?;
        self.present_name(expected)
    }

    /// The present word and the rest of its line, up to a brace that opens there.
    fn present_name(&mut self, expected: &'static str) -> Result<&'a str, BvhError> {
        let line = self.line.content;
        let start = line.len() - self.rest.len() - self.present.len();
        let behind = &line[start..];
        let end = behind.find('{').unwrap_or(behind.len());
        self.rest = &behind[end..];
        self.present = behind[..end].trim_end();
        if self.present.is_empty() {
            return Err(self.unexpected(expected));
        }
        Ok(self.present)
    }

    fn is(&self, keyword: &str) -> bool {
        self.present.eq_ignore_ascii_case(keyword)
    }

    fn next(&mut self, expected: &'static str) -> Result<(), BvhError> {
        if self.advance() {
            Ok(())
        } else {
            Err(self.error(BvhProblem::Ended { expected }))
        }
    }

    fn keyword(&mut self, keyword: &str, expected: &'static str) -> Result<(), BvhError> {
        self.next(expected)?;
        self.present_keyword(keyword, expected)
    }

    fn present_keyword(&mut self, keyword: &str, expected: &'static str) -> Result<(), BvhError> {
        // A colon may stand apart.
        let behind = self.rest.trim_start();
        if let Some(word) = keyword.strip_suffix(':')
            && self.is(word)
            && let Some(rest) = behind.strip_prefix(':')
        {
            self.rest = rest;
            return Ok(());
        }
        // What stands right behind a colon is the next word.
        let found = self.present.split_at_checked(keyword.len());
        let is_it = |word: &str| keyword.ends_with(':') && word.eq_ignore_ascii_case(keyword);
        if let Some((word, behind)) = found.filter(|(word, _)| is_it(word)) {
            let line = self.line.content;
            self.rest = &line[line.len() - self.rest.len() - behind.len()..];
            self.present = word;
        }
        if self.is(keyword) {
            Ok(())
        } else {
            Err(self.unexpected(expected))
        }
    }

    fn whole<T: core::str::FromStr>(&mut self, expected: &'static str) -> Result<T, BvhError> {
        self.next(expected)?;
        whole(self.present).ok_or_else(|| self.unexpected(expected))
    }

    fn number(&mut self, expected: &'static str) -> Result<f64, BvhError> {
        self.next(expected)?;
        self.present_number(expected)
    }

    /// The newest word as a finite number.
    fn present_number(&self, expected: &'static str) -> Result<f64, BvhError> {
        let parsed = self.present.parse().ok();
        parsed
            .filter(|value: &f64| value.is_finite())
            .ok_or_else(|| self.error(BvhProblem::NotANumber(not_a_number(self.present, expected))))
    }

    fn unexpected(&self, expected: &'static str) -> BvhError {
        self.error(BvhProblem::Unexpected {
            expected,
            found: self.present.chars().take(40).collect(),
        })
    }

    fn error(&self, problem: BvhProblem) -> BvhError {
        BvhError {
            line: self.line.number,
            offset: self.line.offset,
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
#[path = "bvh_tests.rs"]
mod tests;
