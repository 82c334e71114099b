//! One error for everything that a caller or a peer can get wrong: the field, what was got, what was expected.

use std::fmt;

/// A payload or an argument that is not acceptable.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Error {
    /// Name of the field as docs/protocol.md has it.
    pub field: String,
    pub got: String,
    pub expected: String,
}

impl Error {
    pub fn new(field: impl Into<String>, got: impl fmt::Display, expected: impl Into<String>) -> Error {
        Error { field: field.into(), got: got.to_string(), expected: expected.into() }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: got {}, expected {}", self.field, self.got, self.expected)
    }
}

impl std::error::Error for Error {}

pub type Result<T> = std::result::Result<T, Error>;
