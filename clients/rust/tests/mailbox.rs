//! What the follower promises to a real-time loop: no allocation in a point, and whole models only.

use dehyst::{CorrectionSettings, Follower, Limits, Out};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, Ordering};

thread_local! {
    /// Calls of the allocator in this thread.
    static CALLS: Cell<u64> = const { Cell::new(0) };
}

struct Counting;

fn count() {
    let _ = CALLS.try_with(|calls| calls.set(calls.get() + 1));
}

// SAFETY: everything is left to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        System.alloc(layout)
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count();
        System.dealloc(pointer, layout);
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        System.realloc(pointer, layout, size)
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const LIMITS: Limits = Limits { u_min_v: 0.0, u_max_v: 10.0, slew_v_per_s: 1e9, y_min_um: -40.0, y_max_um: 140.0 };

fn read(name: &str) -> Vec<u8> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/protocol/vectors/");
    std::fs::read(format!("{folder}{name}.model.payload")).unwrap()
}

#[test]
fn points_and_blocks_allocate_and_free_nothing() {
    let (first, jumped, changed) = (read("auto"), read("auto-jumped"), read("auto-champion-changed"));
    let mut follower = Follower::new(&first, LIMITS).unwrap();
    let settings = Some(CorrectionSettings { share: 0.02, mode_hz: 200.0, fade_s: 0.5 });
    follower.correct(settings, settings).unwrap();
    let publisher = follower.publisher();
    let (mut u, mut std, mut flags) = ([0.0; 8], [0.0; 8], [0u8; 8]);
    let mut total = 0;
    for round in 0..60 {
        // Another model before the points: the follower takes it, and gives the old one back unfreed.
        publisher.publish([&jumped, &changed, &first][round % 3]).unwrap();
        let before = CALLS.with(Cell::get);
        // Inside the domain, and outside it with the stand-in.
        for (k, y) in [40.0, 41.0, 45.0, 120.0, -20.0].into_iter().enumerate() {
            let number = 100 * round as i64 + k as i64;
            follower.number(number).unwrap();
            follower.read(&[number - 1], &[y]).unwrap();
            follower.warm(y, 100.0, 0.0).unwrap();
            follower.point(y + 0.01 * round as f64, 100.0, 0.0).unwrap();
        }
        let mut out = Out { u_v: &mut u, std_v: &mut std, flags: &mut flags };
        follower.block(&[30.0, 31.0, 32.0, 33.0, 34.0, 110.0, 34.0, 33.0], &[], &[], &mut out).unwrap();
        follower.start(f64::NAN);
        follower.advance(&[30.0, 32.0], &[2.0, 2.1]).unwrap();
        total += CALLS.with(Cell::get) - before;
    }
    assert_eq!(total, 0);
    assert_eq!(follower.report().received, 61);
}

#[test]
fn motion_that_repeats_is_found_learnt_and_forgotten_without_allocation() {
    let mut follower = Follower::new(&read("bouc_wen"), LIMITS).unwrap();
    let settings = Some(CorrectionSettings { share: 0.02, mode_hz: 200.0, fade_s: 0.5 });
    follower.correct(settings, settings).unwrap();
    let before = CALLS.with(Cell::get);
    let (mut active, mut periods) = (0, [0; 3]);
    // The motion changes twice, and the second one is of a period that is stated.
    let part = |k: i64| usize::from(k >= 9000) + usize::from(k >= 12_000);
    let period = |k: i64| [66.6667, 50.5, 33.25][part(k)];
    let wanted_um = |k: i64| 40.0 + 10.0 * (2.0 * std::f64::consts::PI * k as f64 / period(k)).sin();
    // Beyond the end of what is kept.
    for k in 0..20_000 {
        if k == 9000 || k == 12_000 {
            let stated = (k == 9000).then_some(0.0505);
            follower.correcting().unwrap().repetition.as_mut().unwrap().state(stated).unwrap();
        }
        follower.number(k).unwrap();
        let seen = k - 1 - k / 4000; // the readings grow older
        follower.read(&[seen], &[wanted_um(seen) + 0.02]).unwrap();
        follower.point(wanted_um(k), 0.0, 0.0).unwrap();
        let repetition = follower.correcting().unwrap().repetition.as_ref().unwrap();
        active += u64::from(repetition.active);
        periods[part(k)] += u64::from(repetition.period.is_some_and(|found| (found - period(k)).abs() < 0.01));
    }
    assert_eq!(CALLS.with(Cell::get), before);
    assert!(active > 10_000, "{active}");
    assert!(periods.iter().all(|count| *count > 2000), "{periods:?}");
}

#[test]
fn a_model_of_another_size_brings_its_own_memory_without_allocation() {
    let (small, other) = (read("bouc_wen"), read("bouc_wen-zero-order"));
    let mut follower = Follower::new(&small, LIMITS).unwrap();
    follower.publisher().publish(&other).unwrap();
    follower.point(30.0, 0.0, 0.0).unwrap();
    // The plays of `mpi` and `pi` differ in number, and both are called mpi.
    let (mpi, pi) = (read("mpi"), read("pi"));
    let mut follower = Follower::new(&mpi, LIMITS).unwrap();
    assert_eq!(follower.memory().len(), 4);
    follower.publisher().publish(&pi).unwrap();
    let before = CALLS.with(Cell::get);
    let got = follower.point(30.0, 0.0, 0.0).unwrap();
    assert_eq!(CALLS.with(Cell::get), before);
    assert_eq!(follower.memory().len(), 3);
    assert_eq!(got.u_v, Follower::new(&pi, LIMITS).unwrap().point(30.0, 0.0, 0.0).unwrap().u_v);
    assert!(follower.publisher().publish(&small).is_err());
    assert_eq!(follower.report().refused, 1);
    assert!(follower.publisher().last_error().contains("bouc_wen"));
}

#[test]
fn a_warm_start_takes_the_newest_model_and_moves_nothing() {
    for name in ["auto", "lssvm", "mpi", "bouc_wen"] {
        let payload = read(name);
        let (mut warmed, mut plain) =
            (Follower::new(&payload, LIMITS).unwrap(), Follower::new(&payload, LIMITS).unwrap());
        for i in 0..50 {
            let y = 40.0 + 20.0 * (0.3 * i as f64).sin();
            warmed.warm(y + 1.0, 100.0, 0.0).unwrap();
            assert_eq!(warmed.point(y, 100.0, 0.0).unwrap(), plain.point(y, 100.0, 0.0).unwrap(), "{name} {i}");
            assert_eq!(warmed.memory(), plain.memory());
        }
        assert_eq!(warmed.report().answered, 50);
        assert!(warmed.warm(f64::NAN, 0.0, 0.0).is_err());
    }
    let mut follower = Follower::new(&read("lssvm"), LIMITS).unwrap();
    follower.publisher().publish(&read("lssvm-jumped")).unwrap();
    follower.warm(40.0, 0.0, 0.0).unwrap();
    assert_eq!(follower.report().gain, 0.94);
}

#[test]
fn every_answer_is_of_one_whole_model_while_others_publish() {
    let payloads = [read("lssvm"), read("lssvm-jumped"), read("lssvm-distrusted")];
    // From the memory of the payload, each model has one answer.
    let expected: Vec<f64> = payloads
        .iter()
        .map(|payload| Follower::new(payload, LIMITS).unwrap().point(44.0, 500.0, 0.0).unwrap().u_v)
        .collect();
    assert!(expected[0] != expected[1] && expected[1] != expected[2]);
    let mut follower = Follower::new(&payloads[0], LIMITS).unwrap();
    let publisher = follower.publisher();
    let (stop, mut seen) = (AtomicBool::new(false), [0u64; 3]);
    std::thread::scope(|scope| {
        for start in 0..2 {
            let (publisher, payloads, stop) = (publisher.clone(), &payloads, &stop);
            scope.spawn(move || {
                let mut i = start;
                while !stop.load(Ordering::Relaxed) {
                    publisher.publish(&payloads[i % 3]).unwrap();
                    i += 1;
                }
            });
        }
        while seen.iter().any(|count| *count < 200) {
            follower.start(f64::NAN);
            let got = follower.point(44.0, 500.0, 0.0).unwrap();
            // A newer model may come between `start` and the point: then its memory is that of the older one.
            if let Some(i) = expected.iter().position(|u| *u == got.u_v) {
                seen[i] += 1;
            }
            assert!(got.u_v.is_finite() && (0.0..=10.0).contains(&got.u_v));
        }
        stop.store(true, Ordering::Relaxed);
    });
    // The last one that was published is in use after the next point: nothing stays in the mailbox.
    publisher.publish(&payloads[1]).unwrap();
    follower.point(44.0, 0.0, 0.0).unwrap();
    assert_eq!(follower.report().snapshot_seq, 4500);
    assert_eq!(follower.report().gain, 0.94);
}

#[test]
fn the_follower_tells_when_models_no_longer_come() {
    let payload = read("lssvm-jumped");
    let mut follower = Follower::new(&payload, LIMITS).unwrap();
    assert!(!follower.report().stale);
    let (mut u, mut std, mut flags) = ([0.0], [0.0], [0u8]);
    for (age_s, expected) in [(None, 0), (Some(1.0), 0), (Some(3.0), 64), (Some(60.5), 64 | 16), (Some(70.0), 64 | 32)]
    {
        let mut out = Out { u_v: &mut u, std_v: &mut std, flags: &mut flags };
        follower.block_at(&[44.0], &[0.0], &[0.0], age_s, &mut out).unwrap();
        assert_eq!(flags[0], expected, "{age_s:?}");
    }
    let source = follower.report().source;
    assert_eq!(source, "bouc_wen");
    assert_eq!(follower.hold(), u[0]);
}

#[test]
fn from_a_voltage_outside_the_limits_the_way_back_is_a_ramp() {
    let narrow = Limits { u_max_v: 3.0, slew_v_per_s: 100.0, ..LIMITS };
    let mut follower = Follower::new(&read("lssvm-jumped"), narrow).unwrap();
    let mut ramp = vec![9.0; 70];
    for i in 0..70 {
        ramp[i] = (if i == 0 { 9.0 } else { ramp[i - 1] } - narrow.slew_v_per_s * follower.report().dt_s).max(3.0);
    }
    let still = vec![0.0; 70];
    let (mut u, mut std, mut flags) = (still.clone(), still.clone(), vec![0u8; 70]);
    follower.start(9.0);
    let mut out = Out { u_v: &mut u, std_v: &mut std, flags: &mut flags };
    follower.block(&[89.0; 70], &still, &still, &mut out).unwrap();
    assert_eq!(u, ramp);
    follower.start(9.0);
    let points: Vec<f64> = (0..70).map(|_| follower.point(89.0, 0.0, 0.0).unwrap().u_v).collect();
    assert_eq!(points, ramp);
    follower.start(9.0);
    let held: Vec<f64> = (0..70).map(|_| follower.hold()).collect();
    assert_eq!(held, ramp);
}
