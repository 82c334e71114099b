//! Time of one followed point: `cargo run --release --example bench [-- POINTS]`.
//!
//! The models are the test vectors `auto` (LSSVM of N = 500 with 63 linear and 5 kernel inputs as the champion, beside
//! linear, mpi and bouc_wen), `mpi` and `bouc_wen`. A second run has a thread that publishes a new model 50 times a
//! second meanwhile. In the last one, 5000 points are asked at 1 kHz, as a controller does: caches and core have cooled
//! down in between.

use dehyst::{Follower, Limits};
use std::hint::black_box;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

fn read(name: &str) -> Vec<u8> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/protocol/vectors/");
    std::fs::read(format!("{folder}{name}.model.payload")).expect("a checkout with docs/protocol/vectors")
}

fn times(follower: &mut Follower, points: usize, pause: Duration) -> Vec<f64> {
    let mut times = Vec::with_capacity(points);
    for i in 0..points + 1000 {
        let phase = i as f64 * 0.02;
        let (y, v) = (45.0 + 30.0 * phase.sin(), 600.0 * phase.cos());
        if !pause.is_zero() {
            std::thread::sleep(pause);
        }
        let start = Instant::now();
        let point = follower.point(black_box(y), black_box(v), black_box(-0.4 * v));
        let took = start.elapsed();
        black_box(point).expect("a point");
        if i >= 1000 {
            times.push(took.as_nanos() as f64 * 1e-3);
        }
    }
    times.sort_by(f64::total_cmp);
    times
}

fn main() {
    let points = std::env::args().nth(1).map_or(1_000_000, |text| text.parse().expect("a number of points"));
    let limits = Limits { u_min_v: 0.0, u_max_v: 10.0, slew_v_per_s: 2e5, y_min_um: -40.0, y_max_um: 140.0 };
    println!("{points} points, time of each in µs, clock included");
    println!("{:<28}{:>8}{:>8}{:>8}{:>9}{:>9}", "model", "p50", "p99", "p99.9", "p99.99", "max");
    for name in ["auto", "mpi", "bouc_wen"] {
        for (label, publishing, pause) in
            [("", false, 0), (", models at 50 Hz", true, 0), (", the same at 1 kHz", true, 1)]
        {
            let payload = read(name);
            let mut follower = Follower::new(&payload, limits).expect("a model");
            let (publisher, stop) = (follower.publisher(), AtomicBool::new(false));
            let times = std::thread::scope(|scope| {
                if publishing {
                    scope.spawn(|| {
                        while !stop.load(Ordering::Relaxed) {
                            publisher.publish(&payload).expect("the same model");
                            std::thread::sleep(Duration::from_millis(20));
                        }
                    });
                }
                let n = if pause == 0 { points } else { 5000 };
                let times = times(&mut follower, n, Duration::from_millis(pause));
                stop.store(true, Ordering::Relaxed);
                times
            });
            let at = |share: f64| times[((times.len() as f64 * share) as usize).min(times.len() - 1)];
            let label = format!("{name}{label}");
            let row = [at(0.5), at(0.99), at(0.999), at(0.9999), at(1.0)];
            println!("{label:<28}{:>8.2}{:>8.2}{:>8.2}{:>9.2}{:>9.2}", row[0], row[1], row[2], row[3], row[4]);
        }
    }
}
