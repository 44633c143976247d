//! Recorded messages fed into a run that goes on, at the times at which they were recorded: as the
//! user's own program in place of a process, or by hand into a channel without a writer.

mod schedule;
mod source;
mod target;

use std::thread;
use std::time::Duration;

use hil_core::time::Instant;
use hil_platform::clock::{MonotonicClock, Wake};
use hil_platform::console::Console;
use hil_platform::signals::Signals;
use hil_platform::words::counted_plainly;
use hil_rundir::manifest::ChannelDescription;

use crate::cli::PlayOptions;
use crate::failure::Failure;
use schedule::{Punctuality, Schedule};
use source::{Material, known_channels, read};
use target::{Outlet, Target};

/// Longest sleep without looking for a signal or the end of the run.
const SLEEP_MAX: Duration = Duration::from_millis(50);
/// From the moment all is ready to the first message.
const LEAD: Duration = Duration::from_millis(2);

/// How it ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PlayEnd {
    /// With the recording or the run.
    Done,
    /// By a signal.
    Interrupted(&'static str),
}

/// Plays until the recording, the run or the user ends it.
pub(crate) fn play(
    options: &PlayOptions,
    signals: &Signals,
    console: &mut Console,
) -> Result<PlayEnd, Failure> {
    if options.only.is_empty() {
        return Err(Failure::usage(format!(
            "which channel is to be played? Give --only CHANNEL; {} has {}",
            options.file.display(),
            known_channels(&options.file)?
        )));
    }
    let target = Target::find(options.into.as_deref())?;
    let channels = options.only.iter().map(|name| target.channel(name));
    let channels: Vec<&ChannelDescription> = channels.collect::<Result<_, _>>()?;
    let material = read(&options.file, &channels)?;
    for loss in &material.losses {
        console.warn(&format!("lost in {}: {loss}", options.file.display()));
    }
    let domains = channels.iter().map(|channel| target.domain(channel));
    let domains = domains.collect::<Result<Vec<_>, _>>()?;
    let outlets = channels.iter().zip(&domains);
    let outlets = outlets.map(|(channel, domain)| target.open(domain, channel));
    let after_ns = material.messages.iter().map(|one| one.after_ns);
    let mut player = Player {
        outlets: outlets.collect::<Result<_, _>>()?,
        schedule: Schedule::new(after_ns.collect(), options.speed),
        kept: Punctuality::of(channels.len()),
        looked: MonotonicClock::now(),
        target: &target,
        signals,
    };
    let count = counted_plainly(material.messages.len() as u64, "message");
    let file = options.file.display();
    console.say(&format!("{file}: {count} for run {}", target.run.name));
    let end = player.play(&material, options.is_looped)?;
    let count = counted_plainly(player.kept.published_count, "message");
    console.say(&format!("{count} published"));
    if player.kept.late_count > 0 || player.kept.bunched_count > 0 {
        console.warn(&player.lateness());
    }
    if end.is_none() && target.is_ours && !target.is_over() {
        // To end now would end the run.
        console.say("the recording is over; silent until the run ends");
        while player.ended().is_none() {
            thread::sleep(SLEEP_MAX);
        }
    }
    // A run asks its processes to end by a signal.
    Ok(end.filter(|_| !target.is_ours).unwrap_or(PlayEnd::Done))
}

struct Player<'a> {
    outlets: Vec<Outlet>,
    schedule: Schedule,
    kept: Punctuality,
    /// When it last asked whether the run is over.
    looked: Instant,
    target: &'a Target,
    signals: &'a Signals,
}

impl Player<'_> {
    /// Plays the rounds; gives why it ended before the recording did, `None` at its end.
    fn play(&mut self, material: &Material, is_looped: bool) -> Result<Option<PlayEnd>, Failure> {
        while !self.target.has_begun() {
            if let Some(end) = self.ended() {
                return Ok(Some(end));
            }
            thread::sleep(LEAD);
        }
        let start = MonotonicClock::now() + LEAD;
        for round in 0_u64.. {
            for (place, message) in material.messages.iter().enumerate() {
                let due_ns = self.schedule.due_ns(round, place);
                if let Some(end) = self.sleep_until(start + Duration::from_nanos(due_ns)) {
                    return Ok(Some(end));
                }
                let at = MonotonicClock::now();
                self.outlets[message.channel].publish(&message.payload)?;
                let at_ns = at.saturating_duration_since(start).as_nanos();
                let at_ns = u64::try_from(at_ns).unwrap_or(u64::MAX);
                self.kept.note(message.channel, due_ns, at_ns);
            }
            if !is_looped {
                break;
            }
        }
        Ok(None)
    }

    fn ended(&self) -> Option<PlayEnd> {
        if let Some(signal) = self.signals.received() {
            return Some(PlayEnd::Interrupted(signal));
        }
        self.target.is_over().then_some(PlayEnd::Done)
    }

    /// Sleeps until `due`; gives why it should not go on. It asks for the end of the run every
    /// [`SLEEP_MAX`], however soon messages follow each other.
    fn sleep_until(&mut self, due: Instant) -> Option<PlayEnd> {
        loop {
            if let Some(signal) = self.signals.received() {
                return Some(PlayEnd::Interrupted(signal));
            }
            let look = self.looked + SLEEP_MAX;
            if MonotonicClock::now() >= look {
                if self.target.is_over() {
                    return Some(PlayEnd::Done);
                }
                // After the answer: a slow one must not be asked for without end.
                self.looked = MonotonicClock::now();
            } else if due > look {
                let (Wake::Due | Wake::Interrupted) = MonotonicClock::sleep_until(look);
            } else if MonotonicClock::sleep_until(due) == Wake::Due {
                return None;
            }
        }
    }

    fn lateness(&self) -> String {
        let Punctuality {
            late_count,
            bunched_count,
            worst_ns,
            ..
        } = &self.kept;
        let worst_ms = *worst_ns as f64 / 1e6;
        format!(
            "{late_count} messages left more than 1 ms late, at worst {worst_ms:.1} ms, and \
             {bunched_count} of all less than half their time after the one before on their channel"
        )
    }
}
