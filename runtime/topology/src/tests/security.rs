//! `[security]` in a topology file: what it may say, what it implies, and what must be said.

use super::faulty::GOOD;
use super::*;
use crate::Hops;

fn with(security: &str) -> String {
    format!("{GOOD}\n{security}\n")
}

#[test]
fn a_key_implies_sealed_hops_and_its_path_counts_from_the_file() {
    let topology = parse_good(&with("[security]\nkey = \"keys/hop.key\""));
    let security = topology.security();
    assert_eq!(security.hops, Some(Hops::Sealed));
    assert_eq!(security.key_file(), Some(PathBuf::from("keys/hop.key")));
    assert_eq!(topology.unsaid_security(), None);
    let elsewhere = parse(
        "/etc/lab/good.toml",
        &with("[security]\nkey = \"hop.key\""),
        &[],
        &known(),
    );
    let file = elsewhere.unwrap().security().key_file();
    assert_eq!(file, Some(PathBuf::from("/etc/lab/hop.key")));
    let absolute = parse_good(&with("[security]\nkey = \"/etc/hop.key\""));
    assert_eq!(
        absolute.security().key_file(),
        Some(PathBuf::from("/etc/hop.key"))
    );
}

#[test]
fn plain_hops_must_be_asked_for_and_win_over_a_key() {
    let topology = parse_good(&with("[security]\nhops = \"plain\"\nkey = \"hop.key\""));
    assert_eq!(topology.security().key_file(), None);
    assert_eq!(topology.unsaid_security(), None);
    let unsaid = parse_good(GOOD).unsaid_security().unwrap();
    for cure in [
        "hil-runtime key new",
        "[security]",
        "key = ",
        "hops = \"plain\"",
    ] {
        assert!(unsaid.contains(cure), "{unsaid}");
    }
    // Inside one PC there is no wire.
    assert_eq!(load_shipped("emulated.toml", &[]).unsaid_security(), None);
    assert_eq!(load_shipped("local.toml", &[]).unsaid_security(), None);
}

#[test]
fn what_it_cannot_mean_is_refused_with_its_key() {
    for (security, key) in [
        ("[security]\nhops = \"sealed\"", "security.key"),
        ("[security]\nkey = \"\"", "security.key"),
        ("[security]\nkey = 4", "security.key"),
        ("[security]\nhops = \"open\"", "security.hops"),
        ("[security]\nkeys = \"hop.key\"", "security.keys"),
    ] {
        let errors = parse("bad.toml", &with(security), &[], &known()).unwrap_err();
        let text = errors.to_string();
        assert!(text.contains(key), "{security}: {text}");
    }
}

#[test]
fn hosts_may_keep_the_key_at_different_places_but_must_agree_on_using_one() {
    let hash = |security: &str| parse_good(&with(security)).hash();
    let base = hash("[security]\nkey = \"/etc/hop.key\"");
    assert_eq!(
        hash("[security]\nkey = \"/root/hop.key\"\nhops = \"sealed\""),
        base
    );
    assert_ne!(hash("[security]\nhops = \"plain\""), base);
}

#[test]
fn every_shipped_topology_of_two_hosts_is_sealed() {
    for name in ["split.toml", "shuttle-split.toml", "shuttle-tcp.toml"] {
        let topology = load_shipped(name, &[]);
        assert!(topology.is_between_hosts(), "{name}");
        assert_eq!(topology.security().hops, Some(Hops::Sealed), "{name}");
    }
}
