//! A radio in a topology file: presets, what differs from them, and what is refused.

use hil_core::options::{Options, Shape, Slot};
use hil_link::wifi::{AccessCategory, PowerSave, WifiPreset};

use super::faulty::GOOD;
use super::*;

fn with(radio: &str) -> String {
    GOOD.replace("via = \"udp\"", &format!("via = \"emulated\"\n{radio}"))
}

fn radio_of(topology: &Topology) -> hil_link::wifi::WifiSpec {
    let specs: Vec<_> = topology
        .channels
        .iter()
        .filter_map(|channel| topology.crossing(channel)?.spec)
        .map(|spec| spec.wifi.expect("the link has a radio"))
        .collect();
    assert!(specs.len() == 2 && specs[0] == specs[1], "both ways alike");
    specs[0]
}

#[test]
fn a_preset_by_name_is_the_preset_in_both_directions() {
    for preset in WifiPreset::ALL {
        let topology = parse_good(&with(&format!("wifi = \"{}\"", preset.name())));
        assert_eq!(radio_of(&topology), preset.spec());
        let again = parse_good(&topology.to_toml());
        assert_eq!(again, topology, "{}", topology.to_toml());
    }
}

#[test]
fn a_table_says_what_differs_from_its_preset_and_is_written_back() {
    let text = with(
        "[links.hop.wifi]\npreset = \"wifi6-long-range\"\ndistance_m = 50\nwall_count = 3\n\
         access_category = \"voice\"\npower_save = \"backward\"\n\
         [links.hop.wifi.outages]\nper_hour = 12\nbuffered = true\n",
    );
    let topology = parse_good(&text);
    let mut expected = WifiPreset::LongRange.spec();
    expected.distance_m = 50.0;
    expected.wall_count = 3;
    expected.access_category = AccessCategory::Voice;
    expected.power_save = PowerSave::Backward;
    expected.outages.per_hour = 12.0;
    expected.outages.buffered = true;
    assert_eq!(radio_of(&topology), expected);
    assert_eq!(parse_good(&topology.to_toml()), topology);
}

#[test]
fn every_number_of_a_radio_is_refused_by_name_outside_its_range() {
    for field in WifiPreset::ShortRange.spec().fields() {
        let above = match field.slot {
            Slot::Value(_, Shape::Number(range)) => (range.end() + 1.0).to_string(),
            Slot::Value(_, Shape::Integer(range)) => (range.end() + 1).to_string(),
            _ => continue,
        };
        let text = with(&format!("[links.hop.wifi]\n{} = {above}\n", field.key));
        let errors = parse("faulty.toml", &text, &[], &known()).unwrap_err();
        let [error] = errors.errors() else {
            panic!("{}: {errors}", field.key);
        };
        assert_eq!(error.key, format!("links.hop.wifi.{}", field.key));
        assert!(error.to_string().contains("is outside"), "{error}");
        assert!(error.to_string().contains(":27"), "{error}");
    }
}

#[test]
fn what_a_radio_cannot_be_is_refused_with_its_reason() {
    for (radio, key, says) in [
        ("wifi = \"wifi6-short\"", "wifi", "did you mean"),
        ("wifi = 6", "wifi", "string"),
        ("wifi = { range = 20 }", "wifi.range", "is not a known key"),
        (
            "wifi = { preset = \"wifi6-short-range\", fading_m = 0.2 }",
            "wifi.fading_m",
            "0.5 to 100",
        ),
        (
            "wifi = { channel_width_mhz = 60 }",
            "wifi.channel_width_mhz",
            "20, 40, 80, 160",
        ),
        (
            "wifi = { contender_count = 0 }",
            "wifi.busy_ratio",
            "0 stations",
        ),
        (
            "wifi = \"wifi6-long-range\"\noutages = { per_hour = 3 }",
            "outages",
            "twice",
        ),
        (
            "wifi = \"wifi6-short-range\"\ntrace = \"runs/x/traces\"",
            "trace",
            "say one of them",
        ),
        (
            "wifi = { distance_m = 20 }\ntrace = { files = { \"arm/command\" = \"a.csv\" } }",
            "trace",
            "no message would meet the radio",
        ),
        (
            "forward = { wifi = \"wifi6-long-range\" }",
            "forward.wifi",
            "is not a known key",
        ),
    ] {
        let errors = parse("faulty.toml", &with(radio), &[], &known()).unwrap_err();
        let [error] = errors.errors() else {
            panic!("{radio}: {errors}");
        };
        assert_eq!(error.key, format!("links.hop.{key}"), "{radio}");
        assert!(error.to_string().contains(says), "{radio}: {error}");
    }
}

#[test]
fn a_real_hop_has_no_radio_of_ours() {
    let text = GOOD.replace(
        "via = \"udp\"",
        "via = \"udp\"\nwifi = \"wifi6-short-range\"",
    );
    let errors = parse("faulty.toml", &text, &[], &known()).unwrap_err();
    assert_eq!(errors.errors()[0].key, "links.hop.wifi");
    assert!(
        errors.to_string().contains("needs via = \"emulated\""),
        "{errors}"
    );
}
