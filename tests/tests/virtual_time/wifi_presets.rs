//! What the Wi-Fi presets do to a message, measured; the table stands in `docs/wifi-model.md`, and this
//! test holds it to what comes out.

use std::fs;
use std::time::Duration;

use hil_core::link_model::Fate;
use hil_core::time::Instant;
use hil_link::spec::{LinkPlace, LinkSpec, Way};
use hil_link::wifi::WifiPreset;
use hil_tests::binary::workspace_folder;

const MESSAGE_COUNT: u32 = 1_000_000;
/// 64 bytes of a message and the 72 of our header.
const LENGTH_BYTES: usize = 136;
const SEED: u64 = 1;

/// One row of the table: the delays of [`MESSAGE_COUNT`] messages of a channel, one every `period`.
fn row(preset: WifiPreset, period: Duration) -> String {
    let spec = LinkSpec {
        wifi: Some(preset.spec()),
        ..LinkSpec::default()
    };
    let place = LinkPlace {
        seed: SEED,
        link: "hop",
        channel: "arm/command",
        way: Way::Forward,
    };
    let mut link = spec.build(&place).unwrap();
    let mut delays_ns = Vec::new();
    for index in 0..MESSAGE_COUNT {
        let now = Instant::ZERO + period * index;
        match link.offer(now, LENGTH_BYTES) {
            Fate::Delivered(at) => delays_ns.push(at.ns_since(now)),
            Fate::Lost => {}
            Fate::Duplicated { .. } => panic!("this radio copies nothing"),
        }
    }
    let delivered_count = delays_ns.len();
    assert!(delivered_count > 900_000, "{delivered_count}");
    delays_ns.sort_unstable();
    let cell = |per_mille: usize| {
        let rank = (per_mille * delivered_count).div_ceil(1000);
        format!("{:.2}", delays_ns[rank - 1] as f64 * 1e-6)
    };
    let cells = [500, 900, 990, 999, 1000].map(cell);
    let lost = 1.0 - delivered_count as f64 / f64::from(MESSAGE_COUNT);
    format!(
        "| `{}` | {} ms | {} | {:.2} |",
        preset.name(),
        period.as_millis(),
        cells.join(" | "),
        100.0 * lost
    )
}

#[test]
fn the_delays_of_the_presets_are_those_of_the_document() {
    let document = fs::read_to_string(workspace_folder().join("docs/wifi-model.md")).unwrap();
    let mut missing = Vec::new();
    for preset in WifiPreset::ALL {
        for period_ms in [4, 10] {
            let row = row(preset, Duration::from_millis(period_ms));
            println!("{row}");
            if !document.contains(&row) {
                missing.push(row);
            }
        }
    }
    assert!(
        missing.is_empty(),
        "not in docs/wifi-model.md: {missing:#?}"
    );
}
