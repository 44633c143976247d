//! What the Debian package is made of: units that systemd takes, files that are there. The package
//! itself is installed in `tests/lab/systemd.sh`.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::Command;

use hil_tests::binary::workspace_folder;
use hil_tests::run_folder::RunFolder;

const UNITS: [&str; 2] = ["hil-runtime@.service", "hil-recorder@.service"];

fn read(path: &str) -> String {
    fs::read_to_string(workspace_folder().join(path)).unwrap()
}

fn unit(name: &str) -> BTreeMap<String, String> {
    keys(&read(&format!("deploy/systemd/{name}")))
}

/// `Section.Key` to its value.
fn keys(text: &str) -> BTreeMap<String, String> {
    let mut section = String::new();
    let mut keys = BTreeMap::new();
    for line in text.lines().map(str::trim) {
        if let Some(name) = line.strip_prefix('[') {
            name.trim_end_matches(']').clone_into(&mut section);
        } else if let Some((key, value)) = line.split_once('=').filter(|_| !line.starts_with('#')) {
            let key = format!("{section}.{key}");
            assert!(!keys.contains_key(&key), "{key} stands there twice");
            keys.insert(key, value.to_owned());
        }
    }
    keys
}

fn assert_keys(unit: &BTreeMap<String, String>, expected: &[(&str, &str)]) {
    for (key, value) in expected {
        assert_eq!(unit.get(*key).map(String::as_str), Some(*value), "{key}");
    }
}

#[test]
fn the_units_say_what_a_run_needs() {
    let runtime = unit(UNITS[0]);
    assert_keys(
        &runtime,
        &[
            ("Service.Type", "notify"),
            ("Service.NotifyAccess", "main"),
            ("Service.KillMode", "mixed"),
            ("Service.Restart", "on-failure"),
            ("Service.RestartPreventExitStatus", "2 77 78"),
            ("Service.SuccessExitStatus", "130"),
            ("Service.User", "hil"),
            ("Service.RemoveIPC", "no"),
            ("Service.LimitRTPRIO", "99"),
            ("Service.LimitMEMLOCK", "infinity"),
            ("Service.StateDirectory", "hil-runtime/%i"),
            ("Service.RuntimeDirectory", "hil"),
            ("Unit.After", "network-online.target time-sync.target"),
        ],
    );
    let needed = [
        "CAP_SYS_NICE",
        "CAP_IPC_LOCK",
        "CAP_NET_RAW",
        "CAP_NET_ADMIN",
    ];
    for capability in needed {
        assert!(runtime["Service.AmbientCapabilities"].contains(capability));
        assert!(runtime["Service.CapabilityBoundingSet"].contains(capability));
    }
    // Either would take away what a run needs; the unit says why they are not there.
    for key in ["RestrictRealtime", "ProtectClock", "PrivateDevices"] {
        assert_eq!(runtime.get(&format!("Service.{key}")), None, "{key}");
    }
    let recorder = unit(UNITS[1]);
    assert_keys(
        &recorder,
        &[
            ("Unit.PartOf", "hil-runtime@%i.service"),
            ("Unit.Before", "hil-runtime@%i.service"),
            ("Install.WantedBy", "hil-runtime@%i.service"),
            ("Service.User", "hil"),
            ("Service.RemoveIPC", "no"),
        ],
    );
}

/// What `systemd-analyze verify` says of units whose programs are there.
fn verdict(units: &[(&str, String)]) -> Option<String> {
    let folder = RunFolder::new("units");
    let mut paths = Vec::new();
    for (name, text) in units {
        let path = folder.join(name);
        let is_manual = |line: &&str| !line.starts_with("Documentation=man:");
        let text: Vec<&str> = text.lines().filter(is_manual).collect();
        let text = text.join("\n");
        let programs = ["/usr/bin/hil-runtime", "/usr/bin/hil-recorder"];
        let text = programs
            .iter()
            .fold(text, |text, program| text.replace(program, "/bin/true"));
        fs::write(&path, text).unwrap();
        paths.push(path);
    }
    let mut command = Command::new("systemd-analyze");
    let output = command.arg("verify").args(&paths).output().ok()?;
    let words = String::from_utf8_lossy(&output.stderr).into_owned();
    // Units of this machine that ours refer to may have faults of their own.
    let of_ours = words.lines().filter(|line| line.contains("hil-"));
    Some(of_ours.collect::<Vec<_>>().join("\n"))
}

#[test]
fn systemd_finds_no_fault_with_the_units() {
    let units: Vec<(&str, String)> = UNITS
        .iter()
        .map(|name| (*name, read(&format!("deploy/systemd/{name}"))))
        .collect();
    let Some(words) = verdict(&units) else {
        println!("skipped: systemd-analyze is not here; the keys are checked by other tests");
        return;
    };
    assert_eq!(words, "");
    let wrong = units[0].1.replace("KillMode=mixed", "KillMood=mixed");
    let words = verdict(&[(UNITS[0], wrong)]).unwrap();
    assert!(words.contains("KillMood"), "a planted fault: {words}");
}

/// Sources of the package's files in `runtime/cli/Cargo.toml`, and where they go.
fn assets() -> Vec<(String, String)> {
    let manifest = read("runtime/cli/Cargo.toml");
    let (_, list) = manifest.split_once("assets = [").unwrap();
    let lines = list.lines().filter(|line| line.trim().starts_with("[\""));
    let assets = lines.map(|line| {
        let parts: Vec<&str> = line.split('"').collect();
        (parts[1].to_owned(), parts[3].to_owned())
    });
    assets.collect()
}

#[test]
fn every_file_of_the_package_is_there() {
    let assets = assets();
    assert!(assets.len() > 15, "{assets:?}");
    for (source, _) in &assets {
        // What the package's script makes is not there before it ran.
        let Some(path) = source.strip_prefix("../../") else {
            assert!(source.starts_with("target/release/deb/"), "{source}");
            continue;
        };
        let (folder, name) = path.rsplit_once('/').unwrap_or((".", path));
        let ending = name.strip_prefix('*');
        let mut names = fs::read_dir(workspace_folder().join(folder)).unwrap();
        let is_there = names.any(|entry| {
            let entry = entry.unwrap().file_name().to_string_lossy().into_owned();
            ending.map_or(entry == name, |ending| entry.ends_with(ending))
        });
        assert!(is_there, "{source}");
    }
    // A conffile of the package may name no option that the program does not have.
    let default = read("deploy/debian/hil-runtime.default");
    for variable in ["HIL_HOST", "HIL_OPTIONS"] {
        assert!(default.contains(variable), "{variable}");
    }
    assert!(unit(UNITS[0])["Service.ExecStart"].contains("$HIL_OPTIONS"));
}

#[test]
fn the_dissector_goes_where_wireshark_looks() {
    let Ok(output) = Command::new("tshark").args(["-G", "folders"]).output() else {
        println!("skipped: tshark is not here");
        return;
    };
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let line = text
        .lines()
        .find(|line| line.starts_with("Global Lua Plugins"));
    let folder = line
        .and_then(|line| line.split_whitespace().last())
        .unwrap();
    let assets = assets();
    let (_, place) = assets
        .iter()
        .find(|(source, _)| source.ends_with("hil.lua"))
        .unwrap();
    assert_eq!(Path::new("/").join(place), Path::new(folder));
}

#[test]
fn the_maintainer_scripts_are_shell_and_take_everything_back() {
    for name in ["postinst", "prerm", "postrm"] {
        let path = workspace_folder().join("deploy/debian/scripts").join(name);
        let checked = Command::new("sh").arg("-n").arg(&path).status().unwrap();
        assert!(checked.success(), "{name}");
    }
    let postrm = read("deploy/debian/scripts/postrm");
    for folder in ["/var/lib/hil-runtime", "/etc/hil-runtime", "/run/hil"] {
        assert!(postrm.contains(folder), "{folder} would stay");
    }
}
