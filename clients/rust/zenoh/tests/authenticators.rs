//! The tags of docs/protocol/vectors/authenticators.txt.

use dehyst_zenoh::authenticator::{Authenticator, Sender};
use dehyst_zenoh::key::by_key;

fn read(name: &str) -> Vec<u8> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../docs/protocol/vectors/").to_string() + name;
    std::fs::read(&path).unwrap_or_else(|error| panic!("{path}: {error}"))
}

fn bytes_of(hex: &str) -> Vec<u8> {
    let digits = hex.trim_matches('-');
    (0..digits.len()).step_by(2).map(|i| u8::from_str_radix(&digits[i..i + 2], 16).unwrap()).collect()
}

#[test]
fn authenticators_are_those_of_the_service() {
    let text = String::from_utf8(read("authenticators.txt")).unwrap();
    let by = by_key(&bytes_of(text.split_whitespace().nth(2).unwrap())).unwrap();
    let file = |name: &str| if name == "-" { Vec::new() } else { read(name) };
    let (mut replies, mut publications, mut queries) = (0, 0, 0);
    for line in text.lines().filter(|line| !line.starts_with('#')) {
        let row: Vec<&str> = line.split_whitespace().collect();
        let (key, stamp, of, asked_stamp) = (row[2], bytes_of(row[3]), row[4].trim_matches('-'), bytes_of(row[5]));
        let (asked, payload) = (file(row[6]), file(row[7]));
        let attached = [stamp.clone(), bytes_of(row[8])].concat();
        if row[1] == "reply" {
            let question = [&asked_stamp[..], of.as_bytes(), &asked];
            assert!(by.answers(key, question, &attached, &payload), "{}", row[0]);
            assert!(!by.answers(key, question, &attached[..31], &payload));
            assert!(!by.answers(key, question, &[], &payload));
            assert!(!by.answers(key, question, &attached, &asked));
            assert!(!by.answers(key, [&[0; 16], question[1], question[2]], &attached, &payload));
            assert!(Authenticator::default().answers(key, question, &[], &payload));
            replies += 1;
        }
        if row[1] == "query" {
            let tag = by.tag(&[b"query", key.as_bytes(), &stamp, of.as_bytes(), &payload]).unwrap();
            assert_eq!([&stamp[..], &tag].concat(), attached, "{}", row[0]);
            queries += 1;
        }
        if row[1] == "put" {
            let (sender, number) = (stamp[..8].try_into().unwrap(), u64::from_le_bytes(stamp[8..].try_into().unwrap()));
            assert_eq!(by.publication(key, sender, number, &payload), attached, "{}", row[0]);
            assert_eq!(Authenticator::default().publication(key, sender, number, &payload), stamp);
            let mut heard = Sender(0);
            assert_eq!(heard.hear(&by, key, &attached, &payload), None);
            heard.meet(&[sender, (number - 1).to_le_bytes()].concat());
            assert_eq!(heard.hear(&by, key, &attached, &asked), Some(false));
            assert_eq!(heard.hear(&by, key, &attached, &payload), Some(true));
            assert_eq!(heard.hear(&by, key, &attached, &payload), Some(false));
            heard.meet(&[sender, (number - 1).to_le_bytes()].concat()); // a late reply
            assert_eq!(heard.hear(&by, key, &attached, &payload), Some(false));
            heard.meet(&[9; 16]);
            assert_eq!(heard.hear(&by, key, &attached, &payload), None);
            assert_eq!(heard.hear(&by, key, &[], &payload), Some(false));
            assert_eq!(heard.hear(&Authenticator::default(), key, &[], &payload), Some(true));
            publications += 1;
        }
    }
    assert!(replies >= 2 && publications >= 2 && queries >= 1);
    assert!(by_key(b"short").is_err());
}
