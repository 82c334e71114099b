//! The tags of docs/protocol/vectors/authenticators.txt.

use dehyst_zenoh::authenticator::{Authenticator, Heard, Sender};

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
    let by = Authenticator::new(&bytes_of(text.split_whitespace().nth(2).unwrap())).unwrap();
    let file = |name: &str| if name == "-" { Vec::new() } else { read(name) };
    let (mut replies, mut publications) = (0, 0);
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
        if row[1] == "put" {
            let (sender, number) = (stamp[..8].try_into().unwrap(), u64::from_le_bytes(stamp[8..].try_into().unwrap()));
            assert_eq!(by.publication(key, sender, number, &payload).unwrap(), attached, "{}", row[0]);
            assert_eq!(Authenticator::default().publication(key, sender, number, &payload), None);
            let mut heard = Sender::default();
            assert_eq!(heard.hear(&by, key, &attached, &payload), Heard::Unknown);
            heard.meet(&[sender, (number - 1).to_le_bytes()].concat());
            assert_eq!(heard.hear(&by, key, &attached, &asked), Heard::Refused);
            assert_eq!(heard.hear(&by, key, &attached, &payload), Heard::Taken);
            assert_eq!(heard.hear(&by, key, &attached, &payload), Heard::Refused);
            heard.meet(&[sender, (number - 1).to_le_bytes()].concat()); // a late reply
            assert_eq!(heard.hear(&by, key, &attached, &payload), Heard::Refused);
            heard.meet(&[9; 16]);
            assert_eq!(heard.hear(&by, key, &attached, &payload), Heard::Unknown);
            assert_eq!(heard.hear(&by, key, &[], &payload), Heard::Refused);
            assert_eq!(heard.hear(&Authenticator::default(), key, &[], &payload), Heard::Taken);
            publications += 1;
        }
    }
    assert!(replies >= 2 && publications >= 2);
    assert!(Authenticator::new(b"short").is_err());
}
