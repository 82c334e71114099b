//! The test vectors of docs/protocol/vectors, by queries and by a follower that goes along.

use dehyst::wire::{samples, Delta, Query, Reply};
use dehyst::{CorrectionSettings, Follower, Limits, Out, Snapshot, Update};
use std::fs;
use std::path::PathBuf;

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../docs/protocol/vectors")
}

fn read(name: &str) -> Vec<u8> {
    fs::read(folder().join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

struct Case {
    name: String,
    model: String,
    query: Query,
    query_bytes: Vec<u8>,
    reply: Reply,
    continues: Option<String>,
    limits: Limits,
    age_s: Option<f64>,
}

fn rows(name: &str) -> Vec<Vec<String>> {
    let text = String::from_utf8(read(name)).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with('#') && !line.trim().is_empty());
    lines.map(|line| line.split_whitespace().map(String::from).collect()).collect()
}

fn cases() -> Vec<Case> {
    let number = |text: &str| text.parse::<f64>().unwrap();
    rows("cases.txt")
        .into_iter()
        .map(|row| Case {
            name: row[0].clone(),
            model: row[1].clone(),
            query: Query::decode(&read(&row[2])).unwrap(),
            query_bytes: read(&row[2]),
            reply: Reply::decode(&read(&row[3])).unwrap(),
            continues: (row[4] != "-").then(|| row[4].clone()),
            limits: Limits {
                u_min_v: number(&row[5]),
                u_max_v: number(&row[6]),
                slew_v_per_s: number(&row[7]),
                y_min_um: number(&row[8]),
                y_max_um: number(&row[9]),
            },
            age_s: Some(number(&row[10])).filter(|age| !age.is_nan()),
        })
        .collect()
}

fn same(what: &str, got: &[f64], expected: &[f64]) {
    assert_eq!(got.len(), expected.len(), "{what}");
    for (i, (g, e)) in got.iter().zip(expected).enumerate() {
        let close = (g - e).abs() <= 1e-12 * e.abs().max(1.0);
        assert!(close || (g.is_nan() && e.is_nan()), "{what}[{i}]: got {g}, expected {e}, off by {:e}", g - e);
    }
}

#[test]
fn every_query_has_the_reply_of_the_service() {
    let cases = cases();
    assert!(cases.len() > 50);
    for case in cases {
        let mut follower = Follower::new(&read(&case.model), case.limits).unwrap();
        let got = follower.reply(&case.query_bytes, case.age_s).unwrap();
        same(&format!("{} u_V", case.name), &got.u_v, &case.reply.u_v);
        same(&format!("{} std_V", case.name), &got.std_v, &case.reply.std_v);
        same(&format!("{} memory", case.name), &got.memory, &case.reply.memory);
        let rest = |r: &Reply| (r.flags.clone(), r.model.clone(), r.stand_in.clone(), r.fallback, r.tracked_memory);
        assert_eq!(rest(&got), rest(&case.reply), "{}", case.name);
        assert_eq!(got.snapshot_seq, case.reply.snapshot_seq);
        assert_eq!(Reply::decode(&got.encode()).unwrap().flags, got.flags);
    }
}

#[test]
fn a_follower_goes_along_with_its_own_memory() {
    let mut followers: Vec<(String, String, Follower)> = Vec::new();
    let mut continued = 0;
    for case in cases() {
        let free = case.query.pending.is_none() && case.query.u_before_v.is_nan() && case.query.memory.is_none();
        let (model, mut follower) = match &case.continues {
            None if free => (case.model.clone(), Follower::new(&read(&case.model), case.limits).unwrap()),
            None => continue,
            Some(name) => {
                continued += 1;
                let at = followers.iter().position(|(known, _, _)| known == name).unwrap();
                let (_, model, follower) = followers.swap_remove(at);
                (model, follower)
            }
        };
        if model != case.model {
            follower.publisher().publish(&read(&case.model)).unwrap();
        }
        let (n, query) = (case.query.y_um.len(), &case.query);
        let (mut u_v, mut std_v, mut flags) = (vec![0.0; n], vec![0.0; n], vec![0; n]);
        let mut out = Out { u_v: &mut u_v, std_v: &mut std_v, flags: &mut flags };
        let (y, v, a) = (&query.y_um, &query.v_um_per_s, &query.a_um_per_s2);
        if n == 1 {
            let got = follower.point(y[0], v[0], a[0]).unwrap();
            (u_v[0], std_v[0], flags[0]) = (got.u_v, got.std_v, got.flags);
        } else if case.age_s.is_some() {
            follower.block_at(y, v, a, case.age_s, &mut out).unwrap();
        } else {
            follower.block(y, v, a, &mut out).unwrap();
        }
        same(&format!("{} u_V", case.name), &u_v, &case.reply.u_v);
        same(&format!("{} std_V", case.name), &std_v, &case.reply.std_v);
        same(&format!("{} memory", case.name), follower.memory(), &case.reply.memory);
        assert_eq!(flags, case.reply.flags, "{}", case.name);
        followers.push((case.name, case.model, follower));
    }
    assert!(continued >= 8);
}

#[test]
fn start_and_advance_are_what_is_under_way() {
    let case = cases().into_iter().find(|case| case.name == "auto-in-change-under-way").unwrap();
    let pending = case.query.pending.as_ref().unwrap();
    let k = pending.y_um.len();
    let mut follower = Follower::new(&read(&case.model), case.limits).unwrap();
    // The service evaluates the last one under way; before it, both only advance.
    follower.start(f64::NAN);
    follower.advance(&pending.y_um[..k - 1], &pending.u_v[..k - 1]).unwrap();
    let (v, a, dt) = (&case.query.v_um_per_s, &case.query.a_um_per_s2, follower.report().dt_s);
    let y: Vec<f64> = [&pending.y_um[k - 1..], &case.query.y_um].concat();
    // The memory does not depend on the velocity there.
    let v: Vec<f64> = [&[v[0] - a[0] * dt], &v[..]].concat();
    let a: Vec<f64> = [&a[..1], a].concat();
    let (mut u_v, mut std_v, mut flags) = (vec![0.0; y.len()], vec![0.0; y.len()], vec![0; y.len()]);
    let mut out = Out { u_v: &mut u_v, std_v: &mut std_v, flags: &mut flags };
    follower.block(&y, &v, &a, &mut out).unwrap();
    same("memory", follower.memory(), &case.reply.memory);
}

#[test]
fn changes_are_of_a_whole_model_and_a_missing_one_is_noticed() {
    let limits = Limits { u_min_v: 0.0, u_max_v: 10.0, slew_v_per_s: 2e3, y_min_um: -40.0, y_max_um: 140.0 };
    let query = read("deltas.query.payload");
    let steps = rows("deltas.txt");
    let mut follower = Follower::new(&read(&steps[0][2]), limits).unwrap();
    let publisher = follower.publisher();
    let mut answered = 0;
    for row in &steps[1..] {
        let got = publisher.update(&read(&row[2]));
        let outcome = match &got {
            Ok(Update::Taken) => "taken",
            Ok(Update::Lost) => "lost",
            Err(_) => "refused",
        };
        assert_eq!(outcome, row[3], "{}: {got:?}", row[0]);
        assert_eq!(format!("{:08x}", publisher.base()), row[4], "{}", row[0]);
        let reply = folder().join(format!("deltas-{}.reply.payload", row[0]));
        if let Ok(expected) = fs::read(reply) {
            let expected = Reply::decode(&expected).unwrap();
            let got = follower.reply(&query, None).unwrap();
            same(&format!("{} u_V", row[0]), &got.u_v, &expected.u_v);
            same(&format!("{} std_V", row[0]), &got.std_v, &expected.std_v);
            same(&format!("{} memory", row[0]), &got.memory, &expected.memory);
            assert_eq!(got.flags, expected.flags);
            assert_eq!(got.snapshot_seq.to_string(), row[5]);
            answered += 1;
        }
    }
    assert!(answered >= 7);
}

#[test]
fn no_damage_of_a_change_panics_and_none_of_its_head_is_taken() {
    let base = read("deltas-base.fetched.payload");
    let limits = Limits { u_min_v: 0.0, u_max_v: 10.0, slew_v_per_s: 2e3, y_min_um: -40.0, y_max_um: 140.0 };
    let whole = read("deltas-frame.change.payload");
    let publisher = Follower::new(&base, limits).unwrap().publisher();
    for end in (0..whole.len()).step_by(7) {
        assert!(publisher.update(&whole[..end]).is_err(), "cut to {end}");
    }
    for at in 0..whole.len() {
        let mut changed = whole.clone();
        changed[at] ^= 1 << (at % 8);
        // A number of the model may be another one: what is sent is signed, not summed.
        let update = publisher.update(&changed);
        assert!(at >= 24 || (8..16).contains(&at) || !matches!(update, Ok(Update::Taken)), "byte {at}");
    }
}

#[test]
fn samples_are_the_bytes_of_the_vector() {
    let column = |field: &str| -> Vec<f64> {
        let of = |row: &&Vec<String>| row[0] == "samples.payload" && row[1] == field;
        rows("payloads.txt").iter().filter(of).map(|row| row[3].parse().unwrap()).collect()
    };
    let seq: Vec<i64> = column("seq").iter().map(|number| *number as i64).collect();
    let [t_s, u_v, y_um] = ["t_s", "u_V", "y_um"].map(column);
    assert_eq!(samples(&seq, &t_s, &u_v, &y_um).unwrap(), read("samples.payload"));
    let refused = |error: dehyst::Result<Vec<u8>>, field: &str| assert_eq!(error.unwrap_err().field, field);
    refused(samples(&seq, &t_s, &u_v[1..], &y_um), "u_V");
    refused(samples(&[], &[], &[], &[]), "n");
    refused(samples(&[0; 65_537], &[0.0; 65_537], &[0.0; 65_537], &[0.0; 65_537]), "n");
    refused(samples(&[0, -1], &[0.0; 2], &[0.0; 2], &[0.0; 2]), "seq[1]");
    refused(samples(&[(1 << 62) + 1], &[0.0], &[0.0], &[0.0]), "seq[0]");
}

#[test]
fn malformed_payloads_are_refused_with_the_field_of_the_service() {
    let mut checked = 0;
    for row in rows("refused.txt") {
        let (payload, field) = (read(&row[0]), &row[2]);
        let error = match row[1].as_str() {
            "4" => Query::decode(&payload).map(drop).unwrap_err(),
            "6" => Snapshot::decode(&payload).map(drop).unwrap_err(),
            "7" => Delta::decode(&payload).map(drop).unwrap_err(),
            _ => continue, // this client sends samples and commands, and reads none
        };
        assert_eq!(&error.field, field, "{}", row[0]);
        checked += 1;
    }
    assert!(checked >= 15);
}

#[test]
fn no_cut_or_changed_payload_panics() {
    // Deterministic damage: every cut of a small payload, and bytes changed in turn.
    for name in ["linear.model.payload", "mpi.model.payload", "lssvm-bare.model.payload", "bouc_wen.model.payload"] {
        let whole = read(name);
        for end in 0..whole.len() {
            assert!(Snapshot::decode(&whole[..end]).is_err(), "{name} cut to {end}");
        }
        for at in 0..whole.len() {
            for value in [0, 0xff, whole[at] ^ 1, b'9'] {
                let mut changed = whole.clone();
                changed[at] = value;
                let limits =
                    Limits { u_min_v: 0.0, u_max_v: 10.0, slew_v_per_s: 2e3, y_min_um: -40.0, y_max_um: 140.0 };
                if let Ok(mut follower) = Follower::new(&changed, limits) {
                    if let Ok(point) = follower.point(40.0, 100.0, 0.0) {
                        assert!((0.0..=10.0).contains(&point.u_v), "{name} byte {at}");
                    }
                }
            }
        }
    }
}

#[test]
fn no_random_damage_of_a_large_payload_panics_or_leaves_the_limits() {
    let whole = read("auto-in-change.model.payload");
    let json = u32::from_le_bytes(whole[16..20].try_into().unwrap()) as usize;
    let limits = Limits { u_min_v: 0.0, u_max_v: 10.0, slew_v_per_s: 2e3, y_min_um: -40.0, y_max_um: 140.0 };
    let mut state = 20_u64;
    let mut next = |below: usize| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state % below as u64) as usize
    };
    let mut accepted = 0;
    for round in 0..1500 {
        let mut changed = whole.clone();
        for _ in 0..=next(3) {
            // Mostly in the header and its JSON; every third time anywhere.
            let at = if round % 3 == 0 { next(whole.len()) } else { next(24 + json) };
            changed[at] = if next(2) == 0 { next(256) as u8 } else { b"0123456789.-e,\"[]{}"[next(19)] };
        }
        let Ok(mut follower) = Follower::new(&changed, limits) else { continue };
        accepted += 1;
        for y in [40.0, 130.0, -30.0] {
            let point = follower.point(y, 1e3, 1e5).unwrap();
            assert!((0.0..=10.0).contains(&point.u_v), "round {round}: {point:?}");
        }
    }
    assert!(accepted > 200, "{accepted}");
}

#[test]
fn points_one_by_one_are_the_block() {
    let mut compared = 0;
    for case in cases() {
        let free = case.query.pending.is_none() && case.query.memory.is_none() && case.age_s.is_none();
        // With the stand-in, and in a change of champion, the page says how they differ.
        if !free || case.reply.flags.iter().any(|flags| flags & 48 != 0) || case.name.starts_with("auto-in-change") {
            continue;
        }
        let mut follower = Follower::new(&read(&case.model), case.limits).unwrap();
        follower.start(case.query.u_before_v);
        let q = &case.query;
        for i in 0..q.y_um.len() {
            let got = follower.point(q.y_um[i], q.v_um_per_s[i], q.a_um_per_s2[i]).unwrap();
            same(&format!("{} u_V of point {i}", case.name), &[got.u_v], &[case.reply.u_v[i]]);
            assert_eq!(got.flags, case.reply.flags[i], "{} point {i}", case.name);
        }
        same(&format!("{} memory", case.name), follower.memory(), &case.reply.memory);
        compared += 1;
    }
    assert!(compared > 15, "{compared}");
}

/// (model, settings of the integral, settings of the repetition) in the first line of a table.
fn corrections(table: &str) -> (String, Option<CorrectionSettings>, Option<CorrectionSettings>) {
    let text = String::from_utf8(read(table)).unwrap();
    let head: Vec<&str> = text.lines().next().unwrap().split_whitespace().collect();
    let settings = |at: usize| {
        let [share, mode_hz, fade_s] = [at, at + 1, at + 2].map(|at| head[at].parse::<f64>().unwrap());
        (!share.is_nan()).then_some(CorrectionSettings { share, mode_hz, fade_s })
    };
    (head[1].to_string(), settings(2), settings(5))
}

#[test]
fn corrections_are_those_of_the_follower_of_the_service() {
    let limits = Limits { u_min_v: 0.0, u_max_v: 10.0, slew_v_per_s: 2e3, y_min_um: -40.0, y_max_um: 140.0 };
    let number = |text: &str| text.parse::<f64>().unwrap();
    for table in ["correction.txt", "repetition.txt"] {
        let (model, integral, repetition) = corrections(table);
        let mut follower = Follower::new(&read(&model), limits).unwrap();
        follower.correct(integral, repetition).unwrap();
        let rows = rows(table);
        for row in &rows {
            let seq: i64 = row[0].parse().unwrap();
            if row[3] != "-" {
                follower.publisher().publish(&read(&row[3])).unwrap();
            }
            if row[4] != "-" {
                let stated = Some(number(&row[4])).filter(|period_s| !period_s.is_nan());
                follower.correcting().unwrap().repetition.as_mut().unwrap().state(stated).unwrap();
            }
            if row[5] != "-" {
                follower.read(&[row[5].parse().unwrap()], &[number(&row[6])]).unwrap();
            }
            follower.number(seq).unwrap();
            let got = follower.point(number(&row[1]), number(&row[2]), 0.0).unwrap();
            let correcting = follower.correcting().unwrap();
            let own = correcting.integral.as_ref().unwrap();
            let mut state =
                vec![correcting.age as f64, own.added.u_v, own.added.halved as f64, own.added.doubted as f64];
            state.extend(correcting.repetition.as_ref().map_or([0.0, 0.0, 0.0, f64::NAN, 0.0], |own| {
                let period = own.period.unwrap_or(f64::NAN);
                [
                    own.added.u_v,
                    own.added.halved as f64,
                    own.added.doubted as f64,
                    period,
                    f64::from(u8::from(own.active)),
                ]
            }));
            let expected: Vec<f64> = row[8..].iter().map(|text| number(text)).collect();
            same(&format!("{table}: u_V of {seq}"), &[got.u_v], &[number(&row[7])]);
            same(&format!("{table}: state after {seq}"), &state, &expected);
        }
        let most = |at: usize| rows.iter().map(|row| number(&row[at])).fold(0.0, f64::max);
        // The gain was halved, and readings were doubted, of what the table is of.
        let own = if repetition.is_some() { 13 } else { 10 };
        assert!(rows.len() >= 1000 && most(own) > 0.0 && most(own + 1) > 0.0, "{table}");
    }
}

#[test]
fn what_a_correction_cannot_use_is_refused_and_changes_nothing() {
    let limits = Limits { u_min_v: 0.0, u_max_v: 10.0, slew_v_per_s: 2e3, y_min_um: -40.0, y_max_um: 140.0 };
    let good = CorrectionSettings { share: 0.02, mode_hz: 200.0, fade_s: 0.05 };
    let mut follower = Follower::new(&read("lssvm.model.payload"), limits).unwrap();
    for (field, bad) in [
        ("share", CorrectionSettings { share: 0.0, ..good }),
        ("share", CorrectionSettings { share: 1.1, ..good }),
        ("mode_Hz", CorrectionSettings { mode_hz: f64::NAN, ..good }),
        ("fade_s", CorrectionSettings { fade_s: -1.0, ..good }),
    ] {
        assert_eq!(follower.correct(Some(bad), None).unwrap_err().field, format!("correction.{field}"));
        assert_eq!(follower.correct(Some(good), Some(bad)).unwrap_err().field, format!("repetition.{field}"));
        assert!(follower.correcting().is_none());
    }
    let endless = Limits { y_max_um: f64::INFINITY, ..limits };
    assert!(Follower::new(&read("lssvm.model.payload"), endless).unwrap().correct(Some(good), None).is_err());
    follower.correct(None, Some(good)).unwrap();
    let repetition = follower.correcting().unwrap().repetition.as_mut().unwrap();
    repetition.state(Some(0.1)).unwrap();
    for period_s in [0.0, -1.0, 1e-3, 10.0, f64::NAN] {
        assert_eq!(repetition.state(Some(period_s)).unwrap_err().field, "period_s");
        assert_eq!(repetition.period, Some(100.0));
    }
    follower.correct(Some(good), None).unwrap();
    assert_eq!(follower.number(-1).unwrap_err().field, "seq");
    assert_eq!(follower.read(&[1, 2], &[40.0]).unwrap_err().field, "y_um");
    assert_eq!(follower.read(&[1, 1], &[40.0, 40.0]).unwrap_err().field, "seq[1]");
    // Switched off, it goes to zero over fade_s, and a point without a number has none.
    let mut plain = Follower::new(&read("lssvm.model.payload"), limits).unwrap();
    let mut added = Vec::new();
    for k in 0..400_i64 {
        follower.number(k).unwrap();
        follower.read(&[k - 1], &[39.98]).unwrap();
        let correcting = follower.correcting().unwrap();
        correcting.on = k < 300;
        added.push(follower.point(40.0, 0.0, 0.0).unwrap().u_v - plain.point(40.0, 0.0, 0.0).unwrap().u_v);
    }
    assert!(added[299] > 1e-4, "{}", added[299]);
    assert!(added[325] > 0.0 && added[325] < added[299]);
    assert_eq!(added[399], 0.0);
}
