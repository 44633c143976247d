//! The textual form of a trace: lines `# key: value` for the header, then comma-separated values
//! with the names of their columns first, as in RFC 4180; other separators are read as well. Text in, text out: it
//! opens no file.

use core::fmt::Write;

use hil_core::text_file::{
    Line, TextFault, TextFile, cells, is_missing, not_whole, separator_of, short, whole,
};

use super::epoch::{NANOSECONDS, origin};
use super::{
    Trace, TraceArrival, TraceDirection, TraceFate, TraceHeader, TraceRecord, UNAVAILABLE_NS,
    UNBOUNDED_NS,
};

/// The columns that are written, in order.
pub const COLUMNS: [&str; 10] = [
    "published_ns",
    "departure_ns",
    "fate",
    "delay_ns",
    "bound_ns",
    "second_delay_ns",
    "size_bytes",
    "sequence",
    "start",
    "flags",
];

/// Most bytes of a message: 1024 datagrams of the longest kind, what a gateway joins at most.
pub const SIZE_BYTES_MAX: u32 = 1024 * 65_535;

/// What could be read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CsvDecoded {
    /// Header and every row before the first fault.
    pub trace: Trace,
    /// The first fault; `None` when the text is whole.
    pub fault: Option<TextFault>,
}

/// The text of `trace`.
pub fn encode(trace: &Trace) -> String {
    let header = &trace.header;
    let mut text = String::new();
    let instant = |ns: i64| (ns != UNAVAILABLE_NS).then(|| ns.to_string());
    let names = [
        ("run", Some(one_line(&header.run))),
        ("channel", Some(one_line(&header.channel))),
        ("link", Some(one_line(&header.link))),
        ("clock", Some(one_line(&header.clock))),
        ("direction", Some(header.direction.word().to_owned())),
        ("arrival", Some(header.arrival.word().to_owned())),
        (
            "link_change_count",
            (header.link_change_count > 0).then(|| header.link_change_count.to_string()),
        ),
        ("origin_ns", instant(header.origin_ns)),
        ("duration_ns", instant(header.duration_ns)),
        ("record_count", Some(trace.records.len().to_string())),
    ];
    for (key, value) in names {
        if let Some(value) = value.filter(|value| !value.is_empty()) {
            let _infallible = writeln!(text, "# {key}: {value}");
        }
    }
    let _infallible = writeln!(text, "{}", COLUMNS.join(","));
    for record in &trace.records {
        let or_empty = |ns: i64| instant(ns).unwrap_or_default();
        let bound = Some(record.bound_ns).filter(|bound| *bound != UNBOUNDED_NS);
        let _infallible = writeln!(
            text,
            "{},{},{},{},{},{},{},{},{},{}",
            record.published_ns,
            record.departure_ns,
            record.fate,
            or_empty(record.delay_ns),
            bound.map(|bound| bound.to_string()).unwrap_or_default(),
            or_empty(record.second_delay_ns),
            record.size_bytes,
            record.sequence,
            record.start,
            record.flags
        );
    }
    text
}

/// A name as a remark can hold it: on one line, without blanks around it.
pub(crate) fn one_line(text: &str) -> String {
    let line: String = text
        .chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect();
    line.trim().to_owned()
}

/// Reads a text. Columns may stand in any order; needed are `published_ns` or `departure_ns`, and
/// `fate` or `delay_ns`, where an empty delay is a loss. So two columns of any measurement make a
/// trace.
///
/// # Errors
/// Before the first row: no line with column names, or a line that cannot be used. Every later
/// fault is beside what could be read.
pub fn decode(file: &TextFile) -> Result<CsvDecoded, TextFault> {
    let mut header = TraceHeader::new("");
    let mut records: Vec<TraceRecord> = Vec::new();
    let mut columns: Option<Columns> = None;
    let mut promised: Option<u64> = None;
    let mut separator = None;
    let mut names_line = 0;
    let mut fault = None;
    for line in file.lines() {
        let content = line.content;
        let remark = remark(content);
        let read = if let Some(remark) = remark {
            // Some programs write the names as a remark.
            let named = || Columns::read(remark, separator).ok();
            let named = records.is_empty().then(named).flatten();
            if named.is_some() {
                (columns, names_line) = (named, line.number);
                Ok(())
            } else {
                read_remark(remark, &mut header, &mut promised)
            }
        } else if content.trim().is_empty() {
            Ok(())
        } else if columns.is_none()
            && let Some(said) = said_separator(content)
        {
            separator = Some(said);
            Ok(())
        } else if let Some(known) = &columns {
            // Where a remark had them already.
            let names = || Columns::read(content, separator).ok();
            if let Some(names) = records.is_empty().then(names).flatten() {
                (columns, names_line) = (Some(names), line.number);
                Ok(())
            } else {
                let before_ns = records.last().map(|record| record.published_ns);
                let record = known.record(content, records.len() as u64, before_ns);
                record.map(|record| records.push(record))
            }
        } else {
            let names = Columns::read(content, separator);
            names.map(|names| (columns, names_line) = (Some(names), line.number))
        };
        if let Err(what) = read {
            if records.is_empty() && (columns.is_none() || remark.is_some()) {
                return Err(line.fault(what));
            }
            fault = Some(line.fault(what));
            break;
        }
    }
    if columns.is_none() {
        let what = format!("no line with column names, e.g. {}", COLUMNS.join(","));
        return Err(file.end().fault(what));
    }
    if fault.is_none() {
        let count = records.len() as u64;
        let missing = promised.filter(|promised| *promised != count);
        fault = missing.map(|promised| {
            let what = format!("{count} records, record_count says {promised}");
            file.end().fault(what)
        });
    }
    // A text of ours, which states its count, means its numbers as they are.
    let first_ns = match promised {
        Some(_) => 0,
        None => first_since_1970(&records)
            .and_then(|first_ns| no_marks(&records).map(|()| first_ns))
            .map_err(|Doubt { index, what }| row(file, names_line, index).fault(what))?,
    };
    for record in &mut records {
        record.published_ns = record.published_ns.saturating_sub(first_ns);
        record.departure_ns = record.departure_ns.saturating_sub(first_ns);
    }
    let trace = Trace { header, records };
    Ok(CsvDecoded { trace, fault })
}

/// What stands behind the `#` of a remark.
fn remark(content: &str) -> Option<&str> {
    content.trim_start().strip_prefix('#')
}

/// The separator of a line `sep=;`, which some spreadsheets want first.
fn said_separator(content: &str) -> Option<char> {
    let said = content.trim_start().trim_matches('"');
    let said = said.split_at_checked("sep=".len());
    let (_, said) = said.filter(|(key, _)| key.eq_ignore_ascii_case("sep="))?;
    let mut letters = said.chars();
    let separator = letters.next()?;
    letters.as_str().trim().is_empty().then_some(separator)
}

/// The line of record `index`, behind the line with the names of columns.
fn row(file: &TextFile, names_line: u64, index: usize) -> Line<'_> {
    let is_row = |line: &Line<'_>| {
        let content = line.content;
        line.number > names_line && !content.trim().is_empty() && remark(content).is_none()
    };
    let mut rows = file.lines().filter(is_row);
    rows.nth(index).unwrap_or_else(|| file.end())
}

/// What a text that states no count may mean otherwise than it says.
#[derive(Debug)]
struct Doubt {
    /// Of the record.
    index: usize,
    what: String,
}

/// The first instant where instants count from 1970, from which they then count; else 0.
fn first_since_1970(records: &[TraceRecord]) -> Result<i64, Doubt> {
    let count = records.len();
    let instants = records.iter().map(|record| record.published_ns);
    let first_ns = origin(instants, NANOSECONDS).map_err(|fault| {
        let otherwise = if fault.is_doubt {
            as_they_are("nanoseconds since a start", count)
        } else {
            String::new()
        };
        let (index, what) = (fault.index, fault.what + &otherwise);
        Doubt { index, what }
    })?;
    let is_apart = |record: &TraceRecord| {
        !NANOSECONDS.is_since_start(record.departure_ns.saturating_sub(record.published_ns))
    };
    records.iter().position(is_apart).map_or(Ok(first_ns), |index| {
        let TraceRecord { published_ns, departure_ns, .. } = records[index];
        Err(Doubt {
            index,
            what: format!(
                "published at {published_ns} and departed at {departure_ns} ns do not count from the same moment"
            ),
        })
    })
}

/// How a text says that its numbers are right.
fn as_they_are(what: &str, count: usize) -> String {
    format!("; if they are {what}, say so with a first line \"# record_count: {count}\"")
}

/// A number in the place of a delay that is none: one below zero again and again beside delays above it, or one of years.
fn no_marks(records: &[TraceRecord]) -> Result<(), Doubt> {
    type Delay = fn(&TraceRecord) -> Option<i64>;
    let columns: [(Delay, &str, &str); 2] = [
        (TraceRecord::delay, COLUMNS[3], "a message that was lost"),
        (TraceRecord::second_delay, COLUMNS[5], "no second copy"),
    ];
    for (delay, column, meaning) in columns {
        let delays = || {
            (0..)
                .zip(records)
                .filter_map(|(index, one)| Some((index, delay(one)?)))
        };
        let mut below = delays().filter(|(_, ns)| *ns < 0);
        let first = below.next().filter(|(_, first_ns)| {
            let is_code =
                first_ns.to_string()[1..].bytes().all(|digit| digit == b'9') || *first_ns == -1;
            let again_count = below.clone().filter(|(_, ns)| ns == first_ns).count();
            let is_one = again_count == below.count() && (is_code || again_count > 0);
            is_one && delays().any(|(_, ns)| ns > 0)
        });
        let years = delays().find(|(_, ns)| !NANOSECONDS.is_since_start(*ns));
        if let Some((index, ns)) = years.or(first) {
            let otherwise = as_they_are("delays", records.len());
            let what = format!("{column} is {ns}: for {meaning} leave it empty{otherwise}");
            return Err(Doubt { index, what });
        }
    }
    Ok(())
}

/// `# key: value`; remarks that are none of ours say nothing.
fn read_remark(
    remark: &str,
    header: &mut TraceHeader,
    promised: &mut Option<u64>,
) -> Result<(), String> {
    let Some((key, value)) = remark.split_once(':') else {
        return Ok(());
    };
    let (key, value) = (key.trim(), value.trim());
    match key {
        "run" => value.clone_into(&mut header.run),
        "channel" => value.clone_into(&mut header.channel),
        "link" => value.clone_into(&mut header.link),
        "clock" => value.clone_into(&mut header.clock),
        "direction" => {
            header.direction = named(key, value, TraceDirection::ALL, TraceDirection::word)?;
        }
        "arrival" => {
            header.arrival = named(key, value, TraceArrival::ALL, TraceArrival::word)?;
        }
        "link_change_count" => header.link_change_count = number(key, value)?,
        "origin_ns" => header.origin_ns = number(key, value)?,
        "duration_ns" => header.duration_ns = number(key, value)?,
        "record_count" => *promised = Some(number(key, value)?),
        _ => {}
    }
    Ok(())
}

/// The one of `all` whose word is `value`.
fn named<T: Copy, const N: usize>(
    key: &str,
    value: &str,
    all: [T; N],
    word: fn(T) -> &'static str,
) -> Result<T, String> {
    let found = all.into_iter().find(|one| word(*one) == value);
    found.ok_or_else(|| {
        let allowed = all.map(word).join(", ");
        format!("{key} is \"{value}\", allowed are {allowed}")
    })
}

fn number<T: core::str::FromStr>(key: &str, value: &str) -> Result<T, String> {
    let expected = "a whole number in range";
    whole(value).ok_or_else(|| {
        let is_epoch = value.parse().is_ok_and(|s: f64| (1e9..3e9).contains(&s));
        let epoch = if is_epoch {
            "; an epoch time in seconds? Multiply by 1000000000"
        } else {
            ""
        };
        format!("{key}: {}{epoch}", not_whole(value, expected))
    })
}

/// Where each column stands.
#[derive(Debug)]
struct Columns {
    places: [Option<usize>; COLUMNS.len()],
    count: usize,
    separator: char,
}

impl Columns {
    fn read(line: &str, separator: Option<char>) -> Result<Self, String> {
        let separator = separator.unwrap_or_else(|| separator_of(line));
        let names = cells(line, separator)?;
        for (index, name) in names.iter().enumerate() {
            if names[..index].contains(name) {
                return Err(format!("column {name} stands there twice"));
            }
        }
        let places = COLUMNS.map(|wanted| names.iter().position(|name| *name == wanted));
        let columns = Self {
            places,
            count: names.len(),
            separator,
        };
        let has = |index: usize| columns.places[index].is_some();
        if !(has(0) || has(1)) || !(has(2) || has(3)) {
            return Err(format!(
                "not the columns of a trace: \"{}\"; needed are published_ns or departure_ns, \
                 and fate or delay_ns, separated by commas{}",
                short(line),
                form_words(line)
            ));
        }
        Ok(columns)
    }

    fn record(
        &self,
        line: &str,
        index: u64,
        before_ns: Option<i64>,
    ) -> Result<TraceRecord, String> {
        let cells = cells(line, self.separator)?;
        if cells.len() != self.count {
            let (found, expected) = (cells.len(), self.count);
            let is_digits = |cell: &str| cell.bytes().all(|byte| byte.is_ascii_digit());
            let is_number = |cell: &str| !cell.is_empty() && is_digits(cell);
            let why = match self.separator {
                _ if found == expected + 1 && cells[expected].is_empty() => {
                    "; the line ends with a separator"
                }
                ',' if found > expected && cells.iter().all(|cell| is_number(cell)) => {
                    "; a decimal comma? Expected are whole numbers"
                }
                _ => "",
            };
            return Err(format!("{found} values for {expected} columns{why}"));
        }
        let cell = |column: usize| {
            let text: &str = &cells[self.places[column]?];
            (!text.is_empty()).then_some(text)
        };
        let number = |column: usize| cell(column).filter(|text| !is_missing(text));
        let published: Option<i64> = optional(number(0), COLUMNS[0])?;
        let departure: Option<i64> = optional(number(1), COLUMNS[1])?;
        let Some(published_ns) = published.or(departure) else {
            return Err("neither published_ns nor departure_ns has a value".to_owned());
        };
        if let Some(before_ns) = before_ns.filter(|before_ns| published_ns < *before_ns) {
            return Err(format!(
                "published at {published_ns} ns, before the row before it at {before_ns} ns"
            ));
        }
        let delay: Option<i64> = optional(number(3), COLUMNS[3])?;
        if delay == Some(UNAVAILABLE_NS) {
            let column = COLUMNS[3];
            return Err(format!(
                "{column} is {UNAVAILABLE_NS}: for a message that was lost leave it empty"
            ));
        }
        let fate = match cell(2) {
            Some(text) => named(COLUMNS[2], text, TraceFate::ALL, TraceFate::word)?,
            None if delay.is_some() => TraceFate::Delivered,
            None => TraceFate::LostInNetwork,
        };
        let is_early_loss = matches!(fate, TraceFate::LostInNetwork | TraceFate::LostBeforeLink);
        if let Some(delay_ns) = delay.filter(|_| is_early_loss) {
            return Err(format!(
                "a delay of {delay_ns} ns for a message that is {fate}"
            ));
        }
        let bound: Option<u64> = optional(number(4), COLUMNS[4])?;
        let size_bytes = optional(number(6), COLUMNS[6])?.unwrap_or(0);
        if size_bytes > SIZE_BYTES_MAX {
            return Err(format!(
                "size_bytes is {size_bytes}, allowed are 0 to {SIZE_BYTES_MAX}"
            ));
        }
        let flags = optional(number(9), COLUMNS[9])?.unwrap_or(0);
        if flags & !TraceRecord::FLAGS != 0 {
            return Err(format!("flags are {flags}, allowed are 0 to 31"));
        }
        Ok(TraceRecord {
            published_ns,
            departure_ns: departure.unwrap_or(published_ns),
            delay_ns: delay.unwrap_or(UNAVAILABLE_NS),
            bound_ns: bound.filter(|_| delay.is_some()).unwrap_or(UNBOUNDED_NS),
            second_delay_ns: optional(number(5), COLUMNS[5])?.unwrap_or(UNAVAILABLE_NS),
            size_bytes,
            sequence: optional(number(7), COLUMNS[7])?.unwrap_or(index),
            start: optional(number(8), COLUMNS[8])?.unwrap_or(0),
            fate,
            flags,
        })
    }
}

/// What a line of numbers in the place of column names may be.
fn form_words(line: &str) -> &'static str {
    let is_number = |word: &str| word.parse::<f64>().is_ok();
    let words = line.split([' ', '\t', ',', ';']);
    let words = words.filter(|word| !word.is_empty());
    let count = words.clone().count();
    if !words.clone().all(is_number) {
        ""
    } else if count > 2 && !line.contains([',', ';']) {
        ". A delay distribution of netem is written, not read"
    } else {
        ". Mahimahi's form has whole milliseconds, one a line, and no remarks; `trace convert` makes a table of it"
    }
}

fn optional<T: core::str::FromStr>(text: Option<&str>, name: &str) -> Result<Option<T>, String> {
    text.map(|text| number(name, text)).transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    type OfMilliseconds = fn(i64) -> i64;

    fn sample() -> Trace {
        let mut header = TraceHeader::new("egm/right/command");
        header.clock = "one clock".to_owned();
        header.direction = TraceDirection::Backward;
        header.duration_ns = 50;
        let mut records = vec![
            TraceRecord::published(0, 0, 40).delivered(7, 1),
            TraceRecord::published(10, 1, 40),
            TraceRecord::published(10, 2, 40).delivered(-3, 9),
        ];
        records[1].fate = TraceFate::LostInNetwork;
        records[2].second_delay_ns = 12;
        records[2].flags = 1;
        Trace { header, records }
    }

    #[test]
    fn a_trace_comes_back_as_it_was() {
        let text = encode(&sample());
        let golden = "# channel: egm/right/command\n# clock: one clock\n# direction: backward\n\
                      # arrival: unknown\n# duration_ns: 50\n# record_count: 3\n\
                      published_ns,departure_ns,fate,delay_ns,bound_ns,second_delay_ns,size_bytes,\
                      sequence,start,flags\n\
                      0,0,delivered,7,1,,40,0,0,0\n\
                      10,10,lost-in-network,,,,40,1,0,0\n\
                      10,10,delivered,-3,9,12,40,2,0,1\n";
        assert_eq!(text, golden);
        let decoded = decode(&text.as_str().into()).unwrap();
        assert_eq!((decoded.trace, decoded.fault), (sample(), None));
    }

    #[test]
    fn two_columns_of_any_measurement_make_a_trace() {
        let decoded = decode(&"delay_ns,host,departure_ns\r\n500,a,0\r\n,b,10\r\n".into()).unwrap();
        assert_eq!(decoded.fault, None);
        let records = decoded.trace.records;
        assert_eq!(records[0].delay(), Some(500));
        assert_eq!(records[1].fate, TraceFate::LostInNetwork);
        assert_eq!((records[1].published_ns, records[1].sequence), (10, 1));
    }

    #[test]
    fn marks_quotes_separators_and_line_ends_change_nothing() {
        let plain = decode(&"published_ns,delay_ns\n0,5\n10,\n".into()).unwrap();
        for bytes in [
            &b"\xef\xbb\xbfpublished_ns,delay_ns\n0,5\n10,\n"[..],
            b"published_ns;delay_ns\r\n0;5\r\n10;\r\n",
            b"\"published_ns\"\t\"delay_ns\"\r0\t5\r10\t\r",
            b"\"published_ns\",\"delay_ns\",\"a, \xfc\"\n\"0\",\"5\",b\n10,,\n",
        ] {
            let decoded = decode(&TextFile::decode(bytes).unwrap()).unwrap();
            assert_eq!(decoded, plain, "{bytes:?}");
        }
    }

    #[test]
    fn instants_since_1970_count_from_the_first_and_other_units_are_named() {
        let of = |told: fn(i64) -> i64| {
            let rows = (0..200).map(|row| format!("{},5\n", told(1_700_000_000_000 + 10 * row)));
            let text = format!("published_ns,delay_ns\n{}", rows.collect::<String>());
            decode(&text.as_str().into())
        };
        let records = of(|ms| ms * 1_000_000).unwrap().trace.records;
        assert_eq!(
            (records[0].published_ns, records[199].departure_ns),
            (0, 1_990_000_000)
        );
        let units: [(OfMilliseconds, &str); 3] = [
            (|ms| ms / 1_000, "in s,"),
            (|ms| ms, "in ms,"),
            (|ms| ms * 1_000, "in us,"),
        ];
        let within_one = of(|_| 1_700_000_000).unwrap_err().to_string();
        assert!(within_one.contains("in s,"), "{within_one}");
        for (told, name) in units {
            let refused = of(told).unwrap_err().to_string();
            assert!(
                refused.contains("epoch time") && refused.contains(name),
                "{refused}"
            );
            assert!(refused.starts_with("line 2, byte 22: "), "{refused}");
        }
        let mixed = "published_ns,delay_ns\n# a remark\n0,5\n\n1700000000000000000,5\n";
        let refused = decode(&mixed.into()).unwrap_err();
        assert_eq!((refused.line, refused.offset), (5, 38));
        let said = "sep=|\n# published_ns,delay_ns\npublished_ns|delay_ns\n1700000000|5\n";
        assert_eq!(decode(&said.into()).unwrap_err().line, 4);
        let apart = "published_ns,departure_ns,delay_ns\n0,1700000000000000000,5\n";
        assert_eq!(decode(&apart.into()).unwrap_err().line, 2);
    }

    #[test]
    fn instants_of_a_computer_long_up_are_no_epoch_times() {
        let decoded = |instants: &[i64]| {
            let rows = instants.iter().map(|ns| format!("{ns},5\n"));
            let text = format!("published_ns,delay_ns\n{}", rows.collect::<String>());
            (decode(&text.as_str().into()), text)
        };
        let (hour, day) = (3_600_000_000_000, 86_400_000_000_000);
        let every = |start: i64, ns: i64| (0..500).map(|row| start + ns * row).collect::<Vec<_>>();
        for instants in [
            vec![hour / 4; 2],
            every(hour, 1_000_000),
            // 1 Gbit/s of full frames, and 100 Hz.
            every(12 * day, 12_304),
            every(30 * day, 10_000_000),
            // From half an hour to an hour.
            every(hour / 2, 5_000_000_000),
        ] {
            let records = decoded(&instants).0.unwrap().trace.records;
            assert_eq!(records[0].published_ns, instants[0]);
        }
        // Between the 14th and the 25th day and from 20 to 37 minutes they could be of another unit, in which a
        // measurement may be as slow as it likes: the text has to say it.
        for instants in [
            every(20 * day, 12_304),
            every(hour / 2, 1_000_000),
            vec![hour / 2],
        ] {
            let (refused, text) = decoded(&instants);
            let refused = refused.unwrap_err().to_string();
            let line = refused.split('"').nth(1).unwrap();
            let said = decode(&format!("{line}\n{text}").as_str().into()).unwrap();
            assert_eq!(
                (said.fault, said.trace.records[0].published_ns),
                (None, instants[0])
            );
        }
    }

    #[test]
    fn a_number_in_the_place_of_a_delay_is_no_delay() {
        let of = |rows: &str| {
            let text = format!("published_ns,delay_ns,second_delay_ns\n{rows}");
            decode(&text.as_str().into()).map(|read| read.trace.counts().delivered_count)
        };
        for (rows, line, column) in [
            ("0,4000,\n1,-1,\n2,5000,\n", 3, "delay_ns is -1:"),
            ("0,4000,\n1,-999,\n2,5000,\n", 3, "delay_ns is -999:"),
            ("0,-50,\n1,4000,\n2,-50,\n", 2, "delay_ns is -50:"),
            ("0,4000,-1\n1,4000,9\n", 2, "second_delay_ns is -1:"),
            (
                "0,4000,\n1,9223372036854775807,\n",
                3,
                "delay_ns is 9223372036854775807:",
            ),
        ] {
            let refused = of(rows).unwrap_err();
            let what = &refused.what;
            assert!(
                what.starts_with(column) && what.contains("leave it empty"),
                "{what}"
            );
            assert_eq!(refused.line, line, "{rows}");
        }
        // What two clocks leave of short delays, and clocks that are apart.
        for rows in [
            "0,4000,\n1,-50,\n2,5000,\n",
            "0,40,\n1,-1,\n2,-3,\n",
            "0,-1,\n1,-1,\n2,0,\n",
        ] {
            assert_eq!(of(rows), Ok(3), "{rows}");
        }
        let smallest = decode(&"published_ns,delay_ns\n0,5\n1,-9223372036854775808\n".into());
        assert_eq!(smallest.unwrap().fault.unwrap().line, 3);
    }

    #[test]
    fn what_spreadsheets_and_programs_add_changes_nothing() {
        let plain = decode(&"published_ns,delay_ns\n0,5\n10,\n".into()).unwrap();
        for text in [
            "sep=;\npublished_ns;delay_ns\n0;5\n10;\n",
            "\"sep=|\"\npublished_ns|delay_ns\n0|5\n10|\n",
            "# published_ns,delay_ns\n0,5\n10,\n",
            "  # published_ns,delay_ns\npublished_ns,delay_ns\n0,5\n10,\n",
            "published_ns,delay_ns\n0.0,5.00\n10.0,NaN\n",
            "published_ns,delay_ns\n  # made by hand\n0,5\n10,NA\n",
            "published_ns,departure_ns,delay_ns\nnull,0,5\n10,None,null\n",
        ] {
            assert_eq!(decode(&text.into()), Ok(plain.clone()), "{text}");
        }
        let refused = |text: &str| decode(&text.into()).unwrap_err().what;
        assert!(refused("3.5\n6.5\n").contains("Mahimahi's form has whole milliseconds"));
        assert!(refused("3,5\n6,5\n").contains("Mahimahi's form has whole milliseconds"));
        assert!(refused("# up link\n3\n6\n").contains("no remarks"));
        let netem = refused("# mean\n -1000 -963 -926 7\n");
        assert!(netem.contains("netem is written, not read"), "{netem}");
        assert!(!refused("a,b\n1,2\n").contains("netem"));
    }

    #[test]
    fn what_is_wrong_says_where_and_keeps_the_rest() {
        let refused = |text: &str| decode(&text.into()).unwrap_err().to_string();
        assert!(refused("").starts_with("line 1, byte 0: no line with column names"));
        assert!(refused("a,b\n1,2\n").contains("not the columns of a trace"));
        let start = "departure_ns,delay_ns\n5,1\n";
        for (row, why) in [
            ("4,1\n", "before the row before it"),
            ("x,1\n", "is not a whole number"),
            ("6;1\n", "1 values for 2 columns"),
            ("6,5,1\n", "a decimal comma?"),
            (
                "6,5,\n",
                "3 values for 2 columns; the line ends with a separator",
            ),
            ("\"6,5\",1\n", "has a decimal comma"),
            ("1700000000.5,1\n", "an epoch time in seconds?"),
            ("6\n", "1 values for 2 columns"),
        ] {
            let decoded = decode(&format!("{start}{row}").as_str().into()).unwrap();
            let fault = decoded.fault.unwrap();
            assert_eq!((fault.line, fault.offset), (3, start.len() as u64));
            assert!(fault.what.contains(why), "{fault}");
            assert_eq!(decoded.trace.records.len(), 1);
        }
        let sized =
            decode(&"published_ns,delay_ns,size_bytes\n0,1,40\n1,1,67107841\n".into()).unwrap();
        let fault = sized.fault.unwrap();
        assert_eq!((fault.line, sized.trace.records.len()), (3, 1));
        assert_eq!(
            fault.what,
            "size_bytes is 67107841, allowed are 0 to 67107840"
        );
        let text = encode(&sample());
        let cut = &text[..text.len() - "10,10,delivered,-3,9,12,40,2,0,1\n".len()];
        let fault = decode(&cut.into()).unwrap().fault.unwrap();
        assert_eq!(fault.what, "2 records, record_count says 3");
        assert_eq!(fault.offset, cut.len() as u64);
    }

    #[test]
    fn a_bad_key_after_rows_keeps_the_rows() {
        let text = "published_ns,delay_ns\n0,5\n10,6\n# direction: sideways\n20,7\n";
        let decoded = decode(&text.into()).unwrap();
        assert_eq!(decoded.trace.records.len(), 2);
        let fault = decoded.fault.unwrap();
        assert!(
            fault.line == 4 && fault.what.contains("sideways"),
            "{fault}"
        );
        let before = "published_ns,delay_ns\n# direction: sideways\n0,5\n";
        assert_eq!(decode(&before.into()).unwrap_err().line, 2);
    }
}
