//! The parts of a report: sections of typed blocks. Numbers are kept as numbers with their unit; a text
//! stands beside them where a form shows it. What is unknown has no value and a reason, never zero.

use serde::ser::SerializeStruct;
use serde::{Serialize, Serializer};

use crate::terminal::strip;
use crate::units::{self, duration, percent};
use hil_platform::text::grouped;

/// What stands where there is no value.
pub const UNAVAILABLE: &str = "unavailable";

/// What a piece of text means; a form decides how that looks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Tone {
    /// As the rest.
    #[default]
    Plain,
    /// What a reader looks for.
    Strong,
    /// As it should be.
    Good,
    /// Worth a look.
    Caution,
    /// Wrong.
    Bad,
    /// Beside the point: labels, methods.
    Faint,
    /// A bar.
    Bar,
    /// Where the reader stands.
    Chosen,
}

impl Tone {
    /// `good`, `caution`, `bad` or `plain`.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Caution => "caution",
            Self::Bad => "bad",
            Self::Plain | Self::Strong | Self::Faint | Self::Bar | Self::Chosen => "plain",
        }
    }
}

impl Serialize for Tone {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(match self {
            Self::Strong => "strong",
            Self::Faint => "faint",
            tone => tone.word(),
        })
    }
}

/// A part of a report under one title.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Section {
    /// Unique among its siblings, fit for an anchor: lower case, digits and hyphens.
    pub id: String,
    /// What it is about.
    pub title: String,
    /// Beside the title; may be empty.
    pub aside: String,
    /// The channel that its metrics are of; empty for those of the whole run.
    pub subject: String,
    /// A page shows the title alone until the reader asks for the rest.
    pub is_folded: bool,
    /// What it says, in this order.
    pub blocks: Vec<Block>,
    /// Parts below it.
    pub children: Vec<Section>,
}

/// One thing a section says.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Block {
    /// Labels with a text beside each.
    Facts {
        /// In the order of reading.
        facts: Vec<Field>,
    },
    /// Rows and columns.
    Table(Table),
    /// Numbers with their intervals and methods.
    Metrics {
        /// In the order of reading.
        metrics: Vec<Metric>,
    },
    /// What happened, in order of time.
    Events(EventList),
    /// A picture; a terminal has none.
    Drawing(Drawing),
    /// Series on one time axis, for a terminal; a page has a drawing.
    Strips(Strips),
    /// A sentence or two.
    Note {
        /// What it means.
        tone: Tone,
        /// The sentence.
        text: String,
    },
    /// Sentences that do not depend on each other; a page folds a long list.
    List {
        /// What they mean.
        tone: Tone,
        /// The sentences.
        items: Vec<String>,
    },
    /// A command to copy.
    Command {
        /// As a shell takes it.
        text: String,
    },
}

/// A label and a text.
#[derive(Debug, Clone, Serialize)]
pub struct Field {
    /// Short; empty where the text continues the field before.
    pub label: String,
    /// What it means.
    pub tone: Tone,
    /// The text.
    pub value: String,
}

impl Field {
    /// A plain one.
    pub fn new(label: impl Into<String>, value: impl Into<String>) -> Self {
        Self::toned(label, Tone::Plain, value)
    }

    /// With a tone.
    pub fn toned(label: impl Into<String>, tone: Tone, value: impl Into<String>) -> Self {
        Self {
            label: label.into(),
            tone,
            value: value.into(),
        }
    }
}

/// One number with its interval and how it came about.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Metric {
    /// Snake case; what CSV calls it.
    pub name: String,
    /// What a reader calls it.
    pub label: String,
    /// SI unit, `1`, or `share` for a ratio that is shown in per cent.
    pub unit: String,
    /// `None` where there is none; [`Metric::method`] says why.
    pub value: Option<f64>,
    /// The value as a reader wants it, or [`UNAVAILABLE`].
    pub text: String,
    /// Lower end of the interval of 95 %.
    pub low: Option<f64>,
    /// Upper end of the interval of 95 %.
    pub high: Option<f64>,
    /// The interval as text, or why the sample has none; empty for what needs none.
    pub interval: String,
    /// How it was obtained, or why it was not.
    pub method: String,
}

impl Metric {
    /// A number with its text.
    pub fn new(name: &str, label: &str, unit: &str, value: f64) -> Self {
        if !value.is_finite() {
            return Self::unavailable(name, label, unit, "it is no finite number");
        }
        Self {
            name: name.to_owned(),
            label: label.to_owned(),
            unit: unit.to_owned(),
            value: Some(value),
            text: units::value(value, unit),
            ..Self::default()
        }
    }

    /// None, and why.
    pub fn unavailable(name: &str, label: &str, unit: &str, reason: &str) -> Self {
        Self {
            name: name.to_owned(),
            label: label.to_owned(),
            unit: unit.to_owned(),
            text: UNAVAILABLE.to_owned(),
            method: reason.to_owned(),
            ..Self::default()
        }
    }

    /// A number, or none because of `reason`.
    pub fn maybe(name: &str, label: &str, unit: &str, value: Option<f64>, reason: &str) -> Self {
        match value.filter(|value| value.is_finite()) {
            Some(value) => Self::new(name, label, unit, value),
            None => Self::unavailable(name, label, unit, reason),
        }
    }

    /// With how it was obtained; a number that there is none of keeps its reason.
    #[must_use]
    pub fn by(mut self, method: &str) -> Self {
        if self.value.is_some() {
            method.clone_into(&mut self.method);
        }
        self
    }

    /// Without an interval, and why; a number that there is none of has no interval either.
    #[must_use]
    pub fn without_interval(mut self, why: &str) -> Self {
        if self.value.is_some() {
            why.clone_into(&mut self.interval);
        }
        self
    }

    /// The value with its interval, where it has one.
    pub fn words(&self) -> String {
        match self.low {
            Some(_) => format!("{} [{}]", self.text, self.interval),
            None => self.text.clone(),
        }
    }

    /// With its interval of 95 %.
    #[must_use]
    pub fn within(mut self, interval: Option<(f64, f64)>) -> Self {
        let is_finite = |(low, high): &(f64, f64)| low.is_finite() && high.is_finite();
        let interval = interval.filter(|ends| self.value.is_some() && is_finite(ends));
        if let Some((low, high)) = interval {
            (self.low, self.high) = (Some(low), Some(high));
            let [low, high] = [low, high].map(|end| units::value(end, &self.unit));
            // A unit that both ends have is said once.
            let unit = high.rsplit_once(units::JOINT).map(|(_, unit)| unit);
            let begin = low.rsplit_once(units::JOINT);
            let begin = begin.filter(|(_, of_low)| Some(*of_low) == unit);
            let low = begin.map_or(low.as_str(), |(begin, _)| begin);
            self.interval = format!("{low} to {high}");
        }
        self
    }
}

/// Rows and columns.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Table {
    /// What it shows; may be empty.
    pub title: String,
    /// From left to right.
    pub columns: Vec<Column>,
    /// From top to bottom. A row with fewer cells than columns ends in a reason that takes their place.
    pub rows: Vec<Row>,
    /// Below it; may be empty.
    pub note: String,
    /// A text of the first column that has no room stands on a line of its own, before a column is left out.
    #[serde(skip)]
    pub has_long_names: bool,
}

/// A column of a table.
#[derive(Debug, Clone, Serialize)]
pub struct Column {
    /// What CSV calls it.
    pub key: String,
    /// Its head.
    pub label: String,
    /// Zero is always shown; where there is no room, the highest goes first.
    pub rank: u8,
}

/// A row of a table.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Row {
    /// From left to right.
    pub cells: Vec<Cell>,
    /// What it means.
    pub tone: Tone,
    /// Drawn behind it where there is room.
    pub bar: Option<Bar>,
}

/// Where a bar begins and ends on a scale of 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Bar {
    /// Where it begins.
    pub start: f64,
    /// Where it ends.
    pub end: f64,
}

/// One value of a table.
#[derive(Debug, Clone, PartialEq)]
pub enum Cell {
    /// Words.
    Text(String),
    /// How many.
    Count(u64),
    /// A duration, nanoseconds.
    Duration(i64),
    /// A ratio, shown in per cent.
    Share(f64),
    /// A number without a unit.
    Number {
        /// The number.
        value: f64,
        /// Digits that are shown behind the point.
        decimals: usize,
    },
    /// From one number to another.
    Range {
        /// Lower end.
        low: f64,
        /// Upper end.
        high: f64,
        /// Digits that are shown behind the point.
        decimals: usize,
    },
    /// A series of equal steps; `None` where nothing is known.
    Spark(Vec<Option<f64>>),
    /// There is none here.
    Missing,
}

impl Cell {
    /// A count, where there is one.
    pub fn count(count: Option<u64>) -> Self {
        count.map_or(Self::Missing, Self::Count)
    }

    /// A duration in nanoseconds, where there is one.
    pub fn duration(ns: Option<i64>) -> Self {
        ns.map_or(Self::Missing, Self::Duration)
    }

    /// A ratio, where there is one.
    pub fn share(ratio: Option<f64>) -> Self {
        ratio.map_or(Self::Missing, Self::Share)
    }

    /// A number shown with so many decimals, where there is one.
    pub fn number(value: Option<f64>, decimals: usize) -> Self {
        value.map_or(Self::Missing, |value| Self::Number { value, decimals })
    }

    /// As a reader wants it.
    pub fn text(&self) -> String {
        match self {
            Self::Text(text) => text.clone(),
            Self::Count(count) => grouped(*count),
            Self::Duration(ns) => duration(*ns),
            Self::Share(ratio) => percent(*ratio),
            Self::Number { value, decimals } => format!("{value:.decimals$}"),
            Self::Range {
                low,
                high,
                decimals,
            } => format!("{low:.decimals$} to {high:.decimals$}"),
            Self::Spark(values) => strip(values, values.len()),
            Self::Missing => "–".to_owned(),
        }
    }

    /// Number and unit for a program.
    pub(crate) fn for_program(&self) -> Option<(f64, &'static str)> {
        match self {
            Self::Text(_) | Self::Range { .. } | Self::Spark(_) | Self::Missing => None,
            Self::Count(count) => Some((*count as f64, "1")),
            Self::Duration(ns) => Some((units::ns_s(*ns), "s")),
            Self::Share(ratio) => Some((*ratio, "share")),
            Self::Number { value, .. } => Some((*value, "1")),
        }
    }

    /// True for what stands at the right of its column.
    pub(crate) fn is_number(&self) -> bool {
        self.for_program().is_some() || matches!(self, Self::Range { .. })
    }
}

impl Serialize for Cell {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let number = self.for_program();
        let mut cell = serializer.serialize_struct("Cell", 3)?;
        cell.serialize_field("text", &self.text())?;
        cell.serialize_field("value", &number.map(|(value, _)| value))?;
        cell.serialize_field("unit", &number.map(|(_, unit)| unit))?;
        cell.end()
    }
}

impl From<String> for Cell {
    fn from(text: String) -> Self {
        Self::Text(text)
    }
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}

impl Table {
    /// An empty one, every column of which is always shown.
    pub fn new(title: &str, columns: &[&str]) -> Self {
        let column = |label: &&str| Column {
            key: (*label).to_owned(),
            label: (*label).to_owned(),
            rank: 0,
        };
        Self {
            title: title.to_owned(),
            columns: columns.iter().map(column).collect(),
            ..Self::default()
        }
    }

    /// With one more column; its rows have no cell for it yet.
    #[must_use]
    pub fn with_column(mut self, label: &str) -> Self {
        self.columns.push(Column {
            key: label.to_owned(),
            label: label.to_owned(),
            rank: 0,
        });
        self
    }

    /// Ranks the column of `label`, see [`Column::rank`].
    #[must_use]
    pub fn ranked(mut self, label: &str, rank: u8) -> Self {
        let mut columns = self.columns.iter_mut();
        if let Some(column) = columns.find(|one| one.label == label) {
            column.rank = rank;
        }
        self
    }

    /// Of rows with long names, see [`Table::has_long_names`].
    #[must_use]
    pub const fn with_long_names(mut self) -> Self {
        self.has_long_names = true;
        self
    }

    /// One more row.
    pub fn push(&mut self, cells: impl IntoIterator<Item = Cell>) {
        self.rows.push(Row {
            cells: cells.into_iter().collect(),
            ..Row::default()
        });
    }
}

/// Events in order of time.
#[derive(Debug, Clone, Default, Serialize)]
pub struct EventList {
    /// Those that are listed.
    pub events: Vec<Event>,
    /// What was left out, and where it is; empty when nothing was.
    pub note: String,
}

/// One event.
#[derive(Debug, Clone, Serialize)]
pub struct Event {
    /// When, from the start of the run.
    pub at: String,
    /// How grave it is, in a word.
    pub severity: &'static str,
    /// What that means.
    pub tone: Tone,
    /// What happened.
    pub what: String,
    /// What stood beside it.
    pub beside: Vec<String>,
}

/// A picture.
#[derive(Debug, Clone, Serialize)]
pub struct Drawing {
    /// Unique in the report; the file's name as SVG.
    pub name: String,
    /// Above it.
    pub title: String,
    /// Below it.
    pub caption: String,
    /// An `svg` element.
    pub svg: String,
    /// True for one that wants the whole width.
    pub is_wide: bool,
}

/// Series on one time axis.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Strips {
    /// Length of the axis, seconds.
    pub whole_s: f64,
    /// From top to bottom.
    pub rows: Vec<Strip>,
    /// Times to mark below the rows, seconds, and what they are.
    pub marks_s: Vec<f64>,
    /// What the marks are.
    pub marks_label: &'static str,
}

/// A series of equal steps.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Strip {
    /// Of what; empty where it continues the row above.
    pub name: String,
    /// What it shows.
    pub what: String,
    /// What it means.
    pub tone: Tone,
    /// A value a step; `None` where nothing is known.
    pub values: Vec<Option<f64>>,
    /// The largest value as a reader wants it.
    pub scale: String,
}

impl Section {
    /// An empty one.
    pub fn new(id: &str, title: impl Into<String>, aside: impl Into<String>) -> Self {
        Self {
            id: id.to_owned(),
            title: title.into(),
            aside: aside.into(),
            ..Self::default()
        }
    }

    /// True when it says nothing.
    pub fn is_empty(&self) -> bool {
        self.blocks.is_empty() && self.children.is_empty()
    }

    /// One more fact, in the last list of facts where that is the last block.
    pub fn fact(&mut self, label: impl Into<String>, tone: Tone, value: impl Into<String>) {
        let fact = Field::toned(label, tone, value);
        match self.blocks.last_mut() {
            Some(Block::Facts { facts }) => facts.push(fact),
            _ => self.blocks.push(Block::Facts { facts: vec![fact] }),
        }
    }

    /// One more note.
    pub fn note(&mut self, tone: Tone, text: impl Into<String>) {
        let text = text.into();
        self.blocks.push(Block::Note { tone, text });
    }

    /// One more metric, in the last list of metrics where that is the last block.
    pub fn metric(&mut self, metric: Metric) {
        match self.blocks.last_mut() {
            Some(Block::Metrics { metrics }) => metrics.push(metric),
            _ => self.blocks.push(Block::Metrics {
                metrics: vec![metric],
            }),
        }
    }

    /// One more table.
    pub fn table(&mut self, table: Table) {
        self.blocks.push(Block::Table(table));
    }

    /// Every metric of it and of what is below it, with its subject.
    pub fn metrics(&self) -> Vec<(&str, &Metric)> {
        let own = self.blocks.iter().filter_map(|block| match block {
            Block::Metrics { metrics } => Some(metrics.as_slice()),
            _ => None,
        });
        let own = own.flatten().map(|metric| (self.subject.as_str(), metric));
        let below = self.children.iter().flat_map(Self::metrics);
        own.chain(below).collect()
    }

    /// Every picture of it and of what is below it.
    pub fn drawings(&self) -> Vec<&Drawing> {
        let own = self.blocks.iter().filter_map(|block| match block {
            Block::Drawing(drawing) => Some(drawing),
            _ => None,
        });
        let below = self.children.iter().flat_map(Self::drawings);
        own.chain(below).collect()
    }
}
