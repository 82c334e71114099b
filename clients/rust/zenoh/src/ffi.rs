//! `dehyst_open` of `include/dehyst_zenoh.h`; the other functions are those of `dehyst.h`.

use crate::{open, Options};
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
        if !(0.0..=3600.0).contains(&timeout_s) {
            return Err(Error::new("timeout_s", timeout_s, "0 to 3600 s"));
        }
        let handle = handle.as_mut().ok_or_else(|| Error::new("handle", "a null pointer", "a valid pointer"))?;
        let options = Options {
            endpoints: text(endpoint, "endpoint")?.split(',').map(String::from).collect(),
            stage: text(stage, "stage")?,
            axis: text(axis, "axis")?,
            model: text(model, "model")?,
            timeout: Duration::from_secs_f64(timeout_s),
            zenoh_config: None,
        };
        let live = open(&options)?;
        *handle = Handle::into_raw(live.follower, Some(Box::new(live.feed)));
        Ok(())
    })
}
