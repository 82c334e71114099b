//! The models of docs/protocol.md ("Evaluating a model"): one point at a time, without allocation.
//!
//! An evaluation is `begin`, one `step` a point, `end`. The caller owns memory and scratch.

use crate::error::{Error, Result};
use crate::json::Value;
use crate::kernel::{blocks, Quadratic, Samples, LANES};
use crate::wire::{Array, Delta};
use std::collections::HashMap;

/// What a model gives for one point.
#[derive(Clone, Copy, Debug, Default)]
pub struct Step {
    pub u_v: f64,
    /// NaN where the model does not state it.
    pub std_v: f64,
    pub inside: bool,
}

// --- Values and arrays of a payload, under a prefix.

/// Where a model finds its parameters.
#[derive(Clone, Copy)]
pub struct Entries<'a> {
    pub values: &'a Value,
    pub arrays: &'a HashMap<String, Array>,
    /// Of names of values and of names of arrays.
    pub prefixes: (&'a str, &'a str),
}

impl Entries<'_> {
    fn value(&self, name: &str) -> Option<&Value> {
        self.values.get(&format!("{}{name}", self.prefixes.0))
    }

    fn missing(&self, name: &str) -> Error {
        Error::new(format!("{}{name}", self.prefixes.0), "nothing", "an entry of the model")
    }

    fn array(&self, name: &str) -> Option<&Array> {
        self.arrays.get(&format!("{}{name}", self.prefixes.1))
    }

    fn number(&self, name: &str) -> Result<f64> {
        let found = self.value(name).and_then(Value::number);
        let scalar = self.array(name).filter(|array| array.shape.is_empty()).map(|array| array.values[0]);
        found.or(scalar).ok_or_else(|| self.missing(name))
    }

    fn finite(&self, name: &str) -> Result<f64> {
        let value = self.number(name)?;
        if !value.is_finite() {
            return Err(Error::new(name, value, "a finite number"));
        }
        Ok(value)
    }

    fn positive(&self, name: &str) -> Result<f64> {
        let value = self.finite(name)?;
        if value <= 0.0 {
            return Err(Error::new(name, value, "a number above 0"));
        }
        Ok(value)
    }

    fn flag(&self, name: &str) -> Result<bool> {
        Ok(self.number(name)? != 0.0)
    }

    fn text(&self, name: &str) -> Result<&str> {
        self.value(name).and_then(Value::text).ok_or_else(|| self.missing(name))
    }

    fn vector(&self, name: &str) -> Result<Vec<f64>> {
        let array = self.array(name).ok_or_else(|| self.missing(name))?;
        if array.values.iter().any(|value| !value.is_finite()) {
            return Err(Error::new(name, "NaN or infinity", "finite numbers"));
        }
        Ok(array.values.clone())
    }

    fn vector_of(&self, name: &str, n: usize) -> Result<Vec<f64>> {
        let values = self.vector(name)?;
        if values.len() != n {
            return Err(Error::new(name, format!("{} values", values.len()), n.to_string()));
        }
        Ok(values)
    }

    fn ascending(&self, name: &str) -> Result<Vec<f64>> {
        let values = self.vector(name)?;
        if values.first().is_some_and(|first| *first <= 0.0) || values.windows(2).any(|pair| pair[0] >= pair[1]) {
            return Err(Error::new(name, format!("{values:?}"), "positive values in ascending order"));
        }
        Ok(values)
    }
}

/// Range of y and v in which a baseline was identified.
#[derive(Clone, Debug)]
struct Range {
    y_min_um: f64,
    y_max_um: f64,
    v_max_um_per_s: f64,
}

impl Range {
    fn new(entries: &Entries) -> Result<Range> {
        Ok(Range {
            y_min_um: entries.number("y_min_um")?,
            y_max_um: entries.number("y_max_um")?,
            v_max_um_per_s: entries.number("v_max_um_per_s")?,
        })
    }

    fn holds(&self, y: f64, v: f64) -> bool {
        self.y_min_um <= y && y <= self.y_max_um && v.abs() <= self.v_max_um_per_s
    }
}

// --- linear

#[derive(Clone, Debug)]
pub struct Linear {
    gain_um_per_v: f64,
    offset_um: f64,
    std_v: f64,
    range: Range,
}

impl Linear {
    fn new(entries: &Entries) -> Result<Linear> {
        let gain_um_per_v = entries.finite("gain_um_per_V")?;
        if gain_um_per_v == 0.0 {
            return Err(Error::new("gain_um_per_V", gain_um_per_v, "a finite value other than 0"));
        }
        let (offset_um, std_v) = (entries.finite("offset_um")?, entries.number("voltage_std_V")?);
        Ok(Linear { gain_um_per_v, offset_um, std_v, range: Range::new(entries)? })
    }

    fn step(&self, y: f64) -> Step {
        let u_v = (y - self.offset_um) / self.gain_um_per_v;
        Step { u_v, std_v: self.std_v, inside: self.range.holds(y, 0.0) }
    }
}

// --- lssvm

#[derive(Clone, Debug)]
pub struct Lssvm {
    pub gain: f64,
    pub offset_um: f64,
    dead_um: f64,
    thresholds_um: Vec<f64>,
    arc_lengths_um: Vec<f64>,
    /// exp(-dt/τ) of the slow states.
    retain: Vec<f64>,
    kernel_plays: Vec<usize>,
    linear: bool,
    asymmetric: bool,
    centre_um: f64,
    half_um: f64,
    v_scale: f64,
    a_scale: f64,
    beta: Vec<f64>,
    widths: Vec<f64>,
    samples: Samples,
    covariance: Quadratic,
    anchor: Vec<f64>,
    allowed_v: f64,
    noise_variance: f64,
    kernel_variance: f64,
    shrink: f64,
    /// Bounds of y, v and a with their margins.
    pub domain: [(f64, f64); 3],
}

/// Bounds within which a point counts as inside, from the learnt range of y, v and a.
fn with_margins(learnt: &[f64]) -> [(f64, f64); 3] {
    std::array::from_fn(|i| {
        let (low, high) = (learnt[2 * i], learnt[2 * i + 1]);
        (low - 0.05 * (high - low), high + 0.05 * (high - low))
    })
}

impl Lssvm {
    fn new(entries: &Entries, dt_s: f64) -> Result<Lssvm> {
        let of = |name: &str| format!("features.{name}");
        let thresholds_um = entries.ascending(&of("thresholds_um"))?;
        let arc_lengths_um = entries.ascending(&of("arc_lengths_um"))?;
        let time_constants_s = entries.ascending(&of("time_constants_s"))?;
        let mut kernel_plays = Vec::new();
        for play in entries.vector(&of("kernel_plays"))? {
            if !(play >= 0.0 && play < thresholds_um.len() as f64) {
                return Err(Error::new("features.kernel_plays", play, format!("below {}", thresholds_um.len())));
            }
            kernel_plays.push(play as usize);
        }
        let (linear, asymmetric) = (entries.flag(&of("linear"))?, entries.flag(&of("asymmetric"))?);
        let (k, d) = (thresholds_um.len(), 2 + kernel_plays.len());
        let others = arc_lengths_um.len() + time_constants_s.len();
        let p = if linear { 6 + k * (1 + usize::from(asymmetric)) + others } else { 1 };
        let (y_min, y_max) = (entries.finite(&of("y_min_um"))?, entries.finite(&of("y_max_um"))?);
        if y_min >= y_max {
            return Err(Error::new("features.y_max_um", y_max, "a number above y_min_um"));
        }
        let alpha = entries.vector("alpha")?;
        let support = entries.vector_of("support", alpha.len() * d)?;
        let widths = entries.vector_of("widths", d)?;
        if let Some(width) = widths.iter().find(|width| **width <= 0.0) {
            return Err(Error::new("widths", width, "positive widths"));
        }
        let covariance = entries.array("beta_covariance").ok_or_else(|| entries.missing("beta_covariance"))?;
        if covariance.shape != [0, 0] && covariance.shape != [p, p] {
            return Err(Error::new("beta_covariance", format!("{:?}", covariance.shape), format!("[{p}, {p}]")));
        }
        // A payload of an earlier version has no bound.
        let anchor = if entries.array("anchor").is_some() { entries.vector("anchor")? } else { Vec::new() };
        if !anchor.is_empty() && anchor.len() != p {
            return Err(Error::new("anchor", format!("{} values", anchor.len()), format!("{p}, or none")));
        }
        let allowed_v = if anchor.is_empty() { 0.0 } else { entries.finite("allowed_V")? };
        let half_um = 0.5 * (y_max - y_min);
        Ok(Lssvm {
            gain: entries.positive(&of("gain"))?,
            offset_um: entries.finite(&of("offset_um"))?,
            dead_um: entries.finite(&of("dead_um"))?,
            retain: time_constants_s.iter().map(|tau| (-dt_s / tau).exp()).collect(),
            thresholds_um,
            arc_lengths_um,
            kernel_plays,
            linear,
            asymmetric,
            centre_um: y_min + half_um,
            half_um,
            v_scale: entries.positive(&of("v_scale_um_per_s"))?,
            a_scale: entries.positive(&of("a_scale_um_per_s2"))?,
            beta: entries.vector_of("beta", p)?,
            samples: Samples::new(&support, &widths, &alpha),
            widths,
            covariance: Quadratic::new(&covariance.values, p),
            anchor,
            allowed_v,
            noise_variance: entries.finite("noise_variance")?,
            kernel_variance: entries.finite("kernel_variance")?,
            shrink: 1.0 / (1.0 + 1.0 / entries.positive("gamma")?),
            domain: with_margins(&entries.vector_of("domain", 6)?),
        })
    }

    fn moved(&self, delta: &Delta) -> Result<Lssvm> {
        if delta.beta.len() != self.beta.len() {
            return Err(Error::new("n", delta.beta.len(), format!("{}, as the whole model has", self.beta.len())));
        }
        if delta.gain <= 0.0 || delta.noise_variance < 0.0 {
            let got = format!("{}, {}", delta.gain, delta.noise_variance);
            return Err(Error::new("gain, noise_variance", got, "above 0, and at least 0"));
        }
        Ok(Lssvm {
            gain: delta.gain,
            offset_um: delta.offset_um,
            noise_variance: delta.noise_variance,
            beta: delta.beta.clone(),
            domain: with_margins(&delta.domain),
            ..self.clone()
        })
    }

    fn memory_size(&self) -> usize {
        let arcs = self.arc_lengths_um.len();
        self.thresholds_um.len() + arcs + self.retain.len() + usize::from(arcs > 0)
    }

    fn scratch_size(&self) -> usize {
        blocks(self.beta.len()) * LANES + self.widths.len()
    }

    /// Frame and memory; returns the displacement in the frame.
    #[inline]
    fn advance(&self, y_um: f64, memory: &mut [f64]) -> f64 {
        let q = (y_um - self.offset_um) / self.gain;
        let (plays, rest) = memory.split_at_mut(self.thresholds_um.len());
        let (arcs, rest) = rest.split_at_mut(self.arc_lengths_um.len());
        let (slow, path) = rest.split_at_mut(self.retain.len());
        for (m, r) in plays.iter_mut().zip(&self.thresholds_um) {
            *m = (q - r).max((q + r).min(*m));
        }
        if let Some(z) = path.first_mut() {
            let before = *z;
            *z = (q - self.dead_um).max((q + self.dead_um).min(before));
            let path_um = (*z - before).abs();
            // Most points of a slow motion are within the dead band, or the exponential is of 0.
            if path_um > 0.0 {
                for (m, rho) in arcs.iter_mut().zip(&self.arc_lengths_um) {
                    *m = q + (*m - q) * (-path_um / rho).exp();
                }
            }
        }
        for (m, retain) in slow.iter_mut().zip(&self.retain) {
            *m = q + (*m - q) * retain;
        }
        q
    }

    fn step(&self, y_um: f64, v: f64, a: f64, memory: &mut [f64], scratch: &mut [f64]) -> Step {
        let q = self.advance(y_um, memory);
        let p = self.beta.len();
        let (basis, scaled) = scratch.split_at_mut(blocks(p) * LANES);
        let yn = (q - self.centre_um) / self.half_um;
        let vn = v / self.gain / self.v_scale;
        let (plays, others) = memory.split_at(self.thresholds_um.len());
        basis[0] = 1.0;
        if self.linear {
            basis[1..6].copy_from_slice(&[yn, vn, a / self.gain / self.a_scale, yn * yn, yn * yn * yn]);
            let mut at = 6;
            for (m, r) in plays.iter().zip(&self.thresholds_um) {
                basis[at] = (q - m) / r;
                at += 1;
            }
            if self.asymmetric {
                for i in 0..plays.len() {
                    basis[at] = basis[6 + i] * yn;
                    at += 1;
                }
            }
            let (arcs, others) = others.split_at(self.arc_lengths_um.len());
            for (m, rho) in arcs.iter().zip(&self.arc_lengths_um) {
                basis[at] = (q - m) / rho;
                at += 1;
            }
            for m in &others[..self.retain.len()] {
                basis[at] = (q - m) / self.half_um;
                at += 1;
            }
        }
        scaled[0] = yn / self.widths[0];
        scaled[1] = vn / self.widths[1];
        for (i, play) in self.kernel_plays.iter().enumerate() {
            scaled[2 + i] = (q - plays[*play]) / self.thresholds_um[*play] / self.widths[2 + i];
        }
        let (kernel, nearest) = self.samples.sum(scaled);
        let mut u_v = dot(&self.beta, &basis[..p]) + kernel;
        if !self.anchor.is_empty() {
            let known = dot(&self.anchor, &basis[..p]);
            u_v = u_v.max(known - self.allowed_v).min(known + self.allowed_v);
        }
        basis[p..].fill(0.0);
        // Blocks of the basis: it is a multiple of LANES long.
        let (whole, _) = basis.as_chunks_of_lanes();
        let variance = self.noise_variance
            + self.covariance.form(whole)
            + self.kernel_variance * (1.0 - self.shrink * nearest * nearest);
        let inside = self.domain.iter().zip([y_um, v, a]).all(|((low, high), x)| *low <= x && x <= *high);
        Step { u_v, std_v: if variance > 0.0 { variance.sqrt() } else { variance.max(0.0) }, inside }
    }
}

/// A slice as whole blocks of `LANES`, and the rest.
trait AsChunks {
    fn as_chunks_of_lanes(&self) -> (&[[f64; LANES]], &[f64]);
}

impl AsChunks for [f64] {
    fn as_chunks_of_lanes(&self) -> (&[[f64; LANES]], &[f64]) {
        let (whole, rest) = self.split_at(self.len() / LANES * LANES);
        // SAFETY: `whole` has that many complete arrays, which have the alignment of their elements.
        (unsafe { std::slice::from_raw_parts(whole.as_ptr().cast(), whole.len() / LANES) }, rest)
    }
}

pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut lanes = [0.0; 4];
    let (a4, b4) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = a4.remainder().iter().zip(b4.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in a4.zip(b4) {
        for l in 0..4 {
            lanes[l] += x[l] * y[l];
        }
    }
    (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]) + rest
}

// --- bouc_wen

/// Below this rate, 1/V, a line replaces the exponential.
const FLAT: f64 = 1e-7;

#[derive(Clone, Debug)]
pub struct BoucWen {
    per_um: f64,
    offset_um: f64,
    lag_s: f64,
    inertia_s2: f64,
    alpha: f64,
    beta: f64,
    gamma: f64,
    std_v: f64,
    range: Range,
}

impl BoucWen {
    fn new(entries: &Entries, dt_s: f64) -> Result<BoucWen> {
        let (m, b, k) = (entries.positive("m_kg")?, entries.positive("b_N_s_per_m")?, entries.positive("k_N_per_m")?);
        let (alpha, beta, gamma) =
            (entries.finite("alpha")?, entries.finite("beta_per_V")?, entries.finite("gamma_per_V")?);
        let rises =
            (0.0..1.0).contains(&alpha) && beta >= 0.0 && beta + gamma > 0.0 && 2.0 * alpha * beta < beta + gamma;
        if !rises {
            let expected = "0 <= alpha < 1, beta >= 0, 2 alpha beta < beta + gamma";
            return Err(Error::new("alpha, beta_per_V, gamma_per_V", format!("{alpha}, {beta}, {gamma}"), expected));
        }
        let ahead = match entries.text("hold")? {
            "linear" => 0.0,
            "zero_order" => 0.5 * dt_s,
            other => return Err(Error::new("hold", other, "linear or zero_order")),
        };
        let lag = b / k;
        Ok(BoucWen {
            per_um: 1.0 / entries.positive("d_um_per_V")?,
            offset_um: entries.finite("offset_um")?,
            lag_s: lag + ahead,
            inertia_s2: m / k + lag * ahead + 0.5 * ahead * ahead,
            alpha,
            beta,
            gamma,
            std_v: entries.number("voltage_std_V")?,
            range: Range::new(entries)?,
        })
    }

    fn begin(&self, memory: &mut [f64]) {
        let bound = self.alpha / (self.beta + self.gamma);
        memory[1] = memory[1].min(bound).max(-bound);
    }

    fn step(&self, y: f64, v: f64, a: f64, memory: &mut [f64]) -> Step {
        let w = (y - self.offset_um + self.lag_s * v + self.inertia_s2 * a) * self.per_um;
        if !w.is_finite() {
            return Step { u_v: f64::NAN, std_v: self.std_v, inside: false };
        }
        let u_v = self.root(w, memory[0], memory[1]);
        self.advance(u_v, memory);
        Step { u_v, std_v: self.std_v, inside: self.range.holds(y, v) }
    }

    fn advance(&self, u_v: f64, memory: &mut [f64]) {
        memory[1] = self.hysteresis(memory[1], u_v - memory[0]);
        memory[0] = u_v;
    }

    fn grow(&self, q: f64, s: f64, rate: f64) -> f64 {
        if rate.abs() < FLAT {
            return q + self.alpha * s;
        }
        q - (q - self.alpha / rate) * -(-rate * s).exp_m1()
    }

    /// Change s of the voltage until q < 0 has grown to zero; infinite where it never does.
    fn crossing(&self, q: f64, rate: f64) -> f64 {
        if rate.abs() < FLAT {
            return if self.alpha > 0.0 { -q / self.alpha } else { f64::INFINITY };
        }
        if self.alpha <= 0.0 || -q * rate / self.alpha <= -1.0 {
            return f64::INFINITY;
        }
        (-q * rate / self.alpha).ln_1p() / rate
    }

    /// Hysteresis after a change `rise` of the voltage in one direction.
    fn hysteresis(&self, g: f64, rise: f64) -> f64 {
        let mut s = rise.abs();
        if s == 0.0 {
            return g;
        }
        let sign = if rise > 0.0 { 1.0 } else { -1.0 };
        let mut q = sign * g;
        if q < 0.0 {
            let s0 = self.crossing(q, self.beta - self.gamma);
            if s < s0 {
                return sign * self.grow(q, s, self.beta - self.gamma);
            }
            (q, s) = (0.0, s - s0);
        }
        sign * self.grow(q, s, self.beta + self.gamma)
    }

    /// The voltage u with u - g(u) = w on the branch that leaves (u0, g0).
    fn root(&self, w: f64, u0: f64, g0: f64) -> f64 {
        let rise = w - (u0 - g0);
        let sign = if rise > 0.0 { 1.0 } else { -1.0 };
        let (mut target, mut q, mut s) = (rise.abs(), sign * g0, 0.0);
        if q < 0.0 {
            let s0 = self.crossing(q, self.beta - self.gamma);
            if target < s0 + q {
                return u0 + sign * self.solve(q, target, self.beta - self.gamma);
            }
            (s, target, q) = (s0, target - (s0 + q), 0.0);
        }
        u0 + sign * (s + self.solve(q, target, self.beta + self.gamma))
    }

    /// Root s >= 0 of s - (q(s) - q) = target. From the first tangent on, Newton's method stays on one side.
    fn solve(&self, q: f64, target: f64, rate: f64) -> f64 {
        if rate.abs() < FLAT {
            return target / (1.0 - self.alpha);
        }
        let span = q - self.alpha / rate;
        let mut s = target / (1.0 - self.alpha + rate * q);
        for _ in 0..60 {
            let shrink = (-rate * s).exp_m1();
            let step = (s - span * shrink - target) / (1.0 + span * rate * (shrink + 1.0));
            s -= step;
            if step.abs() <= 1e-15 * (1.0 + s) {
                break;
            }
        }
        s.max(0.0)
    }
}

// --- mpi

#[derive(Clone, Debug)]
pub struct Mpi {
    r_v: Vec<f64>,
    w_h: Vec<f64>,
    /// Partial sums of w_h, thresholds and weights of the inverse plays.
    sums: Vec<f64>,
    r_star: Vec<f64>,
    w_star: Vec<f64>,
    /// Thresholds and weights of the inverse dead zones.
    d_star: Vec<f64>,
    ws_star: Vec<f64>,
    c_um: f64,
    y_ref_um: f64,
    lag_s: f64,
    std_v: f64,
    range: Range,
}

/// (partial sums, thresholds, weights) of the inverse of an operator.
fn inverse_of(weights: &[f64], thresholds: &[f64]) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let (mut sum, mut moment) = (0.0, 0.0);
    let (mut sums, mut r_star, mut w_star) = (Vec::new(), Vec::new(), Vec::new());
    for (i, (w, r)) in weights.iter().zip(thresholds).enumerate() {
        let before = sum;
        sum += w;
        moment += w * r;
        sums.push(sum);
        r_star.push(sum * r - moment);
        w_star.push(if i == 0 { 1.0 / w } else { -w / (sum * before) });
    }
    (sums, r_star, w_star)
}

impl Mpi {
    fn new(entries: &Entries) -> Result<Mpi> {
        let operator = |thresholds: &str, weights: &str| -> Result<(Vec<f64>, Vec<f64>)> {
            let r = entries.vector(thresholds)?;
            if r.first() != Some(&0.0) || r.windows(2).any(|pair| pair[0] >= pair[1]) {
                return Err(Error::new(thresholds, format!("{r:?}"), "ascending values from 0"));
            }
            let w = entries.vector_of(weights, r.len())?;
            let mut sum = 0.0;
            if w.iter().any(|w| {
                sum += w;
                sum <= 0.0
            }) {
                return Err(Error::new(weights, format!("{w:?}"), "partial sums above 0"));
            }
            Ok((r, w))
        };
        let (r_v, w_h) = operator("r_V", "w_h")?;
        let (d_um, w_s) = operator("d_um", "w_s")?;
        let (sums, r_star, w_star) = inverse_of(&w_h, &r_v);
        let (_, d_star, ws_star) = inverse_of(&w_s, &d_um);
        Ok(Mpi {
            r_v,
            w_h,
            sums,
            r_star,
            w_star,
            d_star,
            ws_star,
            c_um: entries.finite("c_um")?,
            y_ref_um: entries.finite("y_ref_um")?,
            lag_s: entries.finite("lag_s")?,
            std_v: entries.number("voltage_std_V")?,
            range: Range::new(entries)?,
        })
    }

    /// `state`, scratch of the size of the memory: the states of the inverse plays.
    fn begin(&self, memory: &[f64], state: &mut [f64]) {
        let mut tail: f64 = self.w_h.iter().zip(memory).map(|(w, z)| w * z).sum();
        for i in 0..memory.len() {
            tail -= self.w_h[i] * memory[i];
            state[i] = self.sums[i] * memory[i] + tail;
        }
    }

    fn step(&self, y: f64, v: f64, state: &mut [f64]) -> Step {
        let x = y - self.y_ref_um + self.lag_s * v;
        if !x.is_finite() {
            return Step { u_v: f64::NAN, std_v: self.std_v, inside: false };
        }
        let mut p = -self.c_um;
        for (d, w) in self.d_star.iter().zip(&self.ws_star) {
            p += w * if *d > 0.0 { (x - d).max(0.0) } else { x };
        }
        let mut u_v = 0.0;
        for ((z, r), w) in state.iter_mut().zip(&self.r_star).zip(&self.w_star) {
            *z = (p - r).max((p + r).min(*z));
            u_v += w * *z;
        }
        Step { u_v, std_v: self.std_v, inside: self.range.holds(y, v) }
    }

    fn end(&self, memory: &mut [f64], state: &[f64]) {
        let last = memory.len() - 1;
        memory[last] = state[last] / self.sums[last];
        for i in (0..last).rev() {
            memory[i] = memory[i + 1] + (state[i] - state[i + 1]) / self.sums[i];
        }
    }

    fn advance(&self, u_v: f64, memory: &mut [f64]) {
        for (z, r) in memory.iter_mut().zip(&self.r_v) {
            *z = (u_v - r).max((u_v + r).min(*z));
        }
    }
}

// --- champion

#[derive(Clone, Debug)]
pub struct Champion {
    pub names: Vec<String>,
    models: Vec<Kind>,
    pub champion: usize,
    blend_s: f64,
    dt_s: f64,
    /// Where each contestant's memory and scratch begin, and the ends of the last.
    memories: Vec<usize>,
    scratches: Vec<usize>,
}

impl Champion {
    fn new(entries: &Entries, dt_s: f64) -> Result<Champion> {
        let names: Vec<String> = entries.text("names")?.split(',').map(String::from).collect();
        let kinds: Vec<&str> = entries.text("kinds")?.split(',').collect();
        let champion = entries.finite("champion")?;
        if kinds.len() != names.len() || !(champion >= 0.0 && champion < names.len() as f64 && champion.fract() == 0.0)
        {
            let got = format!("{} names, {} kinds, {champion}", names.len(), kinds.len());
            return Err(Error::new("names, kinds, champion", got, "one kind a name, and the index of one of them"));
        }
        let blend_s = entries.finite("blend_s")?;
        if blend_s < 0.0 {
            return Err(Error::new("blend_s", blend_s, "at least 0 s"));
        }
        let k = names.len();
        // Scratch: shares at the start, weights, whether each answers, and what each said; then the parts.
        let (mut memories, mut scratches, mut models) = (vec![k], vec![5 * k + 1], Vec::new());
        for (name, kind) in names.iter().zip(kinds) {
            if kind == "champion" {
                return Err(Error::new("kinds", kind, "contestants of another kind"));
            }
            let prefixes = (format!("{}{name}.", entries.prefixes.0), format!("{}{name}.", entries.prefixes.1));
            let own = Entries { prefixes: (&prefixes.0, &prefixes.1), ..*entries };
            let model = Kind::new(kind, &own, dt_s)?;
            memories.push(memories[memories.len() - 1] + model.memory_size());
            scratches.push(scratches[scratches.len() - 1] + model.scratch_size() + model.memory_size());
            models.push(model);
        }
        Ok(Champion { names, models, champion: champion as usize, blend_s, dt_s, memories, scratches })
    }

    pub fn served(&self) -> &Kind {
        &self.models[self.champion]
    }

    fn moved(&self, delta: &Delta) -> Result<Champion> {
        let mut after = self.clone();
        after.models[self.champion] = self.served().moved(delta)?;
        Ok(after)
    }

    /// Weights at point i, from 1 on, from `shares` at the start.
    fn weights(&self, shares: &[f64], i: f64, weights: &mut [f64]) {
        let s = shares[self.champion];
        let w = if s >= 1.0 || self.blend_s <= 0.0 { 1.0 } else { (s + i * (self.dt_s / self.blend_s)).min(1.0) };
        let others = if s >= 1.0 || self.blend_s <= 0.0 { 0.0 } else { (1.0 - w) / (1.0 - s) };
        for (j, (weight, share)) in weights.iter_mut().zip(shares).enumerate() {
            *weight = if j == self.champion { w } else { others * share };
        }
    }

    /// Shares in a memory, made to sum to 1; those that are no shares become the champion's.
    fn shares(&self, memory: &[f64], shares: &mut [f64]) {
        let own = &memory[..self.models.len()];
        let total: f64 = own.iter().sum();
        if own.iter().all(|s| s.is_finite() && *s >= 0.0) && total > 0.0 {
            for (share, s) in shares.iter_mut().zip(own) {
                *share = if total == 1.0 { *s } else { s / total };
            }
        } else {
            shares.fill(0.0);
            shares[self.champion] = 1.0;
        }
    }

    fn begin(&self, memory: &mut [f64], scratch: &mut [f64]) {
        let k = self.models.len();
        let (head, _) = scratch.split_at_mut(5 * k + 1);
        head.fill(0.0);
        self.shares(memory, &mut head[1..=k]);
        for (j, model) in self.models.iter().enumerate() {
            let answers = j == self.champion || scratch[1 + j] > 0.0;
            scratch[1 + 2 * k + j] = f64::from(u8::from(answers));
            let part = &mut memory[self.memories[j]..self.memories[j + 1]];
            let (backup, own) = scratch[self.scratches[j]..self.scratches[j + 1]].split_at_mut(model.memory_size());
            backup.copy_from_slice(part);
            if answers {
                model.begin(part, own);
            }
        }
    }

    fn step(&self, y: f64, v: f64, a: f64, memory: &mut [f64], scratch: &mut [f64]) -> Step {
        let k = self.models.len();
        let (head, parts) = scratch.split_at_mut(5 * k + 1);
        let (count, head) = head.split_at_mut(1);
        let (shares, head) = head.split_at_mut(k);
        let (weights, head) = head.split_at_mut(k);
        let (answers, said) = head.split_at_mut(k);
        count[0] += 1.0;
        self.weights(shares, count[0], weights);
        let (mut answering, mut inside) = (0, true);
        let mut served = Step::default();
        for (j, model) in self.models.iter().enumerate() {
            if answers[j] == 0.0 {
                continue;
            }
            let part = &mut memory[self.memories[j]..self.memories[j + 1]];
            let start = self.scratches[j] - (5 * k + 1) + model.memory_size();
            let end = self.scratches[j + 1] - (5 * k + 1);
            let step = model.step(y, v, a, part, &mut parts[start..end]);
            answering += 1;
            inside &= step.inside || weights[j] <= 0.0;
            (said[j], said[k + j]) = (step.u_v, step.std_v);
            if j == self.champion {
                served = step;
            }
        }
        let mut out = served;
        if answering > 1 {
            let of = |said: f64| if said.is_finite() { said } else { served.u_v };
            let answering = || (0..k).filter(|j| answers[*j] != 0.0);
            out.u_v = answering().map(|j| weights[j] * of(said[j])).sum();
            let weighing = answering().filter(|j| weights[*j] > 0.0);
            let variance: f64 =
                weighing.map(|j| weights[j] * (said[k + j].powi(2) + (of(said[j]) - out.u_v).powi(2))).sum();
            (out.std_v, out.inside) = (variance.sqrt(), inside);
        }
        for (j, model) in self.models.iter().enumerate() {
            if answers[j] == 0.0 {
                model.advance(y, out.u_v, &mut memory[self.memories[j]..self.memories[j + 1]]);
            }
        }
        out
    }

    fn end(&self, memory: &mut [f64], scratch: &mut [f64]) {
        let k = self.models.len();
        for (j, model) in self.models.iter().enumerate() {
            let answered = scratch[1 + 2 * k + j] != 0.0;
            let part = &mut memory[self.memories[j]..self.memories[j + 1]];
            let (backup, own) = scratch[self.scratches[j]..self.scratches[j + 1]].split_at_mut(model.memory_size());
            if answered {
                model.end(part, own);
            }
            if !part.iter().all(|value| value.is_finite()) {
                part.copy_from_slice(backup);
            }
        }
        memory[..k].copy_from_slice(&scratch[1 + k..1 + 2 * k]);
    }

    fn advance(&self, y_um: &[f64], u_v: &[f64], memory: &mut [f64], scratch: &mut [f64]) {
        let k = self.models.len();
        if y_um.is_empty() {
            return;
        }
        for (j, model) in self.models.iter().enumerate() {
            let part = &mut memory[self.memories[j]..self.memories[j + 1]];
            let backup = &mut scratch[self.scratches[j]..][..part.len()];
            backup.copy_from_slice(part);
            for (y, u) in y_um.iter().zip(u_v) {
                model.advance(*y, *u, part);
            }
            if !part.iter().all(|value| value.is_finite()) {
                part.copy_from_slice(backup);
            }
        }
        let (shares, weights) = scratch[1..1 + 2 * k].split_at_mut(k);
        self.shares(memory, shares);
        self.weights(shares, y_um.len() as f64, weights);
        memory[..k].copy_from_slice(weights);
    }
}

// --- Any model.

#[derive(Clone, Debug)]
pub enum Kind {
    Linear(Linear),
    Lssvm(Box<Lssvm>),
    BoucWen(BoucWen),
    Mpi(Box<Mpi>),
    Champion(Box<Champion>),
}

impl Kind {
    fn new(kind: &str, entries: &Entries, dt_s: f64) -> Result<Kind> {
        Ok(match kind {
            "linear" => Kind::Linear(Linear::new(entries)?),
            "lssvm" => Kind::Lssvm(Box::new(Lssvm::new(entries, dt_s)?)),
            "bouc_wen" => Kind::BoucWen(BoucWen::new(entries, dt_s)?),
            "mpi" => Kind::Mpi(Box::new(Mpi::new(entries)?)),
            "champion" => Kind::Champion(Box::new(Champion::new(entries, dt_s)?)),
            other => return Err(Error::new("kind", other, "linear, lssvm, bouc_wen, mpi or champion")),
        })
    }

    /// After a change of the LSSVM, which is the champion.
    fn moved(&self, delta: &Delta) -> Result<Kind> {
        match self {
            Kind::Lssvm(model) => Ok(Kind::Lssvm(Box::new(model.moved(delta)?))),
            Kind::Champion(model) => Ok(Kind::Champion(Box::new(model.moved(delta)?))),
            _ => Err(Error::new("base", "a model without a part that moves", "one that learns")),
        }
    }

    fn memory_size(&self) -> usize {
        match self {
            Kind::Linear(_) => 0,
            Kind::Lssvm(model) => model.memory_size(),
            Kind::BoucWen(_) => 2,
            Kind::Mpi(model) => model.r_v.len(),
            Kind::Champion(model) => model.memories[model.models.len()],
        }
    }

    fn scratch_size(&self) -> usize {
        match self {
            Kind::Linear(_) | Kind::BoucWen(_) => 0,
            Kind::Lssvm(model) => model.scratch_size(),
            Kind::Mpi(model) => model.r_v.len(),
            Kind::Champion(model) => model.scratches[model.models.len()],
        }
    }

    fn begin(&self, memory: &mut [f64], scratch: &mut [f64]) {
        match self {
            Kind::Linear(_) | Kind::Lssvm(_) => {}
            Kind::BoucWen(model) => model.begin(memory),
            Kind::Mpi(model) => model.begin(memory, scratch),
            Kind::Champion(model) => model.begin(memory, scratch),
        }
    }

    fn step(&self, y: f64, v: f64, a: f64, memory: &mut [f64], scratch: &mut [f64]) -> Step {
        match self {
            Kind::Linear(model) => model.step(y),
            Kind::Lssvm(model) => model.step(y, v, a, memory, scratch),
            Kind::BoucWen(model) => model.step(y, v, a, memory),
            Kind::Mpi(model) => model.step(y, v, scratch),
            Kind::Champion(model) => model.step(y, v, a, memory, scratch),
        }
    }

    fn end(&self, memory: &mut [f64], scratch: &mut [f64]) {
        match self {
            Kind::Linear(_) | Kind::Lssvm(_) | Kind::BoucWen(_) => {}
            Kind::Mpi(model) => model.end(memory, scratch),
            Kind::Champion(model) => model.end(memory, scratch),
        }
    }

    /// Memory of a contestant after one point that was commanded with `u`.
    fn advance(&self, y: f64, u: f64, memory: &mut [f64]) {
        match self {
            Kind::Linear(_) => {}
            Kind::Lssvm(model) => {
                model.advance(y, memory);
            }
            Kind::BoucWen(model) => {
                if u.is_finite() {
                    model.advance(u, memory);
                }
            }
            Kind::Mpi(model) => {
                if u.is_finite() {
                    model.advance(u, memory);
                }
            }
            Kind::Champion(_) => unreachable!("a contestant is never a champion model: `Champion::new` refuses it"),
        }
    }
}

/// A model with its name and sample time.
#[derive(Clone, Debug)]
pub struct Model {
    pub name: String,
    pub dt_s: f64,
    pub kind: Kind,
}

impl Model {
    pub fn new(name: &str, kind: &str, dt_s: f64, entries: &Entries) -> Result<Model> {
        if !(dt_s.is_finite() && dt_s > 0.0) {
            return Err(Error::new("dt_s", dt_s, "a positive number"));
        }
        Ok(Model { name: name.into(), dt_s, kind: Kind::new(kind, entries, dt_s)? })
    }

    /// After a change of what moves in it.
    pub fn moved(&self, delta: &Delta) -> Result<Model> {
        Ok(Model { kind: self.kind.moved(delta)?, name: self.name.clone(), dt_s: self.dt_s })
    }

    /// Doubles of memory.
    pub fn memory_size(&self) -> usize {
        self.kind.memory_size()
    }

    /// Doubles of scratch that an evaluation needs: the model's own, and a copy of the memory.
    pub fn scratch_size(&self) -> usize {
        self.kind.scratch_size() + self.memory_size()
    }

    /// Evaluate n points, given and taken by index. `memory` advances; it stays where it would not be finite.
    /// Returns whether it advanced.
    pub fn evaluate(
        &self,
        n: usize,
        point: impl Fn(usize) -> [f64; 3],
        memory: &mut [f64],
        scratch: &mut [f64],
        mut take: impl FnMut(usize, Step),
    ) -> bool {
        let (backup, own) = scratch.split_at_mut(memory.len());
        backup.copy_from_slice(memory);
        self.kind.begin(memory, own);
        for i in 0..n {
            let [y, v, a] = point(i);
            take(i, self.kind.step(y, v, a, memory, own));
        }
        self.kind.end(memory, own);
        if memory.iter().all(|value| value.is_finite()) {
            return true;
        }
        memory.copy_from_slice(backup);
        false
    }

    /// Memory after a motion `y_um` that was commanded by `u_v`.
    pub fn advance(&self, y_um: &[f64], u_v: &[f64], memory: &mut [f64], scratch: &mut [f64]) {
        let (backup, own) = scratch.split_at_mut(memory.len());
        backup.copy_from_slice(memory);
        match &self.kind {
            Kind::Champion(model) => model.advance(y_um, u_v, memory, own),
            kind => {
                for (y, u) in y_um.iter().zip(u_v) {
                    kind.advance(*y, *u, memory);
                }
            }
        }
        if !memory.iter().all(|value| value.is_finite()) {
            memory.copy_from_slice(backup);
        }
    }

    /// Bounds of y, v and a beyond which the stand-in takes over by distance; None for a model without.
    pub fn domain(&self) -> Option<&[(f64, f64); 3]> {
        let served = match &self.kind {
            Kind::Champion(model) => model.served(),
            kind => kind,
        };
        match served {
            Kind::Lssvm(model) => Some(&model.domain),
            _ => None,
        }
    }

    /// Gain and offset of the learning model's frame, µm; None for a model without a frame.
    pub fn frame(&self) -> Option<(f64, f64)> {
        let own = match &self.kind {
            Kind::Champion(model) => model.models.iter().find(|model| matches!(model, Kind::Lssvm(_)))?,
            kind => kind,
        };
        match own {
            Kind::Lssvm(model) => Some((model.gain, model.offset_um)),
            _ => None,
        }
    }

    /// Name of the model that answers: for `auto` that of its champion.
    pub fn answering(&self) -> &str {
        match &self.kind {
            Kind::Champion(model) => &model.names[model.champion],
            _ => &self.name,
        }
    }
}
