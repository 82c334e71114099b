//! A [`dehyst::Follower`] that is fed by a service over zenoh: docs/protocol.md, "Following a model".
//!
//! ```no_run
//! # fn main() -> Result<(), dehyst::Error> {
//! let mut live = dehyst_zenoh::open(&dehyst_zenoh::Options::default())?;
//! let point = live.follower.point(40.0, 1000.0, 0.0)?;
//! println!("{} V from {}", point.u_v, live.follower.report().source);
//! # Ok(()) }
//! ```

pub mod ffi;
mod link;

pub use link::Link;

use dehyst::json::{self, Value};
use dehyst::{Error, Follower, Limits, Publisher, Result, Update};
use std::sync::mpsc::{SyncSender, TryRecvError};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};
use zenoh::pubsub::Subscriber;
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
        }
    }
}

/// Keeps the models coming: session and subscription end when it is dropped.
pub struct Feed {
    _subscriber: Option<Subscriber<()>>,
    session: Session,
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
    let mut feed = Feed { _subscriber: None, session, base, timeout: options.timeout };
    let status = feed.status()?;
    let text = |name: &str| status.get(name).and_then(Value::text).unwrap_or("").to_string();
    let name = if options.model.is_empty() { text("served") } else { options.model.clone() };
    let limits = limits_of(&status)?;
    // Subscribe before the fetch, so that no model is missed between the two; a follower is made by the fetch.
    let (early, waiting) = std::sync::mpsc::sync_channel::<Vec<u8>>(64);
    let publisher = Arc::new(OnceLock::<Publisher>::new());
    let key = match name.as_str() {
        "auto" => Some("champion"),
        other if other == text("learning") => Some("model"),
        _ => None, // what does not learn is not published
    };
    // A service that publishes no changes publishes whole models.
    let changes = status.get("delta_hz").and_then(Value::number).is_some_and(|rate| rate > 0.0);
    let whole = format!("{}/model?name={name}{}", feed.base, if changes { ";changes=1" } else { "" });
    let repair = repairer(feed.session.clone(), whole.clone(), publisher.clone());
    if let Some(key) = key {
        let key = if changes { format!("{key}_delta") } else { key.to_string() };
        let publisher = publisher.clone();
        let repair = repair.clone();
        let subscriber = feed
            .session
            .declare_subscriber(format!("{}/{key}", feed.base))
            .callback(move |sample| {
                let payload = sample.payload().to_bytes();
                match publisher.get() {
                    Some(publisher) => {
                        // What is refused is counted there. A whole model is complete again; changes are not.
                        if !matches!(publisher.update(&payload), Ok(Update::Taken | Update::Known | Update::Waits)) {
                            let _ = repair.try_send(()); // one that waits already is enough
                        }
                    }
                    None => drop(early.try_send(payload.into_owned())),
                }
            })
            .wait()
            .map_err(|error| failed("model", error, "a subscription"))?;
        feed._subscriber = Some(subscriber);
    }
    let follower = Follower::new(&feed.get(&whole)?, limits)?;
    let own = follower.publisher();
    let mut missing = false;
    while let Ok(payload) = waiting.try_recv() {
        missing = !matches!(own.update(&payload), Ok(Update::Taken | Update::Known));
    }
    drop(publisher.set(own));
    if missing {
        let _ = repair.try_send(()); // one that waits already is enough
    }
    Ok(Live { follower, feed })
}

/// A thread that fetches the whole model when it is told that a change is missing. It ends with the sender.
fn repairer(session: Session, selector: String, publisher: Arc<OnceLock<Publisher>>) -> SyncSender<()> {
    let (sender, missing) = std::sync::mpsc::sync_channel::<()>(1);
    let work = move || {
        while missing.recv().is_ok() {
            let mut pause = Duration::from_millis(5);
            while let Some(publisher) = publisher.get() {
                let got =
                    get(&session, &selector, Duration::from_secs(2)).and_then(|payload| publisher.update(&payload));
                // Until the changes that came meanwhile follow the model that was fetched.
                if matches!(got, Ok(Update::Taken)) {
                    break;
                }
                std::thread::sleep(pause);
                pause = (2 * pause).min(Duration::from_secs(1));
                if matches!(missing.try_recv(), Err(TryRecvError::Disconnected)) {
                    return;
                }
            }
        }
    };
    drop(std::thread::Builder::new().name("dehyst-repair".into()).spawn(work));
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

    /// The one reply to a query, which is repeated until the time-out while nobody answers.
    pub fn get(&self, selector: &str) -> Result<Vec<u8>> {
        get(&self.session, selector, self.timeout)
    }
}

/// The one reply to a query, which is repeated until the time-out while nobody answers.
fn get(session: &Session, selector: &str, timeout: Duration) -> Result<Vec<u8>> {
    get_with(session, selector, None, timeout)
}

fn get_with(session: &Session, selector: &str, payload: Option<&[u8]>, timeout: Duration) -> Result<Vec<u8>> {
    let until = Instant::now() + timeout;
    loop {
        let left = until.saturating_duration_since(Instant::now());
        let asked = session.get(selector).timeout(left.max(Duration::from_millis(100)));
        let asked = match payload {
            Some(payload) => asked.payload(payload),
            None => asked,
        };
        let replies = asked.wait().map_err(|error| failed("query", error, "an open session"))?;
        while let Ok(reply) = replies.recv() {
            match reply.result() {
                Ok(sample) => return Ok(sample.payload().to_bytes().into_owned()),
                Err(error) => {
                    let payload = error.payload().to_bytes();
                    if let Some(pause) = busy(&payload) {
                        // Others ask for too much; the service says when to ask again.
                        std::thread::sleep(pause.min(until.saturating_duration_since(Instant::now())));
                        continue;
                    }
                    if !String::from_utf8_lossy(&payload).to_lowercase().contains("timeout") {
                        return Err(refusal(&payload));
                    }
                }
            }
        }
        if Instant::now() >= until {
            let expected = "a running service for this stage and axis, which this role may query";
            return Err(Error::new(selector, "no reply", expected));
        }
        std::thread::sleep(Duration::from_millis(50));
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
