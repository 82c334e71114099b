//! Who owns `command` of an axis: one controller at a time, by a liveliness token (docs/protocol.md, "Who commands").

use crate::{authenticator::Authenticator, failed, locked};
use dehyst::{Error, Result};
use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use zenoh::{liveliness::LivelinessToken, pubsub::Subscriber, sample::SampleKind, Session, Wait};

/// Longest wait for the tokens that are alive.
const ASK: Duration = Duration::from_secs(1);

/// A controller by what its token says: order, sender, and the process in words. The greatest one owns.
type Holder = (u64, String, String);

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Ms that this host has run: a clock that is never set. Elsewhere than on Unix that of the wall.
fn order() -> u64 {
    #[cfg(unix)]
    {
        let mut now = libc::timespec { tv_sec: 0, tv_nsec: 0 };
        // SAFETY: writes to the local variable only.
        unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &mut now) };
        now.tv_sec as u64 * 1000 + now.tv_nsec as u64 / 1_000_000
    }
    #[cfg(not(unix))]
    unix_ms()
}

fn unix_ms() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64)
}

fn host() -> String {
    let read = std::fs::read_to_string("/proc/sys/kernel/hostname").ok();
    let name = read.or_else(|| std::env::var("HOSTNAME").ok()).unwrap_or_default();
    let plain = |c: char| if c.is_ascii_alphanumeric() || ".-".contains(c) { c } else { '-' };
    let name: String = name.trim().chars().map(plain).take(64).collect();
    if name.is_empty() {
        "unknown".into()
    } else {
        name
    }
}

/// What the token with this key says; none where it is malformed, or its tag is wrong.
fn read(by: &Authenticator, owners: &str, key: &str) -> Option<Holder> {
    let said: Vec<&str> = key.strip_prefix(owners)?.split('/').collect();
    let ([order, sender, process, host, _since], tag) = said.split_first_chunk()?;
    let name = said[..5].join("/");
    let made = by.tag(&[b"owner", format!("{owners}{name}").as_bytes()]);
    let right = made.is_none_or(|made| tag == [hex(&made)]);
    let holder = (order.parse().ok()?, sender.to_string(), format!("process {process} on {host}"));
    (right && order.len() <= 13 && sender.len() == 16).then_some(holder)
}

struct Held {
    mine: Holder,
    others: Arc<Mutex<BTreeSet<Holder>>>,
    _token: LivelinessToken,
    _watch: Subscriber<()>,
}

/// `command` of an axis for one controller. It ends when it is dropped.
pub struct Lease {
    session: Session,
    by: Arc<Authenticator>,
    /// What the keys of all tokens begin with, and the sender of this controller's commands.
    owners: String,
    sender: String,
    held: Option<Held>,
}

impl Lease {
    pub fn new(session: Session, by: Arc<Authenticator>, base: &str, sender: &[u8]) -> Lease {
        Lease { session, by, owners: format!("{base}/owner/"), sender: hex(sender), held: None }
    }

    /// Become the owner, if this controller is not yet; `force`: even if another one owns it, which then gets an error.
    pub fn take(&mut self, force: bool) -> Result<()> {
        let rivals = match &self.held {
            Some(held) => locked(&held.others).clone(),
            None => {
                let others = self.alive()?;
                if let (false, Some(owner)) = (force, others.last()) {
                    return Err(owned(owner));
                }
                self.held = Some(self.declare(order().max(others.last().map_or(0, |last| last.0 + 1)))?);
                self.alive()? // two may have begun at once
            }
        };
        match rivals.last().filter(|owner| self.held.as_ref().is_some_and(|held| **owner > held.mine)) {
            None => Ok(()),
            Some(owner) => {
                self.held = None;
                Err(owned(owner))
            }
        }
    }

    fn declare(&self, order: u64) -> Result<Held> {
        let process = std::process::id();
        let key = format!("{}{order}/{}/{process}/{}/{}", self.owners, self.sender, host(), unix_ms());
        let tag = self.by.tag(&[b"owner", key.as_bytes()]).map(|tag| format!("/{}", hex(&tag)));
        let token = self.session.liveliness().declare_token(key + &tag.unwrap_or_default());
        let others = Arc::new(Mutex::new(BTreeSet::new()));
        let (by, owners, sender, seen) = (self.by.clone(), self.owners.clone(), self.sender.clone(), others.clone());
        let watch = self.session.liveliness().declare_subscriber(format!("{}**", self.owners)).history(true);
        let watch = watch.callback(move |sample| {
            let holder = read(&by, &owners, sample.key_expr().as_str()).filter(|holder| holder.1 != sender);
            match (holder, sample.kind()) {
                (Some(holder), SampleKind::Put) => drop(locked(&seen).insert(holder)),
                (Some(holder), SampleKind::Delete) => drop(locked(&seen).remove(&holder)),
                (None, _) => {}
            }
        });
        let lost = |error| failed("command", error, "an open session");
        let (_token, _watch) = (token.wait().map_err(lost)?, watch.wait().map_err(lost)?);
        Ok(Held { mine: (order, self.sender.clone(), String::new()), others, _token, _watch })
    }

    /// Who else holds a token now.
    fn alive(&self) -> Result<BTreeSet<Holder>> {
        let asked = self.session.liveliness().get(format!("{}**", self.owners)).timeout(ASK);
        let replies = asked.wait().map_err(|error| failed("command", error, "an open session"))?;
        let tokens = replies.into_iter().filter_map(|reply| reply.into_result().ok());
        let holders = tokens.filter_map(|token| read(&self.by, &self.owners, token.key_expr().as_str()));
        Ok(holders.filter(|holder| holder.1 != self.sender).collect())
    }
}

fn owned(owner: &Holder) -> Error {
    let expected = format!("one: {} commands this axis. End it, or take it over (take_command)", owner.2);
    Error::new("command", "a second controller", expected)
}
