//! Who may look on: a decision about the head of a request, and an account of who was refused.
//!
//! A browser lets any page open a socket to any address, this machine's own included, and only says
//! whose page it is, in `Origin`. So a page that is not ours is refused. A page can also come under a
//! name whose owner makes it mean another address while it is shown; such a page is of one origin with
//! us, and is known by the name in `Host`. Programs send no `Origin`, and are let in as anybody is who
//! reaches the address.

use std::collections::BTreeMap;
use std::fmt::{self, Write as _};
use std::net::{Ipv4Addr, Ipv6Addr};
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::head::{Head, only};

/// What programs with pages of their own in them send, as Lichtblick's desktop application does.
/// Browsers do not: of a file they say `null`, as of any page that another shows in a sandbox.
const FILE_ORIGIN: &str = "file://";
/// Which any page can have.
pub(crate) const NO_ORIGIN: &str = "null";

/// As much of a foreign word is repeated.
const WORD_MAX: usize = 100;
/// Different refusals that are named; of more only the number is kept.
const NAMED_MAX: usize = 64;
/// Of these in the account at the end.
const ACCOUNT_MAX: usize = 8;

/// Why a request is refused.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Refusal {
    /// It is not one, or can be read in two ways.
    Malformed,
    /// Its head is too long.
    TooLong,
    /// Its head took too long to come.
    TooSlow,
    /// It names no host.
    NoHost,
    /// It names a host that may be anybody's.
    ForeignHost(String),
    /// It is from a page of somebody else's.
    ForeignOrigin(String),
    /// As many look on as may.
    Full(usize),
    /// What shows the run cannot be reached, and why.
    NoServer(String),
}

impl Refusal {
    /// The number and word of HTTP.
    pub(crate) const fn status(&self) -> (u16, &'static str) {
        match self {
            Self::Malformed | Self::NoHost => (400, "Bad Request"),
            Self::TooSlow => (408, "Request Timeout"),
            Self::TooLong => (431, "Request Header Fields Too Large"),
            Self::ForeignHost(_) | Self::ForeignOrigin(_) => (403, "Forbidden"),
            Self::Full(_) | Self::NoServer(_) => (503, "Service Unavailable"),
        }
    }

    /// All of it in words, for who was refused and for who may change it.
    pub(crate) fn words(&self) -> String {
        let advice = match self {
            Self::ForeignHost(host) => {
                format!("; that is not this machine's name; --allow-host {host} says that it is")
            }
            Self::ForeignOrigin(origin) if origin == NO_ORIGIN => {
                "; every page can be one".to_owned()
            }
            Self::ForeignOrigin(origin) => format!(
                "; --allow-origin {origin} lets its pages see the run and change emulated links"
            ),
            _ => String::new(),
        };
        format!("refused {self}{advice}")
    }
}

/// Who or what is refused.
impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Malformed => f.write_str("what is no request of HTTP/1.1"),
            Self::TooLong => f.write_str("a request with too long a head"),
            Self::TooSlow => f.write_str("a request that was too slow to come"),
            Self::NoHost => f.write_str("a request that names no host"),
            Self::ForeignHost(host) => write!(f, "a request to {host}"),
            Self::ForeignOrigin(origin) if origin == NO_ORIGIN => {
                f.write_str("a page without an origin, such as a file opened in a browser")
            }
            Self::ForeignOrigin(origin) => write!(f, "a page of {origin}"),
            Self::Full(seats) => write!(f, "a viewer, as {seats} look on already"),
            Self::NoServer(why) => {
                write!(
                    f,
                    "a viewer, as what shows the run cannot be reached: {why}"
                )
            }
        }
    }
}

/// Who may look on, and who was refused.
#[derive(Debug)]
pub(crate) struct Access {
    hosts: Vec<String>,
    origins: Vec<String>,
    refused: Mutex<Refused>,
}

#[derive(Debug, Default)]
struct Refused {
    counts: BTreeMap<Refusal, u64>,
    /// Of those beyond the number that is named.
    unnamed_count: u64,
    unsaid: Vec<String>,
}

impl Access {
    /// Beside our own page, pages of `origins` may look on. Names in `hosts` mean this machine, as
    /// its own name does, whole and up to its first dot.
    pub(crate) fn new(hosts: &[String], origins: &[String], machine: Option<&str>) -> Self {
        let short = machine.and_then(|name| name.split('.').next());
        let own = ["localhost"].into_iter().chain(machine).chain(short);
        let hosts = own.chain(hosts.iter().map(String::as_str));
        let origins = [FILE_ORIGIN]
            .into_iter()
            .chain(origins.iter().map(String::as_str));
        Self {
            hosts: hosts.map(str::to_ascii_lowercase).collect(),
            origins: origins.map(str::to_ascii_lowercase).collect(),
            refused: Mutex::default(),
        }
    }

    /// Whether a request to the socket may pass. `page_port` is that of our own page.
    ///
    /// # Errors
    /// Why not.
    pub(super) fn judge(&self, head: &Head, page_port: u16) -> Result<(), Refusal> {
        let named = head.host.as_deref();
        let host = self.judge_host(named)?;
        let Some(origin) = &head.origin else {
            return Ok(());
        };
        let known = origin.to_ascii_lowercase();
        // A page is ours when it is of the same name as this socket and of our page's port: a tunnel
        // leaves both as they are. One of another port may be of any program on either machine.
        let own = match page_port {
            80 => format!("http://{host}"),
            port => format!("http://{host}:{port}"),
        };
        // Some libraries for programs say that they are a page of the socket's. There is none.
        let socket = named.map(|named| format!("http://{}", named.to_ascii_lowercase()));
        if known == own || Some(&known) == socket.as_ref() || self.origins.contains(&known) {
            return Ok(());
        }
        Err(Refusal::ForeignOrigin(word(origin)))
    }

    /// Whether a request with these fields `Host` may see the page.
    ///
    /// # Errors
    /// Why not; it is counted.
    pub(crate) fn judge_page<'a>(
        &self,
        hosts: impl Iterator<Item = &'a [u8]>,
    ) -> Result<(), Refusal> {
        let host = only(hosts).map_err(|_ambiguous| Refusal::Malformed);
        let judged = host.and_then(|host| self.judge_host(host.as_deref()).map(drop));
        judged.inspect_err(|refusal| self.count(refusal))
    }

    /// The host that is named, without its port, in small letters.
    fn judge_host(&self, value: Option<&str>) -> Result<String, Refusal> {
        let value = value.ok_or(Refusal::NoHost)?;
        let host = without_port(value).ok_or(Refusal::Malformed)?;
        let host = host.to_ascii_lowercase();
        let bracketed = host
            .strip_prefix('[')
            .and_then(|rest| rest.strip_suffix(']'));
        // Nobody can make an address mean another one.
        let is_address = bracketed.map_or_else(
            || host.parse::<Ipv4Addr>().is_ok(),
            |inside| inside.parse::<Ipv6Addr>().is_ok(),
        );
        let name = host.strip_suffix('.').unwrap_or(&host);
        if is_address || self.hosts.iter().any(|known| known == name) {
            Ok(host)
        } else {
            Err(Refusal::ForeignHost(word(&host)))
        }
    }

    /// Takes note of a refusal; the first of each is said.
    pub(super) fn count(&self, refusal: &Refusal) {
        let mut refused = self.refused();
        if let Some(count) = refused.counts.get_mut(refusal) {
            *count += 1;
        } else if refused.counts.len() < NAMED_MAX {
            refused.counts.insert(refusal.clone(), 1);
            refused.unsaid.push(refusal.words());
        } else {
            refused.unnamed_count += 1;
            if refused.unnamed_count == 1 {
                let words = "further refusals of other kinds are only counted";
                refused.unsaid.push(words.to_owned());
            }
        }
    }

    /// What has not been said of refusals.
    pub(crate) fn take_unsaid(&self) -> Vec<String> {
        core::mem::take(&mut self.refused().unsaid)
    }

    /// All refusals, if there were any: the most frequent by name.
    pub(crate) fn account(&self) -> Option<String> {
        let refused = self.refused();
        let mut counts: Vec<(&Refusal, u64)> = refused
            .counts
            .iter()
            .map(|(who, count)| (who, *count))
            .collect();
        counts.sort_by_key(|(_, count)| core::cmp::Reverse(*count));
        let total: u64 = counts.iter().map(|(_, count)| count).sum();
        let total = total.saturating_add(refused.unnamed_count);
        let mut words = format!("refused {total} requests");
        for (index, (who, count)) in counts.iter().take(ACCOUNT_MAX).enumerate() {
            let between = if index == 0 { ": " } else { "; " };
            let _infallible = write!(words, "{between}{count} × {who}");
        }
        let rest: u64 = counts
            .iter()
            .skip(ACCOUNT_MAX)
            .map(|(_, count)| count)
            .sum();
        let rest = rest.saturating_add(refused.unnamed_count);
        if rest > 0 {
            let _infallible = write!(words, "; {rest} others");
        }
        (total > 0).then_some(words)
    }

    fn refused(&self) -> MutexGuard<'_, Refused> {
        // Numbers stay numbers, whoever panicked.
        self.refused.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The host of a field `Host`; `None` where there is none to be seen.
fn without_port(value: &str) -> Option<&str> {
    let end = if value.starts_with('[') {
        value.find(']')? + 1
    } else {
        value.find(':').unwrap_or(value.len())
    };
    let (host, port) = value.split_at(end);
    let is_port = |port: &str| port.parse::<u16>().is_ok() && !port.starts_with('+');
    let is_whole = port.is_empty() || port.strip_prefix(':').is_some_and(is_port);
    let is_name = |byte: u8| byte.is_ascii_alphanumeric() || b"-._[]:".contains(&byte);
    (is_whole && !host.is_empty() && host.bytes().all(is_name)).then_some(host)
}

/// A foreign word as a terminal may show it.
fn word(text: &str) -> String {
    let shown = |character: char| {
        if character.is_ascii_graphic() {
            character
        } else {
            '?'
        }
    };
    let mut word: String = text.chars().take(WORD_MAX).map(shown).collect();
    if text.chars().count() > WORD_MAX {
        word.push_str("...");
    }
    word
}

/// An origin as the command line names it: that of a page, without its path.
pub(crate) fn origin(text: &str) -> Result<String, String> {
    let known = text.to_ascii_lowercase();
    if known == NO_ORIGIN || known == FILE_ORIGIN {
        return Ok(known);
    }
    let known = known.strip_suffix('/').unwrap_or(&known);
    let parts = known.split_once("://");
    let is_origin = parts.is_some_and(|(scheme, host)| {
        let is_scheme = |byte: u8| byte.is_ascii_alphanumeric() || b"+-.".contains(&byte);
        !scheme.is_empty() && scheme.bytes().all(is_scheme) && without_port(host).is_some()
    });
    if is_origin {
        Ok(known.to_owned())
    } else {
        Err("must be scheme://host or scheme://host:port, as https://app.foxglove.dev".to_owned())
    }
}

/// A host as the command line names it.
pub(crate) fn host(text: &str) -> Result<String, String> {
    let name = text.strip_suffix('.').unwrap_or(text);
    match without_port(name) {
        Some(host) if host == name => Ok(name.to_ascii_lowercase()),
        _ => Err("must be a name without a port, as control-pc.example.org".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAGE: u16 = 8766;

    fn judged(host: &str, origin: Option<&str>) -> Result<(), Refusal> {
        let (hosts, origins) = (
            ["robot.example.org".to_owned()],
            ["https://app.foxglove.dev".to_owned()],
        );
        let access = Access::new(&hosts, &origins, Some("Control-PC.lab"));
        let head = Head {
            host: Some(host.to_owned()),
            origin: origin.map(str::to_owned),
        };
        access.judge(&head, PAGE)
    }

    fn foreign_origin(origin: &str) -> Result<(), Refusal> {
        Err(Refusal::ForeignOrigin(origin.to_owned()))
    }

    #[test]
    fn programs_own_pages_and_allowed_pages_may_look_on() {
        for (host, origin) in [
            ("127.0.0.1:8765", None),
            ("localhost:8765", Some("http://localhost:8766")),
            ("LOCALHOST:8765", Some("http://localhost:8766")),
            ("127.0.0.1:8765", Some("http://127.0.0.1:8766")),
            ("[::1]:8765", Some("http://[::1]:8766")),
            ("192.168.0.7:8765", Some("http://192.168.0.7:8766")),
            ("control-pc:8765", Some("http://control-pc:8766")),
            ("control-pc.lab:8765", Some("http://control-pc.lab:8766")),
            // A tunnel may have another port for the socket; the page's stays.
            ("localhost:18765", Some("http://localhost:8766")),
            ("robot.example.org", Some("http://robot.example.org:8766")),
            ("localhost:8765", Some("https://app.foxglove.dev")),
            ("localhost:8765", Some("file://")),
            ("localhost", None),
            // As Python's websocket-client does.
            ("127.0.0.1:8765", Some("http://127.0.0.1:8765")),
        ] {
            assert_eq!(judged(host, origin), Ok(()), "{host} {origin:?}");
        }
    }

    #[test]
    fn pages_of_others_may_not() {
        for origin in [
            "https://evil.example",
            "null",
            "",
            "http://localhost",
            "http://localhost:3000",
            "https://localhost:8766",
            "http://127.0.0.1:8766",
            "http://localhost:8766/",
            "http://localhost:8766.evil.example",
            "http://localhost:8766@evil.example",
            "https://app.foxglove.dev.evil.example",
            "http://app.foxglove.dev",
        ] {
            assert_eq!(
                judged("localhost:8765", Some(origin)),
                foreign_origin(origin)
            );
        }
    }

    #[test]
    fn names_that_may_be_anybodys_are_refused_whoever_asks() {
        for name in [
            "evil.example",
            "localhost.evil.example",
            "127.0.0.1.evil.example",
            "control-pc.evil.example",
            "127.1",
        ] {
            let refused = Err(Refusal::ForeignHost(name.to_owned()));
            assert_eq!(judged(name, None), refused);
            let own = format!("http://{name}:8766");
            assert_eq!(judged(&format!("{name}:8765"), Some(&own)), refused);
        }
        for broken in [
            "",
            ":8765",
            "localhost:",
            "localhost:99999",
            "[::1",
            "a@localhost",
            "a b",
        ] {
            assert_eq!(judged(broken, None), Err(Refusal::Malformed), "{broken}");
        }
        let access = Access::new(&[], &[], None);
        let (host, origin) = (None, None);
        assert_eq!(
            access.judge(&Head { host, origin }, PAGE),
            Err(Refusal::NoHost)
        );
    }

    #[test]
    fn a_page_on_the_port_of_the_web_has_none_in_its_origin() {
        let access = Access::new(&[], &[], None);
        let head = |origin: &str| Head {
            host: Some("127.0.0.1:8765".to_owned()),
            origin: Some(origin.to_owned()),
        };
        assert_eq!(access.judge(&head("http://127.0.0.1"), 80), Ok(()));
        assert!(access.judge(&head("http://127.0.0.1:80"), 80).is_err());
    }

    #[test]
    fn each_refusal_is_said_once_and_all_are_counted() {
        let access = Access::new(&[], &[], None);
        assert_eq!(access.account(), None);
        let evil = Refusal::ForeignOrigin("https://evil.example".to_owned());
        for _attempt in 0..3 {
            access.count(&evil);
        }
        access.count(&Refusal::Full(32));
        let said = access.take_unsaid();
        assert_eq!(said.len(), 2, "{said:?}");
        assert!(
            said[0].contains("--allow-origin https://evil.example"),
            "{said:?}"
        );
        access.count(&evil);
        assert!(access.take_unsaid().is_empty());
        assert_eq!(
            access.account().unwrap(),
            "refused 5 requests: 4 × a page of https://evil.example; \
             1 × a viewer, as 32 look on already"
        );
        for index in 0..1000 {
            access.count(&Refusal::ForeignHost(format!("{index}.example")));
        }
        assert_eq!(access.take_unsaid().len(), NAMED_MAX - 2 + 1);
        let account = access.account().unwrap();
        assert!(
            account.starts_with("refused 1005 requests: 4 ×"),
            "{account}"
        );
        assert!(account.ends_with("; 994 others"), "{account}");
    }

    #[test]
    fn foreign_words_are_short_and_leave_the_terminal_alone() {
        assert_eq!(word("http://\u{1b}[31m\u{9b}x\n"), "http://?[31m?x?");
        assert_eq!(word(&"a".repeat(5000)).len(), WORD_MAX + 3);
    }

    #[test]
    fn the_command_line_names_origins_and_hosts() {
        assert_eq!(
            origin("https://App.foxglove.dev/").unwrap(),
            "https://app.foxglove.dev"
        );
        assert_eq!(
            origin("http://localhost:9000").unwrap(),
            "http://localhost:9000"
        );
        assert_eq!(origin("file://").unwrap(), "file://");
        for wrong in [
            "*",
            "app.foxglove.dev",
            "https://",
            "https://a/b",
            "https://a:b",
            "://a",
        ] {
            assert!(origin(wrong).is_err(), "{wrong}");
        }
        assert_eq!(host("Robot.example.org.").unwrap(), "robot.example.org");
        for wrong in ["", "*", "robot:8765", "http://robot", "a b"] {
            assert!(host(wrong).is_err(), "{wrong}");
        }
    }
}
