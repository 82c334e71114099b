//! The JSON of a model payload: a strict parser of one value, without dependencies.

use crate::error::{Error, Result};

/// Deepest nesting that is read, so that no text overflows the stack.
const MAX_DEPTH: usize = 32;

#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    Null,
    Bool(bool),
    Number(f64),
    Text(String),
    List(Vec<Value>),
    Object(Vec<(String, Value)>),
}

impl Value {
    /// The entry of an object; None where it is missing or this is no object. Of equal names the last one counts.
    pub fn get(&self, name: &str) -> Option<&Value> {
        match self {
            Value::Object(entries) => entries.iter().rev().find(|(key, _)| key == name).map(|(_, value)| value),
            _ => None,
        }
    }

    pub fn number(&self) -> Option<f64> {
        match self {
            Value::Number(value) => Some(*value),
            Value::Bool(value) => Some(f64::from(u8::from(*value))),
            _ => None,
        }
    }

    pub fn text(&self) -> Option<&str> {
        match self {
            Value::Text(value) => Some(value),
            _ => None,
        }
    }

    pub fn list(&self) -> Option<&[Value]> {
        match self {
            Value::List(values) => Some(values),
            _ => None,
        }
    }
}

/// The value in `text`, which may have blanks around it.
pub fn parse(text: &[u8]) -> Result<Value> {
    let text = std::str::from_utf8(text).map_err(|error| Error::new("header", error, "UTF-8 JSON"))?;
    let mut parser = Parser { text, at: 0 };
    let value = parser.value(0)?;
    parser.blanks();
    if parser.at != text.len() {
        return Err(parser.wrong("the end of the text"));
    }
    Ok(value)
}

struct Parser<'a> {
    text: &'a str,
    at: usize,
}

impl Parser<'_> {
    fn wrong(&self, expected: &str) -> Error {
        let rest: String = self.text.get(self.at..).unwrap_or("").chars().take(20).collect();
        Error::new("header", format!("{rest:?} at byte {} of the JSON", self.at), expected)
    }

    fn next(&self) -> Option<u8> {
        self.text.as_bytes().get(self.at).copied()
    }

    fn blanks(&mut self) {
        while matches!(self.next(), Some(b' ' | b'\t' | b'\n' | b'\r')) {
            self.at += 1;
        }
    }

    fn take(&mut self, byte: u8) -> Result<()> {
        self.blanks();
        if self.next() != Some(byte) {
            return Err(self.wrong(&format!("{:?}", byte as char)));
        }
        self.at += 1;
        Ok(())
    }

    fn word(&mut self, word: &str, value: Value) -> Result<Value> {
        if !self.text[self.at..].starts_with(word) {
            return Err(self.wrong("a JSON value"));
        }
        self.at += word.len();
        Ok(value)
    }

    fn value(&mut self, depth: usize) -> Result<Value> {
        if depth > MAX_DEPTH {
            return Err(self.wrong("less nesting"));
        }
        self.blanks();
        match self.next() {
            Some(b'{') => {
                let mut entries = Vec::new();
                self.items(b'}', |parser| {
                    parser.blanks();
                    let key = parser.string()?;
                    parser.take(b':')?;
                    entries.push((key, parser.value(depth + 1)?));
                    Ok(())
                })?;
                Ok(Value::Object(entries))
            }
            Some(b'[') => {
                let mut values = Vec::new();
                self.items(b']', |parser| {
                    values.push(parser.value(depth + 1)?);
                    Ok(())
                })?;
                Ok(Value::List(values))
            }
            Some(b'"') => Ok(Value::Text(self.string()?)),
            Some(b't') => self.word("true", Value::Bool(true)),
            Some(b'f') => self.word("false", Value::Bool(false)),
            Some(b'n') => self.word("null", Value::Null),
            _ => self.number(),
        }
    }

    /// What stands between brackets, separated by commas.
    fn items(&mut self, end: u8, mut item: impl FnMut(&mut Self) -> Result<()>) -> Result<()> {
        self.at += 1;
        self.blanks();
        if self.next() == Some(end) {
            self.at += 1;
            return Ok(());
        }
        loop {
            item(self)?;
            self.blanks();
            match self.next() {
                Some(b',') => self.at += 1,
                Some(byte) if byte == end => {
                    self.at += 1;
                    return Ok(());
                }
                _ => return Err(self.wrong("a comma or the end of the list")),
            }
        }
    }

    fn number(&mut self) -> Result<Value> {
        let start = self.at;
        while matches!(self.next(), Some(b'0'..=b'9' | b'+' | b'-' | b'.' | b'e' | b'E')) {
            self.at += 1;
        }
        match self.text[start..self.at].parse::<f64>() {
            Ok(value) => Ok(Value::Number(value)),
            Err(_) => {
                self.at = start;
                Err(self.wrong("a JSON value"))
            }
        }
    }

    fn string(&mut self) -> Result<String> {
        if self.next() != Some(b'"') {
            return Err(self.wrong("a text"));
        }
        self.at += 1;
        let mut out = String::new();
        loop {
            let Some(c) = self.text[self.at..].chars().next() else {
                return Err(self.wrong("the end of the text"));
            };
            self.at += c.len_utf8();
            match c {
                '"' => return Ok(out),
                '\\' => out.push(self.escaped()?),
                c => out.push(c),
            }
        }
    }

    fn escaped(&mut self) -> Result<char> {
        let byte = self.next().ok_or_else(|| self.wrong("an escape"))?;
        self.at += 1;
        Ok(match byte {
            b'"' | b'\\' | b'/' => byte as char,
            b'b' => '\u{8}',
            b'f' => '\u{c}',
            b'n' => '\n',
            b'r' => '\r',
            b't' => '\t',
            b'u' => {
                let high = self.hex()?;
                let mut code = high;
                if (0xd800..0xdc00).contains(&high) && self.text[self.at..].starts_with("\\u") {
                    self.at += 2;
                    let low = self.hex()?;
                    if (0xdc00..0xe000).contains(&low) {
                        code = 0x10000 + ((high - 0xd800) << 10) + (low - 0xdc00);
                    }
                }
                char::from_u32(code).unwrap_or(char::REPLACEMENT_CHARACTER)
            }
            _ => return Err(self.wrong("an escape of JSON")),
        })
    }

    fn hex(&mut self) -> Result<u32> {
        let digits = self.text.get(self.at..self.at + 4).unwrap_or("");
        let code = u32::from_str_radix(digits, 16).map_err(|_| self.wrong("four hexadecimal digits"))?;
        self.at += 4;
        Ok(code)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_every_kind_of_value() {
        let value =
            parse(br#" {"a": [1, -2.5e-3, true, null], "b": {"c": "x\n\u00b5\ud83d\ude00\"y"}, "a": 7}  "#).unwrap();
        assert_eq!(value.get("a").unwrap().number(), Some(7.0));
        assert_eq!(value.get("b").unwrap().get("c").unwrap().text(), Some("x\n\u{b5}\u{1f600}\"y"));
        assert_eq!(parse(b"[[], {}]").unwrap(), Value::List(vec![Value::List(vec![]), Value::Object(vec![])]));
        assert_eq!(parse(b"[1e-07]").unwrap(), Value::List(vec![Value::Number(1e-7)]));
    }

    #[test]
    fn refuses_what_is_no_json() {
        for text in ["", "{", "[1", "[1 2]", "{\"a\" 1}", "nul", "\"\\x\"", "\"\\u12\"", "1 2", "{1: 2}", "[1,]", "-"] {
            assert!(parse(text.as_bytes()).is_err(), "{text}");
        }
        assert!(parse(b"\xff").is_err());
        assert!(parse("[".repeat(100_000).as_bytes()).is_err());
    }
}
