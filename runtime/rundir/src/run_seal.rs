//! The secret of one run and the cipher of its hops, as supervisors hand them to each other and to their
//! gateways. It goes through pipes and encrypted connections only, never into a file.

use std::io;

use hil_protocol::seal::{Association, Initiator, Responder, Rotation, RunSecret, Suite};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use zeroize::Zeroizing;

use crate::launch::DirectionLaunch;
use hil_platform::random::random_bytes;

/// Secret and cipher of one run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunSeal {
    #[serde(with = "secret")]
    secret: RunSecret,
    #[serde(with = "Cipher")]
    cipher: Suite,
}

/// How a [`Suite`] is written.
#[derive(Serialize, Deserialize)]
#[serde(remote = "Suite", rename_all = "kebab-case")]
enum Cipher {
    Aes256Gcm,
    #[serde(rename = "chacha20-poly1305")]
    ChaCha20Poly1305,
}

/// How a [`RunSecret`] is written.
mod secret {
    use super::{Deserialize, Deserializer, RunSecret, Serialize, Serializer};

    pub(super) fn serialize<S: Serializer>(
        secret: &RunSecret,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        secret.expose().serialize(serializer)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<RunSecret, D::Error> {
        let mut bytes = <[u8; 32]>::deserialize(deserializer)?;
        Ok(RunSecret::new(&mut bytes))
    }
}

impl RunSeal {
    /// A fresh secret.
    ///
    /// # Errors
    /// When the system gives no random numbers.
    pub fn fresh(suite: Suite) -> io::Result<Self> {
        Ok(Self {
            secret: RunSecret::new(&mut random_bytes()?),
            cipher: suite,
        })
    }

    /// The cipher of every hop.
    pub fn suite(&self) -> Suite {
        self.cipher
    }

    fn association(&self, launch: &DirectionLaunch) -> Association {
        Association {
            secret: self.secret.clone(),
            suite: self.suite(),
            flow: launch.flow_number,
            flow_name: launch.flow.clone(),
        }
    }

    /// The sending end of the flow of `launch`, with a salt of its own.
    ///
    /// # Errors
    /// As [`RunSeal::fresh`].
    pub fn initiator(&self, launch: &DirectionLaunch) -> io::Result<Initiator> {
        let salt = random_bytes()?;
        Ok(Initiator::new(
            &self.association(launch),
            salt,
            Rotation::default(),
        ))
    }

    /// The receiving end of the flow of `launch`, with salts of its own.
    ///
    /// # Errors
    /// As [`RunSeal::fresh`].
    pub fn responder(&self, launch: &DirectionLaunch) -> io::Result<Responder> {
        let seed = Zeroizing::new(random_bytes::<32>()?);
        Ok(Responder::new(
            &self.association(launch),
            &seed,
            Rotation::default(),
        ))
    }
}

/// Whether this processor has instructions for AES and for the multiplication of GCM.
#[cfg(target_arch = "x86_64")]
pub fn has_fast_aes() -> bool {
    std::arch::is_x86_feature_detected!("aes") && std::arch::is_x86_feature_detected!("pclmulqdq")
}

/// Whether this processor has instructions for AES and for the multiplication of GCM.
#[cfg(target_arch = "aarch64")]
pub fn has_fast_aes() -> bool {
    std::arch::is_aarch64_feature_detected!("aes")
        && std::arch::is_aarch64_feature_detected!("pmull")
}

/// The cipher that is fast on every host; either is safe on any.
pub fn suite_for(all_have_fast_aes: bool) -> Suite {
    if all_have_fast_aes {
        Suite::Aes256Gcm
    } else {
        Suite::ChaCha20Poly1305
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_survives_the_pipe_and_is_never_printed() {
        let seal = RunSeal::fresh(suite_for(true)).unwrap();
        let text = serde_json::to_string(&seal).unwrap();
        let back: RunSeal = serde_json::from_str(&text).unwrap();
        assert_eq!(back, seal);
        assert_eq!(back.suite(), Suite::Aes256Gcm);
        assert_ne!(RunSeal::fresh(suite_for(false)).unwrap(), seal);
        let numbers = text.split('[').nth(1).unwrap();
        let first: Vec<&str> = numbers.split(',').take(4).collect();
        assert!(!format!("{seal:?}").contains(&first.join(", ")));
    }
}
