//! How the hops between the hosts of a run are protected, as records and summaries keep it.

use std::fmt;

use serde::{Deserialize, Serialize};

/// How the hops between the hosts of a run are protected.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunSecurity {
    /// What is done to their datagrams.
    pub hops: HopProtection,
    /// Who else came to the listening supervisor before the run, in words; `None` when nobody did.
    pub strangers: Option<String>,
}

/// What is done to the datagrams of a hop.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum HopProtection {
    /// Nothing, as the topology says.
    Plain,
    /// They are encrypted and authenticated.
    Sealed {
        /// The cipher suite.
        suite: String,
        /// Which key.
        key_fingerprint: String,
    },
}

impl fmt::Display for HopProtection {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Plain => formatter.write_str(
                "PLAIN, as the topology says: whoever reaches the network can read and forge messages",
            ),
            Self::Sealed {
                suite,
                key_fingerprint,
            } => write!(formatter, "sealed ({suite}) with the key {key_fingerprint}"),
        }
    }
}

impl fmt::Display for RunSecurity {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.hops.fmt(formatter)?;
        match &self.strangers {
            Some(strangers) => write!(formatter, "; {strangers}"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn protection_is_told_apart_by_its_kind_in_json() {
        let sealed = RunSecurity {
            hops: HopProtection::Sealed {
                suite: "AES-128-GCM".to_owned(),
                key_fingerprint: "0123".to_owned(),
            },
            strangers: Some("one came".to_owned()),
        };
        let plain = RunSecurity {
            hops: HopProtection::Plain,
            strangers: None,
        };
        for (security, kind) in [(&sealed, "sealed"), (&plain, "plain")] {
            let json = serde_json::to_value(security).unwrap();
            assert_eq!(json["hops"]["kind"], kind);
            assert_eq!(
                &serde_json::from_value::<RunSecurity>(json).unwrap(),
                security
            );
        }
        assert_eq!(
            sealed.to_string(),
            "sealed (AES-128-GCM) with the key 0123; one came"
        );
    }
}
