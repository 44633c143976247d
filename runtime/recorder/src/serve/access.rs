//! Who may look on: a decision about the head of a request, and an account of who was refused.
//!
//! A browser lets any page open a socket to any address, this machine's own included, and only says
//! whose page it is, in `Origin`. So a page that is not ours is refused. A page can also come under a
//! name whose owner makes it mean another address while it is shown; such a page is of one origin with
//! us, and is known by the name in `Host`. Programs send no `Origin`. Whoever asks, and is not a program of
//! this user on this machine, needs the token that was printed with the address.

use std::collections::BTreeMap;
use std::fmt::{self, Write as _};
use std::net::{Ipv4Addr, Ipv6Addr};
use std::sync::{Mutex, MutexGuard, PoisonError};

use hyper::StatusCode;

use super::head::{Head, only};
use super::passage::Excess;
use super::token::Token;

use hil_platform::words::counted_plainly;

/// What programs with pages of their own in them send, as Lichtblick's desktop application does. So does
/// any saved page in some browsers and web views, those of iOS among them; others say `null` of a file.
const FILE_ORIGIN: &str = "file://";
/// Which any page can have, in a sandbox that another shows it in.
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
    /// It is of another user, or from another machine, and has not the token.
    NoToken,
    /// As many look on as may.
    Full(usize),
    /// It said nothing while as many others came.
    Crowded(usize),
    /// One that was let in did not keep to the limits.
    Excess(Excess),
    /// What shows the run cannot be reached, and why.
    NoServer(String),
}

impl Refusal {
    /// As HTTP has it.
    pub(crate) const fn status(&self) -> StatusCode {
        match self {
            Self::Malformed | Self::NoHost => StatusCode::BAD_REQUEST,
            Self::TooSlow | Self::Crowded(_) => StatusCode::REQUEST_TIMEOUT,
            Self::TooLong => StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE,
            Self::ForeignHost(_) | Self::ForeignOrigin(_) | Self::NoToken => StatusCode::FORBIDDEN,
            Self::Excess(_) => StatusCode::TOO_MANY_REQUESTS,
            Self::Full(_) | Self::NoServer(_) => StatusCode::SERVICE_UNAVAILABLE,
        }
    }

    /// All of it in words, for who was refused and for who may change it.
    pub(crate) fn words(&self) -> String {
        let advice = match self {
            Self::ForeignHost(host) => {
                let cure = offered(host, self::host(host).is_ok());
                let cure = cure.map(|host| format!("; --allow-host {host} says that it is"));
                format!(
                    "; that is not this machine's name{}",
                    cure.unwrap_or_default()
                )
            }
            Self::ForeignOrigin(origin) if origin == NO_ORIGIN => {
                "; every page can be one".to_owned()
            }
            Self::ForeignOrigin(origin) if origin == FILE_ORIGIN => format!(
                "; desktop applications such as Lichtblick's are one, and so can any saved page be: \
                 --allow-origin {FILE_ORIGIN} lets them all see the run and change emulated links"
            ),
            Self::ForeignOrigin(origin) => {
                let cure = offered(origin, self::origin(origin).is_ok());
                let lets = "lets its pages see the run and change emulated links";
                let cure = cure.map(|origin| format!("; --allow-origin {origin} {lets}"));
                cure.unwrap_or_default()
            }
            Self::NoToken => {
                "; the address that hil-recorder printed for other users ends in it: ?token=..."
                    .to_owned()
            }
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
            Self::NoToken => {
                f.write_str("a viewer of another user or another machine without the token")
            }
            Self::Full(seats) => write!(f, "a viewer, as {seats} look on already"),
            Self::Crowded(others) => {
                write!(f, "a connection that said nothing while {others} more came")
            }
            Self::Excess(excess) => write!(f, "a viewer that {excess}"),
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
    token: Option<Token>,
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
        let origins = origins.iter();
        Self {
            hosts: hosts.map(str::to_ascii_lowercase).collect(),
            origins: origins.map(|one| one.to_ascii_lowercase()).collect(),
            token: None,
            refused: Mutex::default(),
        }
    }

    /// The same, where those who have `token` may look on as well as this user's own programs.
    #[must_use]
    pub(crate) fn with_token(self, token: Token) -> Self {
        Self {
            token: Some(token),
            ..self
        }
    }

    /// What the printed addresses end in.
    pub(crate) fn query(&self) -> String {
        self.token
            .as_ref()
            .map_or_else(String::new, Token::to_string)
    }

    /// Whether a request to the socket may look on; `is_own` says of one without the token whether it is of a
    /// program of this user on this machine.
    ///
    /// # Errors
    /// Why not.
    pub(super) fn admit(
        &self,
        head: &Head,
        page_port: u16,
        is_own: impl FnOnce() -> bool,
    ) -> Result<(), Refusal> {
        self.judge(head, page_port)?;
        let told = self.token.as_ref().zip(head.token.as_deref());
        if told.is_some_and(|(token, told)| token.is(told)) || is_own() {
            Ok(())
        } else {
            Err(Refusal::NoToken)
        }
    }

    /// Whether a request to the socket may pass by what it says of itself. `page_port` is that of our own page.
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
        let judged = only(hosts).and_then(|host| self.judge_host(host.as_deref()).map(drop));
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
        let mut counts: Vec<(&Refusal, &u64)> = refused.counts.iter().collect();
        counts.sort_by_key(|(_, count)| core::cmp::Reverse(**count));
        let total: u64 = refused.counts.values().sum();
        let total = total.saturating_add(refused.unnamed_count);
        let mut words = format!("refused {}", counted_plainly(total, "request"));
        for (index, (who, count)) in counts.iter().take(ACCOUNT_MAX).enumerate() {
            let between = if index == 0 { ": " } else { "; " };
            let _infallible = write!(words, "{between}{count} × {who}");
        }
        let rest = counts.iter().skip(ACCOUNT_MAX);
        let rest: u64 = rest.map(|(_, count)| **count).sum();
        let rest = rest.saturating_add(refused.unnamed_count);
        if rest > 0 {
            let _infallible = write!(words, "; {}", counted_plainly(rest, "other"));
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

/// A foreign word as part of a command that is offered for pasting into a shell: only a whole one that the
/// option takes, and that means nothing else to a shell.
fn offered(word: &str, is_taken: bool) -> Option<String> {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"._:/+-".contains(&byte);
    let is_own = |byte: u8| is_plain(byte) || b"[]".contains(&byte);
    // What begins with a hyphen would be taken for another option.
    let is_misleading = word.starts_with('-') || word.len() > WORD_MAX;
    if !is_taken || is_misleading || !word.bytes().all(is_own) {
        return None;
    }
    let quote = if word.bytes().all(is_plain) { "" } else { "'" };
    Some(format!("{quote}{word}{quote}"))
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
mod tests;
