//! A stage on the wire: `cargo run --release --example stage -- ENDPOINT STAGE AXIS SECONDS`.
//!
//! Takes the command blocks of a controller, applies one voltage each millisecond, and publishes what its sensor reads,
//! five samples a message. In place of hardware it has a gain and one play; put your own input and output into `Piezo`.
//! Its clock starts with the command for sample 0. Where a voltage is missing it repeats the last one and counts it.

use dehyst_zenoh::{Link, Options};
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

const DT_S: f64 = 1e-3;
const BATCH: usize = 5;

#[derive(Default)]
struct Piezo {
    u_v: f64,
    play: f64,
}

impl Piezo {
    fn read_um(&self) -> f64 {
        1.0 + 8.4 * self.u_v + 2.0 * self.play
    }

    fn apply(&mut self, u_v: f64) {
        self.u_v = u_v;
        self.play = self.play.clamp(u_v - 1.0, u_v + 1.0);
    }
}

/// (number of the first, voltages) of a payload of kind 2.
fn command(data: &[u8]) -> Option<(i64, Vec<f64>)> {
    let n = u32::from_le_bytes(data.get(4..8)?.try_into().ok()?) as usize;
    if data[..4] != [1, 2, 0, 0] || data.len() != 16 + 8 * n {
        return None;
    }
    let first = i64::from_le_bytes(data[8..16].try_into().ok()?);
    let u_v: Vec<f64> =
        data[16..].chunks_exact(8).map(|value| f64::from_le_bytes(value.try_into().unwrap_or_default())).collect();
    u_v.iter().all(|u| u.is_finite()).then_some((first, u_v))
}

fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let word = |i: usize, missing: &str| words.get(i).cloned().unwrap_or_else(|| missing.into());
    let options = Options {
        endpoints: vec![word(0, "tcp/127.0.0.1:7447")],
        stage: word(1, "demo"),
        axis: word(2, "x"),
        ..Options::default()
    };
    let last = (word(3, "5").parse::<f64>()? / DT_S).round() as i64;
    let link = Link::open(&options, Some("command"))?;
    println!("ready");
    let (mut piezo, mut planned, mut begin) = (Piezo::default(), BTreeMap::new(), None::<Instant>);
    let (mut seq, mut t_s, mut u_v, mut y) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let (mut missing, mut refused) = (0, 0);
    let mut k = 0;
    while k < last {
        let pause = begin.map_or(Duration::from_millis(50), |begin| {
            (begin + Duration::from_secs_f64(k as f64 * DT_S)).saturating_duration_since(Instant::now())
        });
        if let Some(data) = link.receive(pause) {
            match command(&data) {
                Some((first, u_v)) => planned.extend((first..).zip(u_v)),
                None => refused += 1,
            }
            if begin.is_none() && planned.contains_key(&0) {
                begin = Some(Instant::now());
            }
            continue;
        }
        if begin.is_none() {
            continue;
        }
        let y_um = piezo.read_um();
        match planned.remove(&k) {
            Some(u_v) => piezo.apply(u_v),
            None => missing += 1,
        }
        seq.push(k);
        t_s.push(k as f64 * DT_S);
        u_v.push(piezo.u_v);
        y.push(y_um);
        k += 1;
        if seq.len() == BATCH || k == last {
            link.samples(&seq, &t_s, &u_v, &y)?;
            seq.clear();
            [&mut t_s, &mut u_v, &mut y].into_iter().for_each(Vec::clear);
        }
    }
    println!("{last} samples, {missing} voltages missing, {refused} commands refused");
    Ok(())
}
