//! Which flows have a name: a filter in the words of pcap-filter(7), of which it knows a few.

use core::net::IpAddr;
use core::str::FromStr;

use super::{FlowKey, TCP, UDP};

const ICMP: u8 = 1;
const ICMP_V6: u8 = 58;
const ARP: u16 = 0x0806;

/// What a frame must be to be of a flow: all of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FlowFilter(Vec<Term>);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Term {
    Protocol(u8),
    Arp,
    V4,
    V6,
    Host(End, IpAddr),
    Port(End, u16),
}

/// Which end of a flow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    Source,
    Destination,
    Either,
}

impl End {
    /// Whether an end that is meant has `value`, as the flow's [source, destination] have.
    fn has<T: PartialEq>(self, value: &T, ends: &[T; 2]) -> bool {
        match self {
            Self::Source => *value == ends[0],
            Self::Destination => *value == ends[1],
            Self::Either => ends.contains(value),
        }
    }
}

/// What is wrong with a filter.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FilterError {
    /// It has no words.
    #[error("is empty: say for example \"udp dst port 6510\"")]
    Empty,
    /// A word that it does not know.
    #[error(
        "has `{0}` where one of udp, tcp, icmp, icmp6, arp, ip, ip6, [src|dst] host ADDRESS or [src|dst] port NUMBER \
         is expected"
    )]
    Word(String),
    /// A word without what belongs to it.
    #[error("ends after `{0}`")]
    Ends(String),
    /// A value of another form.
    #[error("has {kind} `{value}`")]
    Value {
        /// Of which word.
        kind: &'static str,
        /// It.
        value: String,
    },
}

impl FromStr for FlowFilter {
    type Err = FilterError;

    fn from_str(text: &str) -> Result<Self, FilterError> {
        let mut words = text.split_whitespace().filter(|word| *word != "and");
        let mut terms = Vec::new();
        while let Some(word) = words.next() {
            let mut after = |word: &str| words.next().ok_or(FilterError::Ends(word.to_owned()));
            let (end, kind) = match word {
                "src" => (End::Source, after(word)?),
                "dst" => (End::Destination, after(word)?),
                other => (End::Either, other),
            };
            terms.push(match (end, kind) {
                (End::Either, "udp") => Term::Protocol(UDP),
                (End::Either, "tcp") => Term::Protocol(TCP),
                (End::Either, "icmp") => Term::Protocol(ICMP),
                (End::Either, "icmp6") => Term::Protocol(ICMP_V6),
                (End::Either, "arp") => Term::Arp,
                (End::Either, "ip") => Term::V4,
                (End::Either, "ip6") => Term::V6,
                (_, "host") => Term::Host(end, value("address", after(kind)?)?),
                (_, "port") => Term::Port(end, value("port", after(kind)?)?),
                _ => return Err(FilterError::Word(kind.to_owned())),
            });
        }
        if terms.is_empty() {
            return Err(FilterError::Empty);
        }
        Ok(Self(terms))
    }
}

fn value<T: FromStr>(kind: &'static str, text: &str) -> Result<T, FilterError> {
    text.parse().map_err(|_why| FilterError::Value {
        kind,
        value: text.to_owned(),
    })
}

impl FlowFilter {
    /// True where no frame that goes back is of it.
    pub fn is_one_way(&self) -> bool {
        let is_end = |term: &Term| matches!(term, Term::Host(end, _) | Term::Port(end, _) if *end != End::Either);
        self.0.iter().any(is_end)
    }

    /// True where it takes datagrams alone, so that each frame back is the program's: TCP acknowledges by itself.
    pub fn is_of_datagrams(&self) -> bool {
        let is_datagrams =
            |term: &Term| matches!(term, Term::Protocol(protocol) if *protocol != TCP);
        self.0.iter().any(is_datagrams)
    }

    /// True of a frame of this flow.
    pub fn takes(&self, key: &FlowKey) -> bool {
        self.0.iter().all(|term| term.is_of(key))
    }
}

impl Term {
    fn is_of(self, key: &FlowKey) -> bool {
        match (self, *key) {
            (Self::Arp, FlowKey::Other(kind)) => kind == ARP,
            (Self::Protocol(own), FlowKey::Ip { protocol, .. }) => own == protocol,
            (Self::V4, FlowKey::Ip { source, .. }) => source.is_ipv4(),
            (Self::V6, FlowKey::Ip { source, .. }) => source.is_ipv6(),
            (
                Self::Host(end, address),
                FlowKey::Ip {
                    source,
                    destination,
                    ..
                },
            ) => end.has(&address, &[source, destination]),
            (
                Self::Port(end, port),
                FlowKey::Ip {
                    ports: Some(ports), ..
                },
            ) => end.has(&port, &ports),
            _ => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const COMMAND: FlowKey = FlowKey::Ip {
        protocol: UDP,
        source: IpAddr::V4(core::net::Ipv4Addr::new(10, 77, 0, 1)),
        destination: IpAddr::V4(core::net::Ipv4Addr::new(10, 77, 0, 2)),
        ports: Some([5000, 6510]),
    };

    #[test]
    fn a_filter_takes_what_all_its_words_say() {
        for (text, takes) in [
            ("udp dst port 6510", true),
            ("udp and dst port 6510", true),
            ("udp dst port 5000", false),
            ("port 5000", true),
            ("src port 5000 and dst host 10.77.0.2", true),
            ("host 10.77.0.3", false),
            ("tcp dst port 6510", false),
            ("ip", true),
            ("ip6", false),
            ("arp", false),
        ] {
            let filter: FlowFilter = text.parse().unwrap();
            assert_eq!(filter.takes(&COMMAND), takes, "{text}");
        }
        let arp: FlowFilter = "arp".parse().unwrap();
        assert!(arp.takes(&FlowKey::Other(0x0806)));
        for (text, one_way, datagrams) in [
            ("udp dst port 1", true, true),
            ("udp port 1", false, true),
            ("tcp dst port 1", true, false),
            ("src host 10.0.0.1", true, false),
        ] {
            let filter: FlowFilter = text.parse().unwrap();
            let found = (filter.is_one_way(), filter.is_of_datagrams());
            assert_eq!(found, (one_way, datagrams), "{text}");
        }
        let port: FlowFilter = "udp port 1".parse().unwrap();
        assert!(!port.takes(&FlowKey::Rest));
    }

    #[test]
    fn a_word_that_is_not_known_is_named() {
        for (text, says) in [
            ("", "empty"),
            ("and", "empty"),
            ("sctp", "`sctp`"),
            ("udp or tcp", "`or`"),
            ("dst udp", "`udp`"),
            ("dst port", "ends after `port`"),
            ("src", "ends after `src`"),
            ("port x", "port `x`"),
            ("port 65536", "port `65536`"),
            ("host robot", "address `robot`"),
        ] {
            let error = text.parse::<FlowFilter>().unwrap_err().to_string();
            assert!(error.contains(says), "{text}: {error}");
        }
    }
}
