//! The C interface of `include/dehyst.h`. Panics do not cross it.

use crate::answer::{Limits, Out};
use crate::correction::{Added, Correcting, CorrectionSettings};
use crate::delta::Update;
use crate::error::{Error, Result};
use crate::follower::{Follower, Publisher};
use std::cell::{RefCell, UnsafeCell};
use std::ffi::{c_char, c_int};
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::slice;

/// What a handle points to. The publisher is used by any thread, the follower by one thread at a time.
pub struct Handle {
    publisher: Publisher,
    follower: UnsafeCell<Follower>,
    /// Kept until the handle is closed: whatever feeds the publisher.
    _feeder: Option<Box<dyn Send>>,
}

impl Handle {
    /// A handle for C, with what feeds the follower.
    pub fn into_raw(follower: Follower, feeder: Option<Box<dyn Send>>) -> *mut Handle {
        let publisher = follower.publisher();
        Box::into_raw(Box::new(Handle { publisher, follower: UnsafeCell::new(follower), _feeder: feeder }))
    }
}

#[repr(C)]
pub struct CLimits {
    u_min_v: f64,
    u_max_v: f64,
    slew_v_per_s: f64,
    y_min_um: f64,
    y_max_um: f64,
}

#[repr(C)]
pub struct CPoint {
    u_v: f64,
    std_v: f64,
    flags: u32,
}

#[repr(C)]
pub struct CCorrected {
    integral: Added,
    repetition: Added,
    noise_um: f64,
    period: f64,
    age: i64,
    active: u32,
}

#[repr(C)]
pub struct CReport {
    snapshot_seq: i64,
    received: u64,
    refused: u64,
    answered: u64,
    age_s: f64,
    trust: f64,
    dt_s: f64,
    gain: f64,
    offset_um: f64,
    last: CPoint,
    memory_size: u32,
    stale: u32,
    source: [c_char; 132],
}

const OK: c_int = 0;
const REFUSED: c_int = -1;
const INTERNAL: c_int = -2;
/// Of `dehyst_update`: the whole model of a change is missing.
const WHOLE_NEEDED: c_int = 1;

thread_local! {
    /// Text of the last error of this thread, with a zero at its end.
    static LAST_ERROR: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
}

fn note(text: &str) {
    LAST_ERROR.with(|last| {
        let mut bytes = last.borrow_mut();
        bytes.clear();
        bytes.extend(text.bytes().filter(|byte| *byte != 0));
        bytes.push(0);
    });
}

/// Run `work`; an error or a panic becomes a status and the text of `dehyst_error`.
pub fn guarded(work: impl FnOnce() -> Result<()>) -> c_int {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(Ok(())) => OK,
        Ok(Err(error)) => {
            note(&error.to_string());
            REFUSED
        }
        Err(_) => {
            note("internal error: a panic, please report it with the payload");
            INTERNAL
        }
    }
}

fn missing(name: &str) -> Error {
    Error::new(name, "a null pointer", "a valid pointer")
}

/// SAFETY of all slices: the caller promises `n` readable (or writable) elements, as the header says.
unsafe fn read<'a, T>(pointer: *const T, n: usize, name: &str) -> Result<&'a [T]> {
    if n == 0 {
        return Ok(&[]);
    }
    if pointer.is_null() {
        return Err(missing(name));
    }
    Ok(slice::from_raw_parts(pointer, n))
}

/// As `read`; a null pointer is an empty slice.
unsafe fn optional<'a>(pointer: *const f64, n: usize) -> &'a [f64] {
    if pointer.is_null() || n == 0 {
        return &[];
    }
    slice::from_raw_parts(pointer, n)
}

unsafe fn write<'a, T>(pointer: *mut T, n: usize, name: &str) -> Result<&'a mut [T]> {
    if n == 0 {
        return Ok(&mut []);
    }
    if pointer.is_null() {
        return Err(missing(name));
    }
    Ok(slice::from_raw_parts_mut(pointer, n))
}

#[allow(clippy::mut_from_ref)] // the header asks for one thread at a time
unsafe fn follower<'a>(handle: *mut Handle) -> Result<&'a mut Follower> {
    let handle = handle.as_ref().ok_or_else(|| missing("handle"))?;
    Ok(&mut *handle.follower.get())
}

unsafe fn correcting<'a>(handle: *mut Handle) -> Result<&'a mut Correcting> {
    let own = follower(handle)?.correcting();
    own.ok_or_else(|| Error::new("handle", "no correction", "dehyst_correct before"))
}

/// Version of the wire and of this interface: 1.
#[no_mangle]
pub extern "C" fn dehyst_version() -> u32 {
    1
}

/// # Safety
/// `payload` has `bytes` bytes; `limits` and `handle` are valid.
#[no_mangle]
pub unsafe extern "C" fn dehyst_open_payload(
    payload: *const u8,
    bytes: usize,
    limits: *const CLimits,
    handle: *mut *mut Handle,
) -> c_int {
    guarded(|| {
        let limits = limits.as_ref().ok_or_else(|| missing("limits"))?;
        let handle = handle.as_mut().ok_or_else(|| missing("handle"))?;
        let limits = Limits {
            u_min_v: limits.u_min_v,
            u_max_v: limits.u_max_v,
            slew_v_per_s: limits.slew_v_per_s,
            y_min_um: limits.y_min_um,
            y_max_um: limits.y_max_um,
        };
        *handle = Handle::into_raw(Follower::new(read(payload, bytes, "payload")?, limits)?, None);
        Ok(())
    })
}

/// # Safety
/// `handle` is open, `payload` has `bytes` bytes.
#[no_mangle]
pub unsafe extern "C" fn dehyst_update(handle: *mut Handle, payload: *const u8, bytes: usize) -> c_int {
    let mut needed = false;
    let status = guarded(|| {
        let handle = handle.as_ref().ok_or_else(|| missing("handle"))?;
        let update = handle.publisher.update(read(payload, bytes, "payload")?)?;
        needed = update == Update::Lost;
        Ok(())
    });
    if status == OK && needed {
        WHOLE_NEEDED
    } else {
        status
    }
}

/// # Safety
/// `handle` is open and not in use by another thread.
#[no_mangle]
pub unsafe extern "C" fn dehyst_start(handle: *mut Handle, u_before_v: f64) -> c_int {
    guarded(|| {
        follower(handle)?.start(u_before_v);
        Ok(())
    })
}

/// # Safety
/// `handle` is open and not in use by another thread; `y_um` and `u_v` have `n` elements.
#[no_mangle]
pub unsafe extern "C" fn dehyst_advance(handle: *mut Handle, n: usize, y_um: *const f64, u_v: *const f64) -> c_int {
    guarded(|| follower(handle)?.advance(read(y_um, n, "y_um")?, read(u_v, n, "u_V")?))
}

/// # Safety
/// `handle` is open and not in use by another thread; `integral` and `repetition` are valid, or null.
#[no_mangle]
pub unsafe extern "C" fn dehyst_correct(
    handle: *mut Handle,
    integral: *const CorrectionSettings,
    repetition: *const CorrectionSettings,
) -> c_int {
    guarded(|| follower(handle)?.correct(integral.as_ref().copied(), repetition.as_ref().copied()))
}

/// # Safety
/// `handle` is open and not in use by another thread.
#[no_mangle]
pub unsafe extern "C" fn dehyst_period(handle: *mut Handle, period_s: f64) -> c_int {
    guarded(|| {
        let repetition = correcting(handle)?.repetition.as_mut();
        let repetition = repetition.ok_or_else(|| Error::new("handle", "no repetition", "its settings before"))?;
        repetition.state((!period_s.is_nan()).then_some(period_s))
    })
}

/// # Safety
/// `handle` is open and not in use by another thread.
#[no_mangle]
pub unsafe extern "C" fn dehyst_number(handle: *mut Handle, seq: i64) -> c_int {
    guarded(|| follower(handle)?.number(seq))
}

/// # Safety
/// `handle` is open and not in use by another thread; `seq` and `y_um` have `n` elements.
#[no_mangle]
pub unsafe extern "C" fn dehyst_read(handle: *mut Handle, n: usize, seq: *const i64, y_um: *const f64) -> c_int {
    guarded(|| follower(handle)?.read(read(seq, n, "seq")?, read(y_um, n, "y_um")?))
}

/// # Safety
/// `handle` is open and not in use by another thread; `corrected` is valid, or null.
#[no_mangle]
pub unsafe extern "C" fn dehyst_corrected(handle: *mut Handle, on: c_int, corrected: *mut CCorrected) -> c_int {
    guarded(|| {
        let own = correcting(handle)?;
        own.on = on != 0;
        if let Some(corrected) = corrected.as_mut() {
            let (integral, repetition) = (own.integral.as_ref(), own.repetition.as_ref());
            *corrected = CCorrected {
                integral: integral.map_or_else(Added::default, |own| own.added),
                repetition: repetition.map_or_else(Added::default, |own| own.added),
                noise_um: integral.map_or(f64::NAN, |own| own.noise_um),
                period: repetition.and_then(|own| own.period).unwrap_or(f64::NAN),
                age: own.age,
                active: repetition.is_some_and(|own| own.active).into(),
            };
        }
        Ok(())
    })
}

/// # Safety
/// `handle` is open and not in use by another thread; `point` is valid.
#[no_mangle]
pub unsafe extern "C" fn dehyst_point(
    handle: *mut Handle,
    y_um: f64,
    v_um_per_s: f64,
    a_um_per_s2: f64,
    point: *mut CPoint,
) -> c_int {
    guarded(|| {
        let got = follower(handle)?.point(y_um, v_um_per_s, a_um_per_s2)?;
        let point = point.as_mut().ok_or_else(|| missing("point"))?;
        *point = CPoint { u_v: got.u_v, std_v: got.std_v, flags: got.flags.into() };
        Ok(())
    })
}

/// # Safety
/// `handle` is open and not in use by another thread.
#[no_mangle]
pub unsafe extern "C" fn dehyst_warm(handle: *mut Handle, y_um: f64, v_um_per_s: f64, a_um_per_s2: f64) -> c_int {
    guarded(|| follower(handle)?.warm(y_um, v_um_per_s, a_um_per_s2))
}

/// # Safety
/// `handle` is open and not in use by another thread; all pointers have `n` elements, `v` and `a` may be null.
#[no_mangle]
pub unsafe extern "C" fn dehyst_block(
    handle: *mut Handle,
    n: usize,
    y_um: *const f64,
    v_um_per_s: *const f64,
    a_um_per_s2: *const f64,
    u_v: *mut f64,
    std_v: *mut f64,
    flags: *mut u8,
) -> c_int {
    guarded(|| {
        let mut out =
            Out { u_v: write(u_v, n, "u_V")?, std_v: write(std_v, n, "std_V")?, flags: write(flags, n, "flags")? };
        let (v, a) = (optional(v_um_per_s, n), optional(a_um_per_s2, n));
        follower(handle)?.block(read(y_um, n, "y_um")?, v, a, &mut out)
    })
}

/// # Safety
/// `handle` is open and not in use by another thread; `query` has `bytes` bytes, `reply` has `room` bytes.
#[no_mangle]
pub unsafe extern "C" fn dehyst_query(
    handle: *mut Handle,
    query: *const u8,
    bytes: usize,
    age_s: f64,
    reply: *mut u8,
    room: usize,
    length: *mut usize,
) -> c_int {
    guarded(|| {
        let age_s = (!age_s.is_nan()).then_some(age_s);
        let encoded = follower(handle)?.reply(read(query, bytes, "query")?, age_s)?.encode();
        *length.as_mut().ok_or_else(|| missing("length"))? = encoded.len();
        if encoded.len() > room {
            return Err(Error::new("room", room, format!("at least {} bytes", encoded.len())));
        }
        write(reply, encoded.len(), "reply")?.copy_from_slice(&encoded);
        Ok(())
    })
}

/// # Safety
/// `handle` is open and not in use by another thread; `memory` has `room` elements.
#[no_mangle]
pub unsafe extern "C" fn dehyst_memory(handle: *mut Handle, memory: *mut f64, room: usize) -> c_int {
    guarded(|| {
        let own = follower(handle)?.memory();
        if own.len() > room {
            return Err(Error::new("room", room, format!("at least {} doubles", own.len())));
        }
        write(memory, own.len(), "memory")?.copy_from_slice(own);
        Ok(())
    })
}

/// # Safety
/// `handle` is open and not in use by another thread; `report` is valid.
#[no_mangle]
pub unsafe extern "C" fn dehyst_report(handle: *mut Handle, report: *mut CReport) -> c_int {
    guarded(|| {
        let got = follower(handle)?.report();
        let report = report.as_mut().ok_or_else(|| missing("report"))?;
        let mut source = [0; 132];
        for (to, byte) in source[..131].iter_mut().zip(got.source.bytes()) {
            *to = byte as c_char;
        }
        *report = CReport {
            snapshot_seq: got.snapshot_seq,
            received: got.received,
            refused: got.refused,
            answered: got.answered,
            age_s: got.age_s,
            trust: got.trust,
            dt_s: got.dt_s,
            gain: got.gain,
            offset_um: got.offset_um,
            last: CPoint { u_v: got.last.u_v, std_v: got.last.std_v, flags: got.last.flags.into() },
            memory_size: got.memory_size as u32,
            stale: got.stale.into(),
            source,
        };
        Ok(())
    })
}

/// Text of the last error of the calling thread; valid until its next call. Never null.
#[no_mangle]
pub extern "C" fn dehyst_error() -> *const c_char {
    LAST_ERROR.with(|last| {
        if last.borrow().is_empty() {
            last.borrow_mut().push(0);
        }
        last.borrow().as_ptr().cast()
    })
}

/// # Safety
/// `handle` is open and not in use; it is not used again. Null is allowed.
#[no_mangle]
pub unsafe extern "C" fn dehyst_close(handle: *mut Handle) {
    if !handle.is_null() {
        let _ = catch_unwind(AssertUnwindSafe(|| drop(Box::from_raw(handle))));
    }
}
