//! Which host this machine is: every rung of the ladder, and both ways to be undecided.

use super::*;

fn machine(hostname: &str, addresses: &[&str]) -> MachineIdentity {
    MachineIdentity {
        hostname: hostname.to_owned(),
        addresses: addresses.iter().map(|text| text.parse().unwrap()).collect(),
    }
}

fn one(name: &str) -> HostChoice {
    HostChoice::One(name.to_owned())
}

#[test]
fn the_option_beats_the_variable_beats_the_name_beats_the_address() {
    let split = load_shipped("split.toml", &[]);
    let here = machine("robot-pc.lab.example", &["127.0.0.1", "10.77.0.1"]);
    let which = |requested, variable| which_host(&split, requested, variable, &here);
    assert_eq!(
        which(Some("control-pc"), Some("robot-pc")),
        Ok(one("control-pc"))
    );
    assert_eq!(which(None, Some("control-pc")), Ok(one("control-pc")));
    assert_eq!(which(None, None), Ok(one("robot-pc")));
    let nameless = machine("lab7", &["127.0.0.1", "10.77.0.1"]);
    assert_eq!(
        which_host(&split, None, None, &nameless),
        Ok(one("control-pc"))
    );
    let shouting = machine("CONTROL-PC", &[]);
    assert_eq!(
        which_host(&split, None, None, &shouting),
        Ok(one("control-pc"))
    );
}

#[test]
fn an_undecided_machine_says_what_it_compared() {
    let split = load_shipped("split.toml", &[]);
    let stranger = machine("laptop", &["192.168.1.5"]);
    let error = which_host(&split, None, None, &stranger).unwrap_err();
    let text = error.to_string();
    for part in [
        "control-pc",
        "10.77.0.2",
        "laptop",
        "192.168.1.5",
        "--host",
        "HIL_HOST",
    ] {
        assert!(text.contains(part), "{part} in {text}");
    }
    let both = machine("laptop", &["10.77.0.1", "10.77.0.2"]);
    let text = which_host(&split, None, None, &both)
        .unwrap_err()
        .to_string();
    assert!(text.starts_with("several hosts"), "{text}");
}

#[test]
fn a_named_host_must_exist_wherever_the_name_comes_from() {
    let split = load_shipped("split.toml", &[]);
    let here = machine("robot-pc", &[]);
    let text = which_host(&split, Some("robto-pc"), None, &here)
        .unwrap_err()
        .to_string();
    assert!(
        text.contains("--host") && text.contains("did you mean `robot-pc`?"),
        "{text}"
    );
    let text = which_host(&split, None, Some("x"), &here)
        .unwrap_err()
        .to_string();
    assert!(text.starts_with("HIL_HOST names host `x`"), "{text}");
}

#[test]
fn hosts_without_address_all_run_here() {
    let emulated = load_shipped("emulated.toml", &[]);
    let here = machine("robot-pc", &["10.77.0.1"]);
    assert_eq!(
        which_host(&emulated, None, None, &here),
        Ok(HostChoice::All)
    );
    // The variable belongs to the machine; a file without addresses is not about machines.
    assert_eq!(
        which_host(&emulated, None, Some("lab7"), &here),
        Ok(HostChoice::All)
    );
    let error = which_host(&emulated, Some("robot-pc"), None, &here).unwrap_err();
    assert!(matches!(error, HostError::NothingToChoose { .. }));
    let local = load_shipped("local.toml", &[]);
    assert_eq!(
        which_host(&local, Some("local"), None, &here),
        Ok(HostChoice::All)
    );
}

#[test]
fn the_kernel_tells_at_least_the_loopback_address() {
    let machine = MachineIdentity::gather().unwrap();
    assert!(machine.addresses.iter().any(std::net::IpAddr::is_loopback));
}
