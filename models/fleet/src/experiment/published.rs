//! Tables II and III of the seed paper (Lv et al., section III.B), as printed.

/// One row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PublishedRow {
    /// What the paper's first columns say.
    pub condition: Condition,
    /// "Total CS counts".
    pub sections: u64,
    /// "Collision counts".
    pub collisions: u64,
}

/// Under what a row was obtained.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Condition {
    /// Static modelling: packet loss ratio and packet delay.
    Static {
        /// Packet loss ratio.
        loss_ratio: f64,
        /// Packet delay.
        delay_ms: f64,
    },
    /// Hardware in the loop, over this network.
    HardwareInTheLoop(PublishedNetwork),
}

/// A network of the paper's own measurements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PublishedNetwork {
    /// A wire.
    Ethernet,
    /// A radio at 20 m.
    ShortRange,
    /// A radio at 35 m.
    LongRange,
}

impl core::fmt::Display for PublishedNetwork {
    /// What the paper calls it.
    fn fmt(&self, formatter: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        formatter.write_str(match self {
            Self::Ethernet => "Ethernet",
            Self::ShortRange => "short-range Wi-Fi 6",
            Self::LongRange => "long-range Wi-Fi 6",
        })
    }
}

const fn fixed(loss_ratio: f64, delay_ms: f64, sections: u64, collisions: u64) -> PublishedRow {
    PublishedRow {
        condition: Condition::Static {
            loss_ratio,
            delay_ms,
        },
        sections,
        collisions,
    }
}

const fn measured(network: PublishedNetwork, sections: u64, collisions: u64) -> PublishedRow {
    PublishedRow {
        condition: Condition::HardwareInTheLoop(network),
        sections,
        collisions,
    }
}

/// Table II, harbor.
pub const HARBOR: [PublishedRow; 11] = [
    fixed(0.0, 0.0, 10_018, 0),
    fixed(0.0, 10.0, 10_001, 0),
    fixed(0.0, 50.0, 10_003, 0),
    fixed(0.0, 100.0, 10_018, 5),
    fixed(0.1, 0.0, 10_003, 0),
    fixed(0.1, 10.0, 10_007, 0),
    fixed(0.1, 50.0, 10_092, 0),
    fixed(0.1, 100.0, 10_061, 18),
    measured(PublishedNetwork::Ethernet, 10_819, 0),
    measured(PublishedNetwork::ShortRange, 15_489, 14),
    measured(PublishedNetwork::LongRange, 10_004, 23),
];

/// Table III, warehouse.
pub const WAREHOUSE: [PublishedRow; 11] = [
    fixed(0.0, 0.0, 13_859, 0),
    fixed(0.0, 10.0, 10_001, 0),
    fixed(0.0, 50.0, 10_001, 0),
    fixed(0.0, 100.0, 10_015, 0),
    fixed(0.1, 0.0, 10_002, 0),
    fixed(0.1, 10.0, 10_001, 0),
    fixed(0.1, 50.0, 10_037, 0),
    fixed(0.1, 100.0, 21_645, 0),
    measured(PublishedNetwork::Ethernet, 10_004, 1),
    measured(PublishedNetwork::ShortRange, 10_155, 15),
    measured(PublishedNetwork::LongRange, 17_394, 40),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_counts_give_the_printed_probabilities() {
        // The paper's last column, per 1000, where it is not zero.
        let printed = [
            (&HARBOR[3], 0.499_102),
            (&HARBOR[7], 1.789_087),
            (&HARBOR[9], 0.903_867),
            (&HARBOR[10], 2.299_080),
            (&WAREHOUSE[8], 0.099_960),
            (&WAREHOUSE[9], 1.477_105),
            (&WAREHOUSE[10], 2.299_644),
        ];
        for (row, expected) in printed {
            let ratio = 1e3 * row.collisions as f64 / row.sections as f64;
            assert!((ratio - expected).abs() < 1e-6, "{row:?}: {ratio}");
        }
    }
}
