//! Facts of the kernel: its version, how it was built and booted, how it preempts, and what it keeps
//! back from real-time tasks. The one reader of each; it judges nothing.

use std::fs::File;
use std::process::{Command, Stdio};

use super::{Fact, HostFiles};
use crate::open_files;

/// The kernel's release, such as `6.12.1-amd64`.
pub fn kernel_release(files: &HostFiles) -> Fact<String> {
    files.read("/proc/sys/kernel/osrelease")
}

/// The kernel's major and minor version.
pub(crate) fn kernel_version(files: &HostFiles) -> Fact<(u32, u32)> {
    kernel_release(files).and_then(|release| {
        let mut numbers = release
            .split(|c: char| !c.is_ascii_digit())
            .map(str::parse::<u32>);
        match (numbers.next(), numbers.next()) {
            (Some(Ok(major)), Some(Ok(minor))) => Fact::Available((major, minor)),
            _ => Fact::Unavailable(format!("kernel release `{release}` has no version")),
        }
    })
}

/// The options the kernel was built with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KernelOptions {
    text: String,
    /// The file they were read from.
    pub source: String,
}

impl KernelOptions {
    /// From `/boot/config-<release>`, else `/proc/config.gz`.
    pub fn read(files: &HostFiles) -> Fact<Self> {
        let release = kernel_release(files);
        let path = format!("/boot/config-{}", release.to_text());
        if let Fact::Available(text) = files.read(&path) {
            return Fact::Available(Self { text, source: path });
        }
        let packed = "/proc/config.gz";
        unpacked(files, packed).map(|text| Self {
            text,
            source: packed.to_owned(),
        })
    }

    /// True when option `name` (without `CONFIG_`) is built in.
    pub fn has(&self, name: &str) -> bool {
        let wanted = format!("CONFIG_{name}=y");
        self.text.lines().any(|line| line.trim() == wanted)
    }
}

/// `gzip` is part of every distribution's base; a decoder of our own would serve this file alone.
fn unpacked(files: &HostFiles, path: &str) -> Fact<String> {
    let file = match File::open(files.locate(path)) {
        Ok(file) => file,
        Err(error) => return Fact::Unavailable(format!("no /boot/config-* and {path}: {error}")),
    };
    let output = open_files::withhold().and_then(|()| {
        Command::new("gzip")
            .arg("-dc")
            .stdin(Stdio::from(file))
            .stderr(Stdio::null())
            .output()
    });
    match output {
        Ok(output) if output.status.success() => {
            Fact::Available(String::from_utf8_lossy(&output.stdout).into_owned())
        }
        Ok(output) => Fact::Unavailable(format!("gzip -dc {path} ended with {}", output.status)),
        Err(error) => Fact::Unavailable(format!("gzip -dc {path}: {error}")),
    }
}

/// When a task in a system call gives way to a more urgent one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PreemptionMode {
    /// Nearly everywhere, interrupt handlers included (`PREEMPT_RT`).
    Realtime,
    /// Wherever no lock is held.
    Full,
    /// As `Full` for real-time tasks; normal ones wait for the tick.
    Lazy,
    /// At places the kernel's authors chose.
    Voluntary,
    /// When the system call ends.
    None,
}

impl PreemptionMode {
    const WORDS: [(&'static str, Self); 4] = [
        ("full", Self::Full),
        ("lazy", Self::Lazy),
        ("voluntary", Self::Voluntary),
        ("none", Self::None),
    ];

    fn of(word: &str) -> Option<Self> {
        let found = Self::WORDS.iter().find(|(one, _)| *one == word);
        found.map(|(_, mode)| *mode)
    }

    fn word(self) -> &'static str {
        let found = Self::WORDS.iter().find(|(_, mode)| *mode == self);
        found.map_or("realtime", |(word, _)| word)
    }
}

/// How the kernel preempts, and who says so.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Preemption {
    /// The mode in force; why it is not known.
    pub mode: Fact<PreemptionMode>,
    /// For people: `PREEMPT_DYNAMIC, mode full`.
    pub words: String,
    /// The file that tells.
    pub source: String,
}

const REALTIME_FLAG: &str = "/sys/kernel/realtime";
const VERSION: &str = "/proc/sys/kernel/version";
const DYNAMIC_MODE: &str = "/sys/kernel/debug/sched/preempt";

/// `PREEMPT_RT`, or the model built in and, where it can be chosen at boot, the mode in force.
pub fn preemption(files: &HostFiles) -> Fact<Preemption> {
    let found = |mode, words: &str, source: &str| {
        Fact::Available(Preemption {
            mode: Fact::Available(mode),
            words: words.to_owned(),
            source: source.to_owned(),
        })
    };
    let realtime = files.read(REALTIME_FLAG);
    if realtime.available().is_some_and(|flag| flag == "1") {
        return found(PreemptionMode::Realtime, "PREEMPT_RT", REALTIME_FLAG);
    }
    files.read(VERSION).and_then(|version| {
        let mut words = version.split_whitespace();
        match words.find(|word| word.starts_with("PREEMPT")) {
            None => found(PreemptionMode::None, "none (server)", VERSION),
            Some("PREEMPT_RT") => found(PreemptionMode::Realtime, "PREEMPT_RT", VERSION),
            Some("PREEMPT_DYNAMIC") => Fact::Available(dynamic(files)),
            Some(model) => found(PreemptionMode::Full, model, VERSION),
        }
    })
}

/// The mode of a kernel that can choose: what it says, what it was booted with, what it was built
/// with.
fn dynamic(files: &HostFiles) -> Preemption {
    let model = "PREEMPT_DYNAMIC";
    let stated = |mode: PreemptionMode, by: &str, source: &str| Preemption {
        mode: Fact::Available(mode),
        words: format!("{model}, mode {}{by}", mode.word()),
        source: source.to_owned(),
    };
    let marked = files.read(DYNAMIC_MODE);
    let marked = marked.available().and_then(|modes| {
        let (_, rest) = modes.split_once('(')?;
        PreemptionMode::of(rest.split_once(')')?.0)
    });
    if let Some(mode) = marked {
        return stated(mode, "", DYNAMIC_MODE);
    }
    let booted = boot_parameter(files, "preempt");
    if let Some(mode) = booted
        .available()
        .and_then(|value| PreemptionMode::of(value.as_deref()?))
    {
        return stated(mode, " as booted", "/proc/cmdline");
    }
    // What the command line could have changed is not known without it.
    let options = booted.and_then(|_not_named| KernelOptions::read(files));
    match options {
        Fact::Available(options) => {
            let built = [
                ("PREEMPT", PreemptionMode::Full),
                ("PREEMPT_LAZY", PreemptionMode::Lazy),
                ("PREEMPT_VOLUNTARY", PreemptionMode::Voluntary),
            ];
            let found = built.iter().find(|(option, _)| options.has(option));
            let mode = found.map_or(PreemptionMode::None, |(_, mode)| *mode);
            stated(mode, " as built", &options.source)
        }
        Fact::Unavailable(reason) => Preemption {
            words: format!("{model}, mode unavailable ({DYNAMIC_MODE} is not readable)"),
            source: DYNAMIC_MODE.to_owned(),
            mode: Fact::Unavailable(format!(
                "{model}: {DYNAMIC_MODE} is not readable (root, with debugfs mounted, reads it), \
                 the command line names no mode, {reason}"
            )),
        },
    }
}

/// The value of `name=value` on the kernel's command line; the last one counts, `None` when it is
/// not there.
pub fn boot_parameter(files: &HostFiles, name: &str) -> Fact<Option<String>> {
    files.read("/proc/cmdline").map(|line| {
        let mut values = line.split_whitespace().filter_map(|word| {
            let (key, value) = word.split_once('=').unwrap_or((word, ""));
            (key == name).then(|| value.to_owned())
        });
        values.next_back()
    })
}

/// Parameters of the kernel's command line that change how it schedules, ticks or idles. The others
/// are left out: they say nothing about a measurement, and a manifest is meant to be shown around.
const TIMING_PARAMETERS: [&str; 16] = [
    "clocksource",
    "cpuidle.off",
    "idle",
    "intel_idle.max_cstate",
    "intel_pstate",
    "irqaffinity",
    "isolcpus",
    "mitigations",
    "nohz",
    "nohz_full",
    "nosmt",
    "preempt",
    "processor.max_cstate",
    "rcu_nocbs",
    "rt_group_sched",
    "tsc",
];

pub(super) fn boot_parameters(files: &HostFiles) -> Fact<String> {
    files.read("/proc/cmdline").map(|line| {
        let chosen: Vec<&str> = line
            .split_whitespace()
            .filter(|word| TIMING_PARAMETERS.contains(&word.split('=').next().unwrap_or(word)))
            .collect();
        if chosen.is_empty() {
            "none that affect timing".to_owned()
        } else {
            chosen.join(" ")
        }
    })
}

/// The share of each period that real-time tasks may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RealtimeThrottle {
    /// `sched_rt_runtime_us`; negative means without limit.
    pub runtime_us: i64,
    /// `sched_rt_period_us`.
    pub period_us: i64,
}

impl RealtimeThrottle {
    /// What the kernel says.
    pub fn read(files: &HostFiles) -> Fact<Self> {
        let number = |name: &str| files.read_number(&format!("/proc/sys/kernel/{name}"));
        number("sched_rt_runtime_us").and_then(|runtime_us| {
            number("sched_rt_period_us").map(|period_us| Self {
                runtime_us,
                period_us,
            })
        })
    }

    /// It takes something away.
    pub fn is_active(self) -> bool {
        self.runtime_us >= 0 && self.runtime_us < self.period_us
    }

    /// What it takes away of each period, milliseconds.
    pub(crate) fn lost_ms(self) -> i64 {
        (self.period_us - self.runtime_us) / 1000
    }

    /// The period, milliseconds.
    pub(crate) fn period_ms(self) -> i64 {
        self.period_us / 1000
    }
}

/// The first kernel with the deadline server that lends normal tasks 50 ms per second.
const FAIR_SERVER_SINCE: (u32, u32) = (6, 12);

/// Whether this kernel lends normal tasks time even without a throttle.
pub fn has_fair_server(files: &HostFiles) -> Fact<bool> {
    kernel_version(files).map(|version| version >= FAIR_SERVER_SINCE)
}

/// The counter behind the kernel's clocks.
pub fn clocksource(files: &HostFiles) -> Fact<String> {
    files.read("/sys/devices/system/clocksource/clocksource0/current_clocksource")
}

/// Whether a hypervisor runs below; the tail of every latency then belongs to it as well.
pub fn virtual_machine(files: &HostFiles) -> Fact<String> {
    files.read_field("/proc/cpuinfo", "flags").map(|flags| {
        let is_virtual = flags.split_whitespace().any(|flag| flag == "hypervisor");
        let product = files.read("/sys/class/dmi/id/product_name");
        match (is_virtual, product) {
            (false, _) => "no".to_owned(),
            (true, Fact::Available(product)) => format!("yes ({product})"),
            (true, Fact::Unavailable(_)) => "yes".to_owned(),
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::host_facts::FakeHost;

    const DYNAMIC: (&str, &str) = (VERSION, "#1 SMP PREEMPT_DYNAMIC Debian");
    const RELEASE: (&str, &str) = ("/proc/sys/kernel/osrelease", "6.12.1-test");

    fn preemption_of(files: &[(&str, &str)]) -> Preemption {
        let host = FakeHost::with(files);
        preemption(&host.files()).available().unwrap().clone()
    }

    #[test]
    fn a_realtime_kernel_is_recognised() {
        let host = FakeHost::with(&[
            (VERSION, "#1 SMP PREEMPT_RT Debian 6.1"),
            (REALTIME_FLAG, "1"),
            ("/proc/sys/kernel/osrelease", "6.1.0-42-rt-amd64"),
        ]);
        let found = preemption(&host.files());
        assert_eq!(found.available().unwrap().words, "PREEMPT_RT");
        assert_eq!(kernel_version(&host.files()), Fact::Available((6, 1)));
        let by_version = preemption_of(&[(VERSION, "#1 SMP PREEMPT_RT Debian 6.1")]);
        assert_eq!(by_version.mode, Fact::Available(PreemptionMode::Realtime));
    }

    #[test]
    fn a_dynamic_kernel_tells_its_mode_by_what_is_nearest_to_the_truth() {
        let built = ("/boot/config-6.12.1-test", "CONFIG_PREEMPT_VOLUNTARY=y\n");
        let said = (DYNAMIC_MODE, "none voluntary (full) lazy");
        let booted = ("/proc/cmdline", "quiet preempt=none preempt=lazy");
        let plain = ("/proc/cmdline", "quiet");
        for (files, words, source) in [
            (
                vec![DYNAMIC, RELEASE, built, booted, said],
                "PREEMPT_DYNAMIC, mode full",
                DYNAMIC_MODE,
            ),
            (
                vec![DYNAMIC, RELEASE, built, booted],
                "PREEMPT_DYNAMIC, mode lazy as booted",
                "/proc/cmdline",
            ),
            (
                vec![DYNAMIC, RELEASE, built, plain],
                "PREEMPT_DYNAMIC, mode voluntary as built",
                "/boot/config-6.12.1-test",
            ),
        ] {
            let found = preemption_of(&files);
            assert_eq!(
                (found.words.as_str(), found.source.as_str()),
                (words, source)
            );
        }
        // Without the command line nobody knows what it changed.
        let found = preemption_of(&[DYNAMIC, RELEASE, built]);
        let Fact::Unavailable(why) = found.mode else {
            panic!("{found:?}");
        };
        assert!(why.contains("/proc/cmdline"), "{why}");
    }

    #[test]
    fn options_come_from_the_boot_folder_or_the_packed_file() {
        let host = FakeHost::with(&[RELEASE, ("/proc/config", "CONFIG_RT_GROUP_SCHED=y\n")]);
        let Fact::Unavailable(why) = KernelOptions::read(&host.files()) else {
            panic!("there is neither");
        };
        assert!(why.contains("/proc/config.gz"), "{why}");
        let packing = Command::new("gzip")
            .arg(host.files().locate("/proc/config"))
            .status();
        assert!(packing.unwrap().success());
        let options = KernelOptions::read(&host.files());
        let options = options.available().unwrap();
        assert!(options.has("RT_GROUP_SCHED") && !options.has("RT_GROUP"));
        assert_eq!(options.source, "/proc/config.gz");
    }

    #[test]
    fn the_last_word_of_the_command_line_counts() {
        let host = FakeHost::with(&[("/proc/cmdline", "rcu_nocbs=1 nosmt rcu_nocbs=2-3")]);
        let value = |name| boot_parameter(&host.files(), name);
        assert_eq!(value("rcu_nocbs"), Fact::Available(Some("2-3".to_owned())));
        assert_eq!(value("nosmt"), Fact::Available(Some(String::new())));
        assert_eq!(value("isolcpus"), Fact::Available(None));
    }

    #[test]
    fn a_throttle_is_read_with_its_period() {
        let host = FakeHost::with(&[
            ("/proc/sys/kernel/sched_rt_runtime_us", "950000"),
            ("/proc/sys/kernel/sched_rt_period_us", "1000000"),
        ]);
        let found = RealtimeThrottle::read(&host.files());
        let found = found.available().unwrap();
        assert!(found.is_active());
        assert_eq!((found.lost_ms(), found.period_ms()), (50, 1000));
    }
}
