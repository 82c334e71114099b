//! A snapshot of a model as it comes over the wire, with its memory and the rules of its stand-in.

use crate::error::{Error, Result};
use crate::json::Value;
use crate::model::{Entries, Model};
use crate::wire::{Array, Container, Delta};
use std::collections::HashMap;

/// The baseline that answers in place of a model, and its memory in the snapshot.
#[derive(Clone)]
pub struct StandIn {
    pub model: Model,
    pub memory: Vec<f64>,
}

/// A decoded payload of kind 6, and the scratch that its evaluation needs, so that evaluation allocates nothing.
#[derive(Clone)]
pub struct Snapshot {
    pub model: Model,
    pub snapshot_seq: i64,
    /// Hysteresis memory after sample `snapshot_seq`.
    pub memory: Vec<f64>,
    /// Whether the stand-in also replaces the model outside its domain and by its trust.
    pub blends: bool,
    pub blend_share: f64,
    pub trust: f64,
    /// 0: never stale.
    pub stale_s: f64,
    pub last_good_s: f64,
    /// Name of what is wrong with samples or learner, empty for nothing.
    pub trouble: String,
    pub stand_in: Option<StandIn>,
    pub(crate) scratch: Vec<f64>,
    /// Memory of the stand-in while it is evaluated, and its scratch.
    pub(crate) other: (Vec<f64>, Vec<f64>),
    /// Memory of a query; that of a follower has room here too, so that adopting a model allocates nothing.
    pub(crate) room: Vec<f64>,
    /// Memory of a point that is evaluated to warm the caches.
    pub(crate) spare: Vec<f64>,
}

impl Snapshot {
    pub fn decode(data: &[u8]) -> Result<Snapshot> {
        let Container { snapshot_seq, header, arrays } = Container::decode(data)?;
        Snapshot::build(snapshot_seq, &header, &arrays)
    }

    /// From the JSON and the arrays of a payload.
    pub fn build(snapshot_seq: i64, header: &Value, arrays: &HashMap<String, Array>) -> Result<Snapshot> {
        let text = |of: &Value, name: &str| -> Result<String> {
            let found = of.get(name).and_then(Value::text).map(String::from);
            found.ok_or_else(|| Error::new("header", format!("no text {name:?}"), "JSON with name, kind and dt_s"))
        };
        let dt_s = header.get("dt_s").and_then(Value::number);
        let dt_s = dt_s.ok_or_else(|| Error::new("header", "no number \"dt_s\"", "JSON with name, kind and dt_s"))?;
        let empty = Value::Object(Vec::new());
        let values = header.get("values").unwrap_or(&empty);
        let entries = Entries { values, arrays, prefixes: ("", "") };
        let model = Model::new(&text(header, "name")?, &text(header, "kind")?, dt_s, &entries)?;
        let memory = memory_of(&model, arrays.get("/memory"), "/memory")?;
        let safety = header.get("safety").unwrap_or(&empty);
        let number = |name: &str, missing: f64| safety.get(name).map_or(Some(missing), Value::number);
        let wrong = |name: &str| Error::new("safety", name, "the entries in docs/protocol.md");
        let of = |name: &str, missing: f64| number(name, missing).ok_or_else(|| wrong(name));
        let (blend_share, trust) = (of("blend_share", 0.5)?, of("trust", 1.0)?);
        if !(blend_share > 0.0 && (0.0..=1.0).contains(&trust)) {
            return Err(wrong("blend_share or trust out of range"));
        }
        let mut stand_in = None;
        if let Some(other) = safety.get("stand_in") {
            let values = other.get("values").unwrap_or(&empty);
            let entries = Entries { values, arrays, prefixes: ("", "/stand_in/") };
            let model = Model::new(&text(other, "name")?, &text(other, "kind")?, dt_s, &entries)?;
            let memory = memory_of(&model, arrays.get("/stand_in_memory"), "/stand_in_memory")?;
            stand_in = Some(StandIn { model, memory });
        }
        let other = stand_in.as_ref().map_or((Vec::new(), Vec::new()), |other: &StandIn| {
            (other.memory.clone(), vec![0.0; other.model.scratch_size()])
        });
        Ok(Snapshot {
            scratch: vec![0.0; model.scratch_size()],
            room: memory.clone(),
            spare: memory.clone(),
            other,
            snapshot_seq,
            memory,
            blends: of("blends", 0.0)? != 0.0,
            blend_share,
            trust,
            stale_s: of("stale_s", 0.0)?,
            last_good_s: of("last_good_s", 60.0)?,
            trouble: safety.get("trouble").and_then(Value::text).unwrap_or_default().to_string(),
            stand_in,
            model,
        })
    }

    /// After a change of this whole model.
    pub fn moved(&self, delta: &Delta) -> Result<Snapshot> {
        if delta.memory.len() != self.memory.len() {
            return Err(Error::new("m", delta.memory.len(), format!("{}, as the whole model has", self.memory.len())));
        }
        let (model, memory) = (self.model.moved(delta)?, delta.memory.clone());
        Ok(Snapshot { model, memory, snapshot_seq: delta.snapshot_seq, ..self.clone() })
    }

    /// (weight of the model inside its domain, whether it is stale) where the newest sample is `age_s` old.
    ///
    /// `None`: no newer message is expected, age does not count.
    pub fn trust_by_age(&self, age_s: Option<f64>) -> (f64, bool) {
        match age_s {
            Some(age_s) if self.stale_s > 0.0 && age_s > self.stale_s => {
                (self.trust * (1.0 - (age_s - self.last_good_s).clamp(0.0, 1.0)), true)
            }
            _ => (self.trust, false),
        }
    }
}

fn memory_of(model: &Model, array: Option<&Array>, name: &str) -> Result<Vec<f64>> {
    let found = array.map(|array| array.values.clone());
    let memory = found.ok_or_else(|| Error::new("arrays", format!("no {name:?}"), "the memory of the model"))?;
    if memory.len() != model.memory_size() {
        let expected = format!("{} for model {:?}", model.memory_size(), model.name);
        return Err(Error::new(name, format!("{} doubles", memory.len()), expected));
    }
    Ok(memory)
}
