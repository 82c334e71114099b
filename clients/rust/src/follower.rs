//! A follower: holds the newest snapshot of a model and answers in the caller's thread.
//!
//! Another thread publishes snapshots through a [`Publisher`]. Neither side waits for the other: a new snapshot is left
//! in a mailbox of one pointer, the follower takes it before a point, and leaves the old one to be freed by the
//! publisher. So a point never locks, allocates or frees.

use crate::answer::{
    self, limit_voltage, Done, Limits, Motion, Out, BLENDED, NOT_FINITE_REPLACED, OUTSIDE_DOMAIN, STALE,
};
use crate::correction::{Correcting, CorrectionSettings};
use crate::delta::{Changes, Update};
use crate::error::{Error, Result};
use crate::snapshot::Snapshot;
use crate::wire::{Query, Reply};
use std::ptr;
use std::sync::atomic::{AtomicPtr, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

/// A snapshot and when it arrived.
struct Arrived {
    snapshot: Snapshot,
    at: Instant,
}

/// The mailbox hands snapshots from one thread to another, which `AtomicPtr` does not check.
const fn sendable<T: Send>() {}
const _: () = sendable::<Arrived>();

/// What the two sides share.
struct Mailbox {
    /// The newest snapshot, not yet taken; null where there is none.
    waiting: AtomicPtr<Arrived>,
    /// The one that the follower has given up; null where there is none.
    retired: AtomicPtr<Arrived>,
    received: AtomicU64,
    refused: AtomicU64,
    name: String,
    dt_s: f64,
    /// Serialises publishers; the follower never touches it.
    feeding: Mutex<Feeding>,
}

/// What publishers share: the sum of the messages so far, and why the last one was refused.
struct Feeding {
    changes: Changes,
    last_error: String,
}

impl Mailbox {
    fn free(pointer: *mut Arrived) {
        if !pointer.is_null() {
            // SAFETY: whoever swaps a pointer out of the mailbox owns it, and each came from `Box::into_raw`.
            drop(unsafe { Box::from_raw(pointer) });
        }
    }
}

impl Drop for Mailbox {
    fn drop(&mut self) {
        Mailbox::free(*self.waiting.get_mut());
        Mailbox::free(*self.retired.get_mut());
    }
}

/// Gives newer payloads to a follower, from any thread.
#[derive(Clone)]
pub struct Publisher(Arc<Mailbox>);

impl Publisher {
    /// Decode a payload of kind 6 and leave the model for the follower. An error changes nothing there, and is counted.
    pub fn publish(&self, payload: &[u8]) -> Result<()> {
        self.update(payload).map(drop)
    }

    /// The same for a whole model (kind 6) or for a change (kind 7). `Lost` says that the whole model of the change must
    /// be fetched (`.../model?name=...;changes=1`) and given to this function, unless one comes by itself.
    pub fn update(&self, payload: &[u8]) -> Result<Update> {
        let mut feeding = self.0.feeding.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let taken = feeding.changes.take(payload).and_then(|(update, snapshot)| match &snapshot {
            Some(new) if new.model.name != self.0.name => {
                Err(Error::new("model", &new.model.name, format!("{:?}", self.0.name)))
            }
            // The slew limit of a sample follows from it.
            Some(new) if new.model.dt_s != self.0.dt_s => {
                Err(Error::new("dt_s", new.model.dt_s, format!("{} s", self.0.dt_s)))
            }
            _ => Ok((update, snapshot)),
        });
        match taken {
            Ok((update, snapshot)) => {
                if let Some(snapshot) = snapshot {
                    let arrived = Box::new(Arrived { snapshot, at: Instant::now() });
                    Mailbox::free(self.0.waiting.swap(Box::into_raw(arrived), Ordering::AcqRel));
                    // After the swap: the follower takes a snapshot only where the place for the old one is empty.
                    Mailbox::free(self.0.retired.swap(ptr::null_mut(), Ordering::AcqRel));
                    self.0.received.fetch_add(1, Ordering::Relaxed);
                }
                Ok(update)
            }
            Err(error) => {
                self.0.refused.fetch_add(1, Ordering::Relaxed);
                feeding.last_error = error.to_string();
                Err(error)
            }
        }
    }

    /// Checksum of the newest whole model, as in the payloads of kind 7.
    pub fn base(&self) -> u32 {
        self.0.feeding.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).changes.base()
    }

    /// Why the last payload was refused; empty where none was.
    pub fn last_error(&self) -> String {
        self.0.feeding.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).last_error.clone()
    }
}

/// One answered point.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Point {
    /// V; finite, within the limits (from a voltage outside: nearer), within the slew limit from the point before.
    pub u_v: f64,
    /// One standard deviation, V; NaN where the model has none.
    pub std_v: f64,
    /// Bits of `dehyst::answer`.
    pub flags: u8,
}

/// State of a follower for people and logs.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    pub snapshot_seq: i64,
    /// Time since the snapshot in use arrived, s.
    pub age_s: f64,
    pub received: u64,
    pub refused: u64,
    pub trust: f64,
    pub stale: bool,
    pub dt_s: f64,
    pub memory_size: usize,
    /// Frame of the learning model; 1 and 0 for a model without one.
    pub gain: f64,
    pub offset_um: f64,
    /// Answers so far; of the last one.
    pub answered: u64,
    pub last: Point,
    /// Model that gave the last voltage: "A+B" where B was blended in; empty where none was usable.
    pub source: String,
}

/// Evaluates the newest snapshot with the hysteresis memory and limits of the caller's axis.
pub struct Follower {
    mailbox: Arc<Mailbox>,
    current: Box<Arrived>,
    memory: Vec<f64>,
    limits: Limits,
    u_before_v: f64,
    last: Point,
    done: Done,
    answered: u64,
    correcting: Option<Correcting>,
    /// Whether no voltage was answered since `start`: the correction begins where the stage is.
    begins: bool,
}

impl Follower {
    /// From the payload that a query on `.../model` has answered with.
    pub fn new(payload: &[u8], limits: Limits) -> Result<Follower> {
        limits.check()?;
        let snapshot = Snapshot::decode(payload)?;
        let mailbox = Mailbox {
            waiting: AtomicPtr::new(ptr::null_mut()),
            retired: AtomicPtr::new(ptr::null_mut()),
            received: AtomicU64::new(1),
            refused: AtomicU64::new(0),
            name: snapshot.model.name.clone(),
            dt_s: snapshot.model.dt_s,
            feeding: Mutex::new(Feeding { changes: Changes::new(payload)?, last_error: String::new() }),
        };
        Ok(Follower {
            mailbox: Arc::new(mailbox),
            memory: snapshot.memory.clone(),
            current: Box::new(Arrived { snapshot, at: Instant::now() }),
            limits,
            u_before_v: f64::NAN,
            last: Point { std_v: f64::NAN, ..Point::default() },
            done: Done::default(),
            answered: 0,
            correcting: None,
            begins: false,
        })
    }

    /// Correct the voltages by the readings that `read` takes (docs/correction.md): by an `integral` of the residual, and
    /// motion that repeats by the pass before. None: not so. Points need numbers: `number`.
    pub fn correct(
        &mut self,
        integral: Option<CorrectionSettings>,
        repetition: Option<CorrectionSettings>,
    ) -> Result<()> {
        let dt_s = self.current.snapshot.model.dt_s;
        self.correcting = Some(Correcting::new(integral, repetition, &self.limits, dt_s)?);
        Ok(())
    }

    /// The corrections, to look at and to switch.
    pub fn correcting(&mut self) -> Option<&mut Correcting> {
        self.correcting.as_mut()
    }

    /// The next point is for the sample `seq`; later points count on. Without a number nothing is corrected.
    pub fn number(&mut self, seq: i64) -> Result<()> {
        if !(0..=1 << 62).contains(&seq) {
            return Err(Error::new("seq", seq, "0 to 2^62"));
        }
        if let Some(correcting) = &mut self.correcting {
            correcting.number = seq;
        }
        Ok(())
    }

    /// Take readings, µm, of samples, rising, that the next voltages are corrected by. Nothing happens without
    /// `correct`.
    pub fn read(&mut self, seq: &[i64], y_um: &[f64]) -> Result<()> {
        self.correcting.as_mut().map_or(Ok(()), |correcting| correcting.read(seq, y_um))
    }

    pub fn publisher(&self) -> Publisher {
        Publisher(self.mailbox.clone())
    }

    /// Take the newest snapshot, if there is one. Wait-free. What it changes at `next`, the next point, leaves the
    /// correction.
    fn refresh(&mut self, next: Option<[f64; 3]>) {
        let mailbox = &*self.mailbox;
        if mailbox.waiting.load(Ordering::Relaxed).is_null() || !mailbox.retired.load(Ordering::Acquire).is_null() {
            return;
        }
        let newest = mailbox.waiting.swap(ptr::null_mut(), Ordering::AcqRel);
        if newest.is_null() {
            return;
        }
        // SAFETY: swapped out of the mailbox, so it is ours; it came from `Box::into_raw`.
        let mut newest = unsafe { Box::from_raw(newest) };
        // Another number of plays or contestants: the old memory means nothing to this model. Its own has the room.
        if newest.snapshot.memory.len() != self.memory.len() {
            std::mem::swap(&mut self.memory, &mut newest.snapshot.room);
        } else if let (Some(next), Some(correcting)) = (next, &mut self.correcting) {
            if correcting.integral.is_some() && next.iter().all(|value| value.is_finite()) {
                let before = voltage_at(&mut self.current.snapshot, &self.memory, next).0;
                correcting.hand_over(voltage_at(&mut newest.snapshot, &self.memory, next).0 - before, next[1]);
            }
        }
        let old = std::mem::replace(&mut self.current, newest);
        mailbox.retired.store(Box::into_raw(old), Ordering::Release);
    }

    /// Age of the snapshot where newer ones are expected: at least one came after the first.
    fn age_s(&self) -> Option<f64> {
        let expected = self.mailbox.received.load(Ordering::Relaxed) > 1 && self.current.snapshot.stale_s > 0.0;
        expected.then(|| self.current.at.elapsed().as_secs_f64())
    }

    /// The voltage for the next point, µm, µm/s, µm/s².
    #[inline]
    pub fn point(&mut self, y_um: f64, v_um_per_s: f64, a_um_per_s2: f64) -> Result<Point> {
        let mut point = Point::default();
        let (u_v, std_v) = (std::slice::from_mut(&mut point.u_v), std::slice::from_mut(&mut point.std_v));
        let mut out = Out { u_v, std_v, flags: std::slice::from_mut(&mut point.flags) };
        self.block(&[y_um], &[v_um_per_s], &[a_um_per_s2], &mut out)?;
        Ok(self.last)
    }

    /// Evaluate a point on a copy of the memory and throw the answer away. Called some 50 us before `point`, with about
    /// the same motion, it loads what a point reads into the caches; a newer snapshot is taken here. Memory, slew limit
    /// and report stay as they are.
    pub fn warm(&mut self, y_um: f64, v_um_per_s: f64, a_um_per_s2: f64) -> Result<()> {
        self.refresh(None);
        let motion = Motion { y_um: &[y_um], v_um_per_s: &[v_um_per_s], a_um_per_s2: &[a_um_per_s2] };
        motion.check(&self.limits)?;
        let age_s = self.age_s();
        let snapshot = &mut self.current.snapshot;
        let mut memory = std::mem::take(&mut snapshot.spare);
        memory.copy_from_slice(&self.memory);
        let (mut u_v, mut std_v, mut flags) = ([0.0], [0.0], [0]);
        let mut out = Out { u_v: &mut u_v, std_v: &mut std_v, flags: &mut flags };
        answer::answer(snapshot, &mut memory, &motion, self.u_before_v, &self.limits, age_s, |_| {}, &mut out);
        snapshot.spare = memory;
        // Without this the compiler may leave out what nobody reads.
        std::hint::black_box(u_v);
        Ok(())
    }

    /// The voltages for the next points, one sample time apart. `v` and `a` may be empty for 0.
    pub fn block(&mut self, y_um: &[f64], v_um_per_s: &[f64], a_um_per_s2: &[f64], out: &mut Out) -> Result<()> {
        let at = |values: &[f64]| values.first().copied().unwrap_or(0.0);
        self.refresh(Some([at(y_um), at(v_um_per_s), at(a_um_per_s2)]));
        let age_s = self.age_s();
        self.block_at(y_um, v_um_per_s, a_um_per_s2, age_s, out)
    }

    /// As `block` with another age of the newest sample, s, than that by the clock; None: no newer one is expected.
    pub fn block_at(
        &mut self,
        y_um: &[f64],
        v_um_per_s: &[f64],
        a_um_per_s2: &[f64],
        age_s: Option<f64>,
        out: &mut Out,
    ) -> Result<()> {
        let motion = Motion { y_um, v_um_per_s, a_um_per_s2 };
        motion.check(&self.limits)?;
        let n = y_um.len();
        if n == 0 || out.u_v.len() != n || out.std_v.len() != n || out.flags.len() != n {
            return Err(Error::new("n", n, "at least one point, and as many places for the answers"));
        }
        let snapshot = &mut self.current.snapshot;
        let troubled = !snapshot.trouble.is_empty() || snapshot.trust_by_age(age_s).1;
        let mut correcting = self.correcting.as_mut().filter(|correcting| correcting.number >= 0);
        if let Some(correcting) = &mut correcting {
            let Snapshot { model, scratch, spare, .. } = &mut *snapshot;
            correcting.ask(y_um, model, &self.memory, spare, scratch, troubled);
        }
        let correct = |out: &mut Out| {
            if let Some(correcting) = &mut correcting {
                correcting.correct(y_um, out.u_v, out.std_v[0], troubled);
            }
        };
        let (memory, before_v) = (&mut self.memory, self.u_before_v);
        self.done = answer::answer(snapshot, memory, &motion, before_v, &self.limits, age_s, correct, out);
        if let Some(correcting) = correcting {
            correcting.answered(out.u_v, out.flags);
        }
        self.begins = false;
        self.last = Point { u_v: out.u_v[n - 1], std_v: out.std_v[n - 1], flags: out.flags[n - 1] };
        self.u_before_v = self.last.u_v;
        self.answered += n as u64;
        Ok(())
    }

    /// Take the newest snapshot and its memory: that after sample `report().snapshot_seq`. The next voltage is free of
    /// the slew limit, unless `u_before_v` is finite. Then `advance` along what was commanded since.
    pub fn start(&mut self, u_before_v: f64) {
        self.refresh(None);
        self.begins = self.correcting.is_some();
        self.memory.copy_from_slice(&self.current.snapshot.memory);
        self.u_before_v = u_before_v;
    }

    /// Memory after a motion, µm, that was commanded by voltages, V.
    pub fn advance(&mut self, y_um: &[f64], u_v: &[f64]) -> Result<()> {
        if y_um.len() != u_v.len() {
            return Err(Error::new("u_V", format!("{} values", u_v.len()), format!("{}", y_um.len())));
        }
        Motion { y_um, v_um_per_s: &[], a_um_per_s2: &[] }.check(&self.limits)?;
        if let Some(i) = u_v.iter().position(|u| !u.is_finite()) {
            return Err(Error::new(format!("u_V[{i}]"), u_v[i], "a finite number"));
        }
        let Snapshot { model, scratch, .. } = &mut self.current.snapshot;
        model.advance(y_um, u_v, &mut self.memory, scratch);
        if let (Some(last), Some(there)) = (u_v.last(), y_um.last()) {
            self.u_before_v = *last;
            if let Some(correcting) = self.correcting.as_mut().filter(|_| self.begins) {
                let (model_v, std_v) = voltage_at(&mut self.current.snapshot, &self.memory, [*there, 0.0, 0.0]);
                correcting.begin(last - model_v, std_v);
            }
        }
        Ok(())
    }

    /// The reply to a query from the newest snapshot, as the service would give it. Allocates.
    pub fn reply(&mut self, query: &[u8], age_s: Option<f64>) -> Result<Reply> {
        self.refresh(None);
        answer::reply(&mut self.current.snapshot, &Query::decode(query)?, &self.limits, age_s)
    }

    /// Hold the voltage of the last point once more: what to apply where no point could be asked for.
    pub fn hold(&mut self) -> f64 {
        let step_v = self.limits.slew_v_per_s * self.current.snapshot.model.dt_s;
        self.u_before_v = limit_voltage(f64::NAN, self.u_before_v, &self.limits, step_v).0;
        self.u_before_v
    }

    pub fn memory(&self) -> &[f64] {
        &self.memory
    }

    /// State at this moment. Allocates the name of the source.
    pub fn report(&self) -> Report {
        let snapshot = &self.current.snapshot;
        let (trust, stale) = snapshot.trust_by_age(self.age_s());
        let (gain, offset_um) = snapshot.model.frame().unwrap_or((1.0, 0.0));
        let other = snapshot.stand_in.as_ref().map_or("", |other| &other.model.name);
        let own = snapshot.model.answering();
        let source = match self.last.flags {
            _ if self.answered == 0 => String::new(),
            flags if flags & answer::STAND_IN != 0 => other.to_string(),
            flags if flags & NOT_FINITE_REPLACED != 0 => String::new(),
            flags if flags & BLENDED != 0 => format!("{own}+{other}"),
            _ => own.to_string(),
        };
        Report {
            snapshot_seq: snapshot.snapshot_seq,
            age_s: self.current.at.elapsed().as_secs_f64(),
            received: self.mailbox.received.load(Ordering::Relaxed),
            refused: self.mailbox.refused.load(Ordering::Relaxed),
            trust,
            stale,
            dt_s: snapshot.model.dt_s,
            memory_size: self.memory.len(),
            gain,
            offset_um,
            answered: self.answered,
            last: self.last,
            source,
        }
    }
}

/// (voltage, V, deviation, V) of the model of `snapshot` at a point, on a copy of `memory`.
fn voltage_at(snapshot: &mut Snapshot, memory: &[f64], point: [f64; 3]) -> (f64, f64) {
    let Snapshot { model, scratch, spare, .. } = snapshot;
    spare.copy_from_slice(memory);
    let mut got = (f64::NAN, f64::NAN);
    model.evaluate(1, |_| point, spare, scratch, |_, step| got = (step.u_v, step.std_v));
    got
}

/// Names of the bits in flags, for people.
pub fn flag_names(flags: u8) -> Vec<&'static str> {
    let names = [
        (answer::LIMITED_VOLTAGE, "limited_voltage"),
        (answer::LIMITED_SLEW, "limited_slew"),
        (OUTSIDE_DOMAIN, "outside_domain"),
        (NOT_FINITE_REPLACED, "not_finite_replaced"),
        (BLENDED, "blended"),
        (answer::STAND_IN, "stand_in"),
        (STALE, "stale"),
        (answer::CORRECTED, "corrected"),
    ];
    names.iter().filter(|(bit, _)| flags & bit != 0).map(|(_, name)| *name).collect()
}
