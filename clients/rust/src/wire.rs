//! Binary payloads by docs/protocol.md: strict decoding, little-endian, one error per wrong field.

use crate::error::{Error, Result};
use crate::json::{self, Value};
use std::collections::HashMap;

pub const VERSION: u8 = 1;
pub const SAMPLES: u8 = 1;
pub const QUERY: u8 = 4;
pub const REPLY: u8 = 5;
pub const MODEL: u8 = 6;
pub const DELTA: u8 = 7;
const MAX_COUNT: u32 = 65_536;
const MAX_SEQ: i64 = 1 << 62;
const MAX_MEMORY: u32 = 4096;
const MAX_NAME_BYTES: u32 = 64;
const MAX_PENDING: u32 = 4096;
/// Largest model payload that is read.
const MAX_BYTES: usize = 64 << 20;

fn bytes<const N: usize>(data: &[u8], at: usize) -> [u8; N] {
    data[at..at + N].try_into().expect("a slice of N bytes")
}

fn u32_at(data: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes(data, at))
}

fn i64_at(data: &[u8], at: usize) -> i64 {
    i64::from_le_bytes(bytes(data, at))
}

fn f64_at(data: &[u8], at: usize) -> f64 {
    f64::from_le_bytes(bytes(data, at))
}

fn doubles(data: &[u8], at: usize, n: usize) -> Vec<f64> {
    (0..n).map(|i| f64_at(data, at + 8 * i)).collect()
}

/// (options, n) of a payload of `kind` that has at least `least` bytes.
fn header(data: &[u8], kind: u8, least: usize, allowed: u16) -> Result<(u16, u32)> {
    if data.len() < least {
        return Err(Error::new("payload", format!("{} bytes", data.len()), format!("at least {least} bytes")));
    }
    if data[0] != VERSION {
        return Err(Error::new("version", data[0], VERSION.to_string()));
    }
    if data[1] != kind {
        return Err(Error::new("kind", data[1], kind.to_string()));
    }
    let options = u16::from_le_bytes(bytes(data, 2));
    if options & !allowed != 0 {
        return Err(Error::new("options", format!("{options:#06x}"), format!("no bit outside {allowed:#06x}")));
    }
    let n = u32_at(data, 4);
    if !(1..=MAX_COUNT).contains(&n) {
        return Err(Error::new("n", n, format!("1 to {MAX_COUNT}")));
    }
    Ok((options, n))
}

fn check_length(data: &[u8], expected: usize) -> Result<()> {
    if data.len() != expected {
        return Err(Error::new("payload", format!("{} bytes", data.len()), format!("exactly {expected} bytes")));
    }
    Ok(())
}

fn check_finite(field: &str, values: &[f64]) -> Result<()> {
    match values.iter().position(|value| !value.is_finite()) {
        Some(i) => Err(Error::new(format!("{field}[{i}]"), values[i], "a finite number")),
        None => Ok(()),
    }
}

fn check_sizes(m: u32, b: u32) -> Result<()> {
    if m > MAX_MEMORY {
        return Err(Error::new("m", m, format!("at most {MAX_MEMORY} doubles of memory")));
    }
    if b > MAX_NAME_BYTES {
        return Err(Error::new("b", b, format!("a name of at most {MAX_NAME_BYTES} bytes")));
    }
    Ok(())
}

fn name(data: &[u8]) -> Result<String> {
    String::from_utf8(data.to_vec()).map_err(|error| Error::new("model", error, "a name in UTF-8"))
}

/// A payload of kind 1, what the service learns from: n sample numbers, times, s, voltages that are applied from these
/// times on, V, and readings at these times, µm; NaN where there is none.
pub fn samples(seq: &[i64], t_s: &[f64], u_v: &[f64], y_um: &[f64]) -> Result<Vec<u8>> {
    let n = seq.len();
    for (field, values) in [("t_s", t_s), ("u_V", u_v), ("y_um", y_um)] {
        if values.len() != n {
            return Err(Error::new(field, format!("{} values", values.len()), format!("{n}, as many as seq")));
        }
    }
    if !(1..=MAX_COUNT as usize).contains(&n) {
        return Err(Error::new("n", n, format!("1 to {MAX_COUNT} samples")));
    }
    if let Some(i) = seq.iter().position(|number| !(0..=MAX_SEQ).contains(number)) {
        return Err(Error::new(format!("seq[{i}]"), seq[i], "a sequence number from 0 to 2^62"));
    }
    let mut out = vec![VERSION, SAMPLES, 0, 0];
    out.extend((n as u32).to_le_bytes());
    seq.iter().for_each(|number| out.extend(number.to_le_bytes()));
    t_s.iter().chain(u_v).chain(y_um).for_each(|value| out.extend(value.to_le_bytes()));
    Ok(out)
}

/// Samples that are commanded and not yet seen by the snapshot.
#[derive(Clone, Debug, PartialEq)]
pub struct Pending {
    pub first: i64,
    pub y_um: Vec<f64>,
    pub u_v: Vec<f64>,
}

/// A payload of kind 4.
#[derive(Clone, Debug, PartialEq)]
pub struct Query {
    pub as_of: i64,
    /// NaN: none.
    pub u_before_v: f64,
    pub memory: Option<Vec<f64>>,
    pub y_um: Vec<f64>,
    pub v_um_per_s: Vec<f64>,
    pub a_um_per_s2: Vec<f64>,
    pub model: String,
    pub pending: Option<Pending>,
}

impl Query {
    pub fn decode(data: &[u8]) -> Result<Query> {
        let (options, n) = header(data, QUERY, 32, 0b111)?;
        let (as_of, u_before_v) = (i64_at(data, 8), f64_at(data, 16));
        let (m, b) = (u32_at(data, 24), u32_at(data, 28));
        check_sizes(m, b)?;
        if m > 0 && options & 2 == 0 {
            return Err(Error::new("m", m, "0 without the option for a memory"));
        }
        if !(-1..=MAX_SEQ).contains(&as_of) {
            return Err(Error::new("as_of", as_of, "a sequence number from 0 to 2^62, or -1 for the newest"));
        }
        if u_before_v.is_infinite() {
            return Err(Error::new("u_before_V", u_before_v, "a finite voltage in V, or NaN for none"));
        }
        let (n, m, b) = (n as usize, m as usize, b as usize);
        let columns = if options & 1 != 0 { 3 } else { 2 };
        let end = 32 + 8 * (m + columns * n);
        let length = end + b;
        let pending = if options & 4 == 0 {
            check_length(data, length)?;
            None
        } else {
            Some(pending(data, length, options)?)
        };
        let column = |i: usize| doubles(data, 32 + 8 * (m + i * n), n);
        let memory = doubles(data, 32, m);
        let query = Query {
            as_of,
            u_before_v,
            y_um: column(0),
            v_um_per_s: column(1),
            a_um_per_s2: if columns == 3 { column(2) } else { vec![0.0; n] },
            memory: (options & 2 != 0).then_some(memory),
            model: name(&data[end..length])?,
            pending,
        };
        check_finite("memory", query.memory.as_deref().unwrap_or(&[]))?;
        check_finite("y_um", &query.y_um)?;
        check_finite("v_um_per_s", &query.v_um_per_s)?;
        check_finite("a_um_per_s2", &query.a_um_per_s2)?;
        Ok(query)
    }
}

fn pending(data: &[u8], begin: usize, options: u16) -> Result<Pending> {
    if options & 2 != 0 {
        return Err(Error::new("pending", "a memory too", "one of the two"));
    }
    if data.len() < begin + 12 {
        return Err(Error::new("payload", format!("{} bytes", data.len()), format!("at least {}", begin + 12)));
    }
    let (first, k) = (i64_at(data, begin), u32_at(data, begin + 8));
    if !(1..=MAX_PENDING).contains(&k) {
        return Err(Error::new("pending.k", k, format!("1 to {MAX_PENDING} samples")));
    }
    let k = k as usize;
    check_length(data, begin + 12 + 16 * k)?;
    if !(0..=MAX_SEQ).contains(&first) {
        return Err(Error::new("pending.first", first, "a sequence number from 0 to 2^62"));
    }
    let found = Pending { first, y_um: doubles(data, begin + 12, k), u_v: doubles(data, begin + 12 + 8 * k, k) };
    check_finite("pending.y_um", &found.y_um)?;
    check_finite("pending.u_V", &found.u_v)?;
    Ok(found)
}

/// A payload of kind 5.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reply {
    pub behind: bool,
    pub tracked_memory: bool,
    pub fallback: bool,
    pub snapshot_seq: i64,
    pub u_v: Vec<f64>,
    pub std_v: Vec<f64>,
    pub memory: Vec<f64>,
    pub flags: Vec<u8>,
    pub model: String,
    /// Empty: none answered.
    pub stand_in: String,
}

impl Reply {
    pub fn decode(data: &[u8]) -> Result<Reply> {
        let (options, n) = header(data, REPLY, 24, 0b1111)?;
        let (snapshot_seq, m, b) = (i64_at(data, 8), u32_at(data, 16), u32_at(data, 20));
        check_sizes(m, b / 2)?;
        let (n, m, b) = (n as usize, m as usize, b as usize);
        let end = 24 + 8 * (2 * n + m);
        check_length(data, end + n + b)?;
        let mut model = name(&data[end + n..])?;
        let mut stand_in = String::new();
        if options & 8 != 0 {
            if let Some((own, other)) = model.clone().split_once('/') {
                (model, stand_in) = (own.into(), other.into());
            }
        }
        let reply = Reply {
            behind: options & 1 != 0,
            tracked_memory: options & 2 != 0,
            fallback: options & 4 != 0,
            snapshot_seq,
            u_v: doubles(data, 24, n),
            std_v: doubles(data, 24 + 8 * n, n),
            memory: doubles(data, 24 + 16 * n, m),
            flags: data[end..end + n].to_vec(),
            model,
            stand_in,
        };
        check_finite("u_V", &reply.u_v)?;
        check_finite("memory", &reply.memory)?;
        Ok(reply)
    }

    pub fn encode(&self) -> Vec<u8> {
        let mut options = u16::from(self.behind) | u16::from(self.tracked_memory) << 1 | u16::from(self.fallback) << 2;
        let mut name = self.model.clone();
        if !self.stand_in.is_empty() {
            options |= 8;
            name = format!("{name}/{}", self.stand_in);
        }
        let mut out = vec![VERSION, REPLY];
        out.extend(options.to_le_bytes());
        out.extend((self.u_v.len() as u32).to_le_bytes());
        out.extend(self.snapshot_seq.to_le_bytes());
        out.extend((self.memory.len() as u32).to_le_bytes());
        out.extend((name.len() as u32).to_le_bytes());
        for value in self.u_v.iter().chain(&self.std_v).chain(&self.memory) {
            out.extend(value.to_le_bytes());
        }
        out.extend(&self.flags);
        out.extend(name.as_bytes());
        out
    }
}

/// An array of a payload, as doubles.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
}

/// A payload of kind 6 before a model is made of it.
pub struct Container {
    pub snapshot_seq: i64,
    pub header: Value,
    pub arrays: HashMap<String, Array>,
}

impl Container {
    pub fn decode(data: &[u8]) -> Result<Container> {
        let (_, n) = header(data, MODEL, 24, 0)?;
        let (snapshot_seq, j, b) = (i64_at(data, 8), u32_at(data, 16) as usize, u32_at(data, 20) as usize);
        if j + b > MAX_BYTES {
            return Err(Error::new("payload", format!("{} bytes", j + b), format!("at most {MAX_BYTES}")));
        }
        check_length(data, 24 + j + b)?;
        let header = json::parse(&data[24..24 + j])?;
        let table = header.get("arrays").and_then(Value::list);
        let table = table.ok_or_else(|| Error::new("header", "no list 'arrays'", "rows [name, type, shape]"))?;
        if table.len() != n as usize {
            return Err(Error::new("arrays", table.len(), format!("{n}, by the header")));
        }
        let mut arrays = HashMap::new();
        let mut at = 24 + j;
        for row in table {
            let (name, array, length) = array(data, at, row)?;
            at += length.div_ceil(8) * 8;
            arrays.insert(name, array);
        }
        Ok(Container { snapshot_seq, header, arrays })
    }
}

/// (name, array, bytes) of the array that begins at byte `at`.
fn array(data: &[u8], at: usize, row: &Value) -> Result<(String, Array, usize)> {
    let wrong = || Error::new("header", "a row of 'arrays'", "[name, type, shape]");
    let [name, dtype, shape] = row.list().ok_or_else(wrong)? else { return Err(wrong()) };
    let (name, dtype) = (name.text().ok_or_else(wrong)?, dtype.text().ok_or_else(wrong)?);
    let mut sizes = Vec::new();
    for size in shape.list().ok_or_else(wrong)? {
        let size = size.number().filter(|x| *x >= 0.0 && *x <= MAX_BYTES as f64 && x.fract() == 0.0);
        sizes.push(size.ok_or_else(wrong)? as usize);
    }
    let width = match dtype {
        "<f8" | "<i8" => 8,
        "<f4" | "<i4" => 4,
        "|u1" | "|b1" => 1,
        other => return Err(Error::new(format!("arrays.{name}"), other, "one of <f8, <f4, <i8, <i4, |u1, |b1")),
    };
    let field = || format!("arrays.{name}");
    let count = sizes.iter().try_fold(1usize, |product, size| product.checked_mul(*size));
    let count = count.filter(|n| *n <= MAX_BYTES).ok_or_else(|| Error::new(field(), "its shape", "a smaller array"))?;
    let length = count * width;
    if at + length > data.len() {
        return Err(Error::new(field(), format!("{length} bytes at {at}"), format!("an end before {}", data.len())));
    }
    let value = |i: usize| match dtype {
        "<f8" => f64_at(data, at + 8 * i),
        "<i8" => i64_at(data, at + 8 * i) as f64,
        "<f4" => f64::from(f32::from_le_bytes(bytes(data, at + 4 * i))),
        "<i4" => f64::from(i32::from_le_bytes(bytes(data, at + 4 * i))),
        _ => f64::from(data[at + i]),
    };
    Ok((name.to_string(), Array { shape: sizes, values: (0..count).map(value).collect() }, length))
}

/// A payload of kind 7: what has moved in a whole model.
#[derive(Clone, Debug, PartialEq)]
pub struct Delta {
    pub snapshot_seq: i64,
    /// CRC-32 of the payload of the whole model.
    pub base: u32,
    pub gain: f64,
    pub offset_um: f64,
    pub noise_variance: f64,
    pub domain: Vec<f64>,
    pub beta: Vec<f64>,
    pub memory: Vec<f64>,
}

impl Delta {
    pub fn decode(data: &[u8]) -> Result<Delta> {
        let (_, p) = header(data, DELTA, 24, 0)?;
        let (snapshot_seq, base, m) = (i64_at(data, 8), u32_at(data, 16), u32_at(data, 20));
        if snapshot_seq < -1 {
            return Err(Error::new("snapshot_seq", snapshot_seq, "a sequence number, or -1 before any sample"));
        }
        check_sizes(m, 0)?;
        let moving = 9 + p as usize;
        check_length(data, 24 + 8 * (moving + m as usize))?;
        let values = doubles(data, 24, moving);
        check_finite("values", &values)?;
        Ok(Delta {
            snapshot_seq,
            base,
            gain: values[0],
            offset_um: values[1],
            noise_variance: values[2],
            domain: values[3..9].to_vec(),
            beta: values[9..].to_vec(),
            memory: doubles(data, 24 + 8 * moving, m as usize),
        })
    }
}
