//! The head of a request as bytes come in: where it ends, which host it names, and which page it is
//! from. What may be is decided in [`super::access`].

use httparse::{Request, Response, Status};

use super::access::Refusal;

/// Header fields of a request at most; a browser sends about fifteen.
const FIELDS_MAX: usize = 96;

/// What a request says of itself.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Head {
    /// The field `Host`: the name in the address bar, with its port.
    pub(super) host: Option<String>,
    /// The field `Origin`: whose page asks. Browsers always send it with a socket and let no page
    /// change it.
    pub(super) origin: Option<String>,
    /// `token` of the address that is asked for.
    pub(super) token: Option<String>,
}

/// The head that `bytes` begin with; `None` while it is not whole.
///
/// # Errors
/// When it will never be one.
pub(super) fn parse(bytes: &[u8]) -> Option<Result<Head, Refusal>> {
    let mut fields = [httparse::EMPTY_HEADER; FIELDS_MAX];
    let mut request = Request::new(&mut fields);
    match request.parse(bytes) {
        Ok(Status::Partial) => return None,
        Ok(Status::Complete(_)) => {}
        Err(_) => return Some(Err(Refusal::Malformed)),
    }
    let value = |name: &str| {
        let fields = request.headers.iter();
        let named = fields.filter(|field| field.name.eq_ignore_ascii_case(name));
        only(named.map(|field| field.value))
    };
    let head = || {
        Ok(Head {
            host: value("host")?,
            origin: value("origin")?,
            token: request.path.and_then(token).map(str::to_owned),
        })
    };
    Some(head())
}

/// Bytes of the head that `bytes` begin with, of a request or of an answer; `None` while it is not whole.
pub(super) fn head_bytes(bytes: &[u8]) -> Option<usize> {
    let mut fields = [httparse::EMPTY_HEADER; FIELDS_MAX];
    let request = Request::new(&mut fields).parse(bytes);
    let head = request.or_else(|_no_request| Response::new(&mut fields).parse(bytes));
    match head {
        Ok(Status::Complete(count)) => Some(count),
        Ok(Status::Partial) | Err(_) => None,
    }
}

/// The first `token` in the query of an address, which holds no character that is written in another way there.
fn token(path: &str) -> Option<&str> {
    let (_, query) = path.split_once('?')?;
    query
        .split('&')
        .find_map(|part| part.strip_prefix("token="))
}

/// The only one of these values, if there is any.
///
/// # Errors
/// When there are several, or it is no text: readers of it could disagree.
pub(super) fn only<'a>(
    mut values: impl Iterator<Item = &'a [u8]>,
) -> Result<Option<String>, Refusal> {
    let first = values.next();
    if values.next().is_some() {
        return Err(Refusal::Malformed);
    }
    first.map_or(Ok(None), |value| {
        let text = str::from_utf8(value).ok().filter(|text| text.is_ascii());
        let text = text.ok_or(Refusal::Malformed)?;
        Ok(Some(text.to_owned()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(fields: &str) -> Vec<u8> {
        let begin = "GET / HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n";
        format!("{begin}{fields}\r\n\r\n").into_bytes()
    }

    const BROKEN: Option<Result<Head, Refusal>> = Some(Err(Refusal::Malformed));

    #[test]
    fn host_and_origin_are_read_whatever_their_case() {
        let parsed = parse(&request("hOsT: localhost:8765\r\nORIGIN: http://x"));
        let head = Head {
            host: Some("localhost:8765".to_owned()),
            origin: Some("http://x".to_owned()),
            token: None,
        };
        assert_eq!(parsed, Some(Ok(head)));
        let parsed = parse(&request("X-Host: a"));
        let head = Head::default();
        assert_eq!(parsed, Some(Ok(head)));
    }

    #[test]
    fn the_token_is_read_from_the_address() {
        for (path, expected) in [
            ("/?token=0a1b", Some("0a1b")),
            ("/any/path?x=1&token=0a1b&token=2", Some("0a1b")),
            ("/?token=", Some("")),
            ("/?tokens=1&atoken=2", None),
            ("/token=1", None),
            ("/", None),
        ] {
            assert_eq!(token(path), expected, "{path}");
        }
        let parsed = parse(b"GET /?token=7 HTTP/1.1\r\n\r\n");
        assert!(matches!(parsed, Some(Ok(head)) if head.token.as_deref() == Some("7")));
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
            assert_eq!(parse(&request(fields)), BROKEN, "{fields:?}");
        }
        assert_eq!(parse(b"\x16\x03\x01\x02\x00"), BROKEN);
        let many = (0..=FIELDS_MAX).map(|index| format!("X-{index}: 1\r\n"));
        assert_eq!(parse(&request(&many.collect::<String>())), BROKEN);
    }

    #[test]
    fn a_head_is_whole_at_its_last_byte_and_not_before() {
        let whole = request("Host: localhost:8765\r\nOrigin: https://evil.example");
        for end in 0..whole.len() {
            assert_eq!(parse(&whole[..end]), None, "{end} bytes");
        }
        assert!(matches!(parse(&whole), Some(Ok(_))));
        let more = [&whole[..], b"\x81\x85\x00\x01\x02\x03"].concat();
        assert_eq!(parse(&more), parse(&whole));
    }
}
