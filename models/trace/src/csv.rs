//! The textual form of a trace: lines `# key: value` for the header, then comma-separated values
//! with the names of their columns first, as in RFC 4180; other separators are read as well. Text in, text out: it
//! opens no file.

use core::fmt::Write;

use hil_core::text_file::{TextFault, TextFile, cells, not_a_number, separator_of, short};

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
    let mut fault = None;
    for line in file.lines() {
        let content = line.content;
        let read = if let Some(remark) = content.strip_prefix('#') {
            read_remark(remark, &mut header, &mut promised)
        } else if content.trim().is_empty() {
            Ok(())
        } else if let Some(known) = &columns {
            let before_ns = records.last().map(|record| record.published_ns);
            let record = known.record(content, records.len() as u64, before_ns);
            record.map(|record| records.push(record))
        } else {
            Columns::read(content).map(|found| columns = Some(found))
        };
        if let Err(what) = read {
            let is_remark = content.starts_with('#');
            if records.is_empty() && (columns.is_none() || is_remark) {
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
    // A text of ours, which states its count, means its instants as they are.
    let first_ns = match promised {
        Some(_) => 0,
        None => first_since_1970(&records).map_err(|what| file.end().fault(what))?,
    };
    for record in &mut records {
        record.published_ns = record.published_ns.saturating_sub(first_ns);
        record.departure_ns = record.departure_ns.saturating_sub(first_ns);
    }
    let trace = Trace { header, records };
    Ok(CsvDecoded { trace, fault })
}

/// Times of today since 1970 in nanoseconds are beyond this, and times since the start of a run or of a computer are
/// not: three years.
pub(crate) const SINCE_1970_NS: i64 = 100_000_000_000_000_000;

/// The first instant where instants count from 1970, from which they then count; else 0.
fn first_since_1970(records: &[TraceRecord]) -> Result<i64, String> {
    let Some((first, last)) = records.first().zip(records.last()) else {
        return Ok(0);
    };
    let first_ns = first.published_ns;
    if first_ns >= SINCE_1970_NS {
        return Ok(first_ns);
    }
    // In another unit they are years of today (2008 to 2039), and distinct instants are nearer than those of messages.
    let span_ns = last.published_ns.saturating_sub(first_ns);
    let steps = records.windows(2);
    let steps = steps.filter(|two| two[1].published_ns > two[0].published_ns);
    let step_count = i64::try_from(steps.count()).unwrap_or(i64::MAX);
    let units = [
        ("s", 1_000_000_000, 10, 0),
        ("ms", 1_000_000, 1_000, 2),
        ("us", 1_000, 50_000, 2),
    ];
    let is_of = |(_, unit_ns, nearest_ns, steps_min): &(&str, i64, i64, i64)| {
        let per_s = 1_000_000_000 / unit_ns;
        let is_of_today = (1_200_000_000 * per_s..2_200_000_000 * per_s).contains(&first_ns);
        is_of_today
            && records.len() > 1
            && step_count >= *steps_min
            && span_ns / step_count.max(1) < *nearest_ns
    };
    match units.into_iter().find(is_of) {
        None => Ok(0),
        Some((unit, unit_ns, ..)) => Err(format!(
            "the first instant, {first_ns}, is an epoch time in {unit}, expected nanoseconds: multiply by {unit_ns}; \
             if they are nanoseconds, say so with a first line \"# record_count: {}\"",
            records.len()
        )),
    }
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
            let words = TraceDirection::ALL.map(TraceDirection::word);
            header.direction = TraceDirection::ALL[word(key, value, &words)?];
        }
        "arrival" => {
            let words = TraceArrival::ALL.map(TraceArrival::word);
            header.arrival = TraceArrival::ALL[word(key, value, &words)?];
        }
        "link_change_count" => header.link_change_count = number(key, value)?,
        "origin_ns" => header.origin_ns = number(key, value)?,
        "duration_ns" => header.duration_ns = number(key, value)?,
        "record_count" => *promised = Some(number(key, value)?),
        _ => {}
    }
    Ok(())
}

fn word(key: &str, value: &str, words: &[&str]) -> Result<usize, String> {
    let found = words.iter().position(|word| *word == value);
    found.ok_or_else(|| format!("{key} is \"{value}\", allowed are {}", words.join(", ")))
}

fn number<T: core::str::FromStr>(key: &str, value: &str) -> Result<T, String> {
    let expected = "a whole number in range";
    value.parse().map_err(|_not_a_number| {
        let is_epoch = value.parse().is_ok_and(|s: f64| (1e9..3e9).contains(&s));
        let epoch = if is_epoch {
            "; an epoch time in seconds? Multiply by 1000000000"
        } else {
            ""
        };
        format!("{key}: {}{epoch}", not_a_number(value, expected))
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
    fn read(line: &str) -> Result<Self, String> {
        let separator = separator_of(line);
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
                 and fate or delay_ns",
                short(line)
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
            let is_number = |cell: &str| cell.bytes().all(|byte| byte.is_ascii_digit());
            let comma = match self.separator {
                ',' if found > expected && cells.iter().all(|cell| is_number(cell)) => {
                    "; a decimal comma? Expected are whole numbers"
                }
                _ => "",
            };
            return Err(format!("{found} values for {expected} columns{comma}"));
        }
        let cell = |column: usize| {
            let text: &str = &cells[self.places[column]?];
            (!text.is_empty()).then_some(text)
        };
        let published: Option<i64> = optional(cell(0), COLUMNS[0])?;
        let departure: Option<i64> = optional(cell(1), COLUMNS[1])?;
        let Some(published_ns) = published.or(departure) else {
            return Err("neither published_ns nor departure_ns has a value".to_owned());
        };
        if let Some(before_ns) = before_ns.filter(|before_ns| published_ns < *before_ns) {
            return Err(format!(
                "published at {published_ns} ns, before the row before it at {before_ns} ns"
            ));
        }
        let delay: Option<i64> = optional(cell(3), COLUMNS[3])?;
        let words = TraceFate::ALL.map(TraceFate::word);
        let fate = match cell(2) {
            Some(text) => TraceFate::ALL[word(COLUMNS[2], text, &words)?],
            None if delay.is_some() => TraceFate::Delivered,
            None => TraceFate::LostInNetwork,
        };
        let is_early_loss = matches!(fate, TraceFate::LostInNetwork | TraceFate::LostBeforeLink);
        if let Some(delay_ns) = delay.filter(|_| is_early_loss) {
            return Err(format!(
                "a delay of {delay_ns} ns for a message that is {fate}"
            ));
        }
        let bound: Option<u64> = optional(cell(4), COLUMNS[4])?;
        let size_bytes = optional(cell(6), COLUMNS[6])?.unwrap_or(0);
        if size_bytes > SIZE_BYTES_MAX {
            return Err(format!(
                "size_bytes is {size_bytes}, allowed are 0 to {SIZE_BYTES_MAX}"
            ));
        }
        let flags = optional(cell(9), COLUMNS[9])?.unwrap_or(0);
        if flags & !TraceRecord::FLAGS != 0 {
            return Err(format!("flags are {flags}, allowed are 0 to 31"));
        }
        Ok(TraceRecord {
            published_ns,
            departure_ns: departure.unwrap_or(published_ns),
            delay_ns: delay.unwrap_or(UNAVAILABLE_NS),
            bound_ns: bound.filter(|_| delay.is_some()).unwrap_or(UNBOUNDED_NS),
            second_delay_ns: optional(cell(5), COLUMNS[5])?.unwrap_or(UNAVAILABLE_NS),
            size_bytes,
            sequence: optional(cell(7), COLUMNS[7])?.unwrap_or(index),
            start: optional(cell(8), COLUMNS[8])?.unwrap_or(0),
            fate,
            flags,
        })
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
        }
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
            // One instant of several messages, a batch, and messages of 1 kHz, all within 1000 to 3000 s.
            vec![hour / 2; 2],
            vec![hour / 2, hour / 2, hour / 2 + 400],
            every(hour / 2, 1_000_000),
            // 1 Gbit/s of full frames, and 100 Hz.
            every(12 * day, 12_304),
            every(30 * day, 12_304),
            every(20 * day, 10_000_000),
        ] {
            let records = decoded(&instants).0.unwrap().trace.records;
            assert_eq!(records[0].published_ns, instants[0]);
        }
        // That capture between the 14th and the 25th day could be of 80 Hz in microseconds: the text has to say it.
        let instants = every(20 * day, 12_304);
        let (refused, text) = decoded(&instants);
        let refused = refused.unwrap_err().to_string();
        let line = refused.split('"').nth(1).unwrap();
        let said = decode(&format!("{line}\n{text}").as_str().into()).unwrap();
        assert_eq!(
            (said.fault, said.trace.records[0].published_ns),
            (None, instants[0])
        );
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
