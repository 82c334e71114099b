//! Who speaks: tags under the key of a service, by docs/protocol.md, "Authenticator".

use blake2::digest::{consts::U16, Mac};
use dehyst::{Error, Result};
use std::path::{Path, PathBuf};

/// Bytes of a stamp, and of a tag.
pub const STAMP: usize = 16;

/// The keyed hash of the parts of a message.
fn keyed(key: &[u8], parts: &[&[u8]]) -> blake2::Blake2bMac<U16> {
    let hash = blake2::Blake2bMac::new_from_slice(key).expect("at most 64 bytes");
    parts.iter().fold(hash, |hash, part| hash.chain_update((part.len() as u64).to_le_bytes()).chain_update(part))
}

/// Signs and checks by the key of a service. Without one nothing is signed, and everything is believed.
#[derive(Clone, Debug, Default)]
pub struct Authenticator {
    key: Vec<u8>,
}

impl Authenticator {
    /// By a key of 16 to 64 bytes.
    pub fn new(key: &[u8]) -> Result<Authenticator> {
        if !(16..=64).contains(&key.len()) {
            return Err(Error::new("key", format!("{} bytes", key.len()), "16 to 64 bytes"));
        }
        Ok(Authenticator { key: key.to_vec() })
    }

    /// By the key in a file, or for `None` by that of this user on this machine, if there is one.
    pub fn find(path: Option<&Path>) -> Result<Authenticator> {
        let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
        let state = || set("XDG_STATE_HOME").or_else(|| Some(set("HOME")?.join(".local/state")));
        let own = || Some(state()?.join("dehyst/key")).filter(|path| path.exists());
        let named = path.map(PathBuf::from).or_else(|| set("DEHYST_KEY"));
        let Some(path) = named.or_else(own).filter(|path| path != Path::new("-")) else {
            return Ok(Authenticator::default());
        };
        let unread = |error| Error::new("key", format!("{}: {error}", path.display()), "a file with a key");
        Authenticator::new(std::fs::read(&path).map_err(unread)?.trim_ascii())
    }

    /// Whether an attachment ends with the tag of these parts; in a time that does not tell where it differs.
    fn proves(&self, attached: &[u8], parts: &[&[u8]]) -> bool {
        let tag = attached.get(STAMP..).unwrap_or_default();
        self.key.is_empty() || keyed(&self.key, parts).verify_slice(tag).is_ok()
    }

    /// Whether a payload on `key` with this attachment answers the query with these parts: the 16 random bytes that it
    /// was sent with, the text after `?`, and its payload.
    pub fn answers(&self, key: &str, asked: [&[u8]; 3], attached: &[u8], payload: &[u8]) -> bool {
        let stamp = attached.get(..STAMP).unwrap_or_default();
        self.proves(attached, &[b"reply", key.as_bytes(), stamp, asked[0], asked[1], asked[2], payload])
    }

    /// The attachment of publication `number`, from 1 on, of a sender of 8 random bytes; none without a key.
    pub fn publication(&self, key: &str, sender: [u8; 8], number: u64, payload: &[u8]) -> Option<Vec<u8>> {
        let stamp = [sender, number.to_le_bytes()].concat();
        let tag = || keyed(&self.key, &[b"put", key.as_bytes(), &stamp, payload]).finalize().into_bytes();
        (!self.key.is_empty()).then(|| [&stamp[..], &tag()].concat())
    }
}

/// What a publication is to who follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Heard {
    Taken,
    /// No right tag, or said before.
    Refused,
    /// Another instance serves: ask for the model, and [`Sender::meet`] who answers.
    Unknown,
}

/// Whose publications on one key are taken: the last stamp, with the sender in its low half and the number above.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sender(u128);

fn stamp_of(attached: &[u8]) -> u128 {
    attached.first_chunk().map_or(0, |stamp| u128::from_le_bytes(*stamp))
}

impl Sender {
    /// Follow who signed this attachment of a reply.
    pub fn meet(&mut self, attached: &[u8]) {
        let met = stamp_of(attached);
        self.0 = if met as u64 == self.0 as u64 { met.max(self.0) } else { met };
    }

    /// What a publication on `key` is.
    pub fn hear(&mut self, by: &Authenticator, key: &str, attached: &[u8], payload: &[u8]) -> Heard {
        let (stamp, signed) = (stamp_of(attached), attached.get(..STAMP).unwrap_or_default());
        match by.proves(attached, &[b"put", key.as_bytes(), signed, payload]) {
            true if by.key.is_empty() => Heard::Taken,
            true if stamp as u64 != self.0 as u64 => Heard::Unknown,
            true if stamp > self.0 => {
                self.0 = stamp;
                Heard::Taken
            }
            _ => Heard::Refused,
        }
    }
}
