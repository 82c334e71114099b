//! One answer, safe to apply: docs/protocol.md, "Limits, stand-in and flags".

use crate::error::{Error, Result};
use crate::snapshot::Snapshot;
use crate::wire::{Query, Reply};

pub const LIMITED_VOLTAGE: u8 = 1;
pub const LIMITED_SLEW: u8 = 2;
pub const OUTSIDE_DOMAIN: u8 = 4;
pub const NOT_FINITE_REPLACED: u8 = 8;
pub const BLENDED: u8 = 16;
pub const STAND_IN: u8 = 32;
pub const STALE: u8 = 64;
pub const CORRECTED: u8 = 128;

/// Limits of one axis, as the status of the service has them; infinite where there is none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    pub u_min_v: f64,
    pub u_max_v: f64,
    pub slew_v_per_s: f64,
    pub y_min_um: f64,
    pub y_max_um: f64,
}

impl Limits {
    pub fn check(&self) -> Result<()> {
        if !(self.u_min_v.is_finite() && self.u_max_v.is_finite() && self.u_min_v < self.u_max_v) {
            let got = format!("{} to {}", self.u_min_v, self.u_max_v);
            return Err(Error::new("u_max_V", got, "finite limits, u_min_V < u_max_V"));
        }
        if self.slew_v_per_s.is_nan() || self.slew_v_per_s <= 0.0 {
            return Err(Error::new("slew_V_per_s", self.slew_v_per_s, "a positive slew limit in V/s"));
        }
        if self.y_min_um.is_nan() || self.y_max_um.is_nan() || self.y_min_um >= self.y_max_um {
            return Err(Error::new("y_max_um", self.y_max_um, "a limit above y_min_um"));
        }
        Ok(())
    }
}

/// Points of one evaluation, one sample time apart: `v` and `a` may be empty for 0.
#[derive(Clone, Copy)]
pub struct Motion<'a> {
    pub y_um: &'a [f64],
    pub v_um_per_s: &'a [f64],
    pub a_um_per_s2: &'a [f64],
}

impl Motion<'_> {
    fn at(&self, i: usize) -> [f64; 3] {
        let of = |values: &[f64]| values.get(i).copied().unwrap_or(0.0);
        [self.y_um[i], of(self.v_um_per_s), of(self.a_um_per_s2)]
    }

    /// That lengths fit, values are finite and positions within the limits of the axis.
    pub fn check(&self, limits: &Limits) -> Result<()> {
        let n = self.y_um.len();
        for (name, values) in [("v_um_per_s", self.v_um_per_s), ("a_um_per_s2", self.a_um_per_s2)] {
            if !values.is_empty() && values.len() != n {
                return Err(Error::new(name, format!("{} values", values.len()), format!("{n}, as many as y_um")));
            }
            if let Some(i) = values.iter().position(|value| !value.is_finite()) {
                return Err(Error::new(format!("{name}[{i}]"), values[i], "a finite number"));
            }
        }
        let within = |y: &f64| y.is_finite() && limits.y_min_um <= *y && *y <= limits.y_max_um;
        if let Some(i) = self.y_um.iter().position(|y| !within(y)) {
            let expected = format!("{} to {} µm", limits.y_min_um, limits.y_max_um);
            return Err(Error::new(format!("y_um[{i}]"), self.y_um[i], expected));
        }
        Ok(())
    }
}

/// Where the answer to n points goes.
pub struct Out<'a> {
    pub u_v: &'a mut [f64],
    pub std_v: &'a mut [f64],
    pub flags: &'a mut [u8],
}

/// What was done beside the voltages.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Done {
    /// The stand-in gave a share of a voltage.
    pub stand_in: bool,
    /// The model gave a value that is not finite, or is not trusted.
    pub fallback: bool,
}

/// The voltage and flags of one point; `before` NaN: none. From a `before` outside the limits the way back is a ramp.
pub fn limit_voltage(mut u_v: f64, before: f64, limits: &Limits, step_v: f64) -> (f64, u8) {
    let mut flags = 0;
    let known = before.is_finite();
    if !u_v.is_finite() {
        u_v = if known { before } else { 0.5 * (limits.u_min_v + limits.u_max_v) };
        flags |= NOT_FINITE_REPLACED;
    }
    if u_v < limits.u_min_v {
        (u_v, flags) = (limits.u_min_v, flags | LIMITED_VOLTAGE);
    } else if u_v > limits.u_max_v {
        (u_v, flags) = (limits.u_max_v, flags | LIMITED_VOLTAGE);
    }
    if known {
        if u_v > before + step_v {
            (u_v, flags) = (before + step_v, flags | LIMITED_SLEW);
        } else if u_v < before - step_v {
            (u_v, flags) = (before - step_v, flags | LIMITED_SLEW);
        }
    }
    (u_v, flags)
}

fn limit(out: &mut Out, u_before_v: f64, limits: &Limits, step_v: f64) {
    let mut before = u_before_v;
    for (u, flags) in out.u_v.iter_mut().zip(out.flags.iter_mut()) {
        let (safe, found) = limit_voltage(*u, before, limits, step_v);
        (*u, before) = (safe, safe);
        *flags |= found;
    }
}

/// Weight of the model by the distance of a point from its domain.
fn domain_weight(bounds: Option<&[(f64, f64); 3]>, point: [f64; 3], blend_share: f64) -> f64 {
    let Some(bounds) = bounds else { return 1.0 };
    let mut distance = 0.0f64;
    for ((low, high), x) in bounds.iter().zip(point) {
        let span = high - low;
        if span.is_finite() && span > 0.0 {
            distance = distance.max((low - x).max(x - high) / span);
        }
    }
    let s = (distance / blend_share).clamp(0.0, 1.0);
    1.0 - s * s * (3.0 - 2.0 * s)
}

/// Voltages for the points of `motion` from `memory` on, which advances. Neither locks nor allocates.
///
/// `age_s`: age of the newest sample, or None where no newer message is expected. `correct`: adds to the voltages of the
/// model, before the limits.
#[allow(clippy::too_many_arguments)]
pub fn answer(
    snapshot: &mut Snapshot,
    memory: &mut [f64],
    motion: &Motion,
    u_before_v: f64,
    limits: &Limits,
    age_s: Option<f64>,
    correct: impl FnOnce(&mut Out),
    out: &mut Out,
) -> Done {
    let (trust, stale) = snapshot.trust_by_age(age_s);
    let step_v = limits.slew_v_per_s * snapshot.model.dt_s;
    let done = forward(snapshot, memory, motion, trust, out);
    correct(out);
    limit(out, u_before_v, limits, step_v);
    if stale {
        out.flags.iter_mut().for_each(|flags| *flags |= STALE);
    }
    done
}

/// Voltages before any limit: of the model, blended with the stand-in.
fn forward(snapshot: &mut Snapshot, memory: &mut [f64], motion: &Motion, trust: f64, out: &mut Out) -> Done {
    let n = motion.y_um.len();
    let (mut finite, mut inside) = (true, true);
    let Snapshot { model, scratch, blends, blend_share, stand_in, other, .. } = snapshot;
    let advanced = model.evaluate(
        n,
        |i| motion.at(i),
        memory,
        scratch,
        |i, step| {
            (out.u_v[i], out.std_v[i]) = (step.u_v, step.std_v);
            out.flags[i] = if step.inside { 0 } else { OUTSIDE_DOMAIN };
            finite &= step.u_v.is_finite();
            inside &= step.inside;
        },
    );
    let trusted = !*blends || trust >= 1.0;
    let mut done = Done { stand_in: false, fallback: !finite || !advanced || !trusted };
    if finite && trusted && (inside || !*blends) {
        return done;
    }
    if let Some(stand_in) = stand_in {
        let bounds = model.domain();
        let (other_memory, other_scratch) = other;
        other_memory.copy_from_slice(&stand_in.memory);
        stand_in.model.evaluate(
            n,
            |i| motion.at(i),
            other_memory,
            other_scratch,
            |i, there| {
                let own_finite = out.u_v[i].is_finite();
                let mut w = 1.0;
                if *blends {
                    w = trust;
                    if out.flags[i] & OUTSIDE_DOMAIN != 0 {
                        w *= domain_weight(bounds, motion.at(i), *blend_share);
                    }
                }
                w = if own_finite { w } else { 0.0 };
                w = if there.u_v.is_finite() { w } else { 1.0 };
                if w == 1.0 {
                    out.flags[i] |= if own_finite { 0 } else { NOT_FINITE_REPLACED };
                    return;
                }
                let (own, own_std) = if own_finite { (out.u_v[i], out.std_v[i]) } else { (0.0, 0.0) };
                let square = |std: f64| if std.is_nan() { 0.0 } else { std * std };
                let apart = own - there.u_v;
                out.u_v[i] = there.u_v + w * apart;
                out.std_v[i] = if w == 0.0 {
                    there.std_v
                } else {
                    (w * square(own_std) + (1.0 - w) * square(there.std_v) + w * (1.0 - w) * apart * apart).sqrt()
                };
                out.flags[i] |= if w == 0.0 { STAND_IN } else { BLENDED };
                out.flags[i] |= if own_finite { 0 } else { NOT_FINITE_REPLACED };
                done.stand_in = true;
            },
        );
    } else {
        for (u, flags) in out.u_v.iter().zip(out.flags.iter_mut()) {
            *flags |= if u.is_finite() { 0 } else { NOT_FINITE_REPLACED };
        }
    }
    done
}

/// Velocities and accelerations that the last point under way may have been commanded with: from the first point of the
/// query by a polynomial of third order; by the straight line from the point before; by central differences.
fn last_motions(way_um: &[f64], y: f64, v: f64, a: f64, h: f64) -> Vec<(f64, f64)> {
    let k = way_um.len();
    let last = way_um[k - 1];
    let jerk = 6.0 * (y - v * h + 0.5 * a * (h * h) - last) / (h * h * h);
    let mut found = vec![(v - a * h + 0.5 * jerk * (h * h), a - jerk * h)];
    if k > 1 {
        found.push(((last - way_um[k - 2]) / h, 0.0));
    }
    if k > 2 {
        let centre = (last - way_um[k - 3]) / (2.0 * h);
        found.push(((y - way_um[k - 2]) / (2.0 * h), (v - centre) / (2.0 * h)));
    }
    found
}

/// The reply to a query as the service gives it from this snapshot. Allocates: not for a controller's loop.
pub fn reply(snapshot: &mut Snapshot, query: &Query, limits: &Limits, age_s: Option<f64>) -> Result<Reply> {
    limits.check()?;
    let motion = Motion { y_um: &query.y_um, v_um_per_s: &query.v_um_per_s, a_um_per_s2: &query.a_um_per_s2 };
    motion.check(limits)?;
    if !query.model.is_empty() && query.model != snapshot.model.name {
        return Err(Error::new("model", &query.model, format!("{:?}, or empty", snapshot.model.name)));
    }
    let mut memory = query.memory.clone().unwrap_or_else(|| snapshot.memory.clone());
    if memory.len() != snapshot.model.memory_size() {
        let expected = snapshot.model.memory_size().to_string();
        return Err(Error::new("memory", format!("{} values", memory.len()), expected));
    }
    let seen = |pending: &&crate::wire::Pending| pending.first + pending.y_um.len() as i64 > snapshot.snapshot_seq;
    let pending = query.pending.as_ref();
    if let Some(pending) = pending {
        Motion { y_um: &pending.y_um, v_um_per_s: &[], a_um_per_s2: &[] }
            .check(limits)
            .map_err(|error| Error { field: format!("pending.{}", error.field), ..error })?;
    }
    let n = query.y_um.len();
    let (mut u_v, mut std_v, mut flags);
    let done;
    if let Some(pending) = pending.filter(seen) {
        let k = pending.y_um.len();
        let left_out = (snapshot.snapshot_seq + 1 - pending.first).clamp(0, k as i64 - 1) as usize;
        let way = left_out..k - 1;
        let Snapshot { model, scratch, .. } = snapshot;
        model.advance(&pending.y_um[way.clone()], &pending.u_v[way], &mut memory, scratch);
        let dt_s = model.dt_s;
        let before = |first: f64, rest: &[f64]| [&[first], rest].concat();
        let (v, a) = (&query.v_um_per_s, &query.a_um_per_s2);
        let mut nearest = (f64::INFINITY, (0.0, 0.0));
        for (i, pair) in last_motions(&pending.y_um, query.y_um[0], v[0], a[0], dt_s).into_iter().enumerate() {
            let (mut then, mut u) = (memory.clone(), f64::NAN);
            model.evaluate(1, |_| [pending.y_um[k - 1], pair.0, pair.1], &mut then, scratch, |_, step| u = step.u_v);
            let error = (u - pending.u_v[k - 1]).abs();
            if i == 0 || error < nearest.0 {
                nearest = (if error.is_finite() { error } else { f64::INFINITY }, pair);
            }
        }
        let (last_v, last_a) = nearest.1;
        let (y, v, a) = (before(pending.y_um[k - 1], &query.y_um), before(last_v, v), before(last_a, a));
        let motion = Motion { y_um: &y, v_um_per_s: &v, a_um_per_s2: &a };
        (u_v, std_v, flags) = (vec![0.0; n + 1], vec![0.0; n + 1], vec![0; n + 1]);
        let mut out = Out { u_v: &mut u_v, std_v: &mut std_v, flags: &mut flags };
        let free = Limits { slew_v_per_s: f64::INFINITY, ..*limits };
        done = answer(snapshot, &mut memory, &motion, f64::NAN, &free, age_s, |_| {}, &mut out);
        let gap = pending.u_v[k - 1] - u_v[0];
        let fade = (0.006 / dt_s).max(6.0);
        u_v.remove(0);
        std_v.remove(0);
        flags.remove(0);
        for (i, u) in u_v.iter_mut().enumerate() {
            *u += gap * (-((i + 1) as f64) / fade).exp();
        }
        let mut out = Out { u_v: &mut u_v, std_v: &mut std_v, flags: &mut flags };
        limit(&mut out, query.u_before_v, limits, limits.slew_v_per_s * dt_s);
    } else {
        (u_v, std_v, flags) = (vec![0.0; n], vec![0.0; n], vec![0; n]);
        let mut out = Out { u_v: &mut u_v, std_v: &mut std_v, flags: &mut flags };
        done = answer(snapshot, &mut memory, &motion, query.u_before_v, limits, age_s, |_| {}, &mut out);
    }
    let stand_in = snapshot.stand_in.as_ref().filter(|_| done.stand_in).map(|other| other.model.name.clone());
    Ok(Reply {
        behind: false,
        tracked_memory: query.memory.is_none(),
        fallback: done.fallback,
        snapshot_seq: snapshot.snapshot_seq,
        u_v,
        std_v,
        memory,
        flags,
        model: snapshot.model.name.clone(),
        stand_in: stand_in.unwrap_or_default(),
    })
}
