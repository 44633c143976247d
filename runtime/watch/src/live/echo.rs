//! `channel echo`: the messages of a channel as their run's manifest lays them out, or as bytes.

use std::thread;
use std::time::Duration;

use hil_core::message::Envelope;
use serde::Serialize;

use super::channel::ChannelError;
use super::cli::EchoArgs;
use super::observer::Observer;
use crate::{PassiveReader, RecordFollower};
use hil_platform::console::{CommandEnd, Console};
use hil_platform::signals::Signals;
use hil_platform::words::counted_plainly;
use hil_rundir::layout::{Decoder, Selection, Value, hex};
use hil_rundir::live_run::Source;
use hil_rundir::manifest::ChannelDescription;
use hil_rundir::record::RecordKind;

/// How often it looks for messages.
const LOOK_PERIOD: Duration = Duration::from_millis(5);
/// Taken in one look.
const LOOK_BYTES_MAX: usize = 1 << 20;
const LOOK_MESSAGES_MAX: usize = 1024;

/// Where messages come from.
enum Place {
    Records(RecordFollower),
    SharedMemory(PassiveReader),
}

/// How a message becomes text.
enum Form {
    Whole(Decoder),
    Part(Decoder, Selection),
    Bytes,
}

/// One message as JSON.
#[derive(Debug, Serialize)]
struct Answer<'a> {
    channel: &'a str,
    message: &'a str,
    sequence: u64,
    epoch: u32,
    /// On the monotonic clock of the producer's host.
    published_ns: i64,
    #[serde(flatten)]
    content: Content,
}

/// What is shown of a message.
#[derive(Debug, Serialize)]
#[serde(rename_all = "snake_case")]
enum Content {
    Fields(Value),
    Value(Value),
    Bytes(String),
}

pub(super) fn run(
    mut observer: Observer,
    args: &EchoArgs,
    signals: &Signals,
    console: &mut Console,
) -> Result<CommandEnd, ChannelError> {
    let channel = observer.channel(&args.which.channel)?.clone();
    let form = form(&channel, args)?;
    if matches!(form, Form::Bytes) && !args.raw {
        console.warn(&format!(
            "nobody stated the fields of {}; its messages are shown as bytes",
            channel.message
        ));
    }
    let mut place = place(&mut observer, &channel)?;
    let wanted = if args.once { Some(1) } else { args.count };
    let mut shown_count = 0;
    let end = loop {
        let is_over = observer.is_over();
        let mut texts = Vec::new();
        let looked = place.look(&channel.name, &mut |envelope, payload| {
            if wanted.is_none_or(|wanted| shown_count < wanted) {
                shown_count += 1;
                texts.push(text(&channel, &form, args.json, envelope, payload));
            }
        });
        let mut is_heard = true;
        for text in texts {
            is_heard &= console.result(&text?);
        }
        if !is_heard {
            return Ok(CommandEnd::Done);
        }
        if wanted.is_some_and(|wanted| shown_count >= wanted) {
            break CommandEnd::Done;
        }
        for problem in place.take_problems() {
            console.warn(&problem);
        }
        if signals.received().is_some() {
            break CommandEnd::Interrupted;
        }
        match looked {
            // Channels break when their run ends.
            Err(error) if !observer.is_over() => return Err(ChannelError::Broken(error)),
            Err(_) => break CommandEnd::Done,
            Ok(()) if is_over => break CommandEnd::Done,
            Ok(()) => thread::sleep(LOOK_PERIOD),
        }
    };
    if wanted.is_none() {
        console.say(&format!(
            "{}{}",
            counted_plainly(shown_count, "message"),
            place.missed()
        ));
    }
    match wanted {
        Some(wanted) if shown_count < wanted && end == CommandEnd::Done => {
            Err(ChannelError::Ended {
                channel: channel.name,
                shown_count,
                wanted_count: wanted,
            })
        }
        _ => Ok(end),
    }
}

fn form(channel: &ChannelDescription, args: &EchoArgs) -> Result<Form, ChannelError> {
    if args.raw || (channel.fields.is_empty() && args.field.is_none()) {
        return Ok(Form::Bytes);
    }
    let decoder = Decoder::new(&channel.message, &channel.fields, channel.size_bytes);
    let decoder = decoder.map_err(|fault| ChannelError::Layout {
        channel: channel.name.clone(),
        why: fault.to_string(),
    })?;
    Ok(match &args.field {
        None => Form::Whole(decoder),
        Some(path) => {
            let part = decoder.select(path)?;
            Form::Part(decoder, part)
        }
    })
}

fn place(observer: &mut Observer, channel: &ChannelDescription) -> Result<Place, ChannelError> {
    if let Some(Source::SharedMemory { host, .. }) = observer.source(&channel.name).cloned() {
        return Ok(Place::SharedMemory(observer.reader(&host, channel)?));
    }
    let records = observer.run().run_folder().records();
    Ok(Place::Records(RecordFollower::from_now(&records)))
}

impl Place {
    /// Hands every message that came since the last look to `take`.
    ///
    /// # Errors
    /// When the channel is broken.
    fn look(
        &mut self,
        channel: &str,
        take: &mut dyn FnMut(&Envelope, &[u8]),
    ) -> Result<(), hil_shm::ChannelError> {
        match self {
            Self::Records(follower) => {
                follower.poll(LOOK_BYTES_MAX, &mut |batch| {
                    if batch.header.kind == RecordKind::Message && batch.header.channel == channel {
                        for (envelope, payload) in batch.messages() {
                            take(&envelope, payload);
                        }
                    }
                });
            }
            Self::SharedMemory(reader) => {
                reader.poll(LOOK_MESSAGES_MAX, take)?;
            }
        }
        Ok(())
    }

    /// What went wrong since the last call.
    fn take_problems(&mut self) -> Vec<String> {
        match self {
            Self::Records(follower) => follower.take_problems(),
            Self::SharedMemory(_) => Vec::new(),
        }
    }

    /// Messages that it did not see, in words that follow their number; empty where it sees all.
    fn missed(&self) -> String {
        match self {
            Self::Records(_) => String::new(),
            Self::SharedMemory(reader) => {
                let counters = reader.counters();
                format!(", {} missed by their numbers", counters.gap_count)
            }
        }
    }
}

fn text(
    channel: &ChannelDescription,
    form: &Form,
    is_json: bool,
    envelope: &Envelope,
    payload: &[u8],
) -> Result<String, ChannelError> {
    let content = match form {
        Form::Whole(decoder) => decoder.decode(payload).map(Content::Fields),
        Form::Part(decoder, part) => decoder.decode_part(part, payload).map(Content::Value),
        Form::Bytes => None,
    };
    // Of another size than its layout it is shown as it is.
    let content = content.unwrap_or_else(|| Content::Bytes(hex(payload)));
    if is_json {
        let answer = Answer {
            channel: &channel.name,
            message: &channel.message,
            sequence: envelope.sequence,
            epoch: envelope.epoch,
            published_ns: envelope.published_ns,
            content,
        };
        return Ok(format!("{}\n", serde_json::to_string(&answer)?));
    }
    let body = match content {
        Content::Value(value) => return Ok(format!("{value}\n")),
        Content::Fields(fields) => fields.lines(),
        Content::Bytes(digits) => format!("{digits}\n"),
    };
    let published_s = Duration::from_nanos(envelope.published_ns.unsigned_abs()).as_secs_f64();
    Ok(format!(
        "--- {} number {} of start {}, published at {published_s:.6} s\n{body}",
        channel.name, envelope.sequence, envelope.epoch
    ))
}
