//! A [`dehyst::Follower`] that is fed by a service over zenoh: docs/protocol.md, "Following a model".
//!
//! ```no_run
//! # fn main() -> Result<(), dehyst::Error> {
//! let mut live = dehyst_zenoh::open(&dehyst_zenoh::Options::default())?;
//! let point = live.follower.point(40.0, 1000.0, 0.0)?;
//! println!("{} V from {}", point.u_v, live.follower.report().source);
//! # Ok(()) }
//! ```

pub mod authenticator;
pub mod ffi;
pub mod key;
mod lease;
mod link;

pub use link::Link;

use authenticator::{Authenticator, Sender, STAMP};
use dehyst::json::{self, Value};
use dehyst::{Error, Follower, Limits, Publisher, Result, Update};
use std::hash::{BuildHasher, RandomState};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Subscriber;
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::{Config, Session, Wait};

/// Which service, and which of its models.
#[derive(Clone, Debug)]
pub struct Options {
    /// Of the service, and of its standby if there is one.
    pub endpoints: Vec<String>,
    pub stage: String,
    pub axis: String,
    /// Empty: the default of the service.
    pub model: String,
    /// Longest time until the first model is there.
    pub timeout: Duration,
    /// zenoh's own JSON5 file with certificates and passwords; the endpoints here come over it.
    pub zenoh_config: Option<std::path::PathBuf>,
    /// File with the key of the service; none: `DEHYST_KEY`, or that of this user on this machine.
    pub key: Option<std::path::PathBuf>,
}

impl Default for Options {
    fn default() -> Options {
        Options {
            endpoints: vec!["tcp/127.0.0.1:7447".into()],
            stage: "demo".into(),
            axis: "x".into(),
            model: String::new(),
            timeout: Duration::from_secs(2),
            zenoh_config: None,
            key: None,
        }
    }
}

/// Keeps the models coming: session and subscription end when it is dropped.
pub struct Feed {
    _subscriber: Option<Subscriber<()>>,
    asker: Asker,
    base: String,
    timeout: Duration,
}

/// A follower and what feeds it.
pub struct Live {
    pub follower: Follower,
    pub feed: Feed,
}

fn failed(field: &str, error: impl std::fmt::Display, expected: &str) -> Error {
    Error::new(field, error, expected)
}

/// What all keys of the axis begin with. Refuses names that are none.
fn base_of(options: &Options) -> Result<String> {
    for (field, name) in [("stage", &options.stage), ("axis", &options.axis)] {
        let good = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_' || c == '-';
        let first = name.chars().next().is_some_and(|c| c.is_ascii_lowercase());
        if !first || name.len() > 64 || !name.chars().all(good) {
            return Err(Error::new(field, name, "1 to 64 of a-z, 0-9, _ and -, beginning with a letter"));
        }
    }
    Ok(format!("dehyst/v1/{}/{}", options.stage, options.axis))
}

/// Connect, fetch the model, and follow it. Waits up to the time-out for the service.
pub fn open(options: &Options) -> Result<Live> {
    let base = base_of(options)?;
    let session = zenoh::open(config(options)?)
        .wait()
        .map_err(|error| failed("endpoints", error, "the endpoint of a running service"))?;
    let asker = Asker { session, by: Arc::new(key::find(options.key.as_deref())?) };
    let mut feed = Feed { _subscriber: None, asker, base, timeout: options.timeout };
    let status = feed.status()?;
    let text = |name: &str| status.get(name).and_then(Value::text).unwrap_or("").to_string();
    let name = if options.model.is_empty() { text("served") } else { options.model.clone() };
    let limits = limits_of(&status)?;
    // Subscribe before the fetch, so that no model is missed between the two; a follower is made by the fetch.
    let (early, waiting) = std::sync::mpsc::sync_channel::<(Vec<u8>, Vec<u8>)>(64);
    let sender = Arc::new(Mutex::new(Sender(0)));
    let publisher = Arc::new(OnceLock::<Publisher>::new());
    let key = match name.as_str() {
        "auto" => Some("champion"),
        other if other == text("learning") => Some("model"),
        _ => None, // what does not learn is not published
    };
    // A service that publishes no changes publishes whole models.
    let changes = status.get("delta_hz").and_then(Value::number).is_some_and(|rate| rate > 0.0);
    let whole = format!("{}/model?name={name}{}", feed.base, if changes { ";changes=1" } else { "" });
    let fetch = fetcher(feed.asker.clone(), whole.clone(), publisher.clone(), sender.clone());
    let key = key.map(|key| format!("{}/{key}{}", feed.base, if changes { "_delta" } else { "" }));
    if let Some(key) = key.clone() {
        let (publisher, fetch, sender) = (publisher.clone(), fetch.clone(), sender.clone());
        let by = feed.asker.by.clone();
        let subscriber = feed
            .asker
            .session
            .declare_subscriber(key.clone())
            .callback(move |sample| {
                let (payload, attached) = (sample.payload().to_bytes(), bytes_of(sample.attachment()));
                let Some(publisher) = publisher.get() else {
                    return drop(early.try_send((payload.into_owned(), attached)));
                };
                let known = match locked(&sender).hear(&by, &key, &attached, &payload) {
                    // What is refused is counted there.
                    Some(true) => !matches!(publisher.update(&payload), Ok(Update::Lost)),
                    refused => refused.is_some(), // else another instance serves
                };
                if !known {
                    let _ = fetch.try_send(()); // one that waits already is enough
                }
            })
            .wait()
            .map_err(|error| failed("model", error, "a subscription"))?;
        feed._subscriber = Some(subscriber);
    }
    let (model, attached) = feed.asker.get(&whole, &[], feed.timeout)?;
    let follower = Follower::new(&model, limits)?;
    locked(&sender).meet(&attached);
    let own = follower.publisher();
    while let Ok((payload, attached)) = waiting.try_recv() {
        let key = key.as_deref().unwrap_or_default();
        if locked(&sender).hear(&feed.asker.by, key, &attached, &payload) == Some(true) {
            let _ = own.update(&payload); // what is missing shows with the next change
        }
    }
    drop(publisher.set(own));
    Ok(Live { follower, feed })
}

/// Pause between two fetches of the whole model.
const FETCH_PAUSE: Duration = Duration::from_secs(1);

/// A thread that fetches the whole model when it is told that one is missing. It ends with the sender.
fn fetcher(
    asker: Asker,
    selector: String,
    publisher: Arc<OnceLock<Publisher>>,
    whose: Arc<Mutex<Sender>>,
) -> SyncSender<()> {
    let (sender, missing) = std::sync::mpsc::sync_channel::<()>(1);
    let work = move || {
        while missing.recv().is_ok() {
            if let (Some(publisher), Ok((payload, attached))) =
                (publisher.get(), asker.get(&selector, &[], Duration::from_secs(2)))
            {
                locked(&whose).meet(&attached);
                let _ = publisher.update(&payload); // an error is counted there
            }
            std::thread::sleep(FETCH_PAUSE);
        }
    };
    drop(std::thread::Builder::new().name("dehyst-fetch".into()).spawn(work));
    sender
}

fn config(options: &Options) -> Result<Config> {
    let mut config = match &options.zenoh_config {
        Some(path) => {
            Config::from_file(path).map_err(|error| failed("zenoh_config", error, "a JSON5 file of zenoh"))?
        }
        None => Config::default(),
    };
    let endpoints: Vec<String> = options.endpoints.iter().map(|endpoint| format!("{endpoint:?}")).collect();
    for (key, value) in [
        ("mode", "\"client\"".to_string()),
        ("connect/endpoints", format!("[{}]", endpoints.join(","))),
        ("connect/timeout_ms", options.timeout.as_millis().to_string()),
        ("scouting/multicast/enabled", "false".to_string()),
        ("scouting/gossip/enabled", "false".to_string()),
    ] {
        config.insert_json5(key, &value).map_err(|error| failed(key, error, "a setting of zenoh"))?;
    }
    Ok(config)
}

fn limits_of(status: &Value) -> Result<Limits> {
    let limits = status.get("limits").ok_or_else(|| Error::new("status", "no limits", "the five limits of an axis"))?;
    let of = |name: &str, missing: f64| limits.get(name).and_then(Value::number).unwrap_or(missing);
    let limits = Limits {
        u_min_v: of("u_min_V", f64::NAN),
        u_max_v: of("u_max_V", f64::NAN),
        slew_v_per_s: of("slew_V_per_s", f64::INFINITY),
        y_min_um: of("y_min_um", f64::NEG_INFINITY),
        y_max_um: of("y_max_um", f64::INFINITY),
    };
    limits.check()?;
    Ok(limits)
}

impl Feed {
    /// The status of the axis, as docs/protocol.md has it.
    pub fn status(&self) -> Result<Value> {
        json::parse(&self.get(&format!("{}/status", self.base))?)
    }

    /// The reply to a query, which is repeated until the time-out while nobody answers.
    pub fn get(&self, selector: &str) -> Result<Vec<u8>> {
        Ok(self.asker.get(selector, &[], self.timeout)?.0)
    }
}

fn locked<T>(held: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    held.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

fn bytes_of(attached: Option<&ZBytes>) -> Vec<u8> {
    attached.map(|bytes| bytes.to_bytes().into_owned()).unwrap_or_default()
}

/// 16 bytes that nobody can foresee: a keyed hash under keys of the operating system.
fn random() -> [u8; STAMP] {
    let half = || RandomState::new().hash_one(Instant::now()).to_le_bytes();
    let mut made = [0; STAMP];
    made[..8].copy_from_slice(&half());
    made[8..].copy_from_slice(&half());
    made
}

/// Asks a service, and believes what carries its authenticator.
#[derive(Clone)]
struct Asker {
    session: Session,
    by: Arc<Authenticator>,
}

impl Asker {
    /// The first right reply to a query and its attachment. The query is repeated until the time-out while there is none.
    fn get(&self, selector: &str, payload: &[u8], timeout: Duration) -> Result<(Vec<u8>, Vec<u8>)> {
        let until = Instant::now() + timeout;
        let parameters = selector.split_once('?').map_or("", |(_, parameters)| parameters);
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let stamp = random();
            // What is under way is believed of who has the key; payloads are on `feedforward` alone.
            let key = selector.split('?').next().unwrap_or_default();
            let parts: [&[u8]; 5] = [b"query", key.as_bytes(), &stamp, parameters.as_bytes(), payload];
            let tag = self.by.tag(&parts).filter(|_| !payload.is_empty());
            let attached: Vec<u8> = stamp.into_iter().chain(tag.into_iter().flatten()).collect();
            let asked = self.session.get(selector).timeout(left.max(Duration::from_millis(100)));
            // Whoever answers first must not keep the others' replies from us.
            let asked = asked.target(QueryTarget::All).consolidation(ConsolidationMode::None).attachment(attached);
            let asked = if payload.is_empty() { asked } else { asked.payload(payload) };
            let replies = asked.wait().map_err(|error| failed("query", error, "an open session"))?;
            let (mut failure, mut unsigned) = (None, 0);
            while let Ok(reply) = replies.recv() {
                match reply.result() {
                    Ok(sample) => {
                        let (reply, attached) = (sample.payload().to_bytes(), bytes_of(sample.attachment()));
                        let asked = [&stamp[..], parameters.as_bytes(), payload];
                        if self.by.answers(sample.key_expr().as_str(), asked, &attached, &reply) {
                            return Ok((reply.into_owned(), attached));
                        }
                        unsigned += 1;
                    }
                    // Anybody can send one: it counts where there is no right reply.
                    Err(error) => drop(failure.get_or_insert_with(|| error.payload().to_bytes().into_owned())),
                }
            }
            if let Some(failure) = failure {
                if let Some(pause) = busy(&failure) {
                    // Others ask for too much; the service says when to ask again.
                    std::thread::sleep(pause.min(until.saturating_duration_since(Instant::now())));
                } else if !String::from_utf8_lossy(&failure).to_lowercase().contains("timeout") {
                    return Err(refusal(&failure));
                }
            }
            if Instant::now() >= until {
                if unsigned > 0 {
                    let got = format!("{unsigned} replies without the authenticator of the service");
                    return Err(Error::new(selector, got, "the key that 'dehyst serve' prints, as key or DEHYST_KEY"));
                }
                let expected = "a running service for this stage and axis, which this role may query";
                return Err(Error::new(selector, "no reply", expected));
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

/// How long to wait before the query is repeated, where the service is busy.
fn busy(payload: &[u8]) -> Option<Duration> {
    let data = json::parse(payload).ok()?;
    let seconds = data.get("retry_after_s").and_then(Value::number)?;
    let is_busy = data.get("error").and_then(Value::text) == Some("busy");
    (is_busy && (0.0..3600.0).contains(&seconds)).then(|| Duration::from_secs_f64(seconds))
}

/// The error in an error reply.
fn refusal(payload: &[u8]) -> Error {
    let data = json::parse(payload).unwrap_or(Value::Null);
    let text = |name: &str| data.get(name).and_then(Value::text).unwrap_or("").to_string();
    if text("field").is_empty() {
        return Error::new("service", String::from_utf8_lossy(payload), "an answer");
    }
    Error::new(text("field"), text("got"), text("expected"))
}
