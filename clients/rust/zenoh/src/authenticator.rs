//! Tags under the key of a service: docs/protocol.md, "Authenticator". Where the key lies: [`crate::key`].

use blake2::digest::{consts::U16, Mac};

/// Bytes of a stamp, and of a tag.
pub const STAMP: usize = 16;

/// Signs and checks by the key of a service, of at most 64 bytes. An empty one signs nothing and believes everything.
#[derive(Clone, Debug, Default)]
pub struct Authenticator(pub Vec<u8>);

impl Authenticator {
    fn keyed(&self, parts: &[&[u8]]) -> blake2::Blake2bMac<U16> {
        let hash = blake2::Blake2bMac::new_from_slice(&self.0).expect("at most 64 bytes");
        parts.iter().fold(hash, |hash, part| hash.chain_update((part.len() as u64).to_le_bytes()).chain_update(part))
    }

    /// The tag of these parts; none without a key.
    pub fn tag(&self, parts: &[&[u8]]) -> Option<[u8; STAMP]> {
        (!self.0.is_empty()).then(|| self.keyed(parts).finalize().into_bytes().into())
    }

    /// Whether an attachment proves the message of kind and key `to`, in a time that does not show where a tag differs.
    fn proves(&self, attached: &[u8], to: [&[u8]; 2], said: &[&[u8]]) -> bool {
        let (stamp, tag) = attached.split_at(attached.len().min(STAMP));
        self.0.is_empty() || self.keyed(&[&to[..], &[stamp], said].concat()).verify_slice(tag).is_ok()
    }

    /// Whether a payload on `key` with this attachment answers the query with these parts: its stamp, the text after
    /// `?`, and its payload.
    pub fn answers(&self, key: &str, asked: [&[u8]; 3], attached: &[u8], payload: &[u8]) -> bool {
        self.proves(attached, [b"reply", key.as_bytes()], &[asked[0], asked[1], asked[2], payload])
    }

    /// The attachment of publication `number`, from 1 on, of a sender of 8 random bytes: without a key the stamp alone.
    pub fn publication(&self, key: &str, sender: [u8; 8], number: u64, payload: &[u8]) -> Vec<u8> {
        let stamp = [sender, number.to_le_bytes()].concat();
        let tag = self.tag(&[b"put", key.as_bytes(), &stamp, payload]);
        stamp.into_iter().chain(tag.into_iter().flatten()).collect()
    }
}

/// Whose publications on one key are taken: the last stamp, with the sender in its low half and the number above. 0 for
/// nobody's.
pub struct Sender(pub u128);

impl Sender {
    /// Follow who signed this attachment of a reply.
    pub fn meet(&mut self, attached: &[u8]) {
        let met = attached.first_chunk().map_or(0, |stamp| u128::from_le_bytes(*stamp));
        self.0 = if met as u64 == self.0 as u64 { met.max(self.0) } else { met };
    }

    /// Whether to take a publication on `key`; none: another instance serves. Ask for the model, and meet who answers.
    pub fn hear(&mut self, by: &Authenticator, key: &str, attached: &[u8], payload: &[u8]) -> Option<bool> {
        let stamp = attached.first_chunk().map_or(0, |stamp| u128::from_le_bytes(*stamp));
        let right = by.proves(attached, [b"put", key.as_bytes()], &[payload]);
        let newer = (stamp as u64 == self.0 as u64).then_some(stamp > self.0);
        let takes = if by.0.is_empty() || !right { Some(right) } else { newer };
        self.0 = if takes == Some(true) { stamp } else { self.0 };
        takes
    }
}
