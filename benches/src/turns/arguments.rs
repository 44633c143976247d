//! What a bench of turns is told, by its command line or its environment.

use std::time::Duration;

use crate::gateway::hosts::SetupError;

/// Rounds, the length of a turn in seconds, and a processor for each host, where the command line says
/// nothing of them.
const ROUNDS_VARIABLE: &str = "HIL_BENCH_ROUNDS";
const TURN_VARIABLE: &str = "HIL_BENCH_TURN_S";
const PIN_VARIABLE: &str = "HIL_BENCH_PIN";

/// What a bench of turns is told.
#[derive(Debug)]
pub struct Arguments {
    /// Rounds of turns.
    pub round_count: usize,
    /// How long a turn is measured, of two in each round.
    pub turn: Duration,
    /// Messages per second and channel.
    pub rate_hz: f64,
    /// The processor of each host's processes, in the order of the hosts; without, any.
    pub pins: Vec<usize>,
    /// Settings of the topology, as `--set` takes them.
    pub settings: Vec<String>,
}

impl Arguments {
    /// Reads `[--rounds N] [--turn SECONDS] [--rate HZ] [--pin CPU,CPU] [--set KEY=VALUE]...` of this
    /// process; rounds, turns and processors also from its environment. Without either, `round_count` rounds of `turn_s`.
    ///
    /// # Errors
    /// At a word it does not know, or a value that is no number.
    pub fn read(round_count: usize, turn_s: f64) -> Result<Self, SetupError> {
        let said = |name| std::env::var(name).ok();
        let of_environment = [
            ("--rounds", said(ROUNDS_VARIABLE)),
            ("--turn", said(TURN_VARIABLE)),
            ("--pin", said(PIN_VARIABLE)),
        ];
        let mut given = Vec::new();
        for (word, value) in of_environment {
            given.extend(value.into_iter().flat_map(|value| [word.to_owned(), value]));
        }
        given.extend(std::env::args().skip(1).filter(|word| word != "--bench"));
        Self::of(given.into_iter(), round_count, turn_s)
    }

    fn of(
        mut given: impl Iterator<Item = String>,
        round_count: usize,
        turn_s: f64,
    ) -> Result<Self, SetupError> {
        let mut read = Self {
            round_count,
            turn: Duration::try_from_secs_f64(turn_s)?,
            rate_hz: 1000.0,
            pins: Vec::new(),
            settings: Vec::new(),
        };
        while let Some(word) = given.next() {
            let value = given.next().ok_or(format!("{word} needs a value"))?;
            match word.as_str() {
                "--rounds" => read.round_count = value.parse()?,
                "--turn" => read.turn = Duration::try_from_secs_f64(value.parse()?)?,
                "--rate" => read.rate_hz = value.parse()?,
                "--pin" => {
                    let pins = value.split(',').map(|cpu| cpu.trim().parse());
                    read.pins = pins.collect::<Result<_, _>>()?;
                }
                "--set" => read.settings.push(value),
                _ => return Err(format!("unknown argument {word}").into()),
            }
        }
        Ok(read)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_environment_says_rounds_and_turns_and_the_command_line_has_the_last_word() {
        let words = [
            "--rounds", "7", "--pin", "0,1", "--turn", "0.5", "--rounds", "9",
        ];
        let read = Arguments::of(words.map(str::to_owned).into_iter(), 60, 1.5).unwrap();
        assert_eq!(
            (read.round_count, read.turn),
            (9, Duration::from_millis(500))
        );
        assert_eq!(read.pins, [0, 1]);
        let read = Arguments::of(core::iter::empty(), 60, 1.5).unwrap();
        assert_eq!(
            (read.round_count, read.turn),
            (60, Duration::from_millis(1500))
        );
        for words in [
            ["--rounds", "x"],
            ["--turn", "-1"],
            ["--what", "1"],
            ["--pin", "0-1"],
        ] {
            assert!(Arguments::of(words.map(str::to_owned).into_iter(), 1, 1.0).is_err());
        }
    }
}
