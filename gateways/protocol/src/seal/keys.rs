//! From a run's secret to the keys of one way of one flow. It draws no random number and keeps no
//! state beyond the secrets. Secrets and ciphers are overwritten when they go; the HMAC and HKDF states
//! of an association last as long as its gateway, and `ring` offers no way to overwrite them.
//!
//! With HKDF-SHA256 (RFC 5869), where | joins and the name carries its length:
//!
//! ```text
//! root     = extract(salt "hil-runtime seal v1", secret of the run)
//! request  = expand(root, "request"  | flow number | flow name)            HMAC key
//! answer   = expand(root, "answer"   | flow number | flow name)            HMAC key
//! forward  = expand(root, "forward"  | flow | both salts)   generation 0, messages
//! backward = expand(root, "backward" | flow | both salts)   generation 0, replies
//! key      = expand(generation, "key")
//! next     = expand(generation, "next")                        the generation after it
//! ```

use core::fmt;
use core::hint::black_box;

use ring::aead::{AES_256_GCM, Aad, CHACHA20_POLY1305, LessSafeKey, Nonce, UnboundKey};
use ring::{hkdf, hmac};
use zeroize::{Zeroize, Zeroizing};

use crate::wire::{HEADER_BYTES, TAG_BYTES};

/// Bytes of a salt.
pub const SALT_BYTES: usize = 16;
/// What one start of a gateway draws at random.
pub type Salt = [u8; SALT_BYTES];

const SECRET_BYTES: usize = 32;
type Secret = Zeroizing<[u8; SECRET_BYTES]>;

/// The secret of one run, known to its hosts only; never printed, overwritten when it goes.
#[derive(Clone, PartialEq, Eq)]
pub struct RunSecret(Secret);

impl RunSecret {
    /// Takes 32 random bytes; the caller's copy is overwritten.
    pub fn new(bytes: &mut [u8; SECRET_BYTES]) -> Self {
        let secret = Zeroizing::new(*bytes);
        bytes.zeroize();
        Self(secret)
    }

    /// The bytes, to be handed to another process of the run.
    pub fn expose(&self) -> &[u8; SECRET_BYTES] {
        &self.0
    }
}

impl fmt::Debug for RunSecret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("RunSecret(..)")
    }
}

hil_core::labelled! {
    /// The cipher that both hosts use.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum Suite, label {
        /// AES-256-GCM (NIST SP 800-38D): the fastest where every processor has the instructions.
        Aes256Gcm = "AES-256-GCM",
        /// ChaCha20-Poly1305 (RFC 8439): as safe, and fast without them.
        ChaCha20Poly1305 = "ChaCha20-Poly1305",
    }
}

/// What both ends of a flow know of each other before they exchange salts.
#[derive(Debug, Clone)]
pub struct Association {
    /// The run's secret.
    pub secret: RunSecret,
    /// The run's cipher.
    pub suite: Suite,
    /// Number of the flow in datagrams.
    pub flow: u16,
    /// Name of the flow.
    pub flow_name: String,
}

/// The keys that an association has before salts are exchanged.
#[derive(Debug)]
pub(super) struct Root {
    secret: hkdf::Prk,
    suite: Suite,
    pub(super) flow: u16,
    flow_name: String,
    pub(super) request: hmac::Key,
    pub(super) answer: hmac::Key,
}

impl Root {
    pub(super) fn new(association: &Association) -> Self {
        let salt = hkdf::Salt::new(hkdf::HKDF_SHA256, b"hil-runtime seal v1");
        let secret = salt.extract(association.secret.expose());
        let mac = |label: &str| {
            let key = expand(
                &secret,
                label,
                association.flow,
                &association.flow_name,
                [&[], &[]],
            );
            hmac::Key::new(hmac::HMAC_SHA256, &*key)
        };
        Self {
            request: mac("request"),
            answer: mac("answer"),
            secret,
            suite: association.suite,
            flow: association.flow,
            flow_name: association.flow_name.clone(),
        }
    }

    /// Generation 0 of the sender's way.
    pub(super) fn forward(&self, asking: &Salt, answering: &Salt) -> Generation {
        self.generation("forward", asking, answering)
    }

    /// Generation 0 of the replies' way.
    pub(super) fn backward(&self, asking: &Salt, answering: &Salt) -> Generation {
        self.generation("backward", asking, answering)
    }

    fn generation(&self, label: &str, asking: &Salt, answering: &Salt) -> Generation {
        let salts: [&[u8]; 2] = [asking, answering];
        let secret = expand(&self.secret, label, self.flow, &self.flow_name, salts);
        Generation {
            secret,
            suite: self.suite,
        }
    }
}

/// The secret of one generation of one way.
#[derive(Clone)]
pub(super) struct Generation {
    secret: Secret,
    suite: Suite,
}

impl Generation {
    pub(super) fn key(&self) -> SealKey {
        let bytes = ratchet(&self.secret, b"key");
        SealKey::new(self.suite, &bytes)
    }

    pub(super) fn next(&self) -> Self {
        Self {
            secret: ratchet(&self.secret, b"next"),
            suite: self.suite,
        }
    }
}

impl fmt::Debug for Generation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Generation(..)")
    }
}

/// Length of an output of HKDF, in the form that `ring` asks for.
struct Length;

impl hkdf::KeyType for Length {
    fn len(&self) -> usize {
        SECRET_BYTES
    }
}

fn expand(
    root: &hkdf::Prk,
    label: &str,
    flow: u16,
    name: &str,
    [asking, answering]: [&[u8]; 2],
) -> Secret {
    let flow = flow.to_le_bytes();
    let name_bytes = u16::try_from(name.len()).unwrap_or(u16::MAX).to_le_bytes();
    let info = [
        label.as_bytes(),
        &flow[..],
        &name_bytes,
        name.as_bytes(),
        asking,
        answering,
    ];
    fill(root, &info)
}

fn ratchet(secret: &Secret, label: &[u8]) -> Secret {
    let root = hkdf::Prk::new_less_safe(hkdf::HKDF_SHA256, &**secret);
    fill(&root, &[label])
}

fn fill(root: &hkdf::Prk, info: &[&[u8]]) -> Secret {
    let mut bytes = Zeroizing::new([0; SECRET_BYTES]);
    root.expand(info, Length)
        .and_then(|output| output.fill(&mut *bytes))
        .expect("32 bytes are far below HKDF's limit");
    bytes
}

/// One key of one cipher; its place in memory is overwritten when it goes.
pub(super) struct SealKey(LessSafeKey);

impl SealKey {
    fn new(suite: Suite, bytes: &[u8; SECRET_BYTES]) -> Self {
        let algorithm = match suite {
            Suite::Aes256Gcm => &AES_256_GCM,
            Suite::ChaCha20Poly1305 => &CHACHA20_POLY1305,
        };
        let key = UnboundKey::new(algorithm, bytes).expect("both ciphers take 32 bytes");
        Self(LessSafeKey::new(key))
    }

    /// Seals what follows the header within `datagram`, whose last 16 bytes take the tag.
    pub(super) fn seal(&self, nonce: [u8; 12], datagram: &mut [u8]) {
        let (header, rest) = datagram.split_at_mut(HEADER_BYTES);
        let (payload, tag_place) = rest.split_at_mut(rest.len() - TAG_BYTES);
        let tag = self
            .0
            .seal_in_place_separate_tag(
                Nonce::assume_unique_for_key(nonce),
                Aad::from(&*header),
                payload,
            )
            .expect("a datagram is far below the cipher's limit");
        tag_place.copy_from_slice(tag.as_ref());
    }

    /// Opens what follows the header within `datagram`; false when the tag does not fit. The payload
    /// is then undefined.
    pub(super) fn open(&self, nonce: [u8; 12], datagram: &mut [u8]) -> bool {
        let (header, rest) = datagram.split_at_mut(HEADER_BYTES);
        let nonce = Nonce::assume_unique_for_key(nonce);
        self.0
            .open_in_place(nonce, Aad::from(&*header), rest)
            .is_ok()
    }
}

impl Drop for SealKey {
    fn drop(&mut self) {
        let empty = UnboundKey::new(self.0.algorithm(), &[0; SECRET_BYTES]);
        self.0 = LessSafeKey::new(empty.expect("both ciphers take 32 bytes"));
        // Otherwise the compiler may see that nobody reads it any more.
        black_box(&self.0);
    }
}

impl fmt::Debug for SealKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SealKey(..)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn root(secret: u8, flow: u16, name: &str) -> Root {
        Root::new(&Association {
            secret: RunSecret::new(&mut [secret; 32]),
            suite: Suite::Aes256Gcm,
            flow,
            flow_name: name.to_owned(),
        })
    }

    #[test]
    fn secret_flow_way_salts_and_generation_each_give_another_key() {
        let base = root(1, 0, "arm/command");
        let (one, two) = ([1; 16], [2; 16]);
        let mut secrets = vec![
            base.forward(&one, &two),
            base.forward(&two, &one),
            base.forward(&one, &one),
            base.backward(&one, &two),
            root(2, 0, "arm/command").forward(&one, &two),
            root(1, 1, "arm/command").forward(&one, &two),
            root(1, 0, "arm/comman").forward(&one, &two),
        ];
        let next = secrets[0].next();
        secrets.extend([next.next(), next]);
        let mut bytes: Vec<_> = secrets.iter().map(|one| *one.secret).collect();
        bytes.extend(secrets.iter().map(|one| *ratchet(&one.secret, b"key")));
        let count = bytes.len();
        bytes.sort_unstable();
        bytes.dedup();
        assert_eq!(bytes.len(), count);
        let again = root(1, 0, "arm/command").forward(&one, &two);
        assert_eq!(again.secret, secrets[0].secret, "both ends derive the same");
    }

    #[test]
    fn nothing_secret_is_printed() {
        let association = Association {
            secret: RunSecret::new(&mut [0xab; 32]),
            suite: Suite::Aes256Gcm,
            flow: 0,
            flow_name: "x".to_owned(),
        };
        let text = format!(
            "{association:?} {:?}",
            Root::new(&association).forward(&[1; 16], &[2; 16])
        );
        assert!(!text.contains("171") && !text.contains("ab, ab"), "{text}");
    }
}
