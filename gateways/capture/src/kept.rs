//! What a capture kept, by the filter that its file names: whether a stream was surely among it. It runs no filter:
//! of the words of `pcap-filter(7)` those are understood that ask for protocol, host and port, and of our own the
//! flows; what any other word asks for is unknown.

use std::net::{IpAddr, SocketAddr};
use std::str::FromStr as _;

use super::flow::FlowFilter;
use super::observe::Stream;

/// True when a capture with this filter kept every datagram of the stream.
pub(super) fn surely_keeps(filter: &str, stream: &Stream) -> bool {
    let spaced = filter
        .replace("&&", " and ")
        .replace("||", " or ")
        .replace('!', " ! ")
        .replace('(', " ( ")
        .replace(')', " ) ");
    let words: Vec<&str> = spaced.split_whitespace().collect();
    // They change where all words behind them look.
    let moves = |word: &&str| matches!(*word, "vlan" | "mpls" | "pppoes" | "geneve" | "vxlan");
    if words.iter().any(moves) {
        return false;
    }
    let mut words = Words {
        words: &words,
        stream,
    };
    words.words.is_empty() || (words.any() == Some(true) && words.words.is_empty())
}

/// Words that are left.
struct Words<'a> {
    words: &'a [&'a str],
    stream: &'a Stream,
}

impl<'a> Words<'a> {
    fn next_if(&mut self, is_so: impl FnOnce(&str) -> bool) -> Option<&'a str> {
        let (first, rest) = self.words.split_first()?;
        is_so(first).then(|| {
            self.words = rest;
            *first
        })
    }

    /// Conditions with `and` and `or` between, which bind alike; `None` where it is unknown whether they hold.
    fn any(&mut self) -> Option<bool> {
        let mut holds = self.condition();
        while let Some(word) = self.next_if(|word| matches!(word, "and" | "or")) {
            let next = self.condition();
            let decisive = Some(word == "or");
            holds = if holds == decisive || next == decisive {
                decisive
            } else {
                holds.and(next)
            };
        }
        holds
    }

    fn condition(&mut self) -> Option<bool> {
        if self.next_if(|word| matches!(word, "not" | "!")).is_some() {
            return self.condition().map(|holds| !holds);
        }
        if self.next_if(|word| word == "(").is_some() {
            let holds = self.any();
            return self.next_if(|word| word == ")").and(holds);
        }
        let is_own = |word: &str| FlowFilter::from_str(word).is_ok();
        if let Some(own) = self.next_if(is_own) {
            return FlowFilter::from_str(own)
                .ok()
                .map(|own| own.keeps(self.stream));
        }
        let end = |word: &&str| matches!(*word, "and" | "or" | ")");
        let length = self.words.iter().position(end).unwrap_or(self.words.len());
        let (condition, rest) = self.words.split_at(length);
        self.words = rest;
        holds(condition, self.stream)
    }
}

fn holds(condition: &[&str], stream: &Stream) -> Option<bool> {
    let Stream {
        source,
        destination,
        ..
    } = stream;
    let (protocol, condition) = match condition {
        [word, rest @ ..] => match *word {
            "udp" => (true, rest),
            "ip" => (source.is_ipv4(), rest),
            "ip6" => (source.is_ipv6(), rest),
            "tcp" | "sctp" | "icmp" | "icmp6" | "igmp" | "arp" | "rarp" => (false, rest),
            _ => (true, condition),
        },
        [] => return None,
    };
    let (ends, condition): (&[SocketAddr], &[&str]) = match condition {
        ["src", rest @ ..] => (&[*source], rest),
        ["dst", rest @ ..] => (&[*destination], rest),
        _ => (&[*source, *destination], condition),
    };
    let holds = match condition {
        [] if ends.len() == 2 => true,
        ["port", port] => {
            let port: u16 = port.parse().ok()?;
            ends.iter().any(|end| end.port() == port)
        }
        ["portrange", range] => {
            let (from, to) = range.split_once('-')?;
            let range = from.parse().ok()?..=to.parse().ok()?;
            ends.iter().any(|end| range.contains(&end.port()))
        }
        ["host", address] => {
            let address: IpAddr = address.parse().ok()?;
            ends.iter().any(|end| end.ip() == address)
        }
        _ => return None,
    };
    Some(protocol && holds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_filter_that_asks_for_what_the_stream_has_surely_keeps_it() {
        let mut stream = Stream {
            flow_index: 0,
            source: "10.0.0.1:5000".parse().unwrap(),
            destination: "10.0.0.2:5004".parse().unwrap(),
            own: None,
        };
        for filter in [
            "",
            "udp",
            "ip",
            "ip or ip6",
            "not tcp",
            "!(tcp or arp)",
            "udp port 5004",
            "port 5000",
            "udp dst port 5004 and src host 10.0.0.1",
            "udp && (port 9 || portrange 5000-5010)",
            "less 100 or udp",
            "not port 22",
            "udp:dport=5004,id=0+4",
            "hil or udp:src=10.0.0.1,dst=10.0.0.2",
        ] {
            assert!(surely_keeps(filter, &stream), "{filter}");
        }
        for filter in [
            "tcp",
            "ip6",
            "not udp",
            "udp port 5005",
            "udp src port 5004",
            "host 10.0.0.3",
            "less 100",
            "udp and less 100",
            "not less 100",
            "ip[1] & 0xfc == 0xb8",
            "vlan or udp",
            "src",
            "udp and (ip",
            "host robot",
            "tcp port 5004",
            "port 5004 5005",
            "udp:dport=5005",
            "hil",
            "all",
            "udp port 5004 and not host 10.0.0.2",
        ] {
            assert!(!surely_keeps(filter, &stream), "{filter}");
        }
        // Of ours.
        stream.own = Some((3, 1));
        assert!(surely_keeps("hil", &stream) && !surely_keeps("hil:port=9", &stream));
    }
}
