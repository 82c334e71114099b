//! Changes of a followed model (kind 7): each is one of a whole model, and replaces the change before.
//!
//! All of this runs in the thread that receives; a follower sees whole snapshots only.

use crate::error::Result;
use crate::snapshot::Snapshot;
use crate::wire::{Delta, DELTA};

/// What became of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Update {
    /// It is in the model that the follower gets.
    Taken,
    /// It is a change of another whole model: fetch the newest, unless it comes by itself.
    Lost,
}

const TABLE: [u32; 256] = {
    let mut table = [0u32; 256];
    let mut i = 0;
    while i < 256 {
        let mut word = i as u32;
        let mut bit = 0;
        while bit < 8 {
            word = if word & 1 != 0 { word >> 1 ^ 0xEDB8_8320 } else { word >> 1 };
            bit += 1;
        }
        table[i] = word;
        i += 1;
    }
    table
};

/// CRC-32 of zip and zlib.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, byte| crc >> 8 ^ TABLE[((crc ^ u32::from(*byte)) & 0xff) as usize])
}

/// Takes whole models and changes in the order of their arrival.
pub struct Changes {
    whole: Snapshot,
    base: u32,
    /// The last change of a whole model that has not come yet: it may be the last one for long.
    left: Option<Delta>,
}

impl Changes {
    pub fn new(payload: &[u8]) -> Result<Changes> {
        Ok(Changes { whole: Snapshot::decode(payload)?, base: crc32(payload), left: None })
    }

    /// Checksum of the whole model.
    pub fn base(&self) -> u32 {
        self.base
    }

    /// A payload of kind 6, or of kind 7. With `Taken` the snapshot to use.
    pub fn take(&mut self, payload: &[u8]) -> Result<(Update, Option<Snapshot>)> {
        if payload.get(1) != Some(&DELTA) {
            if crc32(payload) == self.base {
                return Ok((Update::Taken, None)); // fetched late: the changes since are not undone
            }
            let left = std::mem::replace(self, Changes::new(payload)?).left.filter(|left| left.base == self.base);
            let newest = left.map_or_else(|| Ok(self.whole.clone()), |left| self.whole.moved(&left))?;
            return Ok((Update::Taken, Some(newest)));
        }
        let delta = Delta::decode(payload)?;
        if delta.base != self.base {
            self.left = Some(delta);
            return Ok((Update::Lost, None));
        }
        Ok((Update::Taken, Some(self.whole.moved(&delta)?)))
    }
}
