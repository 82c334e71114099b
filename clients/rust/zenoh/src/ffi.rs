//! `dehyst_open` and `dehyst_link_...` of `include/dehyst_zenoh.h`; the other functions are those of `dehyst.h`.

use crate::{open, Link, Options};
pub use dehyst::ffi::*;
use dehyst::Error;
use std::ffi::{c_char, c_int, CStr};
use std::time::Duration;

unsafe fn text(pointer: *const c_char, name: &str) -> dehyst::Result<String> {
    if pointer.is_null() {
        return Err(Error::new(name, "a null pointer", "a text"));
    }
    let text = CStr::from_ptr(pointer).to_str();
    Ok(text.map_err(|error| Error::new(name, error, "UTF-8"))?.to_string())
}

unsafe fn options(
    endpoint: *const c_char,
    stage: *const c_char,
    axis: *const c_char,
    timeout_s: f64,
) -> dehyst::Result<Options> {
    if !(0.0..=3600.0).contains(&timeout_s) {
        return Err(Error::new("timeout_s", timeout_s, "0 to 3600 s"));
    }
    Ok(Options {
        endpoints: text(endpoint, "endpoint")?.split(',').map(String::from).collect(),
        stage: text(stage, "stage")?,
        axis: text(axis, "axis")?,
        timeout: Duration::from_secs_f64(timeout_s),
        ..Options::default()
    })
}

/// # Safety
/// The texts end with a zero; `handle` is valid.
#[no_mangle]
pub unsafe extern "C" fn dehyst_open(
    endpoint: *const c_char,
    stage: *const c_char,
    axis: *const c_char,
    model: *const c_char,
    timeout_s: f64,
    handle: *mut *mut Handle,
) -> c_int {
    guarded(|| {
        let handle = handle.as_mut().ok_or_else(|| Error::new("handle", "a null pointer", "a valid pointer"))?;
        let options = options(endpoint, stage, axis, timeout_s)?;
        let options = Options { model: text(model, "model")?, ..options };
        let live = open(&options)?;
        *handle = Handle::into_raw(live.follower, Some(Box::new(live.feed)));
        Ok(())
    })
}

unsafe fn link<'a>(link: *const Link) -> dehyst::Result<&'a Link> {
    link.as_ref().ok_or_else(|| Error::new("link", "a null pointer", "an open link"))
}

unsafe fn column<'a, T>(values: *const T, n: usize, field: &str) -> dehyst::Result<&'a [T]> {
    if values.is_null() {
        return Err(Error::new(field, "a null pointer", format!("{n} values")));
    }
    Ok(std::slice::from_raw_parts(values, n))
}

unsafe fn give(found: &[u8], into: *mut u8, room: usize, count: *mut usize) -> dehyst::Result<()> {
    let count = count.as_mut().ok_or_else(|| Error::new("bytes", "a null pointer", "a valid pointer"))?;
    if found.len() > room || into.is_null() {
        return Err(Error::new("room", room, format!("at least {} bytes", found.len())));
    }
    std::ptr::copy_nonoverlapping(found.as_ptr(), into, found.len());
    *count = found.len();
    Ok(())
}

/// # Safety
/// The texts end with a zero, `receive` may be null; `opened` is valid.
#[no_mangle]
pub unsafe extern "C" fn dehyst_link_open(
    endpoint: *const c_char,
    stage: *const c_char,
    axis: *const c_char,
    receive: *const c_char,
    timeout_s: f64,
    opened: *mut *mut Link,
) -> c_int {
    guarded(|| {
        let opened = opened.as_mut().ok_or_else(|| Error::new("link", "a null pointer", "a valid pointer"))?;
        let key = if receive.is_null() { None } else { Some(text(receive, "receive")?) };
        let link = Link::open(&options(endpoint, stage, axis, timeout_s)?, key.as_deref())?;
        *opened = Box::into_raw(Box::new(link));
        Ok(())
    })
}

/// # Safety
/// `to` comes from `dehyst_link_open`; `payload` has `count` bytes.
#[no_mangle]
pub unsafe extern "C" fn dehyst_link_send(
    to: *const Link,
    key: *const c_char,
    payload: *const u8,
    count: usize,
) -> c_int {
    guarded(|| link(to)?.send(&text(key, "key")?, column(payload, count, "payload")?.to_vec()))
}

/// # Safety
/// `to` comes from `dehyst_link_open`.
#[no_mangle]
pub unsafe extern "C" fn dehyst_take_command(to: *const Link, force: c_int) -> c_int {
    guarded(|| link(to)?.take_command(force != 0))
}

/// # Safety
/// `to` comes from `dehyst_link_open`; the columns have `n` values each.
#[no_mangle]
pub unsafe extern "C" fn dehyst_samples(
    to: *const Link,
    n: usize,
    seq: *const i64,
    t_s: *const f64,
    u_v: *const f64,
    y_um: *const f64,
) -> c_int {
    guarded(|| {
        let (seq, t_s) = (column(seq, n, "seq")?, column(t_s, n, "t_s")?);
        link(to)?.samples(seq, t_s, column(u_v, n, "u_V")?, column(y_um, n, "y_um")?)
    })
}

/// # Safety
/// `from` comes from `dehyst_link_open`; `payload` has `room` bytes; one thread at a time.
#[no_mangle]
pub unsafe extern "C" fn dehyst_link_receive(
    from: *const Link,
    wait_s: f64,
    payload: *mut u8,
    room: usize,
    count: *mut usize,
) -> c_int {
    guarded(|| {
        if !(0.0..=3600.0).contains(&wait_s) {
            return Err(Error::new("wait_s", wait_s, "0 to 3600 s"));
        }
        let found = link(from)?.receive(Duration::from_secs_f64(wait_s)).unwrap_or_default();
        give(&found, payload, room, count)
    })
}

/// # Safety
/// `to` comes from `dehyst_link_open`; `query` has `query_bytes` bytes, `reply` has `room`.
#[no_mangle]
pub unsafe extern "C" fn dehyst_link_ask(
    to: *const Link,
    key: *const c_char,
    query: *const u8,
    query_bytes: usize,
    reply: *mut u8,
    room: usize,
    count: *mut usize,
) -> c_int {
    guarded(|| {
        let found = link(to)?.ask(&text(key, "key")?, column(query, query_bytes, "query")?)?;
        give(&found, reply, room, count)
    })
}

/// # Safety
/// `closed` comes from `dehyst_link_open` and is not used again; null does nothing.
#[no_mangle]
pub unsafe extern "C" fn dehyst_link_close(closed: *mut Link) {
    if !closed.is_null() {
        drop(Box::from_raw(closed));
    }
}
