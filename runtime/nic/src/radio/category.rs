//! Which access category of IEEE 802.11 (enhanced distributed channel access, clause 10.23.2) a
//! datagram's marks lead to, as Linux decides it. It sets nothing.

hil_core::labelled! {
    /// Who may try first when stations contend for the air, and how long they wait.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
    pub enum AccessCategory, label {
        /// `AC_BK`: waits longest.
        Background = "background (AC_BK)",
        /// `AC_BE`.
        BestEffort = "best effort (AC_BE)",
        /// `AC_VI`.
        Video = "video (AC_VI)",
        /// `AC_VO`: waits least.
        Voice = "voice (AC_VO)",
    }
}

/// The kernel whose mapping of code points applies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mapping {
    /// The three top bits of the code point: Linux before 6.8 as it was released.
    TopBits,
    /// RFC 8325, section 4: Linux 6.8 and later, where no quality-of-service map of the access
    /// point says otherwise.
    Rfc8325,
}

impl Mapping {
    /// The mapping of a kernel by its release, e.g. `6.1.0-18-amd64`; `None` when that cannot be
    /// read.
    pub fn of_release(release: &str) -> Option<Self> {
        let mut numbers = release.split(|c: char| !c.is_ascii_digit());
        let major: u32 = numbers.next()?.parse().ok()?;
        let minor: u32 = numbers.next()?.parse().ok()?;
        Some(if (major, minor) >= (6, 8) {
            Self::Rfc8325
        } else {
            Self::TopBits
        })
    }
}

/// The user priority 0..=7 of IEEE 802.1D that a socket priority and a code point lead to
/// (`cfg80211_classify8021d`): socket priorities 256..=263 are user priorities as they stand.
pub fn user_priority(priority: u32, dscp: u8, mapping: Mapping) -> u8 {
    if (256..=263).contains(&priority) {
        // The low byte of 256 + n is n.
        return priority.to_le_bytes()[0];
    }
    let top_bits = (dscp & 63) >> 3;
    if mapping == Mapping::TopBits {
        return top_bits;
    }
    match dscp {
        // Lower effort, CS1, CS2, AF2x, CS3, AF3x, voice admit and expedited forwarding.
        1 => 1,
        16 => 0,
        18 | 20 | 22 => 3,
        24 | 26 | 28 | 30 => 4,
        44 | 46 => 6,
        _ => top_bits,
    }
}

/// The access category of a user priority (IEEE 802.11, table 10-1).
pub const fn category(user_priority: u8) -> AccessCategory {
    match user_priority {
        1 | 2 => AccessCategory::Background,
        4 | 5 => AccessCategory::Video,
        6 | 7 => AccessCategory::Voice,
        _ => AccessCategory::BestEffort,
    }
}

/// In words, where a socket with these marks stands when stations contend, on a kernel of this
/// release.
pub fn describe(priority: u32, dscp: u8, release: &str) -> String {
    let marks = format!("priority {priority} and dscp {dscp}");
    let Some(mapping) = Mapping::of_release(release) else {
        return format!("unavailable: kernel release {release:?} cannot be read ({marks})");
    };
    let of = |mapping| {
        let user = user_priority(priority, dscp, mapping);
        (user, category(user))
    };
    let (user, found) = of(mapping);
    let mut text = format!("{found}: {marks} give user priority {user}");
    let (other_user, other) = of(Mapping::Rfc8325);
    if mapping == Mapping::TopBits && other != found {
        let more = format!("; a kernel with the mapping of RFC 8325 says {other_user}, {other}");
        text.push_str(&more);
    }
    text.push_str(", unless the access point gave a QoS map or demands admission");
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn expedited_forwarding_is_video_before_linux_6_8_and_voice_since() {
        let old = user_priority(4, 46, Mapping::TopBits);
        assert_eq!(category(old), AccessCategory::Video);
        let new = user_priority(4, 46, Mapping::Rfc8325);
        assert_eq!(category(new), AccessCategory::Voice);
        assert_eq!(
            category(user_priority(0, 48, Mapping::TopBits)),
            AccessCategory::Voice
        );
        assert_eq!(
            category(user_priority(0, 8, Mapping::Rfc8325)),
            AccessCategory::Background
        );
        assert_eq!(
            category(user_priority(0, 0, Mapping::Rfc8325)),
            AccessCategory::BestEffort
        );
    }

    #[test]
    fn priorities_from_256_stand_for_themselves() {
        for direct in 0..8_u8 {
            let found = user_priority(256 + u32::from(direct), 46, Mapping::TopBits);
            assert_eq!(found, direct);
        }
        assert_eq!(user_priority(264, 46, Mapping::TopBits), 5);
        assert_eq!(user_priority(7, 0, Mapping::TopBits), 0);
    }

    #[test]
    fn the_words_name_the_category_and_what_a_newer_kernel_would_say() {
        let words = describe(4, 46, "6.1.0-56-amd64");
        assert!(
            words.starts_with("video (AC_VI): priority 4 and dscp 46"),
            "{words}"
        );
        assert!(words.contains("RFC 8325 says 6, voice (AC_VO)"), "{words}");
        let words = describe(262, 0, "6.18.0");
        assert!(words.starts_with("voice (AC_VO)"), "{words}");
        assert!(!words.contains("RFC 8325"), "{words}");
        assert!(describe(0, 0, "?").starts_with("unavailable"));
    }

    #[test]
    fn the_mapping_follows_the_kernel_release() {
        for (release, expected) in [
            ("6.1.0-18-amd64", Some(Mapping::TopBits)),
            ("5.10.0", Some(Mapping::TopBits)),
            ("6.7.12", Some(Mapping::TopBits)),
            ("6.8.0-rc1", Some(Mapping::Rfc8325)),
            ("6.18.2", Some(Mapping::Rfc8325)),
            ("7.0", Some(Mapping::Rfc8325)),
            ("unknown", None),
        ] {
            assert_eq!(Mapping::of_release(release), expected, "{release}");
        }
    }
}
