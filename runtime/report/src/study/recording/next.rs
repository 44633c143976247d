//! What comes next for a row, from what its folder holds. It touches nothing, so that a call that was killed
//! and one that was not decide alike.

use std::collections::BTreeMap;

use super::folder::Part;

/// Refused runs in a row after which the row stops.
pub(super) const REFUSED_MAX: u64 = 5;

/// What a row is to become.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Target {
    /// As many are enough of what the case counts.
    pub(super) enough: u64,
    /// Of the first run.
    pub(super) seed: u64,
    /// How many copies of the robots this host keeps is to be found out.
    pub(super) is_tried: bool,
}

/// What the folder of a row holds.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Found {
    /// What each sound run counted, by its seed.
    pub(super) runs: BTreeMap<u64, u64>,
    /// Why each other run was refused, by its seed.
    pub(super) refused: BTreeMap<u64, String>,
    /// Trial runs by the number of copies: why each was not clean, if it was not.
    pub(super) trials: BTreeMap<u64, Option<String>>,
}

/// What comes next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Next {
    /// This run or trial; with so many copies where that is tried.
    Make { part: Part, copies: Option<u64> },
    /// Nothing: there is enough.
    Enough,
    /// Nothing: what this call made was refused too often.
    RefusedTooOften,
}

impl Found {
    /// What its sound runs counted together.
    pub(super) fn count(&self) -> u64 {
        self.runs.values().sum()
    }

    /// The most copies that a clean trial had.
    pub(super) fn copies(&self) -> Option<u64> {
        let mut trials = self.trials.iter().rev();
        trials.find_map(|(copies, fault)| fault.is_none().then_some(*copies))
    }

    /// Adds a part: what it counted, or why it was refused.
    pub(super) fn add(&mut self, part: Part, outcome: Result<u64, String>) {
        match (part, outcome) {
            (Part::Trial(copies), outcome) => {
                self.trials.insert(copies, outcome.err());
            }
            (Part::Run(seed) | Part::Refused(seed), Ok(count)) => {
                self.runs.insert(seed, count);
            }
            (Part::Run(seed) | Part::Refused(seed), Err(why)) => {
                self.refused.insert(seed, why);
            }
        }
    }
}

/// What comes next of a row, of which this call had `refused_count` refused without a sound one between them.
pub(super) fn next(target: &Target, found: &Found, refused_count: u64) -> Next {
    if found.count() >= target.enough {
        return Next::Enough;
    }
    if refused_count >= REFUSED_MAX {
        return Next::RefusedTooOften;
    }
    let copies = found.copies().filter(|_| target.is_tried);
    let trial = match (copies, found.trials.last_key_value()) {
        _ if !target.is_tried => None,
        // Not even one was kept: the host may be less busy now.
        (None, _) => Some(1),
        (Some(copies), Some((_, None))) => Some(2 * copies),
        _ => None,
    };
    if let Some(copies) = trial {
        let part = Part::Trial(copies);
        return Next::Make {
            part,
            copies: Some(copies),
        };
    }
    let last = found.runs.keys().chain(found.refused.keys()).max();
    let part = Part::Run(last.map_or(target.seed, |seed| seed + 1));
    Next::Make { part, copies }
}

#[cfg(test)]
mod tests {
    use super::*;

    use hil_core::random::RandomStream;

    const TARGET: Target = Target {
        enough: 1000,
        seed: 7,
        is_tried: true,
    };

    /// A host that keeps five copies, and now and then does not keep up.
    fn outcome(seed: u64, copies: u64) -> Result<u64, String> {
        match seed % 4 {
            1 => Err(format!("seed {seed} skipped ticks")),
            rest => Ok(copies * (10 + rest)),
        }
    }

    /// Calls until the row has enough, each of which is killed after some steps, within one.
    fn recorded(mut steps_until_killed: impl FnMut() -> u64) -> (Found, u64) {
        let (mut found, mut killed_count) = (Found::default(), 0);
        loop {
            let mut refused_count = 0;
            for _ in 0..steps_until_killed() {
                match next(&TARGET, &found, refused_count) {
                    Next::Enough => return (found, killed_count),
                    Next::RefusedTooOften => panic!("{found:?}"),
                    Next::Make {
                        part: Part::Run(seed),
                        copies,
                    } => {
                        let outcome = outcome(seed, copies.unwrap());
                        refused_count = outcome.as_ref().map_or(refused_count + 1, |_| 0);
                        found.add(Part::Run(seed), outcome);
                    }
                    Next::Make { part, copies } => {
                        let is_kept = copies.unwrap() <= 5;
                        found.add(
                            part,
                            is_kept.then_some(0).ok_or_else(|| "skipped".to_owned()),
                        );
                    }
                }
            }
            // The step under way leaves nothing that counts.
            killed_count += 1;
        }
    }

    #[test]
    fn a_row_that_was_killed_at_any_time_becomes_what_it_would_have_been() {
        let (whole, killed_count) = recorded(|| u64::MAX);
        assert_eq!(killed_count, 0);
        assert_eq!((whole.copies(), whole.trials.len()), (Some(4), 4));
        assert!(whole.count() >= 1000 && !whole.refused.is_empty());
        for seed in 0..200 {
            let mut random = RandomStream::new(seed, "kills");
            let (found, killed_count) = recorded(|| random.next_u64() % 4);
            assert!(killed_count > 3);
            assert_eq!(found, whole, "seed {seed}");
        }
    }

    #[test]
    fn trials_double_until_one_is_not_clean_and_one_copy_is_tried_again() {
        let after = |trials: &[(u64, bool)]| {
            let fault = |is_clean: bool| (!is_clean).then(|| "skipped".to_owned());
            let trials = trials
                .iter()
                .map(|(copies, is_clean)| (*copies, fault(*is_clean)));
            let found = Found {
                trials: trials.collect(),
                ..Found::default()
            };
            next(&TARGET, &found, 0)
        };
        let trial = |copies| Next::Make {
            part: Part::Trial(copies),
            copies: Some(copies),
        };
        assert_eq!(after(&[]), trial(1));
        assert_eq!(after(&[(1, false)]), trial(1));
        assert_eq!(after(&[(1, true), (2, true)]), trial(4));
        let run = |copies| Next::Make {
            part: Part::Run(7),
            copies: Some(copies),
        };
        assert_eq!(after(&[(1, true), (2, true), (4, false)]), run(2));
        let found = Found::default();
        let fixed = Target {
            is_tried: false,
            ..TARGET
        };
        let expected = Next::Make {
            part: Part::Run(7),
            copies: None,
        };
        assert_eq!(next(&fixed, &found, 0), expected);
        assert_eq!(next(&fixed, &found, REFUSED_MAX), Next::RefusedTooOften);
    }

    #[test]
    fn what_has_enough_needs_nothing_whatever_was_refused() {
        let found = Found {
            runs: [(7, 600), (9, 400)].into(),
            refused: [(8, "skipped".to_owned()), (10, "skipped".to_owned())].into(),
            trials: BTreeMap::new(),
        };
        assert_eq!(next(&TARGET, &found, REFUSED_MAX), Next::Enough);
        let more = Target {
            enough: 1001,
            is_tried: false,
            ..TARGET
        };
        let expected = Next::Make {
            part: Part::Run(11),
            copies: None,
        };
        assert_eq!(next(&more, &found, 0), expected);
    }
}
