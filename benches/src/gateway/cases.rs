//! The cases of `gateway_overhead`: what is compared with what. It opens nothing.

use std::collections::BTreeMap;
use std::time::Duration;

use hil_platform::wait::WaitMode;

use super::applications::PARTY_COUNT;
use super::hosts::Plan;

/// Of the cases that keep a pace.
pub const PERIOD: Duration = Duration::from_millis(1);

/// What a case is made of.
#[derive(Debug, Clone, Copy)]
pub enum Kind {
    /// Bare UDP over the product's sockets.
    Echo,
    /// Through gateways, one thread per host: application to application in the two threads.
    Gateway,
    /// The round trips of the case before, less what the applications took: from where a gateway
    /// takes a message to where the other has delivered it, both ways.
    BetweenGateways,
    /// Blocking sockets of the standard library.
    Plain,
    /// One way at 1 kHz.
    Hop,
    /// A thread per party.
    Applications {
        /// One round trip every [`PERIOD`] instead of one after the other.
        is_paced: bool,
    },
}

/// One case.
#[derive(Debug, Clone, Copy)]
pub struct CasePlan {
    /// What it is made of.
    pub kind: Kind,
    /// Its name in the table.
    pub title: &'static str,
    /// Its channels.
    pub plan: Plan,
    /// The case it is compared with; itself for a floor.
    pub reference: usize,
}

const BLOCK: WaitMode = WaitMode::Block;

fn word(wait: WaitMode) -> &'static str {
    match wait {
        WaitMode::Block => "block",
        WaitMode::Hybrid => "hybrid",
        WaitMode::Spin => "spin",
    }
}

/// All cases for a machine with `cpu_count` processors; groups come last.
pub fn case_plans(cpu_count: usize) -> Vec<CasePlan> {
    let mut list = List::default();
    let mut blocking_echo = BTreeMap::new();
    for wait in [BLOCK, WaitMode::Spin] {
        for size in [64, 1024] {
            for is_stamped in [true, false] {
                let stamps = if is_stamped { "stamps" } else { "no stamps" };
                let name = |what: &str| format!("{what} {} {size} B {stamps}", word(wait));
                let mut add = |kind, what, reference| {
                    list.add(kind, name(what), size, wait, is_stamped, reference)
                };
                let echo = add(Kind::Echo, "UDP echo", None);
                add(Kind::Gateway, "put-gateways-take", Some(echo));
                add(Kind::BetweenGateways, "gateways", Some(echo));
                if is_stamped && wait == BLOCK {
                    blocking_echo.insert(size, echo);
                }
            }
        }
    }
    let plain = "plain UDP echo block 64 B no stamps".to_owned();
    list.add(Kind::Plain, plain, 64, BLOCK, false, None);
    let mut spinning = None;
    for wait in [WaitMode::Spin, WaitMode::Hybrid, BLOCK] {
        let name = format!("one hop {} 64 B 1 kHz", word(wait));
        let hop = list.add(Kind::Hop, name, 64, wait, true, spinning);
        spinning.get_or_insert(hop);
    }
    for (size, echo) in blocking_echo {
        let kind = Kind::Applications { is_paced: false };
        let name = format!("applications block {size} B");
        list.add(kind, name, size, BLOCK, true, Some(echo));
    }
    let spin = (cpu_count >= PARTY_COUNT).then_some(WaitMode::Spin);
    let mut reference = None;
    for wait in spin.into_iter().chain([BLOCK, WaitMode::Hybrid]) {
        let kind = Kind::Applications { is_paced: true };
        let name = format!("applications {} 64 B 1 kHz", word(wait));
        let case = list.add(kind, name, 64, wait, true, reference);
        reference.get_or_insert(case);
    }
    list.cases
}

/// Those of which the title holds `text`, and what they are compared with.
pub fn only(cases: &[CasePlan], text: &str) -> Vec<CasePlan> {
    let is_named = |case: &CasePlan| case.title.contains(text);
    let is_wanted = |index: usize| {
        let refers = |case: &CasePlan| is_named(case) && case.reference == index;
        let follows = cases
            .get(index + 1)
            .is_some_and(|next| is_named(next) && matches!(next.kind, Kind::BetweenGateways));
        is_named(&cases[index]) || follows || cases.iter().any(refers)
    };
    let kept: Vec<usize> = (0..cases.len()).filter(|index| is_wanted(*index)).collect();
    let place = |index: usize| kept.iter().position(|kept| *kept == index);
    let mut list: Vec<CasePlan> = kept.iter().map(|index| cases[*index]).collect();
    for (own, case) in list.iter_mut().enumerate() {
        // The reference of a mere reference may be gone.
        case.reference = place(case.reference).unwrap_or(own);
    }
    list
}

#[derive(Default)]
struct List {
    cases: Vec<CasePlan>,
}

impl List {
    fn add(
        &mut self,
        kind: Kind,
        title: String,
        size_bytes: usize,
        wait: WaitMode,
        is_stamped: bool,
        reference: Option<usize>,
    ) -> usize {
        let case = self.cases.len();
        self.cases.push(CasePlan {
            kind,
            // A handful, needed until the end of the program.
            title: title.leak(),
            plan: Plan {
                name: format!("case{case}").leak(),
                size_bytes,
                wait,
                is_stamped,
                depth: 1,
            },
            reference: reference.unwrap_or(case),
        });
        case
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_gateway_case_is_compared_with_the_echo_of_its_kind() {
        let cases = case_plans(2);
        for case in &cases {
            let reference = &cases[case.reference];
            if matches!(case.kind, Kind::Gateway | Kind::BetweenGateways) {
                assert!(matches!(reference.kind, Kind::Echo));
                assert_eq!(
                    (case.plan.size_bytes, case.plan.wait, case.plan.is_stamped),
                    (
                        reference.plan.size_bytes,
                        reference.plan.wait,
                        reference.plan.is_stamped
                    )
                );
            }
        }
        let is_crew = |case: &CasePlan| matches!(case.kind, Kind::Applications { .. });
        let first = cases.iter().position(is_crew).unwrap();
        assert!(cases[first..].iter().all(is_crew));
    }

    #[test]
    fn a_choice_keeps_what_it_is_compared_with() {
        let chosen = only(&case_plans(2), "gateways spin 64");
        let titles: Vec<&str> = chosen.iter().map(|case| case.title).collect();
        assert_eq!(
            titles,
            [
                "UDP echo spin 64 B stamps",
                "put-gateways-take spin 64 B stamps",
                "gateways spin 64 B stamps",
                "UDP echo spin 64 B no stamps",
                "put-gateways-take spin 64 B no stamps",
                "gateways spin 64 B no stamps",
            ]
        );
        assert_eq!(chosen[2].reference, 0);
        assert_eq!(chosen[4].reference, 3);
    }

    #[test]
    fn spinning_parties_need_a_processor_each() {
        let spins = |cpu_count| {
            let cases = case_plans(cpu_count);
            let mut titles = cases.iter().map(|case| case.title);
            titles.any(|title| title == "applications spin 64 B 1 kHz")
        };
        assert!(!spins(2) && spins(PARTY_COUNT));
    }
}
