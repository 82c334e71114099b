//! Model changes (kind 7): the sum of a whole model and of the changes after it, checked by fingerprints.
//!
//! All of this runs in the thread that receives; a follower sees whole snapshots only.

use crate::error::{Error, Result};
use crate::json::Value;
use crate::snapshot::Snapshot;
use crate::wire::{Array, Change, Container, Delta};
use std::collections::HashMap;

/// What became of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Update {
    /// It is in the model that the follower gets.
    Taken,
    /// It was in the model already.
    Known,
    /// It waits for the whole model that has been asked for.
    Waits,
    /// A change before it is missing: fetch the whole model.
    Lost,
    /// The sum has another fingerprint than that of the service: fetch the whole model.
    Mismatch,
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
fn crc32(bytes: impl Iterator<Item = u8>) -> u32 {
    !bytes.fold(!0u32, |crc, byte| crc >> 8 ^ TABLE[((crc ^ u32::from(byte)) & 0xff) as usize])
}

fn crc_of(values: &[f64]) -> u32 {
    crc32(values.iter().flat_map(|value| value.to_le_bytes()))
}

/// The numbers of a model that has been put together from messages.
#[derive(Clone)]
pub struct Sum {
    header: Value,
    arrays: HashMap<String, Array>,
    /// Names of the entries in order, and the CRC-32 of each; that of the names themselves.
    names: Vec<String>,
    crcs: Vec<u32>,
    names_crc: u32,
    pub snapshot_seq: i64,
    pub fingerprint: u32,
}

/// The object in the JSON that holds an entry, and its name there.
fn place(name: &str) -> (&'static [&'static str], &str) {
    if let Some(rest) = name.strip_prefix("/safety/") {
        (&["safety"], rest)
    } else if let Some(rest) = name.strip_prefix("/stand_in/") {
        (&["safety", "stand_in", "values"], rest)
    } else {
        (&["values"], name)
    }
}

fn object<'a>(header: &'a Value, path: &[&str]) -> Option<&'a Value> {
    path.iter().try_fold(header, |value, key| value.get(key))
}

impl Sum {
    /// From a payload of kind 6.
    pub fn decode(payload: &[u8]) -> Result<Sum> {
        let Container { snapshot_seq, header, arrays } = Container::decode(payload)?;
        let mut names: Vec<String> = arrays.keys().cloned().collect();
        for prefix in ["", "/safety/", "/stand_in/"] {
            if let Some(Value::Object(entries)) = object(&header, place(&format!("{prefix}x")).0) {
                let numbers = entries.iter().filter(|(_, value)| matches!(value, Value::Number(_) | Value::Bool(_)));
                names.extend(
                    numbers
                        .map(|(name, _)| format!("{prefix}{name}"))
                        .filter(|name| name != "seq" && !name.ends_with(".seq") && !name.ends_with("/seq")),
                );
            }
        }
        names.sort();
        if names.windows(2).any(|pair| pair[0] == pair[1]) {
            return Err(Error::new("header", "a name twice", "each name once, in values or in arrays"));
        }
        let names_crc = crc32(names.join("\n").into_bytes().into_iter());
        let mut sum = Sum { header, arrays, names, crcs: Vec::new(), names_crc, snapshot_seq, fingerprint: 0 };
        sum.crcs = (0..sum.names.len()).map(|i| crc_of(&sum.doubles(i))).collect();
        sum.fingerprint = sum.of_all();
        Ok(sum)
    }

    fn of_all(&self) -> u32 {
        crc32(std::iter::once(&self.names_crc).chain(&self.crcs).flat_map(|word| word.to_le_bytes()))
    }

    /// The doubles of an entry.
    fn doubles(&self, entry: usize) -> Vec<f64> {
        let name = &self.names[entry];
        if let Some(array) = self.arrays.get(name) {
            return array.values.clone();
        }
        let (path, key) = place(name);
        let found = object(&self.header, path).and_then(|group| group.get(key)).and_then(Value::number);
        vec![found.unwrap_or(f64::NAN)]
    }

    /// The sum after a message that follows this one; its fingerprint is not compared.
    pub fn changed(&self, delta: &Delta) -> Result<Sum> {
        let mut sum = self.clone();
        let mut touched = Vec::new();
        for (i, change) in delta.changes.iter().enumerate() {
            sum.apply(i, change)?;
            touched.push(change.entry as usize);
        }
        touched.sort_unstable();
        touched.dedup();
        for entry in touched {
            sum.crcs[entry] = crc_of(&sum.doubles(entry));
        }
        sum.snapshot_seq = delta.snapshot_seq;
        sum.fingerprint = sum.of_all();
        Ok(sum)
    }

    fn apply(&mut self, i: usize, change: &Change) -> Result<()> {
        let field = |name: &str| format!("change[{i}].{name}");
        let entries = self.names.len();
        let name = self.names.get(change.entry as usize);
        let name = name.ok_or_else(|| Error::new(field("entry"), change.entry, format!("below {entries}")))?;
        let (size, first, values) = (change.size as usize, change.first as usize, &change.values);
        let whole_rows = || Error::new(field("size"), size, format!("whole rows of {name:?}, an array of doubles"));
        if let Some(array) = self.arrays.get_mut(name) {
            let have = array.values.len();
            if size != have {
                let row: usize = array.shape.iter().skip(1).product();
                if !array.f8 || array.shape.is_empty() || row == 0 || size % row != 0 {
                    return Err(whole_rows());
                }
                if size > have && !(first <= have && first + values.len() == size) {
                    return Err(Error::new(field("first"), first, format!("all of the new doubles from {have} on")));
                }
                array.shape[0] = size / row;
                array.values.resize(size, 0.0);
            }
            array.values[first..first + values.len()].copy_from_slice(values);
            return Ok(());
        }
        if size != 1 {
            return Err(whole_rows());
        }
        let (path, key) = place(name);
        let mut group = &mut self.header;
        for step in path {
            let Value::Object(members) = group else { return Err(whole_rows()) };
            group = match members.iter_mut().rev().find(|(name, _)| name == step) {
                Some((_, value)) => value,
                None => return Err(whole_rows()),
            };
        }
        let Value::Object(members) = group else { return Err(whole_rows()) };
        let Some((_, old)) = members.iter_mut().rev().find(|(name, _)| name == key) else { return Err(whole_rows()) };
        if let Some(value) = values.first() {
            *old = match old {
                Value::Bool(_) if *value == 0.0 || *value == 1.0 => Value::Bool(*value != 0.0),
                Value::Bool(_) => return Err(Error::new(name, value, "a truth value, 0 or 1")),
                _ => Value::Number(*value),
            };
        }
        Ok(())
    }

    /// The model, ready to be evaluated.
    pub fn snapshot(&self) -> Result<Snapshot> {
        Snapshot::build(self.snapshot_seq, &self.header, &self.arrays)
    }
}

/// Most changes that wait for a whole model.
const MOST_WAITING: usize = 1024;

/// Takes whole models and changes in the order of their arrival.
pub struct Changes {
    sum: Option<Sum>,
    /// Changes that wait for a whole model; None where none is needed.
    waiting: Option<Vec<Delta>>,
}

impl Changes {
    pub fn new(payload: &[u8]) -> Result<Changes> {
        Ok(Changes { sum: Some(Sum::decode(payload)?), waiting: None })
    }

    /// Fingerprint of the model.
    pub fn fingerprint(&self) -> u32 {
        self.sum.as_ref().map_or(0, |sum| sum.fingerprint)
    }

    /// A payload of kind 6, or of kind 7. With `Taken`, and where a whole model came that a change is missing after
    /// (`Lost`), the snapshot to use. After `Lost`, `Mismatch` or an error of a change a whole model is needed.
    pub fn take(&mut self, payload: &[u8]) -> Result<(Update, Option<Snapshot>)> {
        if payload.get(1) != Some(&crate::wire::DELTA) {
            return self.whole(payload);
        }
        let delta = match Delta::decode(payload) {
            Ok(delta) => delta,
            Err(error) => {
                self.waiting.get_or_insert_with(Vec::new);
                return Err(error);
            }
        };
        if let Some(model) = &delta.model {
            let sum = Sum::decode(model)?;
            if sum.fingerprint != delta.after {
                self.waiting.get_or_insert_with(Vec::new);
                return Ok((Update::Mismatch, None));
            }
            let snapshot = sum.snapshot()?;
            (self.sum, self.waiting) = (Some(sum), None);
            return Ok((Update::Taken, Some(snapshot)));
        }
        if let Some(waiting) = &mut self.waiting {
            if waiting.len() == MOST_WAITING {
                waiting.remove(0);
            }
            waiting.push(delta);
            return Ok((Update::Waits, None));
        }
        self.change(delta)
    }

    fn change(&mut self, delta: Delta) -> Result<(Update, Option<Snapshot>)> {
        let sum = self.sum.as_ref().expect("only a model that is whole takes changes");
        if delta.after == sum.fingerprint {
            return Ok((Update::Known, None));
        }
        if delta.before != sum.fingerprint {
            self.waiting = Some(vec![delta]);
            return Ok((Update::Lost, None));
        }
        let made = sum.changed(&delta).and_then(|next| {
            if next.fingerprint != delta.after {
                return Ok(None);
            }
            next.snapshot().map(|snapshot| Some((next, snapshot)))
        });
        match made {
            Ok(Some((next, snapshot))) => {
                self.sum = Some(next);
                Ok((Update::Taken, Some(snapshot)))
            }
            Ok(None) => {
                self.waiting = Some(Vec::new());
                Ok((Update::Mismatch, None))
            }
            Err(error) => {
                self.waiting = Some(Vec::new());
                Err(error)
            }
        }
    }

    fn whole(&mut self, payload: &[u8]) -> Result<(Update, Option<Snapshot>)> {
        let sum = Sum::decode(payload)?;
        let mut newest = Some(sum.snapshot()?);
        let Some(waiting) = self.waiting.take() else {
            self.sum = Some(sum);
            return Ok((Update::Taken, newest));
        };
        let follows = waiting.iter().position(|delta| delta.before == sum.fingerprint);
        let joined = follows.is_some() || waiting.iter().all(|delta| delta.snapshot_seq <= sum.snapshot_seq);
        self.sum = Some(sum);
        if !joined {
            self.waiting = Some(waiting);
            return Ok((Update::Lost, newest));
        }
        for delta in waiting.into_iter().skip(follows.unwrap_or(usize::MAX)) {
            match self.change(delta)? {
                (Update::Taken, snapshot) => newest = snapshot,
                (Update::Known, _) => {}
                (update, _) => return Ok((update, newest)),
            }
        }
        Ok((Update::Taken, newest))
    }
}
