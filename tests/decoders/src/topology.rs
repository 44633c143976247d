//! Topology files.

use hil_fleet::Fleet;
use hil_shuttle::Shuttle;
use hil_teleoperation::Teleoperation;
use hil_topology::{KnownCases, Topology, TopologyErrors, parse};

use crate::Verdict;

/// The case studies that ship.
pub(crate) fn known() -> KnownCases {
    KnownCases::new()
        .with::<Fleet>()
        .with::<Teleoperation>()
        .with::<Shuttle>()
}

fn read(text: &str) -> Result<Topology, TopologyErrors> {
    parse("/nowhere/input.toml", text, &[], &known())
}

/// As the text of an override on the command line, nothing is worse than refused with a reason; a
/// topology that is accepted, written with all its defaults, is accepted as the same; one that is
/// refused says why.
pub(crate) fn topology(bytes: &[u8]) -> Verdict {
    let Ok(text) = str::from_utf8(bytes) else {
        return Verdict::Refused;
    };
    // Would make the outcome hang on this machine's files.
    if text.contains("extends") {
        return Verdict::Refused;
    }
    if let Err(errors) = parse(
        "/nowhere/input.toml",
        "version = 1",
        &[text.to_owned()],
        &known(),
    ) {
        assert!(errors.render(false).contains("error"));
    }
    match read(text) {
        Ok(topology) => {
            let written = topology.to_toml();
            let again = read(&written).unwrap_or_else(|errors| panic!("{errors}\n{written}"));
            assert_eq!(again.to_toml(), written, "writing and reading changes it");
            assert_eq!(again.hash(), topology.hash());
            Verdict::Accepted
        }
        Err(errors) => {
            assert!(
                !errors.to_string().trim().is_empty(),
                "refused without a word"
            );
            Verdict::Refused
        }
    }
}
