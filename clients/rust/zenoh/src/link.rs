//! Bytes to and from the keys of an axis, without a model: what a stage, or a controller that asks ahead, needs.

use crate::{base_of, config, failed, key, lease::Lease, locked, random, Asker, Options};
use dehyst::{wire, Result};
use std::sync::mpsc::{channel, Receiver};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use zenoh::{pubsub::Subscriber, qos::CongestionControl, Wait};

/// Whose publications these are, how many there were, and the right to command.
struct Sent {
    sender: [u8; 8],
    number: u64,
    lease: Lease,
}

/// A connection. It ends when it is dropped.
pub struct Link {
    asker: Asker,
    /// Held while a message is sent, so that they arrive in order.
    sent: Mutex<Sent>,
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
        let asker = Asker { session, by: Arc::new(key::find(options.key.as_deref())?) };
        let [a, b, c, d, e, f, g, h, ..] = random();
        let sender = [a, b, c, d, e, f, g, h];
        let lease = Lease::new(asker.session.clone(), asker.by.clone(), &base, &sender);
        let sent = Mutex::new(Sent { sender, number: 0, lease });
        Ok(Link { asker, sent, base, timeout: options.timeout, received })
    }

    /// Publish on a key; waits while the wire is full, so that nothing is dropped. The first `command` makes this link
    /// the owner of the axis' voltages. It is an error where another controller owns them.
    pub fn send(&self, key: &str, payload: Vec<u8>) -> Result<()> {
        let mut sent = locked(&self.sent);
        if key == "command" {
            sent.lease.take(false)?;
        }
        let key = format!("{}/{key}", self.base);
        sent.number += 1;
        let attached = self.asker.by.publication(&key, sent.sender, sent.number, &payload);
        let put = self.asker.session.put(key, payload).congestion_control(CongestionControl::Block);
        put.attachment(attached).wait().map_err(|error| failed("send", error, "an open session"))
    }

    /// Command the axis from now on; `force`: although another controller does, whose commands are then left out.
    pub fn take_command(&self, force: bool) -> Result<()> {
        locked(&self.sent).lease.take(force)
    }

    /// Publish samples of the stage, which the service learns from; see [`dehyst::wire::samples`].
    pub fn samples(&self, seq: &[i64], t_s: &[f64], u_v: &[f64], y_um: &[f64]) -> Result<()> {
        self.send("sample", wire::samples(seq, t_s, u_v, y_um)?)
    }

    /// The next payload of the key that is received; none within `wait`.
    pub fn receive(&self, wait: Duration) -> Option<Vec<u8>> {
        self.received.as_ref().and_then(|(payloads, _)| payloads.recv_timeout(wait).ok())
    }

    /// The one reply to a query with a payload, such as one of kind 4 on `feedforward`.
    pub fn ask(&self, key: &str, payload: &[u8]) -> Result<Vec<u8>> {
        Ok(self.asker.get(&format!("{}/{key}", self.base), payload, self.timeout)?.0)
    }
}
