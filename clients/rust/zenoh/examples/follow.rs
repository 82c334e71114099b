//! Follow a service and print what comes: `cargo run --release --example follow -- ENDPOINT STAGE AXIS MODEL SECONDS`.
//!
//! Evaluates a 2 Hz sine at the sample time of the axis in this process, and prints each second the newest sample that
//! the model has seen, its age, the last voltage and the slowest point.

use dehyst_zenoh::{open, Options};
use std::time::{Duration, Instant};

fn main() {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let word = |i: usize, missing: &str| words.get(i).cloned().unwrap_or_else(|| missing.into());
    let options = Options {
        endpoints: vec![word(0, "tcp/127.0.0.1:7447")],
        stage: word(1, "demo"),
        axis: word(2, "x"),
        model: word(3, ""),
        ..Options::default()
    };
    let seconds: f64 = word(4, "5").parse().expect("a number of seconds");
    let mut live = match open(&options) {
        Ok(live) => live,
        Err(error) => {
            eprintln!("{error}");
            std::process::exit(1);
        }
    };
    let dt_s = live.follower.report().dt_s;
    let (begin, mut slowest, mut ages, mut printed) = (Instant::now(), Duration::ZERO, Vec::new(), 0);
    for i in 1.. {
        let t = f64::from(i) * dt_s;
        if t > seconds {
            break;
        }
        std::thread::sleep((begin + Duration::from_secs_f64(t)).saturating_duration_since(Instant::now()));
        let (w, start) = (4.0 * std::f64::consts::PI, Instant::now());
        let asked = live.follower.point(45.0 + 20.0 * (w * t).sin(), 20.0 * w * (w * t).cos(), 0.0);
        slowest = slowest.max(start.elapsed());
        if let Err(error) = asked {
            eprintln!("{error}");
            std::process::exit(1);
        }
        let report = live.follower.report();
        ages.push(report.age_s);
        if t as u64 > printed {
            printed = t as u64;
            ages.sort_by(f64::total_cmp);
            println!(
                "sample {}, model's age median {:.1} and 99 % {:.1} ms, {:.6} V from {}, gain {:.4}, {} models, \
                 {} refused, slowest point {:.1} µs",
                report.snapshot_seq,
                1e3 * ages[ages.len() / 2],
                1e3 * ages[ages.len() * 99 / 100],
                report.last.u_v,
                report.source,
                report.gain,
                report.received,
                report.refused,
                1e6 * slowest.as_secs_f64()
            );
            ages.clear();
        }
    }
}
