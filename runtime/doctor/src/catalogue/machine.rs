//! What is found of kernel, processors, rights, memory and files: words only.

use super::Entry;

pub(super) const KERNEL: &[Entry] = &[
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

pub(super) const PROCESSORS: &[Entry] = &[
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

pub(super) const RIGHTS: &[Entry] = &[
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

pub(super) const MEMORY: &[Entry] = &[
    Entry {
        id: "shared_memory",
        title: "Shared memory in /dev/shm",
        source: "statvfs of /dev/shm",
        why: "channels live there: one that outgrows the space ends its process with SIGBUS",
        fix: "mount -o remount,size=1G,mode=1777 /dev/shm (--shm-size=1g for a container)",
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
