//! Tests of the real-time requests. What the kernel grants depends on the rights of whoever runs
//! them, so they check that the report tells the truth, not that the kernel is generous.

use std::thread;

use super::*;
use crate::host_facts::FakeHost;

/// Applies a request in a thread of its own, which takes the change with it when it ends.
fn apply_in_scratch_thread<T: Send + 'static>(
    request: RealtimeRequest,
    inspect: impl FnOnce(RealtimeGrant) -> T + Send + 'static,
) -> T {
    thread::spawn(move || inspect(apply(&request)))
        .join()
        .unwrap()
}

fn first_allowed_cpu() -> usize {
    core_affinity::get_core_ids().unwrap()[0].id
}

#[test]
fn pinning_leaves_exactly_one_cpu() {
    let cpu = first_allowed_cpu();
    let request = RealtimeRequest {
        cpu: Some(cpu),
        ..RealtimeRequest::default()
    };
    let (grant, cpus) = apply_in_scratch_thread(request, |grant| {
        (grant, core_affinity::get_core_ids().unwrap())
    });
    assert!(grant.is_complete(), "{grant:?}");
    assert_eq!(cpus, [CoreId { id: cpu }]);
}

#[test]
fn a_cpu_that_does_not_exist_is_refused_with_the_ones_that_do() {
    for cpu in [1000, 1024, usize::MAX] {
        let request = RealtimeRequest {
            cpu: Some(cpu),
            ..RealtimeRequest::default()
        };
        let grant = apply_in_scratch_thread(request, |grant| grant);
        let text = grant.refusals().next().unwrap().to_string();
        assert!(
            text.starts_with(&format!("cpu {cpu} refused: EINVAL")),
            "{text}"
        );
        assert!(text.contains("the CPUs online are 0"), "{text}");
    }
}

#[test]
fn fifo_is_granted_and_seen_in_force_or_refused_with_a_cure() {
    let policy = SchedulingPolicy::Fifo { priority: 5 };
    let request = RealtimeRequest {
        policy,
        ..RealtimeRequest::default()
    };
    let (grant, actual) = apply_in_scratch_thread(request, |grant| (grant, current_policy()));
    assert_eq!(grant.items.len(), 1);
    assert_eq!(grant.is_complete(), actual & libc::SCHED_FIFO != 0);
    if let Some(refusal) = grant.refusals().next() {
        let text = refusal.to_string();
        assert!(text.starts_with("SCHED_FIFO 5 refused: EPERM"), "{text}");
    }
}

#[test]
fn a_child_thread_does_not_inherit_the_priority() {
    let policy = SchedulingPolicy::Fifo { priority: 5 };
    let request = RealtimeRequest {
        policy,
        ..RealtimeRequest::default()
    };
    let child_policy =
        apply_in_scratch_thread(request, |_| thread::spawn(current_policy).join().unwrap());
    assert_eq!(child_policy, libc::SCHED_OTHER);
}

#[test]
fn a_priority_out_of_range_states_the_range() {
    let policy = SchedulingPolicy::Fifo { priority: 0 };
    let request = RealtimeRequest {
        policy,
        ..RealtimeRequest::default()
    };
    let grant = apply_in_scratch_thread(request, |grant| grant);
    let text = grant.refusals().next().unwrap().to_string();
    assert!(text.contains("priority 0 is outside 1 to 99"), "{text}");
}

#[test]
fn a_refusal_despite_the_capability_points_at_the_control_group() {
    let privileged = FakeHost::with(&[("/proc/self/status", "CapEff:\t0000000000800000\n")]);
    let refusal = explain_scheduling(Errno::EPERM, 80, &privileged.files());
    assert!(refusal.reason.contains("CONFIG_RT_GROUP_SCHED"));
    let plain = FakeHost::with(&[("/proc/self/status", "CapEff:\t0000000000000000\n")]);
    let refusal = explain_scheduling(Errno::EPERM, 80, &plain.files());
    assert_eq!(refusal.fix, "needs CAP_SYS_NICE or LimitRTPRIO");
}

#[test]
fn what_lets_a_thread_up_again_is_said_as_systemd_reads_it() {
    let (policy, priority) = SchedulingPolicy::Other.of_kernel(0);
    let refusal = explain(Errno::EPERM, policy, priority);
    assert_eq!(
        refusal.fix,
        "needs CAP_SYS_NICE or LimitNICE=+0 in the unit"
    );
    assert!(refusal.reason.starts_with("RLIMIT_NICE is "));
}

#[test]
fn the_timer_slack_is_read_back() {
    let request = RealtimeRequest {
        timer_slack: Some(Duration::from_nanos(1)),
        ..Default::default()
    };
    let (grant, slack_ns) =
        apply_in_scratch_thread(request, |grant| (grant, prctl::get_timerslack().unwrap()));
    assert!(grant.is_complete());
    assert_eq!(slack_ns, 1);
}

#[test]
fn an_empty_request_asks_for_the_normal_policy_only() {
    let grant = apply_in_scratch_thread(RealtimeRequest::default(), |grant| grant);
    assert_eq!(grant.items.len(), 1);
    assert_eq!(grant.items[0].to_string(), "SCHED_OTHER granted");
}

#[test]
fn grants_survive_json() {
    let request = RealtimeRequest {
        cpu: Some(9999),
        ..RealtimeRequest::default()
    };
    let grant = apply_in_scratch_thread(request, |grant| grant);
    let text = serde_json::to_string(&grant).unwrap();
    assert!(text.contains(r#""outcome":"refused""#), "{text}");
    assert_eq!(serde_json::from_str::<RealtimeGrant>(&text).unwrap(), grant);
}

fn advice(isolated: &str, runtime_us: &str, release: &str) -> SpinAdvice {
    let host = FakeHost::with(&[
        ("/sys/devices/system/cpu/isolated", isolated),
        ("/proc/sys/kernel/sched_rt_runtime_us", runtime_us),
        ("/proc/sys/kernel/sched_rt_period_us", "1000000"),
        ("/proc/sys/kernel/osrelease", release),
    ]);
    spin_advice_in(3, &host.files())
}

#[test]
fn spinning_is_fine_only_where_nothing_takes_the_cpu_away() {
    assert_eq!(advice("2-3", "-1", "6.1.0"), SpinAdvice::Fine);
    assert_eq!(advice("2-3", "950000", "6.18.2"), SpinAdvice::Fine);
    for (isolated, runtime_us, release, expected) in [
        ("", "950000", "6.18.2", "about 50 ms of every 1000 ms"),
        ("2", "900000", "6.1.0", "about 100 ms of every 1000 ms"),
        ("2-3", "950000", "6.1.0", "is isolated, but"),
        ("", "-1", "6.12.0", "even with sched_rt_runtime_us=-1"),
        ("", "-1", "6.1.0", "starves the kernel's own workers"),
    ] {
        let SpinAdvice::Warn(reason) = advice(isolated, runtime_us, release) else {
            panic!("no warning for isolated={isolated:?} runtime={runtime_us} {release}");
        };
        assert!(reason.contains(expected), "{reason}");
    }
}

#[test]
fn an_unknown_throttle_is_a_warning_and_not_a_guess() {
    let host = FakeHost::with(&[("/sys/devices/system/cpu/isolated", "0-7")]);
    let SpinAdvice::Warn(reason) = spin_advice_in(3, &host.files()) else {
        panic!("a host that says nothing was called fine");
    };
    assert!(reason.contains("unknown"), "{reason}");
}

#[test]
fn the_kernel_tells_how_the_clock_is_steered() {
    let discipline = clock_discipline().unwrap();
    assert!(discipline.max_error_us >= 0, "{discipline:?}");
}
