//! What is found of network and clocks: words only.

use super::Entry;

pub(super) const NETWORK: &[Entry] = &[
    Entry {
        id: "interface",
        title: "Interface",
        source: "getifaddrs",
        why: "the topology names it; without it the run cannot start",
        fix: "name one that is there in place of {}; ip -brief link lists them",
    },
    Entry {
        id: "timestamps",
        title: "Stamps on",
        source: "ETHTOOL_GET_TS_INFO of {}",
        why: "without kernel stamps the scheduler's delay, 10 to 1000 us, is counted as the network's",
        fix: "use an interface whose driver stamps both ways: ethtool -T {}",
    },
    Entry {
        id: "card",
        title: "Card of",
        source: "the clock, the setting and a probe of {}",
        why: "card stamps are good to 1 us or less, if they come",
        fix: "leave timestamps = \"software\", or use a card that delivers",
    },
    Entry {
        id: "radio",
        title: "Radio of",
        source: "nl80211: power save, frequency and stations of {}",
        why: "a radio that sleeps hears of an arrival with the next beacon only, some 100000 us late; at 1 Mbit/s a \
              datagram of 200 bytes takes 2000 us",
        fix: "iw dev {} set power_save off",
    },
    Entry {
        id: "interrupts",
        title: "Interrupts of",
        source: "/sys/class/net/{}/device, /proc/interrupts, /proc/irq/*/smp_affinity_list and effective_affinity_list",
        why: "an interrupt of the card on a pinned CPU takes 2 to 50 us from the thread there, for every packet",
        fix: "echo CPUS > /proc/irq/N/smp_affinity_list with CPUS that nothing is pinned to",
    },
    Entry {
        id: "coalescing",
        title: "Interrupt coalescing of",
        source: "ETHTOOL_MSG_COALESCE_GET of {}",
        why: "the card waits that long for more packets before it interrupts: it is added to each delay",
        fix: "ethtool -C {} adaptive-rx off rx-usecs 0 tx-usecs 0",
    },
    Entry {
        id: "ring",
        title: "Receive ring of",
        source: "ETHTOOL_MSG_RINGS_GET of {}",
        why: "a burst longer than the ring is dropped while the CPU is away: at 10000 packets per second 256 \
              places bridge 25000 us",
        fix: "ethtool -G {} rx 1024",
    },
    Entry {
        id: "udp_buffers",
        title: "Largest socket buffers",
        source: "/proc/sys/net/core/rmem_max and wmem_max",
        why: "transmit stamps are charged to the receive buffer too: a small one fills within a stall of some \
              1000 us and drops arrivals",
        fix: "sysctl -w net.core.rmem_max=4194304 net.core.wmem_max=4194304",
    },
    Entry {
        id: "route",
        title: "Route to",
        source: "the source address the kernel chooses towards {} (connect, nothing is sent), getifaddrs, \
                 /proc/net/arp",
        why: "what leaves by another interface measures another network",
        fix: "ip route get ADDRESS shows the choice; ip route add ADDRESS dev INTERFACE src OWN sets it",
    },
    Entry {
        id: "addresses",
        title: "Addresses of this host",
        source: "getifaddrs",
        why: "an address or a subnet on two interfaces makes the kernel answer on either: delays of two networks \
              in one figure",
        fix: "ip address del ADDRESS/PREFIX dev INTERFACE on the one not under test; a double on another host shows \
              with arping -D -I INTERFACE ADDRESS",
    },
    Entry {
        id: "mtu",
        title: "Message size on link",
        source: "/sys/class/net/*/mtu, path_mtu_bytes and the message sizes of link {}",
        why: "a message above the MTU goes as several datagrams, of which each may be lost and each adds its time \
              on the wire: 12 us at 1 Gbit/s, 120 us at 100 Mbit/s",
        fix: "set path_mtu_bytes to the MTU of the path (ip link show), or ip link set INTERFACE mtu 9000 on both hosts",
    },
    Entry {
        id: "ports",
        title: "Ports of the topology",
        source: "/proc/net/udp, udp6, tcp, tcp6; the owner in /proc/*/fd",
        why: "a port that is in use keeps the run from starting",
        fix: "end the program named, or set links.NAME.port and hosts.NAME.control_port",
    },
    Entry {
        id: "firewall",
        title: "Packet filter",
        source: "nfnetlink: base chains of all families; /proc/net/ip_tables_names",
        why: "a filter that drops the run's ports keeps the hosts from meeting; its rules cost 0.1 to 2 us per packet, \
              connection tracking more",
        fix: "nft add rule inet filter input udp dport PORTS accept; nft list ruleset shows what is there",
    },
    Entry {
        id: "clock_path",
        title: "Clock path",
        source: "clock_address of the topology, getifaddrs, ETHTOOL_GET_TS_INFO",
        why: "without it clocks are exchanged over the data path alone, and the bound of one-way figures is as wide \
              as that path is slow",
        fix: "ip address add ADDRESS/24 dev INTERFACE",
    },
];

pub(super) const CLOCKS: &[Entry] = &[
    Entry {
        id: "clock_synchronisation",
        title: "Time of day against a reference",
        source: "adjtimex(2)",
        why: "kernel receive stamps jump when a daemon steps the clock during a run; one-way delays then rest on \
              the runtime's own exchanges alone",
        fix: "systemctl enable --now chrony on both hosts, and wait until chronyc tracking shows it settled",
    },
    Entry {
        id: "clock_reference",
        title: "Reference of the time of day",
        source: "chronyd, ptp4l with phc2sys, or ntpd, whichever runs",
        why: "without one the bound of one-way delays is half the smallest round trip of the clock exchanges: \
              50 us on a cable, 1000 us on Wi-Fi",
        fix: "keep both hosts on one reference with chronyd or ptp4l and phc2sys, best over a wired link",
    },
    Entry {
        id: "clock_between_hosts",
        title: "Clocks of this host and",
        source: "clock_reference of both hosts; the other's from its report (--with FILE), {}",
        why: "it bounds every one-way delay between the two before the runtime's own exchanges do",
        fix: "on the other host: hil-runtime doctor --json > other.json; here: hil-runtime doctor --with other.json",
    },
];
