//! The head of a request as bytes come in: where it ends, which host it names, and which page it is
//! from. What may be is decided in [`super::access`].

use httparse::{Request, Status};

/// Header fields of a request at most; a browser sends about fifteen.
const FIELDS_MAX: usize = 96;

/// What a request says of itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Head {
    /// The field `Host`: the name in the address bar, with its port.
    pub(super) host: Option<String>,
    /// The field `Origin`: whose page asks. Browsers always send it with a socket and let no page
    /// change it.
    pub(super) origin: Option<String>,
}

/// How far the head of a request has come.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Parsed {
    /// Not all of it is there.
    Partial,
    /// It is whole.
    Whole(Head),
    /// It will never be one.
    Broken,
}

/// Reads the beginning of `bytes`.
pub(super) fn parse(bytes: &[u8]) -> Parsed {
    let mut fields = [httparse::EMPTY_HEADER; FIELDS_MAX];
    let mut request = Request::new(&mut fields);
    match request.parse(bytes) {
        Ok(Status::Partial) => Parsed::Partial,
        Ok(Status::Complete(_)) => {
            let values = |name: &'static str| {
                let fields = request.headers.iter();
                let named = fields.filter(move |field| field.name.eq_ignore_ascii_case(name));
                named.map(|field| field.value)
            };
            match (only(values("host")), only(values("origin"))) {
                (Ok(host), Ok(origin)) => Parsed::Whole(Head { host, origin }),
                _ => Parsed::Broken,
            }
        }
        Err(_) => Parsed::Broken,
    }
}

/// More than one value, or one that is no text: readers of it could disagree.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Ambiguous;

/// The only one of these values, if there is any.
pub(super) fn only<'a>(
    mut values: impl Iterator<Item = &'a [u8]>,
) -> Result<Option<String>, Ambiguous> {
    match (values.next(), values.next()) {
        (None, _) => Ok(None),
        (Some(value), None) => {
            let text = str::from_utf8(value).ok().filter(|text| text.is_ascii());
            text.map(|text| Some(text.to_owned())).ok_or(Ambiguous)
        }
        (Some(_), Some(_)) => Err(Ambiguous),
    }
}

#[cfg(test)]
mod tests {
    use hil_models::random::RandomStream;

    use super::super::access::Access;
    use super::*;

    const OWN_PORT: u16 = 8766;

    fn request(fields: &str) -> Vec<u8> {
        let begin = "GET / HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n";
        format!("{begin}{fields}\r\n\r\n").into_bytes()
    }

    #[test]
    fn host_and_origin_are_read_whatever_their_case() {
        let parsed = parse(&request("hOsT: localhost:8765\r\nORIGIN: http://x"));
        let head = Head {
            host: Some("localhost:8765".to_owned()),
            origin: Some("http://x".to_owned()),
        };
        assert_eq!(parsed, Parsed::Whole(head));
        let parsed = parse(&request("X-Host: a"));
        let head = Head {
            host: None,
            origin: None,
        };
        assert_eq!(parsed, Parsed::Whole(head));
    }

    #[test]
    fn a_head_that_can_be_read_in_two_ways_is_none() {
        for fields in [
            "Host: localhost\r\nHost: evil.example",
            "Host: localhost\r\nOrigin: http://localhost:8766\r\nOrigin: https://evil.example",
            "Host : localhost",
            "Host: localhost\r\n Origin: http://folded",
            "Host: local\u{e9}host",
            "Host: localhost\r\nOrigin: http://\u{9b}31m",
            "Host: localhost\u{0}",
        ] {
            assert_eq!(parse(&request(fields)), Parsed::Broken, "{fields:?}");
        }
        assert_eq!(parse(b"\x16\x03\x01\x02\x00"), Parsed::Broken);
        let many = (0..=FIELDS_MAX).map(|index| format!("X-{index}: 1\r\n"));
        assert_eq!(parse(&request(&many.collect::<String>())), Parsed::Broken);
    }

    #[test]
    fn a_head_is_whole_at_its_last_byte_and_not_before() {
        let whole = request("Host: localhost:8765\r\nOrigin: https://evil.example");
        for end in 0..whole.len() {
            assert_eq!(parse(&whole[..end]), Parsed::Partial, "{end} bytes");
        }
        assert!(matches!(parse(&whole), Parsed::Whole(_)));
        let more = [&whole[..], b"\x81\x85\x00\x01\x02\x03"].concat();
        assert_eq!(parse(&more), parse(&whole));
    }

    fn below(random: &mut RandomStream, bound: usize) -> usize {
        usize::try_from(random.next_u64() % bound as u64).unwrap()
    }

    /// Changes, removes, adds or repeats some of the bytes.
    fn mutate(bytes: &mut Vec<u8>, random: &mut RandomStream) {
        const TELLING: &[u8] = b"\r\n: \tOoHh,/[]@%\x00\x7f\xff\x1b";
        for _ in 0..=below(random, 4) {
            let at = below(random, bytes.len());
            let byte = match below(random, 2) {
                0 => TELLING[below(random, TELLING.len())],
                _ => u8::try_from(below(random, 256)).unwrap(),
            };
            match below(random, 4) {
                0 => bytes[at] = byte,
                1 => drop(bytes.remove(at)),
                2 => bytes.insert(at, byte),
                _ => {
                    let end = (at + 1 + below(random, 48)).min(bytes.len());
                    let piece = bytes[at..end].to_vec();
                    let to = below(random, bytes.len());
                    bytes.splice(to..to, piece);
                }
            }
            if bytes.is_empty() {
                bytes.push(byte);
            }
        }
    }

    /// The origins that a head names, read in the plainest way there is.
    fn plain_origins(bytes: &[u8]) -> Vec<String> {
        let text = String::from_utf8_lossy(bytes);
        let lines = text.split('\n').map(|line| line.trim_end_matches('\r'));
        let lines = lines.skip_while(|line| line.is_empty()).skip(1);
        let head = lines.take_while(|line| !line.is_empty());
        let named = head.filter_map(|line| line.split_once(':'));
        let named = named.filter(|(name, _)| name.trim().eq_ignore_ascii_case("origin"));
        named.map(|(_, value)| value.trim().to_owned()).collect()
    }

    #[test]
    fn no_bytes_make_the_parser_panic_or_let_a_foreign_page_in() {
        let access = Access::new(&[], &[], Some("control-pc"));
        let seeds = [
            "Host: localhost:8765\r\nOrigin: https://evil.example",
            "Host: evil.example:8765\r\nOrigin: http://localhost:8766",
            "Host: 127.0.0.1:8765\r\nOrigin: http://127.0.0.1:8766",
            "Host: [::1]:8765\r\nAccept: */*\r\nOrigin: null",
        ];
        let mut random = RandomStream::new(1, "head mutation");
        let (mut admitted, mut with_origin) = (0, 0);
        for case in 0..100_000 {
            let mut bytes = request(seeds[case % seeds.len()]);
            mutate(&mut bytes, &mut random);
            let Parsed::Whole(head) = parse(&bytes) else {
                continue;
            };
            if access.judge(&head, OWN_PORT).is_err() {
                continue;
            }
            admitted += 1;
            for origin in plain_origins(&bytes) {
                with_origin += 1;
                let host = head.host.clone().unwrap();
                let end = host.find(']').map(|end| end + 1).or(host.find(':'));
                let own = format!("http://{}:{OWN_PORT}", &host[..end.unwrap_or(host.len())]);
                let socket = format!("http://{host}");
                let known = [&*own, &*socket, "file://"];
                let is_own = known.iter().any(|one| origin.eq_ignore_ascii_case(one));
                assert!(is_own, "{origin} of {}", String::from_utf8_lossy(&bytes));
            }
        }
        assert!(
            admitted > 1000 && with_origin > 1000,
            "{admitted} {with_origin}: the test would prove nothing"
        );
    }
}
