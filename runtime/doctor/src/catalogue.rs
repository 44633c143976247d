//! Everything the doctor can find: identifier, where it is read, why it matters and the cure. One
//! table for the report, the JSON and `docs/doctor.md`, so that they cannot differ. It examines
//! nothing.

#[cfg(test)]
use super::finding::Severity;

/// One thing that is looked at.
#[derive(Debug, Clone, Copy)]
pub(super) struct Entry {
    /// Stable identifier. Where there are several of a kind, a finding adds `.<which>`.
    pub(super) id: &'static str,
    /// What is looked at, for people.
    pub(super) title: &'static str,
    /// Where it is read; `{}` stands for which one.
    pub(super) source: &'static str,
    /// What it does to a measurement, in the units of one.
    pub(super) why: &'static str,
    /// The general cure, a command where there is one; `{}` as above.
    pub(super) fix: &'static str,
}

/// All of them, by subject, in the order of the page.
pub(super) const SUBJECTS: [(&str, &[Entry]); 6] = [
    ("Kernel", KERNEL),
    ("Processors", PROCESSORS),
    ("Rights of this user", RIGHTS),
    ("Network", NETWORK),
    ("Clocks", CLOCKS),
    ("Memory and files", MEMORY),
];

const KERNEL: &[Entry] = &[
    Entry {
        id: "preemption",
        title: "Kernel preemption",
        source: "/sys/kernel/realtime, /proc/sys/kernel/version, /sys/kernel/debug/sched/preempt, preempt= in \
                 /proc/cmdline, the kernel's options in /boot or /proc/config.gz",
        why: "where a task in a system call does not give way, a wake-up waits for it: 100 us to some ms \
              instead of 10 us",
        fix: "boot with preempt=full (PREEMPT_DYNAMIC), or install a PREEMPT_RT kernel: apt-get install \
              linux-image-rt-amd64",
    },
    Entry {
        id: "realtime_throttle",
        title: "Time kept back from SCHED_FIFO",
        source: "/proc/sys/kernel/sched_rt_runtime_us and sched_rt_period_us",
        why: "a FIFO thread that busy-polls (wait = \"spin\") stands still for about 50000 us in every second on \
              a CPU that others want; loops that block do not feel it",
        fix: "isolate the CPU of the busy poller, then sysctl -w kernel.sched_rt_runtime_us=-1",
    },
    Entry {
        id: "fair_server",
        title: "Time lent to normal tasks",
        source: "/proc/sys/kernel/osrelease, /sys/kernel/debug/sched/fair_server/cpu*/runtime",
        why: "since Linux 6.12 normal tasks get about 50000 us of every second on a CPU that a FIFO busy poller \
              holds, also with sched_rt_runtime_us=-1",
        fix: "isolate the CPU, or as root, with debugfs mounted: echo 0 > \
              /sys/kernel/debug/sched/fair_server/cpuN/runtime",
    },
    Entry {
        id: "rt_group_sched",
        title: "Real-time budgets of control groups",
        source: "CONFIG_RT_GROUP_SCHED in the kernel's options, rt_group_sched= in /proc/cmdline",
        why: "SCHED_FIFO fails even for root in a group without a budget; without it any load delays the loop by \
              1000 us and more",
        fix: "boot with rt_group_sched=0, or give the group a budget in cpu.rt_runtime_us",
    },
    Entry {
        id: "clocksource",
        title: "Clock source",
        source: "/sys/devices/system/clocksource/clocksource0/current_clocksource",
        why: "any other than the processor's counter makes every clock read a system call of 1 us and more, \
              several in each hop",
        fix: "look for `clocksource` in dmesg; boot with tsc=reliable if the counter is sound",
    },
    Entry {
        id: "clock_read_cost",
        title: "Cost of a clock read",
        source: "measured: the cheapest of 20 batches of CLOCK_MONOTONIC",
        why: "every stamp of a message pays it; at 0.03 us it is nothing, at 1 us it is a shared-memory hop",
        fix: "echo tsc > /sys/devices/system/clocksource/clocksource0/current_clocksource",
    },
    Entry {
        id: "transparent_huge_pages",
        title: "Transparent huge pages",
        source: "/sys/kernel/mm/transparent_hugepage/enabled",
        why: "the kernel merges pages in the background and holds a thread up for 100 us and more while it does",
        fix: "echo madvise > /sys/kernel/mm/transparent_hugepage/enabled",
    },
    Entry {
        id: "irqbalance",
        title: "Interrupt balancing daemon",
        source: "/proc/*/comm",
        why: "it moves interrupts during a run, onto pinned CPUs too: 5 to 50 us each time one strikes there",
        fix: "systemctl stop irqbalance, or IRQBALANCE_BANNED_CPULIST=CPUS in /etc/default/irqbalance",
    },
    Entry {
        id: "virtual_machine",
        title: "Virtual machine",
        source: "the flag `hypervisor` in /proc/cpuinfo, /sys/class/dmi/id/product_name",
        why: "the tail comes from below and stays when this system is idle: single wake-ups of several 1000 us that \
              no setting in here cures, and that steal time need not show",
        fix: "measure tails on hardware; in here trust medians and ratios within one run",
    },
    Entry {
        id: "load",
        title: "Load of this host",
        source: "/proc/loadavg, /sys/devices/system/cpu/online",
        why: "every runnable task more than there are CPUs delays threads without real-time priority by 1000 us \
              and more",
        fix: "end what else runs: top -o %CPU",
    },
    Entry {
        id: "wakeup_latency",
        title: "Lateness of a wake-up",
        source: "measured: absolute sleeps, pinned, at SCHED_FIFO where that is granted",
        why: "every message that wakes a thread has it in its delay; it is the resolution of this host",
        fix: "allow SCHED_FIFO, isolate a CPU, set the performance governor, quieten the host; then \
              hil-runtime doctor --latency 60s",
    },
];

const PROCESSORS: &[Entry] = &[
    Entry {
        id: "pinned_cpus",
        title: "CPUs to be had for pinned threads",
        source: "sched_setaffinity(2), tried: the cpuset of this process, and what is online of it",
        why: "a thread whose CPU is refused runs on any: it is moved about, 10 to 1000 us each time",
        fix: "cpu = of the key named, or AllowedCPUs= in the unit (--cpuset-cpus for a container)",
    },
    Entry {
        id: "isolated_cpus",
        title: "Isolated CPUs",
        source: "/sys/devices/system/cpu/isolated; pins: cpu = in the topology",
        why: "on a CPU that is not isolated any task may run: a busy poller loses 1000 us and more at a time to it",
        fix: "boot with isolcpus=CPUS nohz_full=CPUS rcu_nocbs=CPUS and pin to these",
    },
    Entry {
        id: "nohz_full",
        title: "CPUs without a periodic tick",
        source: "/sys/devices/system/cpu/nohz_full; pins: cpu = in the topology",
        why: "each tick takes 2 to 20 us from a busy poller, 100 to 1000 times a second",
        fix: "boot with nohz_full=CPUS for the CPUs that busy-poll (CONFIG_NO_HZ_FULL)",
    },
    Entry {
        id: "rcu_nocbs",
        title: "CPUs without RCU callbacks",
        source: "rcu_nocbs= in /proc/cmdline, nohz_full; pins: cpu = in the topology",
        why: "the kernel's deferred frees run in batches of 10 to 500 us on the CPU that caused them",
        fix: "boot with rcu_nocbs=CPUS for the pinned CPUs",
    },
    Entry {
        id: "governor",
        title: "Frequency governor",
        source: "/sys/devices/system/cpu/cpu*/cpufreq/scaling_governor",
        why: "the clock rate follows the load, so the same work takes up to three times as long, and a change of \
              rate 10 to 100 us",
        fix: "cpupower frequency-set -g performance",
    },
    Entry {
        id: "idle_states",
        title: "Deepest idle state in use",
        source: "/sys/devices/system/cpu/cpu*/cpuidle/state*/latency and disable, /dev/cpu_dma_latency",
        why: "a CPU that sleeps adds the exit latency of its state, 1 to 1000 us, to the next wake-up or interrupt",
        fix: "hold /dev/cpu_dma_latency open with 0 during a run, or cpupower idle-set -D 10",
    },
    Entry {
        id: "smt",
        title: "Hardware threads sharing a core",
        source: "/sys/devices/system/cpu/smt/active, cpu*/topology/thread_siblings_list",
        why: "whatever runs on the sibling takes half of the core: 2 us become 4 us, at any time",
        fix: "echo off > /sys/devices/system/cpu/smt/control, or keep the sibling of a pinned CPU idle",
    },
];

const RIGHTS: &[Entry] = &[
    Entry {
        id: "fifo",
        title: "SCHED_FIFO for this user",
        source: "tried in a thread of its own; RLIMIT_RTPRIO, CAP_SYS_NICE",
        why: "without real-time priority any load delays the loop by 1000 us and more",
        fix: "echo \"$USER - rtprio 90\" > /etc/security/limits.d/90-hil.conf and log in again; in a unit \
              LimitRTPRIO=90",
    },
    Entry {
        id: "memory_lock",
        title: "Locked memory for this user",
        source: "tried and released; RLIMIT_MEMLOCK, CAP_IPC_LOCK",
        why: "a page fault in the loop costs 1 us, from a disk 1000 us and more",
        fix: "echo \"$USER - memlock unlimited\" > /etc/security/limits.d/91-hil.conf and log in again; in a unit \
              LimitMEMLOCK=infinity",
    },
];

const NETWORK: &[Entry] = &[
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

const CLOCKS: &[Entry] = &[
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

const MEMORY: &[Entry] = &[
    Entry {
        id: "shared_memory",
        title: "Shared memory in /dev/shm",
        source: "statvfs of /dev/shm",
        why: "channels live there: one that outgrows the space ends its process with SIGBUS",
        fix: "mount -o remount,size=1G,mode=1777 /dev/shm (--shm-size=1g for a container)",
    },
    Entry {
        id: "run_limits",
        title: "Limits of this host for the run",
        source: "what the topology takes, against statvfs, RLIMIT_NOFILE, RLIMIT_NPROC, RLIMIT_MEMLOCK, pids.max, \
                 MemAvailable and the memory limits of control groups",
        why: "a run that takes more is refused before it begins (exit 78)",
        fix: "what is named with each",
    },
    Entry {
        id: "shared_memory_leftovers",
        title: "Segments of ended runs",
        source: "/dev/shm, the locks of the domains below the runtime folder",
        why: "a run that was killed leaves its segments; they take room from the next one until it sweeps them",
        fix: "start any run, which removes them, or rm those named here",
    },
    Entry {
        id: "iceoryx2_nodes",
        title: "Stale iceoryx2 nodes",
        source: "iceoryx2's list of nodes, of its default domain",
        why: "a dead node holds its slots, and a service it died making refuses every later open; runs have \
              domains of their own, so this concerns other iceoryx2 programs",
        fix: "start any program of that domain, which cleans up; with none running rm -r /tmp/iceoryx2 \
              /dev/shm/iox2_*",
    },
    Entry {
        id: "runtime_folder",
        title: "Folder for sockets and service files",
        source: "tried: may this user write there",
        why: "channels keep their sockets and locks there; a fallback among temporary files may be cleaned up \
              or hidden under a run",
        fix: "RuntimeDirectory=hil in the unit, or install -d -o USER /run/hil",
    },
    Entry {
        id: "remove_ipc",
        title: "Segments survive a log-out",
        source: "RemoveIPC= in /etc/systemd/logind.conf and logind.conf.d, the user's id",
        why: "logind removes the shared memory of a normal user at log-out, under a run that goes on",
        fix: "run as a system user (User=hil), or printf '[Login]\\nRemoveIPC=no\\n' > \
              /etc/systemd/logind.conf.d/hil.conf and systemctl restart systemd-logind",
    },
    Entry {
        id: "private_tmp",
        title: "Temporary folder of its own",
        source: "/proc/self/mountinfo",
        why: "with PrivateTmp= programs outside the unit do not see channels whose files are in /tmp",
        fix: "PrivateTmp=no in the unit, or RuntimeDirectory=hil",
    },
    Entry {
        id: "run_disk",
        title: "Room for the run's folder",
        source: "statvfs of run.record; /proc/self/mountinfo",
        why: "records that find no room are lost and counted, and a folder on the network stalls the writer \
              for 1000 us and more",
        fix: "--set run.record='\"/var/tmp/hil\"', or make room: du -sh runs/*",
    },
];

/// The entry called `id`.
pub(super) fn entry(id: &str) -> Option<&'static Entry> {
    let mut all = SUBJECTS.iter().flat_map(|(_, entries)| entries.iter());
    all.find(|entry| entry.id == id)
}

/// The part of `docs/doctor.md` that lists every finding.
#[cfg(test)]
fn page() -> String {
    use core::fmt::Write as _;
    let mut text = String::new();
    let which = |words: &str| words.replace("{}", "NAME").replace('|', "\\|");
    for (subject, entries) in SUBJECTS {
        write!(
            text,
            "\n### {subject}\n\n| Id | What, and where it is read | Why | Fix |\n|---|---|---|---|\n"
        )
        .unwrap();
        for entry in entries {
            let Entry {
                id,
                title,
                source,
                why,
                fix,
            } = entry;
            let is_one_of_several = source.contains("{}") || fix.contains("{}");
            let suffix = if is_one_of_several { ".NAME" } else { "" };
            let (source, fix) = (which(source), which(fix));
            writeln!(
                text,
                "| `{id}{suffix}` | {title}: {source} | {why} | {fix} |"
            )
            .unwrap();
        }
    }
    text
}

/// How much a severity weighs, for the page.
#[cfg(test)]
const fn meaning(severity: Severity) -> &'static str {
    match severity {
        Severity::Ok => "as it should be",
        Severity::Note => "costs something that a careful reader wants to know of",
        Severity::CannotTell => "could not be read; never taken for ok",
        Severity::Warning => "spoils figures in microseconds, or a run as the topology wants it",
        Severity::Error => "prevents a run, or makes its figures wrong",
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::path::Path;

    use super::*;

    const BEGIN: &str = "<!-- findings: begin -->\n";
    const END: &str = "\n<!-- findings: end -->";

    fn document() -> (std::path::PathBuf, String) {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/doctor.md");
        let text = std::fs::read_to_string(&path).unwrap();
        (path, text)
    }

    #[test]
    fn identifiers_are_unique_and_nothing_is_left_unsaid() {
        let mut seen = BTreeSet::new();
        for entry in SUBJECTS.iter().flat_map(|(_, entries)| entries.iter()) {
            assert!(seen.insert(entry.id), "{} twice", entry.id);
            let is_plain = |c: char| c.is_ascii_lowercase() || c == '_' || c.is_ascii_digit();
            assert!(entry.id.chars().all(is_plain), "{}", entry.id);
            for words in [entry.title, entry.source, entry.why, entry.fix] {
                assert!(words.len() > 3, "{entry:?}");
                assert!(!words.ends_with('.'), "{entry:?}");
            }
        }
    }

    /// `HIL_WRITE_DOCS=1` writes the table into the page instead.
    #[test]
    fn the_page_lists_every_finding_as_the_program_knows_it() {
        let (path, text) = document();
        let (before, rest) = text.split_once(BEGIN).expect("the page has its mark");
        let (listed, after) = rest.split_once(END).expect("the page has its end mark");
        if std::env::var_os("HIL_WRITE_DOCS").is_some() {
            let written = format!("{before}{BEGIN}{}{END}{after}", page());
            std::fs::write(path, written).unwrap();
        } else {
            assert_eq!(listed, page(), "run this test with HIL_WRITE_DOCS=1");
        }
    }

    #[test]
    fn the_page_explains_the_severities_as_the_program_means_them() {
        let (_, text) = document();
        for severity in Severity::ALL {
            let line = format!("| `{}` | {} |", severity.word(), meaning(severity));
            assert!(text.contains(&line), "{line} is missing");
        }
    }
}
