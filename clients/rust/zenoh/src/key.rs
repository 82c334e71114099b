//! Where the key of a service lies: docs/access.md, "The key".

use crate::authenticator::Authenticator;
use dehyst::{Error, Result};
use std::path::{Path, PathBuf};

/// By a key of 16 to 64 bytes.
pub fn by_key(key: &[u8]) -> Result<Authenticator> {
    if !(16..=64).contains(&key.len()) {
        return Err(Error::new("key", format!("{} bytes", key.len()), "16 to 64 bytes"));
    }
    Ok(Authenticator(key.to_vec()))
}

/// By the key in a file, or for `None` by that of this user on this machine, if there is one.
pub fn find(path: Option<&Path>) -> Result<Authenticator> {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let state = || set("XDG_STATE_HOME").or_else(|| Some(set("HOME")?.join(".local/state")));
    let own = || Some(state()?.join("dehyst/key")).filter(|path| path.exists());
    let named = path.map(PathBuf::from).or_else(|| set("DEHYST_KEY"));
    let Some(path) = named.or_else(own).filter(|path| path != Path::new("-")) else {
        return Ok(Authenticator::default());
    };
    let unread = |error| Error::new("key", format!("{}: {error}", path.display()), "a file with a key");
    by_key(std::fs::read(&path).map_err(unread)?.trim_ascii())
}
