//! Who speaks: tags under the key of a service, by docs/protocol.md, "Authenticator".

use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Bytes of a stamp, and of a tag.
pub const STAMP: usize = 16;
const SENDER: usize = 8;

const IV: [u64; 8] = [
    0x6a09e667f3bcc908,
    0xbb67ae8584caa73b,
    0x3c6ef372fe94f82b,
    0xa54ff53a5f1d36f1,
    0x510e527fade682d1,
    0x9b05688c2b3e6c1f,
    0x1f83d9abfb41bd6b,
    0x5be0cd19137e2179,
];
const SIGMA: [[usize; 16]; 10] = [
    [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15],
    [14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3],
    [11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4],
    [7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8],
    [9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13],
    [2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9],
    [12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11],
    [13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10],
    [6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5],
    [10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0],
];
/// Places that are mixed together: columns, then diagonals.
const MIXED: [[usize; 4]; 8] = [
    [0, 4, 8, 12],
    [1, 5, 9, 13],
    [2, 6, 10, 14],
    [3, 7, 11, 15],
    [0, 5, 10, 15],
    [1, 6, 11, 12],
    [2, 7, 8, 13],
    [3, 4, 9, 14],
];

/// BLAKE2b of RFC 7693, keyed, 16 bytes long.
struct Blake2b {
    h: [u64; 8],
    block: [u8; 128],
    filled: usize,
    count: u128,
}

impl Blake2b {
    fn new(key: &[u8]) -> Blake2b {
        let mut made = Blake2b { h: IV, block: [0; 128], filled: 0, count: 0 };
        made.h[0] ^= 0x0101_0000 | (key.len() as u64) << 8 | STAMP as u64;
        if !key.is_empty() {
            made.block[..key.len()].copy_from_slice(key);
            made.filled = 128;
        }
        made
    }

    fn compress(&mut self, last: bool) {
        self.count += self.filled as u128;
        let word = |i: usize| u64::from_le_bytes(self.block[8 * i..8 * i + 8].try_into().expect("8 bytes"));
        let m: [u64; 16] = std::array::from_fn(word);
        let mut v = [0u64; 16];
        v[..8].copy_from_slice(&self.h);
        v[8..].copy_from_slice(&IV);
        v[12] ^= self.count as u64;
        v[13] ^= (self.count >> 64) as u64;
        v[14] ^= if last { u64::MAX } else { 0 };
        for round in 0..12 {
            let order = &SIGMA[round % 10];
            for (i, [a, b, c, d]) in MIXED.into_iter().enumerate() {
                for (x, by_d, by_b) in [(m[order[2 * i]], 32, 24), (m[order[2 * i + 1]], 16, 63)] {
                    v[a] = v[a].wrapping_add(v[b]).wrapping_add(x);
                    v[d] = (v[d] ^ v[a]).rotate_right(by_d);
                    v[c] = v[c].wrapping_add(v[d]);
                    v[b] = (v[b] ^ v[c]).rotate_right(by_b);
                }
            }
        }
        for i in 0..8 {
            self.h[i] ^= v[i] ^ v[i + 8];
        }
        self.filled = 0;
    }

    fn update(&mut self, mut data: &[u8]) {
        while !data.is_empty() {
            if self.filled == 128 {
                self.compress(false);
            }
            let n = data.len().min(128 - self.filled);
            self.block[self.filled..self.filled + n].copy_from_slice(&data[..n]);
            self.filled += n;
            data = &data[n..];
        }
    }

    fn digest(mut self) -> [u8; STAMP] {
        self.block[self.filled..].fill(0);
        self.compress(true);
        let mut out = [0; STAMP];
        out[..8].copy_from_slice(&self.h[0].to_le_bytes());
        out[8..].copy_from_slice(&self.h[1].to_le_bytes());
        out
    }
}

/// The tag of the parts of a message under a key of at most 64 bytes.
pub fn tag(key: &[u8], parts: &[&[u8]]) -> [u8; STAMP] {
    let mut hash = Blake2b::new(&key[..key.len().min(64)]);
    for part in parts {
        hash.update(&(part.len() as u64).to_le_bytes());
        hash.update(part);
    }
    hash.digest()
}

/// Whether an attachment ends with the tag of the parts; in a time that does not tell where it differs.
fn proves(key: &[u8], attached: &[u8], parts: &[&[u8]]) -> bool {
    let right = tag(key, parts);
    let given = attached.get(STAMP..).unwrap_or_default();
    given.len() == STAMP && given.iter().zip(right).fold(0, |differs, (g, r)| differs | (g ^ r)) == 0
}

/// Signs and checks by the key of a service. Without one nothing is signed, and everything is believed.
#[derive(Clone, Debug, Default)]
pub struct Authenticator {
    key: Vec<u8>,
}

/// A query: its key expression, the text after `?`, its payload, and the 16 random bytes that it was sent with.
pub struct Question<'a> {
    pub key: &'a str,
    pub parameters: &'a str,
    pub payload: &'a [u8],
    pub stamp: [u8; STAMP],
}

impl Authenticator {
    /// By a key of 16 to 64 bytes; none: everything is believed.
    pub fn new(key: &[u8]) -> Result<Authenticator> {
        if !key.is_empty() && !(16..=64).contains(&key.len()) {
            return Err(Error::new("key", format!("{} bytes", key.len()), "16 to 64 bytes"));
        }
        Ok(Authenticator { key: key.to_vec() })
    }

    /// By the key in a file, or for `None` by that of this user on this machine, if there is one.
    pub fn find(path: Option<&Path>) -> Result<Authenticator> {
        let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
        let named = path.map(PathBuf::from).or_else(|| set("DEHYST_KEY").map(PathBuf::from));
        if named.as_deref() == Some(Path::new("-")) {
            return Ok(Authenticator::default());
        }
        let state = || set("XDG_STATE_HOME").map(PathBuf::from);
        let home = || set("HOME").map(|home| Path::new(&home).join(".local/state"));
        let own = || state().or_else(home).map(|folder| folder.join("dehyst/key")).filter(|path| path.exists());
        let Some(path) = named.or_else(own) else {
            return Ok(Authenticator::default());
        };
        let found = std::fs::read(&path)
            .map_err(|error| Error::new("key", format!("{}: {error}", path.display()), "a file with a key"))?;
        Authenticator::new(found.trim_ascii())
    }

    /// Whether there is a key.
    pub fn is_signing(&self) -> bool {
        !self.key.is_empty()
    }

    /// Whether a payload with this attachment answers a question.
    pub fn answers(&self, asked: &Question, attached: &[u8], payload: &[u8]) -> bool {
        let stamp = attached.get(..STAMP).unwrap_or_default();
        let key = asked.key.as_bytes();
        let parts: [&[u8]; 7] =
            [b"reply", key, stamp, &asked.stamp, asked.parameters.as_bytes(), asked.payload, payload];
        !self.is_signing() || proves(&self.key, attached, &parts)
    }

    /// The attachment of publication `number`, from 1 on, of a sender of 8 random bytes; empty without a key.
    pub fn publication(&self, key: &str, sender: [u8; SENDER], number: u64, payload: &[u8]) -> Vec<u8> {
        if !self.is_signing() {
            return Vec::new();
        }
        let stamp = [sender, number.to_le_bytes()].concat();
        let tag = tag(&self.key, &[b"put", key.as_bytes(), &stamp, payload]);
        [stamp, tag.to_vec()].concat()
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

/// Whose publications on one key are taken, and the number of the last one.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sender {
    last: Option<([u8; SENDER], u64)>,
}

fn split(attached: &[u8]) -> Option<([u8; SENDER], u64)> {
    let sender = attached.get(..SENDER)?.try_into().ok()?;
    Some((sender, u64::from_le_bytes(attached.get(SENDER..STAMP)?.try_into().ok()?)))
}

impl Sender {
    /// Follow who signed this attachment of a reply.
    pub fn meet(&mut self, attached: &[u8]) {
        let met = split(attached);
        if !matches!((self.last, met), (Some((a, had)), Some((b, number))) if a == b && number <= had) {
            self.last = met;
        }
    }

    /// What a publication on `key` is.
    pub fn hear(&mut self, by: &Authenticator, key: &str, attached: &[u8], payload: &[u8]) -> Heard {
        if !by.is_signing() {
            return Heard::Taken;
        }
        let stamp = attached.get(..STAMP).unwrap_or_default();
        let Some((sender, number)) =
            split(attached).filter(|_| proves(&by.key, attached, &[b"put", key.as_bytes(), stamp, payload]))
        else {
            return Heard::Refused;
        };
        match self.last {
            Some((known, last)) if known == sender && number <= last => Heard::Refused,
            Some((known, _)) if known == sender => {
                self.last = Some((sender, number));
                Heard::Taken
            }
            _ => Heard::Unknown,
        }
    }
}
