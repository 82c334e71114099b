//! A correction for motion that repeats, learnt from one pass for the next: docs/correction.md, "Motion that repeats".
//!
//! `adaptive/correction/repetition.py` of the service, number for number. Nothing allocates once it is made: what
//! depends on the stage alone is computed then, and all kernels have their room.

use crate::correction::Added;
use crate::error::{Error, Result};
use crate::model::dot;
use std::f64::consts::PI;

/// Share of the residual that a pass corrects.
const GAIN: f64 = 0.7;
/// Largest factor of the residual from pass to pass, at every frequency, that a design may have.
const GROWTH: f64 = 0.95;
/// What a design bears: the model's slope is off by this share, its lag by this share and half a sample, and a mode has
/// this damping at least.
const SLOPE_ERROR: f64 = 0.3;
const LAG_ERROR: f64 = 0.25;
const LEAST_DAMPING: f64 = 0.01;
/// Half length of the low-pass as a multiple of 1 / cut-off, and the shape of its Kaiser window.
const HALF: f64 = 3.0;
const KAISER: f64 = 7.0;
/// Cut-offs that are tried, as shares of the lowest mode and of the sample rate; frequencies at which they are.
const OF_MODE: f64 = 0.9;
const OF_RATE: f64 = 0.35;
const STEP: f64 = 0.95;
const LEAST: f64 = 0.1;
const FREQUENCIES: usize = 400;

/// Samples that are kept: the longest period is half of them. The longest that is found is half of `SEARCHED`.
const KEPT: usize = 8192;
const SEARCHED: usize = 4096;
/// Shortest period, samples, and the ratio of the windows that are tried.
const SHORTEST: usize = 16;
const WINDOWS: f64 = std::f64::consts::SQRT_2;
/// Shifts at which the motion nearly repeats that are looked at closely, of each window.
const VALLEYS: usize = 8;
/// Difference of two windows as a share of their power: above the first they are not alike, below the second nearly.
const APART: f64 = 0.1;
const CLOSE: f64 = 0.02;
/// Two passes are the same motion where they differ by less than this share of its range, and what lies between their
/// samples.
const SAME: f64 = 0.005;

/// Residual of a pass, as a multiple of the smallest so far, from which on what was learnt is wrong.
const GROWN: f64 = 3.0;
/// A single residual counts by so many times their root mean square at most.
const SPIKE: f64 = 4.0;
/// Passes without growth after which a halved gain doubles again.
const QUIET: f64 = 20.0;
/// Samples between two looks for a period: as a share of those that are looked at, and at least.
const LOOK: f64 = 0.05;
const LOOK_SAMPLES: i64 = 32;

/// Modified Bessel function of order 0 by its power series, for the 0 to 7 of the window.
fn bessel_i0(x: f64) -> f64 {
    let (mut sum, mut term) = (1.0, 1.0);
    for k in 1..40 {
        term *= (0.5 * x / f64::from(k)).powi(2);
        sum += term;
    }
    sum
}

/// Weight, not normalised, `x` samples from the middle of a low-pass.
fn weight(x: f64, cutoff: f64, half: usize) -> f64 {
    let z = 2.0 * cutoff * x * PI;
    let sinc = if z == 0.0 { 1.0 } else { z.sin() / z };
    let share = x / (half as f64 + 0.5);
    sinc * bessel_i0(KAISER * (1.0 - share * share).max(0.0).sqrt())
}

/// A low-pass without phase about a delay of samples, whole or not.
#[derive(Default)]
struct Kernel {
    /// Delay of the last weight, samples.
    first: usize,
    /// Oldest sample first; they sum to 1.
    weights: Vec<f64>,
}

impl Kernel {
    fn set(&mut self, delay: f64, cutoff: f64, half: usize) {
        self.first = delay.round_ties_even() as usize - half;
        let oldest = self.first + 2 * half;
        self.weights.clear();
        self.weights.extend((0..=2 * half).map(|j| weight((oldest - j) as f64 - delay, cutoff, half)));
        let sum: f64 = self.weights.iter().sum();
        self.weights.iter_mut().for_each(|weight| *weight /= sum);
    }

    /// Samples back to the oldest one.
    fn reach(&self) -> usize {
        self.first + self.weights.len() - 1
    }

    /// Its output at sample `at` of `values`.
    fn apply(&self, values: &[f64], at: usize) -> f64 {
        let begin = at - self.reach();
        dot(&self.weights, &values[begin..begin + self.weights.len()])
    }
}

/// A low-pass, and the longest lag of the model with which the residual falls from pass to pass at every frequency.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Design {
    /// In cycles per sample.
    cutoff: f64,
    half: usize,
    most_lag_s: f64,
}

/// The longest lag, s, with which the factor of the residual per pass is at most `GROWTH`; below 0: none.
///
/// Up to the mode a stage is off by slope, by a phase of half a sample and a share of the lag, and lifted by the mode;
/// from there on it may be 1 / (2 damping) at any phase. As the factor grows with the phase, the phase that it allows
/// gives the lag.
fn most_lag_s(cutoff: f64, half: usize, mode_hz: f64, dt_s: f64) -> f64 {
    let mut weights: Vec<f64> = (0..=half).map(|k| weight(k as f64, cutoff, half)).collect();
    let sum = 2.0 * weights.iter().sum::<f64>() - weights[0];
    weights.iter_mut().skip(1).for_each(|weight| *weight *= 2.0);
    let (peak, mode) = (0.5 / LEAST_DAMPING, mode_hz * dt_s);
    let (least, most) = (GAIN * (1.0 - SLOPE_ERROR), GAIN * (1.0 + SLOPE_ERROR));
    let mut longest = f64::INFINITY;
    // Close enough about the mode, however slow it is beside the samples.
    for top in [(2.0 * mode).min(0.5), 0.5] {
        for k in 0..FREQUENCIES {
            let f = top * k as f64 / (FREQUENCIES - 1) as f64;
            let cos = (2.0 * PI * f).cos();
            // Clenshaw's sum of the cosines.
            let (b1, b2) = weights[1..].iter().rev().fold((0.0, 0.0), |(b1, b2), w| (w + 2.0 * cos * b1 - b2, b1));
            let allowed = GROWTH / ((weights[0] + cos * b1 - b2) / sum).abs();
            let share = f / mode;
            if share >= 1.0 {
                if 1.0 + most * peak > allowed {
                    return -1.0;
                }
                continue;
            }
            let lift = (1.0 / (1.0 - share * share).max(1.0 / peak)).min(peak);
            for gain in [least, most * lift] {
                // |1 - gain e^(i phase)| <= allowed
                let cos = (1.0 + gain * gain - allowed * allowed) / (2.0 * gain);
                if cos > 1.0 {
                    return -1.0;
                }
                if cos > -1.0 && f > 0.0 {
                    longest = longest.min((cos.acos() / (2.0 * PI * f) - 0.5) * dt_s / LAG_ERROR);
                }
            }
        }
    }
    longest
}

/// All designs of a stage, highest cut-off first, each for longer lags than the one before.
fn designs(mode_hz: f64, dt_s: f64) -> Vec<Design> {
    let mut found = Vec::new();
    let mut cutoff = (OF_MODE * mode_hz * dt_s).min(OF_RATE);
    let (least, mut longest) = (LEAST * cutoff, 0.0);
    while cutoff > least && longest < f64::INFINITY {
        let half = (HALF / cutoff).ceil();
        // A longer low-pass does not fit into what is kept.
        if 2.0 * half + 1.0 >= KEPT as f64 {
            break;
        }
        let design =
            Design { cutoff, half: half as usize, most_lag_s: most_lag_s(cutoff, half as usize, mode_hz, dt_s) };
        if design.most_lag_s >= longest {
            longest = design.most_lag_s;
            found.push(design);
        }
        cutoff *= STEP;
    }
    found
}

/// Between the samples: (the one before, the part of a sample).
fn between(at: f64) -> (usize, f64) {
    (at as usize, at.fract())
}

fn interpolated(values: impl Fn(usize) -> f64, (k, part): (usize, f64)) -> f64 {
    let low = values(k);
    if part == 0.0 {
        return low;
    }
    low + part * (values(k + 1) - low)
}

/// Largest less smallest.
fn range(values: &[f64]) -> f64 {
    let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |(low, high), y| (y.min(low), y.max(high)));
    high - low
}

/// The period, samples, with which the last of the positions repeat; None where they do not.
///
/// The shortest one of at most half their number. Two passes are compared in full (de Cheveigné and Kawahara, YIN, J.
/// Acoust. Soc. Am. 111, 2002); the part of a sample follows by Newton's method.
fn find_period(y_um: &[f64]) -> Option<f64> {
    let n = y_um.len();
    let mut window = SHORTEST as f64;
    while window.ceil() as usize <= n / 2 {
        let w = window.ceil() as usize;
        window *= WINDOWS;
        let (late, both) = (&y_um[n - w..], &y_um[n - 2 * w..]);
        let mean = late.iter().sum::<f64>() / w as f64;
        let power: f64 = late.iter().map(|y| (y - mean) * (y - mean)).sum();
        if power <= 0.0 {
            continue;
        }
        // The shift at which a valley is deepest, and how deep; valleys count from the first shift that is none.
        let (mut any, mut deepest, mut valleys) = (false, None, 0);
        for shift in 0..=w {
            let apart = apart(late, &both[w - shift..2 * w - shift], power);
            any |= apart > APART;
            if any && apart < CLOSE {
                deepest = Some(deepest.filter(|(_, least)| *least <= apart).unwrap_or((shift, apart)));
                if shift < w {
                    continue;
                }
            }
            if let Some((shift, _)) = deepest.take() {
                let period = refined(y_um, shift as f64, w);
                if period.is_some() {
                    return period;
                }
                valleys += 1;
                if valleys == VALLEYS {
                    break;
                }
            }
        }
    }
    None
}

/// Mean square of the difference of two windows over twice the power; infinite where it is clearly above `APART`, so
/// that most shifts cost little.
fn apart(late: &[f64], early: &[f64], power: f64) -> f64 {
    let (mut sum, most) = (0.0, 4.0 * APART * power);
    for (late, early) in late.chunks(64).zip(early.chunks(64)) {
        sum += late.iter().zip(early).map(|(late, early)| (late - early) * (late - early)).sum::<f64>();
        if sum > most {
            return f64::INFINITY;
        }
    }
    sum / (2.0 * power)
}

/// `period` to the part of a sample, from the last `w` positions; None where they are not the same motion.
fn refined(y_um: &[f64], mut period: f64, w: usize) -> Option<f64> {
    let n = y_um.len();
    let y = |i: usize| y_um[i];
    let v = |i: usize| match i {
        0 => y_um[1] - y_um[0],
        i if i == n - 1 => y_um[i] - y_um[i - 1],
        i => 0.5 * (y_um[i + 1] - y_um[i - 1]),
    };
    for _ in 0..4 {
        let (mut moved, mut squares) = (0.0, 0.0);
        for i in n - w..n {
            let at = between(i as f64 - period);
            // The mean of both passes' velocities: at a corner neither alone is right.
            let mean = 0.5 * (v(i) + interpolated(v, at));
            moved += mean * (y(i) - interpolated(y, at));
            squares += mean * mean;
        }
        period -= moved / squares.max(1e-300);
        if !(SHORTEST as f64..=(w + 1).min(n - w) as f64).contains(&period) {
            return None;
        }
    }
    let way = |i: usize| if i == 0 { 0.0 } else { (y_um[i] - y_um[i - 1]).abs() };
    let same_um = SAME * range(&y_um[n - w..]);
    let same = (n - w..n).all(|i| {
        let (k, part) = between(i as f64 - period);
        (y(i) - interpolated(y, (k, part))).abs() - 0.5 * (way(i) + way(k + 1)) <= same_um
    });
    same.then_some(period)
}

/// What is added to the model's answers while the motion repeats; `add` and `applied` once for each point.
#[derive(Default)]
pub struct Repetition {
    /// Of the last point.
    pub added: Added,
    /// In samples, stated or found; None: none yet.
    pub period: Option<f64>,
    /// Whether the last point was corrected by the pass before.
    pub active: bool,
    dt_s: f64,
    bound_v: f64,
    /// Samples without a good reading after which the correction is let go.
    fade: u64,
    designs: Vec<Design>,
    design: Option<Design>,
    stated: bool,
    slope: f64,
    lag_s: f64,
    age: i64,
    // By sample, from sample `base` on: wanted, µm; voltage, residual, low-passed residual, V; squares that `judge`
    // sums. Twice what is kept, to be one piece.
    y_um: Vec<f64>,
    w_v: Vec<f64>,
    r_v: Vec<f64>,
    low_v: Vec<f64>,
    square: Vec<f64>,
    base: i64,
    next: i64,
    /// Whether the kernels are those of the period, and its passes back as whole samples.
    planned: bool,
    back: usize,
    of_w: Kernel,
    of_r: Kernel,
    since: i64,
    same_since: i64,
    look_at: i64,
    span_um: f64,
    weight: f64,
    fade_v: f64,
    missing: u64,
    /// Sum of the squares of the last pass, and the least so far; None before the first.
    powers: Option<(f64, f64)>,
    quiet: f64,
}

impl Repetition {
    /// `mode_hz`: lowest frequency at which the stage rings. `fade_s`: time without good readings after which the
    /// correction is let go. `bound_v`: largest correction, and largest residual that is no doubt.
    pub(crate) fn new(dt_s: f64, mode_hz: f64, fade_s: f64, bound_v: f64) -> Repetition {
        let kernel = || Kernel { first: 0, weights: Vec::with_capacity(KEPT) };
        let column = || vec![0.0; 2 * KEPT];
        Repetition {
            added: Added::WHOLE,
            dt_s,
            bound_v,
            fade: (fade_s / dt_s).ceil() as u64,
            designs: designs(mode_hz, dt_s),
            lag_s: f64::NAN,
            age: -1,
            y_um: column(),
            w_v: column(),
            r_v: column(),
            low_v: column(),
            square: column(),
            of_w: kernel(),
            of_r: kernel(),
            look_at: 2 * SHORTEST as i64,
            ..Repetition::default()
        }
    }

    /// Let go what was learnt; what the stage does from now on is learnt anew.
    fn forget(&mut self) {
        self.active = false;
        if !self.stated {
            self.period = None;
        }
        (self.since, self.same_since) = (self.next, self.next);
        self.look_at = self.next + 2 * SHORTEST as i64;
        (self.span_um, self.weight, self.fade_v) = (0.0, 0.0, self.added.u_v.abs());
        (self.missing, self.powers, self.quiet) = (0, None, 0.0);
    }

    /// The motion from the next point on repeats with `period_s`, s; None: find it. An error changes nothing.
    pub fn state(&mut self, period_s: Option<f64>) -> Result<()> {
        let period = period_s.map(|period_s| period_s / self.dt_s);
        let (least, most) = (SHORTEST as f64, 0.5 * KEPT as f64);
        if period.is_some_and(|period| !(least..=most).contains(&period)) {
            let expected = format!("{} to {} s", least * self.dt_s, most * self.dt_s);
            return Err(Error::new("period_s", period_s.unwrap_or(f64::NAN), expected));
        }
        (self.stated, self.period) = (period.is_some(), period);
        self.forget();
        self.plan();
        Ok(())
    }

    /// What the next readings are used by: samples from a reading to the voltage that it changes; slope, V/µm, and lag,
    /// s, of the model. Another low-pass where the lag has changed by more than moves it.
    pub(crate) fn set(&mut self, age: i64, slope_v_per_um: f64, lag_s: f64) {
        self.slope = slope_v_per_um;
        let near = (lag_s - self.lag_s).abs() <= 0.25 * self.dt_s + 0.1 * self.lag_s; // false for NaN
        if !near {
            self.lag_s = lag_s;
            self.design = self.designs.iter().find(|design| lag_s <= design.most_lag_s).copied();
        }
        if !near || age != self.age {
            self.age = age;
            self.plan();
        }
    }

    /// Kernels of voltage and residual for the period: of as many passes back as their last readings need.
    fn plan(&mut self) {
        self.planned = false;
        let (Some(period), Some(Design { cutoff, half, .. })) = (self.period, self.design) else { return };
        let lead = self.lag_s / self.dt_s;
        let delay = ((half as f64 + 1.0 + lead + self.age as f64) / period).ceil() * period;
        if delay.round_ties_even() + half as f64 + 1.0 > KEPT as f64 {
            return;
        }
        self.of_w.set(delay, cutoff, half);
        self.of_r.set(delay - lead, cutoff, half);
        (self.planned, self.back) = (true, delay.round_ties_even() as usize);
    }

    /// Take the residual, wanted less read, µm, of a sample; one not finite, or beyond the bound, is doubted.
    ///
    /// Nothing is learnt where the low-pass would use a doubted one; one that never came counts as 0.
    pub(crate) fn read(&mut self, number: i64, residual_um: f64) {
        if number < self.since.max(self.base) || number >= self.next {
            return;
        }
        let i = (number - self.base) as usize;
        let r_v = self.slope * residual_um;
        if self.slope != 0.0 && r_v.abs() <= self.bound_v {
            self.r_v[i] = r_v;
            self.missing = 0;
        } else {
            self.r_v[i] = f64::NAN;
            self.added.doubted += 1;
            self.missing += 1;
        }
        if self.active && r_v.is_finite() {
            self.judge(i, r_v * r_v);
        } else if r_v.is_finite() {
            self.square[i] = r_v * r_v;
        }
    }

    /// Let go, with half the gain, once the residual of the last pass is `GROWN` times the smallest of a pass.
    fn judge(&mut self, i: usize, square: f64) {
        let n = self.period.unwrap_or_default().round_ties_even();
        let Some(begin) = i.checked_sub(n as usize) else { return };
        let (power, least) = self.powers.unwrap_or_else(|| {
            let first = self.square[begin..i].iter().sum();
            (first, first)
        });
        self.square[i] = square.min(SPIKE * SPIKE * power / n);
        let power = power + (self.square[i] - self.square[begin]);
        self.quiet += 1.0;
        if power > GROWN * GROWN * least {
            self.added.factor *= 0.5;
            self.added.halved += 1;
            self.forget();
            return;
        }
        self.powers = Some((power, power.min(least)));
        if self.added.factor < 1.0 && self.quiet > QUIET * n {
            (self.added.factor, self.quiet) = (2.0 * self.added.factor, 0.0);
        }
    }

    /// The correction, V, of the point of sample `number`: `y_um` is wanted, the model answers `answer_v`.
    pub(crate) fn add(&mut self, number: i64, y_um: f64, answer_v: f64) -> f64 {
        if number != self.next {
            (self.next, self.base) = (number, number);
            self.forget();
        }
        let mut i = (number - self.base) as usize;
        if i == 2 * KEPT {
            for column in [&mut self.y_um, &mut self.w_v, &mut self.r_v, &mut self.low_v, &mut self.square] {
                column.copy_within(KEPT.., 0);
            }
            (self.base, i) = (self.base + KEPT as i64, KEPT);
        }
        (self.y_um[i], self.w_v[i], self.r_v[i], self.low_v[i], self.square[i]) = (y_um, answer_v, 0.0, f64::NAN, 0.0);
        self.next = number + 1;
        if self.missing > self.fade {
            self.forget();
        }
        self.follow(i);
        if !self.active {
            self.release();
            return self.added.u_v;
        }
        let voltage = self.of_w.apply(&self.w_v, i);
        let mut low = self.of_r.apply(&self.r_v, i);
        if low.is_nan() {
            low = 0.0;
        }
        self.low_v[i] = low;
        let before = self.low_v[i.saturating_sub(self.back)];
        if !before.is_nan() {
            // Only what both passes have repeats.
            low = if low * before > 0.0 { low.abs().min(before.abs()).copysign(low) } else { 0.0 };
        }
        self.weight = (self.weight + 1.0 / self.half()).min(1.0);
        let u_v = voltage + GAIN * self.added.factor * low - answer_v;
        self.added.u_v = self.weight * u_v.max(-self.bound_v).min(self.bound_v);
        self.added.u_v
    }

    /// The voltage, V, that the point of sample `number` got in the end, less what others have added to it.
    pub(crate) fn applied(&mut self, number: i64, u_v: f64) {
        if (self.base..self.next).contains(&number) {
            self.w_v[(number - self.base) as usize] = u_v;
        }
    }

    /// Let the correction go for one sample; it is 0 after the length of the low-pass.
    pub(crate) fn release(&mut self) {
        if self.active {
            self.forget();
        }
        self.added.u_v = (self.added.u_v.abs() - self.fade_v / self.half()).max(0.0).copysign(self.added.u_v);
    }

    /// Half length of the low-pass, samples; 1 without one.
    fn half(&self) -> f64 {
        self.design.map_or(1.0, |design| design.half as f64)
    }

    /// Find the period, see that the motion still repeats, and begin once two passes and the low-pass are there.
    fn follow(&mut self, i: usize) {
        let number = self.next - 1;
        let Some(period) = self.period else {
            if number >= self.look_at {
                let kept = (number - self.since + 1).min(SEARCHED as i64);
                self.look_at = number + LOOK_SAMPLES.max((LOOK * kept as f64).ceil() as i64);
                self.period = find_period(&self.y_um[i + 1 - kept as usize..=i]);
                if let Some(period) = self.period {
                    self.same_since = number - (2.0 * period) as i64;
                    self.plan();
                }
            }
            return;
        };
        let (at, y_um) = (i as f64 - period, &self.y_um);
        if at < 1.0 || number as f64 - period < self.since as f64 {
            return;
        }
        let (k, part) = between(at);
        let before_um = (1.0 - part) * y_um[k] + part * y_um[k + 1];
        let way_um = (y_um[i] - y_um[i - 1]).abs() + (y_um[k + 1] - y_um[k]).abs();
        let span_um = if self.active { self.span_um } else { range(&y_um[k..=i]) };
        if (y_um[i] - before_um).abs() > SAME * span_um + 0.5 * way_um {
            self.forget();
            return;
        }
        // The first pass is left out: hysteresis and creep of a motion that has begun are not yet those of the next.
        let reach = if self.planned { self.of_w.reach() } else { KEPT };
        if (number - reach as i64) as f64 <= self.same_since as f64 + period {
            self.release(); // older readings or another lag may need more than there is
        } else if !self.active {
            (self.active, self.span_um) = (true, span_um);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As the service has it: |Q| |1 - GAIN G| at its largest over the frequencies.
    fn growth(design: &Design, lag_s: f64, mode_hz: f64, dt_s: f64) -> f64 {
        let weights: Vec<f64> = (0..=design.half).map(|k| weight(k as f64, design.cutoff, design.half)).collect();
        let sum = 2.0 * weights.iter().sum::<f64>() - weights[0];
        let mut worst = 0.0f64;
        for top in [(2.0 * mode_hz * dt_s).min(0.5), 0.5] {
            for k in 0..FREQUENCIES {
                let f = top * k as f64 / (FREQUENCIES - 1) as f64;
                let cosines = weights.iter().enumerate().map(|(k, w)| w * (2.0 * PI * f * k as f64).cos());
                let low_pass = (2.0 * cosines.sum::<f64>() - weights[0]) / sum;
                let (share, peak) = (f / (mode_hz * dt_s), 0.5 / LEAST_DAMPING);
                let lift = (1.0 / (1.0 - share * share).max(1.0 / peak)).min(peak);
                let phase = (2.0 * PI * f * (0.5 + LAG_ERROR * lag_s / dt_s)).min(PI);
                let off = |gain: f64| (1.0 + gain * gain - 2.0 * gain * phase.cos()).sqrt();
                let (least, most) = (GAIN * (1.0 - SLOPE_ERROR), GAIN * (1.0 + SLOPE_ERROR));
                let factor = if share < 1.0 { off(least).max(off(most * lift)) } else { 1.0 + most * peak };
                worst = worst.max(low_pass.abs() * factor);
            }
        }
        worst
    }

    #[test]
    fn a_design_holds_up_to_its_lag_and_no_further() {
        for (mode_hz, dt_s) in [(50.0, 1e-3), (200.0, 1e-3), (2000.0, 1e-3)] {
            let found = designs(mode_hz, dt_s);
            assert!(found.len() > 3, "{mode_hz} Hz: {}", found.len());
            for design in &found {
                assert!(growth(design, design.most_lag_s - 1e-9, mode_hz, dt_s) <= GROWTH, "{design:?}");
                assert!(growth(design, design.most_lag_s + 1e-9, mode_hz, dt_s) > GROWTH, "{design:?}");
            }
            assert!(found.windows(2).all(|pair| pair[0].cutoff > pair[1].cutoff));
        }
        // No low-pass of what is kept is that slow.
        assert!(designs(1.0, 1e-5).is_empty());
    }

    #[test]
    fn a_period_is_found_to_the_part_of_a_sample_and_none_where_nothing_repeats() {
        for period in [33.333, 66.6667, 200.0, 533.4] {
            let triangle = |k: usize| ((k as f64 / period).fract() - 0.5).abs();
            let y: Vec<f64> = (0..(3.0 * period).round() as usize).map(triangle).collect();
            let found = find_period(&y).unwrap();
            assert!((found - period).abs() < 2e-4 * period, "{found} {period}");
        }
        let frame: Vec<f64> = (0..800).map(|k| [0.0, 1.0, 2.0, 1.5][k / 50 % 4]).collect();
        assert!((find_period(&frame).unwrap() - 200.0).abs() < 0.01);
        let squares: Vec<f64> = (0..4000).map(|k| f64::from(k * k)).collect();
        assert_eq!((find_period(&squares), find_period(&[3.0; 4000])), (None, None));
    }
}
