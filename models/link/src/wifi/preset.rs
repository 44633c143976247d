//! The two wireless links of the seed paper (Lv et al., section III.A) as presets. What in them is
//! from a standard, what is assumed and what is fitted is told in docs/wifi-model.md, number by
//! number. They are no measurement of those routers.

use crate::outages::Outages;
use crate::wifi::spec::WifiSpec;
use hil_core::options::{Scalar as _, Setting, Shape, Short, Templates};

hil_core::labelled! {
    /// A link by name.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum WifiPreset, name {
        /// Two routers, 20 m apart, in adjacent laboratory areas.
        ShortRange = "wifi6-short-range",
        /// Two routers, 35 m apart, the second at the end of the corridor.
        LongRange = "wifi6-long-range",
    }
}

impl WifiPreset {
    const NAMES: &'static [&'static str] = &[Self::ALL[0].name(), Self::ALL[1].name()];

    /// The preset of that name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|preset| preset.name() == name)
    }

    /// Its numbers.
    pub const fn spec(self) -> WifiSpec {
        match self {
            Self::ShortRange => WifiSpec::TEMPLATE,
            Self::LongRange => LONG_RANGE,
        }
    }
}

/// Farther, behind one more wall, and more often interrupted; else the same routers.
const LONG_RANGE: WifiSpec = WifiSpec {
    distance_m: 35.0,
    wall_count: 2,
    outages: Outages {
        per_hour: 300.0,
        ..WifiSpec::TEMPLATE.outages
    },
    ..WifiSpec::TEMPLATE
};

/// A radio is a table that starts from a preset, or the name of one.
impl Short for WifiSpec {
    const TEMPLATES: Option<Templates> = Some(Templates {
        key: "preset",
        names: WifiPreset::NAMES,
        chosen: None,
        is_required: false,
    });
    const KEY: &'static str = "wifi";
    const ABOUT: &'static str = "A preset as it is.";

    fn template(index: usize) -> Self {
        WifiPreset::ALL[index].spec()
    }

    fn shape() -> Shape {
        Shape::Words(WifiPreset::NAMES.to_vec())
    }

    fn of_short(setting: Setting) -> Result<Self, String> {
        let name = String::from_setting(setting)?;
        let preset = WifiPreset::named(&name).ok_or_else(|| format!("no preset is `{name}`"))?;
        Ok(preset.spec())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_preset_is_sound_and_found_by_its_name() {
        for preset in WifiPreset::ALL {
            assert_eq!(preset.spec().check(), Ok(()));
            assert_eq!(WifiPreset::named(preset.name()), Some(preset));
        }
        assert_eq!(WifiPreset::named("wifi7"), None);
    }
}
