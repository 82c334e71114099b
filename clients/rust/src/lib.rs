//! Evaluates the models of a dehyst service in the controller's own process, by docs/protocol.md.
//!
//! A [`Follower`] is made of the payload of a model and of the limits of the axis. It answers a point in microseconds,
//! without a lock or an allocation, with the voltages of the service to 1e-12 V. Another thread hands it newer payloads
//! through its [`Publisher`], whole models or their changes; how they come is the caller's business (the crate in `zenoh/` subscribes to a service).
//!
//! ```no_run
//! use dehyst::{Follower, Limits};
//! # fn main() -> Result<(), dehyst::Error> {
//! # let payload: Vec<u8> = Vec::new();
//! let limits = Limits { u_min_v: 0.0, u_max_v: 10.0, slew_v_per_s: 2000.0, y_min_um: 0.0, y_max_um: 90.0 };
//! let mut follower = Follower::new(&payload, limits)?;
//! let publisher = follower.publisher(); // give this to the thread that receives
//! let point = follower.point(40.0, 1000.0, 0.0)?;
//! println!("{} V, {:?}", point.u_v, dehyst::flag_names(point.flags));
//! # let _ = publisher; Ok(()) }
//! ```
//!
//! The same through C: `include/dehyst.h`.

pub mod answer;
pub mod correction;
mod delta;
mod error;
pub mod ffi;
mod follower;
pub mod json;
mod kernel;
mod model;
pub mod repetition;
mod snapshot;
pub mod wire;

pub use answer::{Limits, Motion, Out};
pub use correction::{Correcting, CorrectionSettings};
pub use delta::{Changes, Update};
pub use error::{Error, Result};
pub use follower::{flag_names, Follower, Point, Publisher, Report};
pub use snapshot::Snapshot;
