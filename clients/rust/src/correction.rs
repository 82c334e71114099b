//! Corrections on top of the feedforward by fresh readings: docs/correction.md.
//!
//! [`Integral`] is `adaptive/correction/integral.py` of the service, a guarded integral of the residual. [`Correcting`]
//! pairs readings with what was asked for, by the numbers of the samples, for it and for
//! [`Repetition`](crate::repetition::Repetition). None of them allocates once it is made.

use crate::answer::Limits;
use crate::error::{Error, Result};
use crate::model::{Model, Step};
use crate::repetition::Repetition;
use std::collections::VecDeque;
use std::f64::consts::PI;

const PHASE_MARGIN: f64 = PI / 3.0;
const GAIN_MARGIN: f64 = 2.0;
/// Damping ratio that a mode has at least.
const LEAST_DAMPING: f64 = 0.01;
/// Largest gain as a share of the lowest mode. Up to there the mode lifts the loop by less than `LIFT`.
const OF_MODE: f64 = 0.25;
const LIFT: f64 = 1.08;

/// (gain of the integral, 1/s, time constant of its low-pass, s): the fastest with both margins, in closed form.
///
/// `delay_s`: from the instant of a reading to the voltage that it changes. `lag_s`: of the stage. `mode_hz`: lowest
/// frequency at which the stage may ring.
pub fn design(delay_s: f64, lag_s: f64, mode_hz: f64, dt_s: f64) -> (f64, f64) {
    let omega = 2.0 * PI * mode_hz;
    let dead_s = delay_s.max(0.0) + lag_s.max(0.0);
    let phase = (0.5 * PI - PHASE_MARGIN) / LIFT;
    let most_per_s = 2.0 * LEAST_DAMPING * omega / GAIN_MARGIN;
    if omega * dt_s >= PI {
        return (most_per_s.min(if dead_s > 0.0 { phase / dead_s } else { f64::INFINITY }), 0.0);
    }
    let most_per_s2 = most_per_s * 2.0 / dt_s * (0.5 * omega * dt_s).sin();
    let filter_s = -0.5 * dead_s + (0.25 * (dead_s * dead_s) + phase / most_per_s2).sqrt();
    ((most_per_s2 * filter_s).min(OF_MODE * omega), filter_s)
}

/// Time in which the estimate of the noise grows or falls by a factor e, s.
const NOISE_S: f64 = 1.0;
/// Standard deviations of noise: dead band at rest, and what a reading may be off by noise alone.
const DEAD_SIGMA: f64 = 3.0;
const NOISE_SIGMA: f64 = 4.0;
/// Half periods of an oscillation after which the gain is halved, and the ratio of last to first peak that lasts.
const HALF_PERIODS: usize = 8;
const LASTING: f64 = 0.9;
/// Time without an oscillation after which the gain doubles again, s.
const RECOVER_S: f64 = 60.0;

/// Tells an oscillation that lasts from noise, from a ring that dies away, and from the motion that is asked for.
#[derive(Default)]
struct Oscillation {
    side: i32,
    peak_um: f64,
    since_s: f64,
    /// The last peaks, oldest first, and how many there are.
    peaks_um: [f64; HALF_PERIODS + 1],
    count: usize,
}

impl Oscillation {
    fn lasts(&mut self, residual_um: f64, level_um: f64, longest_s: f64, turned: bool, dt_s: f64) -> bool {
        self.since_s += dt_s;
        if turned || self.since_s > longest_s {
            self.count = 0;
        }
        let side = i32::from(residual_um > level_um) - i32::from(residual_um < -level_um);
        if side == self.side || side == 0 {
            self.peak_um = self.peak_um.max(residual_um.abs());
            return false;
        }
        if self.side != 0 {
            if self.count > HALF_PERIODS {
                self.peaks_um.rotate_left(1);
                self.count = HALF_PERIODS;
            }
            self.peaks_um[self.count] = self.peak_um;
            self.count += 1;
        }
        (self.side, self.peak_um, self.since_s) = (side, residual_um.abs(), 0.0);
        // By pairs: a ring about another place than 0 has higher peaks on one side.
        let pair = |at: usize| self.peaks_um[at].max(self.peaks_um[at + 1]);
        if self.count <= HALF_PERIODS || pair(HALF_PERIODS - 1) < LASTING * pair(0) {
            return false;
        }
        self.count = 0;
        true
    }
}

/// Settings of a correction, as the status of the service has them under `correction` and under `repetition`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CorrectionSettings {
    /// Largest correction as a share of the voltage range, above 0, up to 1.
    pub share: f64,
    /// Lowest frequency at which the stage rings with the heaviest payload, Hz.
    pub mode_hz: f64,
    /// Time over which a correction without good readings is let go, s.
    pub fade_s: f64,
}

impl CorrectionSettings {
    fn check(&self, table: &str) -> Result<()> {
        for (name, value, most) in
            [("share", self.share, 1.0), ("mode_Hz", self.mode_hz, f64::MAX), ("fade_s", self.fade_s, f64::MAX)]
        {
            if !(value > 0.0 && value <= most) {
                return Err(Error::new(format!("{table}.{name}"), value, format!("a number above 0, up to {most:e}")));
            }
        }
        Ok(())
    }
}

/// What a correction adds, and what became of it.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub struct Added {
    /// The correction, V.
    pub u_v: f64,
    /// Share of its gain in use.
    pub factor: f64,
    /// Times that its gain was halved; readings that were not used.
    pub halved: u64,
    pub doubted: u64,
}

impl Added {
    pub(crate) const WHOLE: Added = Added { u_v: 0.0, factor: 1.0, halved: 0, doubted: 0 };
}

/// The integral of one axis, V; one `take` for each reading.
#[derive(Default)]
pub struct Integral {
    pub added: Added,
    /// Standard deviation of a reading, µm.
    pub noise_um: f64,
    dt_s: f64,
    mode_hz: f64,
    fade_s: f64,
    designed: (i64, f64),
    loop_: (f64, f64),
    slope: f64,
    bound_v: f64,
    most_v: f64,
    filtered_um: f64,
    before_um: f64,
    readings: f64,
    speed: f64,
    held_v: f64,
    watch: Oscillation,
    quiet_s: f64,
    waited_s: f64,
    fade_v: f64,
}

impl Integral {
    fn new(dt_s: f64, mode_hz: f64, fade_s: f64) -> Integral {
        let (added, designed, before_um) = (Added::WHOLE, (-1, f64::NAN), f64::NAN);
        Integral { added, dt_s, mode_hz, fade_s, designed, before_um, ..Integral::default() }
    }

    /// What the next readings are used by; the gain is designed anew where age or lag have changed. The bound falls at
    /// once; it rises with good readings only, by a factor e in `fade_s`.
    fn set(&mut self, age: i64, slope_v_per_um: f64, lag_s: f64, bound_v: f64) {
        if (age, lag_s) != self.designed {
            self.designed = (age, lag_s);
            self.loop_ = design(age as f64 * self.dt_s, lag_s, self.mode_hz, self.dt_s);
        }
        (self.slope, self.most_v) = (slope_v_per_um, bound_v);
        self.bound_v = if self.bound_v == 0.0 { bound_v } else { self.bound_v.min(bound_v) };
    }

    /// Use a reading: `residual_um` is wanted less read, and `speed_um_per_s` as wanted.
    fn take(&mut self, residual_um: f64, speed_um_per_s: f64) {
        let (dt_s, slope) = (self.dt_s, self.slope.abs());
        let turned = speed_um_per_s * self.speed < 0.0;
        self.speed = speed_um_per_s;
        let noise_um = NOISE_SIGMA * self.noise_um;
        if slope != 0.0 && residual_um.is_finite() {
            self.look(residual_um, (0.25 * self.bound_v / slope).max(noise_um), turned);
        }
        let near = residual_um.abs() <= self.bound_v / slope + noise_um; // false for NaN
        if slope == 0.0 || !near {
            self.added.doubted += 1;
            self.wait();
            return;
        }
        (self.waited_s, self.fade_v) = (0.0, 0.0);
        // The median of the differences of white readings is 0.95 of their standard deviation.
        let change_um = (residual_um - self.before_um).abs();
        self.before_um = residual_um;
        self.readings += 1.0;
        let share = (1.0 / (self.readings + 1.0)).max(dt_s / NOISE_S);
        if change_um > self.noise_um {
            let grown = self.noise_um * (1.0 + share);
            self.noise_um = if grown == 0.0 { change_um } else { grown };
        } else if change_um < self.noise_um {
            self.noise_um *= 1.0 - share;
        }
        let (gain_per_s, filter_s) = self.loop_;
        let alpha = dt_s / (dt_s + filter_s);
        self.filtered_um += alpha * (residual_um - self.filtered_um);
        let mut error_um = self.filtered_um;
        if self.at_rest(speed_um_per_s) {
            // At rest: what the noise explains would only make the stage jitter.
            let dead_um = DEAD_SIGMA * self.noise_um * (alpha / (2.0 - alpha)).sqrt();
            error_um -= error_um.max(-dead_um).min(dead_um);
        }
        let u_v = self.added.u_v + self.added.factor * gain_per_s * dt_s * self.slope * error_um;
        // A bound that has come down takes the correction along as slowly as it is let go.
        let most_v = self.bound_v.max(self.added.u_v.abs() * (1.0 - dt_s / self.fade_s));
        self.added.u_v = u_v.max(-most_v).min(most_v);
        self.bound_v = self.most_v.min(self.bound_v * (1.0 + dt_s / self.fade_s));
    }

    fn begin(&mut self, u_v: f64, bound_v: f64) {
        self.added.u_v = u_v.max(-bound_v).min(bound_v);
    }

    /// Give up what a new model has taken over: its voltage is by `taken_v` above that of the one before. At rest the
    /// voltage stays, and `let_in` the rest of the change: a model changes with noise.
    fn hand_over(&mut self, taken_v: f64, speed_um_per_s: f64) {
        let left_v = self.added.u_v - taken_v;
        self.added.u_v = left_v.max(self.added.u_v.min(0.0)).min(self.added.u_v.max(0.0));
        if self.at_rest(speed_um_per_s) {
            self.held_v += left_v - self.added.u_v;
            self.added.u_v = left_v;
        }
    }

    /// Once for each point: let in of a new model what is held back, as fast as the low-pass of the readings.
    fn let_in(&mut self) {
        let part_v = self.held_v * self.dt_s / (self.dt_s + self.loop_.1);
        self.held_v -= part_v;
        self.added.u_v -= part_v;
    }

    /// Whether the way within low-pass and age is less than the noise.
    fn at_rest(&self, speed_um_per_s: f64) -> bool {
        speed_um_per_s.abs() * (self.loop_.1 + self.designed.0 as f64 * self.dt_s) < self.noise_um
    }

    /// Keep the correction for one sample without a reading; after `fade_s` of them in a row let it go.
    fn wait(&mut self) {
        self.waited_s += self.dt_s;
        self.before_um = f64::NAN;
        if self.waited_s > self.fade_s {
            self.release();
        }
    }

    /// Let the correction go for one sample; after `fade_s` of them in a row it is 0.
    fn release(&mut self) {
        if self.fade_v == 0.0 {
            self.fade_v = self.added.u_v.abs() * self.dt_s / self.fade_s;
        }
        self.added.u_v = (self.added.u_v.abs() - self.fade_v).max(0.0).copysign(self.added.u_v);
        (self.filtered_um, self.before_um) = (0.0, f64::NAN);
        self.held_v = 0.0;
    }

    /// Halve the gain once an oscillation lasts that is as fast as the loop or faster.
    fn look(&mut self, residual_um: f64, level_um: f64, turned: bool) {
        let gain_per_s = (self.added.factor * self.loop_.0).max(1e-9);
        self.quiet_s += self.dt_s;
        if self.watch.lasts(residual_um, level_um, PI / gain_per_s, turned, self.dt_s) {
            self.added.factor *= 0.5;
            self.added.halved += 1;
            self.quiet_s = 0.0;
        } else if self.added.factor < 1.0 && self.quiet_s > RECOVER_S {
            (self.added.factor, self.quiet_s) = ((2.0 * self.added.factor).min(1.0), 0.0);
        }
    }
}

/// Points at which the slope is asked for, as a share of the range to both sides, and ranges per second.
const STEP: f64 = 0.02;
const SPEED_PER_S: f64 = 1.0;
/// Points that are kept for readings to come.
const KEPT: usize = 4096;
/// Standard deviations of the model's answer up to which it is corrected.
const SIGMA: f64 = 4.0;
/// Time after which the slope is taken anew, s; points for which the largest age of the readings is kept.
const SLOPE_S: f64 = 0.02;
const AGE_KEPT: u32 = 1000;

/// What a follower adds to its voltages, and the readings that it waits to use.
#[derive(Default)]
pub struct Correcting {
    /// None: the axis has none. It stays as it is while the repetition is active.
    pub integral: Option<Integral>,
    /// The correction of motion that repeats; None: the axis has none.
    pub repetition: Option<Repetition>,
    /// False lets the corrections go, over `fade_s`.
    pub on: bool,
    /// Samples from a reading to the last voltage that it changes; the largest of late.
    pub age: i64,
    /// Number of the next point's sample; negative: none, and nothing is corrected.
    pub number: i64,
    range_um: f64,
    most_v: f64,
    dt_s: f64,
    wanted_um: Vec<f64>,
    flagged: Vec<bool>,
    numbers: Vec<i64>,
    readings: VecDeque<(i64, f64)>,
    read: i64,
    age_held: u32,
    slope_held: u32,
    slope_every: u32,
    local: (f64, f64),
}

impl Correcting {
    /// `integral` and `repetition`: None where the axis has none. Settings out of their range, and an axis without a
    /// displacement range, are errors.
    pub fn new(
        integral: Option<CorrectionSettings>,
        repetition: Option<CorrectionSettings>,
        limits: &Limits,
        dt_s: f64,
    ) -> Result<Correcting> {
        integral.map_or(Ok(()), |settings| settings.check("correction"))?;
        repetition.map_or(Ok(()), |settings| settings.check("repetition"))?;
        let range_um = limits.y_max_um - limits.y_min_um;
        if !range_um.is_finite() {
            return Err(Error::new("y_min_um, y_max_um", "no limits", "the displacement range of the axis"));
        }
        let drive_v = limits.u_max_v - limits.u_min_v;
        Ok(Correcting {
            integral: integral.map(|settings| Integral::new(dt_s, settings.mode_hz, settings.fade_s)),
            repetition: repetition
                .map(|given| Repetition::new(dt_s, given.mode_hz, given.fade_s, given.share * drive_v)),
            on: true,
            number: -1,
            range_um,
            most_v: integral.map_or(0.0, |settings| settings.share * drive_v),
            dt_s,
            wanted_um: vec![f64::NAN; KEPT],
            flagged: vec![false; KEPT],
            numbers: vec![-1; KEPT],
            readings: VecDeque::with_capacity(KEPT),
            read: -1,
            slope_every: (SLOPE_S / dt_s).ceil().max(1.0) as u32,
            ..Correcting::default()
        })
    }

    /// Take readings of samples, rising; those that were taken are left out. An error changes nothing.
    pub fn read(&mut self, seq: &[i64], y_um: &[f64]) -> Result<()> {
        if seq.len() != y_um.len() {
            return Err(Error::new("y_um", format!("{} values", y_um.len()), format!("{}, as many as seq", seq.len())));
        }
        if let Some(at) = (1..seq.len()).find(|at| seq[*at] <= seq[*at - 1]) {
            return Err(Error::new(format!("seq[{at}]"), seq[at], "rising sample numbers"));
        }
        for (number, read_um) in seq.iter().zip(y_um).filter(|(number, _)| **number > self.read) {
            if self.readings.len() == KEPT {
                self.readings.pop_front();
            }
            self.readings.push_back((*number, *read_um));
        }
        self.read = self.readings.back().map_or(self.read, |last| last.0);
        Ok(())
    }

    /// The integral's correction, V; 0 without one.
    pub(crate) fn integral_v(&self) -> f64 {
        self.integral.as_ref().map_or(0.0, |integral| integral.added.u_v)
    }

    /// Keep what is asked for, and take the slope of `model` at the first point where that is due. `troubled`: the
    /// service has named a trouble, or the model is stale.
    pub(crate) fn ask(
        &mut self,
        y_um: &[f64],
        model: &Model,
        memory: &[f64],
        spare: &mut [f64],
        scratch: &mut [f64],
        troubled: bool,
    ) {
        for (k, y) in y_um.iter().enumerate() {
            let number = self.number + k as i64;
            let at = number as usize % KEPT;
            (self.numbers[at], self.wanted_um[at], self.flagged[at]) = (number, *y, false);
        }
        if troubled || !self.on {
            self.readings.clear();
        } else if !self.readings.is_empty() {
            if self.slope_held == 0 {
                let mut voltage = |y: f64, v: f64| {
                    spare.copy_from_slice(memory);
                    let mut u_v = f64::NAN;
                    model.evaluate(1, |_| [y, v, 0.0], spare, scratch, |_, step: Step| u_v = step.u_v);
                    u_v
                };
                self.local = sensitivity(&mut voltage, y_um[0], self.range_um);
            }
            self.slope_held = (self.slope_held + 1) % self.slope_every;
        }
    }

    /// Add the corrections to the model's voltages `u_v`, V, for the next points; `std_v`: deviation that it states for
    /// the first one, V. `troubled`: as for `ask`.
    pub(crate) fn correct(&mut self, y_um: &[f64], u_v: &mut [f64], std_v: f64, troubled: bool) {
        if let Some(integral) = &mut self.integral {
            u_v.iter().for_each(|_| integral.let_in());
        }
        if troubled || !self.on {
            self.integral.iter_mut().for_each(Integral::release);
            self.repetition.iter_mut().for_each(Repetition::release);
            let repeated_v = self.repetition.as_ref().map_or(0.0, |repetition| repetition.added.u_v);
            u_v.iter_mut().for_each(|u| *u += self.integral_v() + repeated_v);
            return;
        }
        if let Some((first, _)) = self.readings.front() {
            self.age_held += 1;
            let age = self.number + u_v.len() as i64 - 1 - first;
            if age >= self.age || self.age_held >= AGE_KEPT {
                (self.age, self.age_held) = (age.max(0), 0);
            }
            self.take(std_v);
        } else if let Some(integral) = &mut self.integral {
            integral.wait();
        }
        let integral_v = self.integral_v();
        for (k, (u, y)) in u_v.iter_mut().zip(y_um).enumerate() {
            // What is no number is replaced by the limits, and has nothing to learn from.
            let repetition = self.repetition.as_mut().filter(|_| u.is_finite());
            let repeated_v = repetition.map_or(0.0, |repetition| repetition.add(self.number + k as i64, *y, *u));
            *u += integral_v + repeated_v;
        }
    }

    /// Use the readings that have come.
    fn take(&mut self, std_v: f64) {
        let ((slope, lag_s), bound_v) = (self.local, self.bound_v(std_v));
        if let Some(integral) = &mut self.integral {
            integral.set(self.age, slope, lag_s, bound_v);
        }
        if let Some(repetition) = &mut self.repetition {
            repetition.set(self.age, slope, lag_s);
        }
        while let Some((number, read_um)) = self.readings.pop_front() {
            let (mut wanted_um, before_um) = (self.asked(number), self.asked(number - 1));
            let mut repeats = false;
            if let Some(repetition) = &mut self.repetition {
                repetition.read(number, wanted_um - read_um);
                repeats = repetition.active;
            }
            if self.flagged[number.rem_euclid(KEPT as i64) as usize] {
                wanted_um = f64::NAN; // not what the model has answered
            }
            if let Some(integral) = self.integral.as_mut().filter(|_| !repeats) {
                integral.take(wanted_um - read_um, (wanted_um - before_um) / self.dt_s);
            }
        }
    }

    /// Take what the points got in the end, V. The readings of those with flags are left out of the integral; what
    /// repeats is learnt from them too: from the voltage that they got, whatever it came of.
    pub(crate) fn answered(&mut self, u_v: &[f64], flags: &[u8]) {
        let integral_v = self.integral_v();
        for (k, (u_v, flags)) in u_v.iter().zip(flags).enumerate() {
            let number = self.number + k as i64;
            self.flagged[number as usize % KEPT] = *flags != 0;
            if let Some(repetition) = &mut self.repetition {
                repetition.applied(number, u_v - integral_v);
            }
        }
        self.number += flags.len() as i64;
    }

    /// Begin with an integral of `u_v`, V, as far as it is within its bound: a stage that is driven already.
    pub(crate) fn begin(&mut self, u_v: f64, std_v: f64) {
        let bound_v = self.bound_v(std_v);
        if let Some(integral) = self.integral.as_mut().filter(|_| u_v.is_finite()) {
            integral.begin(u_v, bound_v);
        }
    }

    /// A new model gives a voltage that is by `changed_v` above that of the one before.
    pub(crate) fn hand_over(&mut self, changed_v: f64, speed_um_per_s: f64) {
        if let Some(integral) = self.integral.as_mut().filter(|_| changed_v.is_finite()) {
            integral.hand_over(changed_v, speed_um_per_s);
        }
    }

    fn bound_v(&self, std_v: f64) -> f64 {
        if std_v.is_nan() {
            return 0.0;
        }
        self.most_v.min(SIGMA * std_v)
    }

    fn asked(&self, number: i64) -> f64 {
        let at = number.rem_euclid(KEPT as i64) as usize;
        if self.numbers[at] == number {
            self.wanted_um[at]
        } else {
            f64::NAN
        }
    }
}

/// (slope dV/dy in V/µm, lag in s) at rest at `y_um`. Of the slopes to the two sides it is the flatter one: that of the
/// branch on which the stage moves.
fn sensitivity(voltage: &mut impl FnMut(f64, f64) -> f64, y_um: f64, range_um: f64) -> (f64, f64) {
    let (step_um, speed) = (STEP * range_um, SPEED_PER_S * range_um);
    let here_v = voltage(y_um, 0.0);
    let up = (voltage(y_um + step_um, 0.0) - here_v) / step_um;
    let down = (here_v - voltage(y_um - step_um, 0.0)) / step_um;
    let slope = if down.abs() < up.abs() { down } else { up };
    if !slope.is_finite() || slope == 0.0 {
        return (0.0, 0.0);
    }
    let lag_s = (voltage(y_um, speed) - voltage(y_um, -speed)) / (2.0 * speed * slope);
    (slope, if lag_s.is_finite() { lag_s.max(0.0) } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bound_rises_with_good_readings_only() {
        let mut integral = Integral::new(1e-3, 200.0, 0.1);
        integral.set(1, 1.0, 0.0, 0.1);
        integral.take(0.05, f64::INFINITY);
        for _ in 0..20 {
            integral.set(1, 1.0, 0.0, 5.0);
            integral.take(3.0, f64::INFINITY);
        }
        assert_eq!(integral.added.doubted, 20);
        assert!(integral.added.u_v.abs() < 0.1);
        for _ in 0..100 {
            integral.take(0.05, f64::INFINITY);
        }
        integral.take(0.2, f64::INFINITY);
        assert_eq!(integral.added.doubted, 20);
        assert!((integral.bound_v - 0.1 * 1.01f64.powi(101)).abs() < 1e-12);
    }
}
