//! Bytes to and from the keys of an axis, without a model: what a stage, or a controller that asks ahead, needs.

use crate::{base_of, config, failed, get_with, Options};
use dehyst::Result;
use std::sync::mpsc::{channel, Receiver};
use std::time::Duration;
use zenoh::{pubsub::Subscriber, qos::CongestionControl, Session, Wait};

/// A connection. It ends when it is dropped.
pub struct Link {
    session: Session,
    base: String,
    timeout: Duration,
    /// Payloads of the key that is received, and what takes them from the wire.
    received: Option<(Receiver<Vec<u8>>, Subscriber<()>)>,
}

impl Link {
    /// Connect. `receive`: the key that is subscribed to, below `dehyst/v1/STAGE/AXIS/`, such as `command`.
    pub fn open(options: &Options, receive: Option<&str>) -> Result<Link> {
        let base = base_of(options)?;
        let session = zenoh::open(config(options)?)
            .wait()
            .map_err(|error| failed("endpoints", error, "the endpoint of a running service"))?;
        let received = match receive {
            None => None,
            Some(key) => {
                let (sender, payloads) = channel();
                let subscriber = session
                    .declare_subscriber(format!("{base}/{key}"))
                    .callback(move |sample| drop(sender.send(sample.payload().to_bytes().into_owned())))
                    .wait()
                    .map_err(|error| failed("receive", error, "a key of the axis"))?;
                Some((payloads, subscriber))
            }
        };
        Ok(Link { session, base, timeout: options.timeout, received })
    }

    /// Publish on a key; waits while the wire is full, so that nothing is dropped.
    pub fn send(&self, key: &str, payload: Vec<u8>) -> Result<()> {
        self.session
            .put(format!("{}/{key}", self.base), payload)
            .congestion_control(CongestionControl::Block)
            .wait()
            .map_err(|error| failed("send", error, "an open session"))
    }

    /// The next payload of the key that is received; none within `wait`.
    pub fn receive(&self, wait: Duration) -> Option<Vec<u8>> {
        self.received.as_ref().and_then(|(payloads, _)| payloads.recv_timeout(wait).ok())
    }

    /// The one reply to a query with a payload, such as one of kind 4 on `feedforward`.
    pub fn ask(&self, key: &str, payload: &[u8]) -> Result<Vec<u8>> {
        get_with(&self.session, &format!("{}/{key}", self.base), Some(payload), self.timeout)
    }
}
