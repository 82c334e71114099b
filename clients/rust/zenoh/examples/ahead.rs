//! A controller that asks the service ahead of time and commands a stage:
//! `cargo run --release --example ahead -- ENDPOINT STAGE AXIS SECONDS CENTRE_UM SWING_UM`.
//!
//! A 2 Hz sine in blocks of 20 samples, each asked for 60 samples ahead with what is under way (docs/protocol.md). It
//! starts the count of its stage with sample 0, as `dehyst stage` and the example `stage` wait for. The last line
//! printed says how many voltages were sent, and how many of the blocks came too late for their first sample.

use dehyst::wire::Reply;
use dehyst_zenoh::{open, Link, Options};
use std::time::{Duration, Instant};

const BLOCK: i64 = 20;
const LEAD: i64 = 60;

fn header(kind: u8, options: u16, n: i64) -> Vec<u8> {
    let mut out = vec![1, kind];
    out.extend(options.to_le_bytes());
    out.extend((n as u32).to_le_bytes());
    out
}

fn extend(out: &mut Vec<u8>, values: &[f64]) {
    values.iter().for_each(|value| out.extend(value.to_le_bytes()));
}

/// A query of kind 4 for the points of `motion`; `under_way` is first, y_um and u_V of what was commanded.
fn query(motion: &[[f64; 3]], under_way: Option<(i64, &[f64], &[f64])>) -> Vec<u8> {
    let mut out = header(4, if under_way.is_some() { 0b101 } else { 0b001 }, motion.len() as i64);
    out.extend((-1i64).to_le_bytes()); // the newest snapshot
    let before = under_way.and_then(|(_, _, u_v)| u_v.last().copied());
    extend(&mut out, &[before.unwrap_or(f64::NAN)]);
    out.extend([0; 8]); // no memory, the default model
    for column in 0..3 {
        extend(&mut out, &motion.iter().map(|point| point[column]).collect::<Vec<_>>());
    }
    if let Some((first, y_um, u_v)) = under_way {
        out.extend(first.to_le_bytes());
        out.extend((y_um.len() as u32).to_le_bytes());
        extend(&mut out, y_um);
        extend(&mut out, u_v);
    }
    out
}

fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let word = |i: usize, missing: &str| words.get(i).cloned().unwrap_or_else(|| missing.into());
    let (seconds, centre, swing): (f64, f64, f64) =
        (word(3, "5").parse()?, word(4, "45").parse()?, word(5, "20").parse()?);
    let options = Options {
        endpoints: vec![word(0, "tcp/127.0.0.1:7447")],
        stage: word(1, "demo"),
        axis: word(2, "x"),
        ..Options::default()
    };
    let dt_s = open(&options)?.follower.report().dt_s;
    let link = Link::open(&options, None)?;
    let w = 4.0 * std::f64::consts::PI;
    // From the bottom at rest, so that the first command is no step.
    let point = |k: i64| {
        let t = k as f64 * dt_s;
        [centre - swing * (w * t).cos(), swing * w * (w * t).sin(), swing * w * w * (w * t).cos()]
    };
    let end = (seconds / dt_s).round() as i64;
    let (mut y_um, mut u_v, mut late) = (Vec::new(), Vec::<f64>::new(), 0);
    let mut begin = Instant::now();
    for first in (0..end).step_by(BLOCK as usize) {
        std::thread::sleep(
            (begin + Duration::from_secs_f64(((first - LEAD).max(0)) as f64 * dt_s))
                .saturating_duration_since(Instant::now()),
        );
        let motion: Vec<[f64; 3]> = (first..first + BLOCK).map(point).collect();
        // More than can be under way: the service leaves out what its snapshot has seen.
        let kept = u_v.len().saturating_sub(1000);
        let under_way = (!u_v.is_empty()).then(|| (kept as i64, &y_um[kept..], &u_v[kept..]));
        let reply = Reply::decode(&link.ask("feedforward", &query(&motion, under_way))?)?;
        let mut block = header(2, 0, BLOCK);
        block.extend(first.to_le_bytes());
        extend(&mut block, &reply.u_v);
        link.send("command", block)?;
        if first == 0 {
            begin = Instant::now(); // the stage's clock starts with the first block
        } else if begin.elapsed().as_secs_f64() > first as f64 * dt_s {
            late += 1;
        }
        y_um.extend(motion.iter().map(|point| point[0]));
        u_v.extend(reply.u_v);
    }
    println!("{} voltages, {late} blocks late, last {:.4} V", u_v.len(), u_v.last().copied().unwrap_or(f64::NAN));
    Ok(())
}
