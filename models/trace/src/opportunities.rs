//! The form of Mahimahi's link shell (Netravali et al., USENIX ATC 2015): one line per opportunity
//! to deliver 1500 bytes, its time in whole milliseconds; the file wraps at its last line. It tells
//! of a link's rate and nothing else: what is lost on the way to and from it is stated by
//! [`ENCODE_LOSS`] and [`DECODE_LOSS`]. Text in, text out.

use core::fmt::Write;

use hil_core::text_file::{TextFault, TextFile, not_whole, whole};

use super::epoch::{MILLISECONDS, origin};
use super::{Trace, TraceFate, TraceHeader, TraceRecord};

/// Bytes of one opportunity.
pub const OPPORTUNITY_BYTES: u64 = 1500;

/// Most opportunities of a text: what 2^24 messages of one packet make, the most of a run's trace.
pub const OPPORTUNITY_COUNT_MAX: u64 = 1 << 24;

const MS_NS: i64 = 1_000_000;

/// What this form does not keep of a trace.
pub const ENCODE_LOSS: &str = "kept: the millisecond of each arrival, one opportunity of 1500 bytes \
     per message begun; not kept: delays, losses (they are times without an opportunity), sizes, \
     order, copies, bounds";

/// What a trace made of this form assumes.
pub const DECODE_LOSS: &str = "one message of 1500 bytes is published and delivered at once at each \
     opportunity: the trace has the rate of the link, and neither delay nor loss";

/// Why a trace has no opportunities.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum OpportunityError {
    /// No message has a known arrival.
    #[error("no message has a known arrival, so there is no opportunity")]
    None,
    /// The messages are too long, or too many.
    #[error(
        "record {index} of {size_bytes} bytes makes it {count} opportunities of \
         {OPPORTUNITY_BYTES} bytes, at most {OPPORTUNITY_COUNT_MAX}"
    )]
    TooMany {
        /// The first record beyond the bound, from 0.
        index: usize,
        /// Its size.
        size_bytes: u32,
        /// Opportunities up to it.
        count: u64,
    },
}

/// The opportunities of `trace`: the arrivals of its delivered messages, from the first departure
/// on.
///
/// # Errors
/// [`OpportunityError`].
pub fn encode(trace: &Trace) -> Result<String, OpportunityError> {
    let origin_ns = trace.records.first().map_or(0, |first| first.departure_ns);
    let mut arrivals: Vec<(i64, u64)> = Vec::new();
    let mut count = 0;
    for (index, record) in trace.records.iter().enumerate() {
        let delay = record
            .delay()
            .filter(|_| record.fate == TraceFate::Delivered);
        let Some(delay_ns) = delay else {
            continue;
        };
        let size_bytes = record.size_bytes;
        let packets = u64::from(size_bytes).div_ceil(OPPORTUNITY_BYTES).max(1);
        count += packets;
        if count > OPPORTUNITY_COUNT_MAX {
            return Err(OpportunityError::TooMany {
                index,
                size_bytes,
                count,
            });
        }
        let arrival_ns = record.departure_ns.saturating_add(delay_ns);
        arrivals.push((arrival_ns.saturating_sub(origin_ns).max(0), packets));
    }
    if arrivals.is_empty() {
        return Err(OpportunityError::None);
    }
    arrivals.sort_unstable();
    let mut text = String::new();
    for (at_ns, packets) in arrivals {
        for _ in 0..packets {
            let _infallible = writeln!(text, "{}", at_ns / MS_NS);
        }
    }
    Ok(text)
}

/// The trace of a text; see [`DECODE_LOSS`].
///
/// # Errors
/// The first line that is no time or is earlier than the one before, and what could be read.
pub fn decode(file: &TextFile) -> (Trace, Option<TextFault>) {
    let mut records: Vec<TraceRecord> = Vec::new();
    let mut header = TraceHeader::new("");
    "opportunities of 1500 bytes, whole milliseconds".clone_into(&mut header.clock);
    let mut fault = None;
    for line in file.lines() {
        let content = time(line.content);
        if content.is_empty() {
            continue;
        }
        let before_ns = records.last().map_or(0, |record| record.published_ns);
        match opportunity(content, before_ns) {
            Ok(at_ns) => {
                let sequence = records.len() as u64;
                let size_bytes = u32::try_from(OPPORTUNITY_BYTES).unwrap_or(u32::MAX);
                let record = TraceRecord::published(at_ns, sequence, size_bytes);
                // A time of whole milliseconds is early by up to one.
                records.push(record.delivered(0, MS_NS.unsigned_abs()));
            }
            Err(what) => {
                fault = Some(line.fault(what));
                break;
            }
        }
    }
    if fault.is_none() && records.is_empty() {
        fault = Some(file.end().fault("no delivery opportunity"));
    }
    let instants = records.iter().map(|record| record.published_ns / MS_NS);
    let first_ms = origin(instants, MILLISECONDS).unwrap_or_else(|wrong| {
        let mut times = file.lines().filter(|line| !time(line.content).is_empty());
        let line = times.nth(wrong.index).unwrap_or_else(|| file.end());
        fault = Some(line.fault(wrong.what));
        records.truncate(wrong.index);
        0
    });
    for record in &mut records {
        record.published_ns -= first_ms * MS_NS;
        record.departure_ns -= first_ms * MS_NS;
    }
    // The file wraps at its last line.
    header.duration_ns = records.last().map_or(0, |record| record.published_ns);
    (Trace { header, records }, fault)
}

/// What stands on a line, without quotes.
fn time(content: &str) -> &str {
    content.trim().trim_matches('"')
}

fn opportunity(content: &str, before_ns: i64) -> Result<i64, String> {
    let expected = "a whole number of milliseconds";
    let ms: i64 = whole(content).ok_or_else(|| not_whole(content, expected))?;
    let at_ns = ms.checked_mul(MS_NS).filter(|ns| *ns >= 0);
    let at_ns = at_ns.ok_or_else(|| format!("{ms} ms is outside 0 to 9223372036854"))?;
    if at_ns < before_ns {
        return Err(format!("{ms} ms comes after {} ms", before_ns / MS_NS));
    }
    Ok(at_ns)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn opportunities_are_arrivals_in_whole_milliseconds() {
        let at = |ms: i64, size| TraceRecord::published(ms * MS_NS, 0, size);
        let mut lost = at(20, 64);
        lost.fate = TraceFate::LostInNetwork;
        let trace = Trace {
            header: TraceHeader::new("a/b"),
            records: vec![
                at(10, 64).delivered(2_900_000, 0),
                at(12, 3_001).delivered(500_000, 0),
                lost,
            ],
        };
        assert_eq!(encode(&trace).unwrap(), "2\n2\n2\n2\n");
        let none = Trace {
            records: vec![lost],
            ..trace
        };
        assert_eq!(encode(&none), Err(OpportunityError::None));
        let mut huge = Trace {
            records: vec![at(0, 1).delivered(0, 0); 8],
            ..none
        };
        for record in &mut huge.records {
            record.size_bytes = u32::MAX;
        }
        let error = encode(&huge).unwrap_err().to_string();
        let start = "record 5 of 4294967295 bytes makes it 17179872 opportunities";
        assert!(error.starts_with(start), "{error}");
    }

    #[test]
    fn a_text_makes_a_trace_of_its_rate_that_writes_itself() {
        let decimals = decode(&"0.0\n0\n4.000\n10.\n".into());
        let text = "0\n0\n4\n10\n";
        assert_eq!(decimals, decode(&text.into()));
        let (trace, fault) = decode(&text.into());
        assert_eq!((fault, trace.records.len()), (None, 4));
        assert_eq!(trace.header.duration_ns, 10 * MS_NS);
        assert_eq!(trace.records[2].published_ns, 4 * MS_NS);
        assert_eq!(encode(&trace).unwrap(), text);
    }

    #[test]
    fn times_since_1970_count_from_the_first() {
        let (trace, fault) = decode(&"1700000000000\n1700000000007\n".into());
        assert_eq!((fault, trace.header.duration_ns), (None, 7 * MS_NS));
        assert_eq!(encode(&trace).unwrap(), "0\n7\n");
        let (trace, fault) = decode(&"\n1700000000\n1700000007\n".into());
        let fault = fault.unwrap();
        assert_eq!((trace.records.len(), fault.line, fault.offset), (0, 2, 1));
        assert!(fault.what.contains("epoch time in s"), "{fault}");
    }

    #[test]
    fn what_is_wrong_says_where_and_keeps_the_rest() {
        for (row, why) in [
            ("3\n", "3 ms comes after 5 ms"),
            ("x\n", "is not a whole number"),
            ("5.5\n", "is not a whole number"),
        ] {
            let (trace, fault) = decode(&format!("1\n5\n{row}7\n").as_str().into());
            let fault = fault.unwrap();
            assert_eq!((trace.records.len(), fault.line, fault.offset), (2, 3, 4));
            assert!(fault.what.contains(why), "{fault}");
        }
        assert_eq!(
            decode(&"\n".into()).1.unwrap().what,
            "no delivery opportunity"
        );
    }
}
