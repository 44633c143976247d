#!/usr/bin/env bash
# Runs the real binary over a real wlan0, and over a cable with a known impairment, in one emulated
# PC whose clock counts instructions. Opt-in: it boots a PC and downloads Debian packages once.
#
#   tests/lab/wifi.sh [--binary FILE] [--seconds N] [--keep FOLDER]
#
#   --binary FILE   the hil-runtime to test (default: built with cargo build --release)
#   --seconds N     length of each run in the PC's own time (default 20)
#   --keep FOLDER   where to leave run folders, reports and logs (default: removed)
#
# Shows:
# 1. A split shuttle run crosses wlan0 (simulated radios, the kernel's own 802.11, WPA2): every
#    message that arrived closes in the account, its stamp before the queue is labelled as the
#    fallback it is, and each datagram has exactly one acknowledgement report of the radio.
# 2. Over a cable that delays by 5 ms and loses 2 %, the one-way delay reads 5 ms within its bound
#    and 0.02 lies inside the interval of the loss, both ways.
#
# Needs root (network namespaces are the PC's own, but its share keeps file owners), python3 and
# what images.sh names. Took 10 minutes on two cores with a load of 15; the PC is given 15.
# Exit code 0 when all held, 1 when something did not, 2 when the lab itself failed.
set -u -o pipefail
# shellcheck source=tests/lab/lib.sh
source "$(dirname "$0")/lib.sh"
ROOT=$(cd "$LAB_DIR/../.." && pwd)
WALL_LIMIT_S=900

binary='' seconds=20 keep=''
while [[ $# -gt 0 ]]; do
    case $1 in
        --binary) binary=${2:?}; shift 2 ;;
        --seconds) seconds=${2:?}; shift 2 ;;
        --keep) keep=${2:?}; shift 2 ;;
        -h | --help) sed -n '2,/^set/{/^#/s/^# \{0,1\}//p}' "$0"; exit 0 ;;
        *) lab_fail "unknown argument $1 (see --help)" ;;
    esac
done
[[ $seconds =~ ^[1-9][0-9]*$ ]] || lab_fail "--seconds $seconds is not a whole number above 0"
lab_need python3 python3-minimal

topology() { # NAME INTERFACE
    cat <<TOML
version = 1
name = "$1"
[run]
duration = "$seconds s"
seed = 7
start_timeout = "60 s"
[case]
name = "shuttle"
[case.parameters]
rate_hz = 100.0
[hosts.control-pc]
address = "10.77.0.1"
interface = "$2"
[hosts.robot-pc]
address = "10.77.0.2"
interface = "$2"
[processes.controller]
role = "controller"
host = "control-pc"
wait = "block"
[processes.robot]
role = "robot"
host = "robot-pc"
wait = "block"
[channels]
"shuttle/command".link = "hop"
"shuttle/status".link = "hop"
[links.hop]
via = "udp"
between = ["control-pc", "robot-pc"]
dscp = 46
[links.hop.gateway]
wait = "block"
TOML
}

# The last word on a folder of runs: prints what was found, fails when a claim does not hold.
judge() {
    python3 - "$1" <<'PYTHON'
import json, math, pathlib, sys
root, failures = pathlib.Path(sys.argv[1]), []
def check(holds, words):
    print(("  holds   " if holds else "  FAILED  ") + words)
    holds or failures.append(words)
def wilson(successes, trials, z=1.959964):
    share, scale = successes / trials, 1 + z * z / trials
    spread = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    centre = share + z * z / (2 * trials)
    return (centre - spread) / scale, (centre + spread) / scale
def summary(name, host="robot-pc"):
    found = sorted((root / name / host).glob("runs/*/summary.json"))
    if not found:
        sys.exit(f"no summary of {name} on {host}")
    return json.loads(found[-1].read_text())
def counters(channel, way):
    one = next(d for d in channel["directions"] if d["direction"] == way)
    return ({c["name"]: c["count"] for c in one["counters"]}, {f["label"]: f["value"] for f in one["facts"]})

wifi = summary("wifi")
print("over wlan0:", wifi["run"]["outcome"], wifi["run"]["duration_s"], "s")
for channel in wifi["channels"]:
    name, account = channel["name"], channel["account"]
    closing = account["closing"]
    sent, facts = counters(channel, "egress")
    came, came_facts = counters(channel, "ingress")
    radio = next(r for r in wifi["radio"]["channels"] if r["channel"] == name)
    stamps, acks = radio["transmit_stamps"], radio["acknowledgements"]
    print(f" {name}: {facts.get('radio')}")
    check(closing["closed_count"] == closing["checked_count"] > 0,
          f"account closes: {closing['closed_count']} of {closing['checked_count']} messages")
    check(stamps["before_queue_count"] == stamps["handed_count"] > 0,
          f"stamped before the queue, and labelled: {stamps['before_queue_count']} of {stamps['handed_count']}")
    check("before the queue" in facts.get("stamp fallback", ""), f"fallback: {facts.get('stamp fallback')}")
    datagrams = sent["socket: sent_count"]
    acked, unacked = sent["socket: radio_acknowledged_count"], sent["socket: radio_unacknowledged_count"]
    check(acked + unacked == datagrams and sent["socket: radio_unmatched_count"] == 0,
          f"one report per datagram: {datagrams} sent, {acked} acknowledged, {unacked} not")
    kinds = {k: v for k, v in acks.items() if k.endswith("_count")}
    check(sum(v for k, v in kinds.items() if k != "handed_count") == acks["handed_count"] and
          acks["unreported_arrived_count"] + acks["unreported_lost_count"] == 0,
          "each message has its report: " + ", ".join(f"{k[:-6]} {v}" for k, v in kinds.items() if v))
    print(f"          access category: {facts.get('access category')}")
    check(came_facts.get("mark", "").startswith("dscp 46 on all"), f"mark: {came_facts.get('mark')}")
check(len(wifi["radio"]["hops"]) == 2, f"radios sampled: {[h['process'] for h in wifi['radio']['hops']]}")
for hop in wifi["radio"]["hops"]:
    for station in hop["stations"]:
        print(f"          {hop['process']}: {station['mac']} {station['sample_count']} samples, signal "
              f"{station['signal_dbm']}, {station['transmit_modulation']}, retries {station['tx_retry_count']}")
        check(station["sample_count"] > 10 and station["signal_dbm"] is not None, "samples with a signal")
report = "".join(p.read_text() for p in (root / "wifi").glob("*/runs/*/report.txt"))
check("before the queue" in report, "the report labels the stamp")

def one_way(channel):
    """From the send call to the receive stamp: the impairment sits where it sends."""
    account = channel["account"]
    parts = [s["distribution"] for s in account["segments"]
             if (s["from"], s["to"]) in (("handed_to_kernel", "tx_software"), ("tx_software", "rx_software"))]
    bound = account["end_to_end"]["alignment_bound_ns"]
    return sum(p["min_ns"] for p in parts), sum(p["p50_ns"] for p in parts), bound
plain, cable = summary("plain"), summary("cable")
print("over a cable, plain and with 5 ms and 2 % loss at each sender:", cable["run"]["outcome"])
TRUE_DELAY_NS, TRUE_LOSS = 5_000_000, 0.02
for floor, channel in zip(plain["channels"], cable["channels"]):
    name, account = channel["name"], channel["account"]
    (_, floor_ns, floor_bound), (least, median, bound) = one_way(floor), one_way(channel)
    added, error = median - floor_ns, bound + floor_bound
    print(f" {name}: one way {median / 1e3:.1f} us at the median, {least / 1e3:.1f} at least, bound {bound} ns; "
          f"plain {floor_ns / 1e3:.1f} us")
    # Two medians, and the wake-up of a timer in between: 50 us.
    check(abs(added - TRUE_DELAY_NS) <= error + 50_000, f"the cable adds {added / 1e3:.1f} us, 5000 asked for")
    check(least >= TRUE_DELAY_NS - bound, f"no message came before 5 ms less the bound of {bound} ns")
    lost, total = account["fates"].get("lost_on_wire", 0), account["published_count"]
    low, high = wilson(lost, total)
    check(low <= TRUE_LOSS <= high,
          f"{lost} of {total} lost, 95 % interval {100 * low:.2f} to {100 * high:.2f} % (2 % asked for)")
    closing = account["closing"]
    check(closing["closed_count"] == closing["checked_count"] > 0,
          f"account closes: {closing['closed_count']} of {closing['checked_count']} messages")
sys.exit(1 if failures else 0)
PYTHON
}

main() {
    local share
    if [[ -z "$binary" ]]; then
        lab_say "building the release binary"
        (cd "$ROOT" && cargo build --release --quiet --package hil-runtime) ||
            lab_fail "cargo build failed"
        binary=${CARGO_TARGET_DIR:-$ROOT/target}/release/hil-runtime
    fi
    [[ -x "$binary" ]] || lab_fail "$binary is not a program"
    "$LAB_DIR/images.sh" guest qemu7 || exit 2
    share=$(mktemp -d "$LAB_CACHE/wifi.XXXXXX") || lab_fail "no room in $LAB_CACHE"
    SHARE=$share
    cp "$binary" "$share/hil-runtime"
    cp "$LAB_DIR/wifi-guest.sh" "$share/run.sh"
    topology wifi wlan0 >"$share/wifi.toml"
    topology plain eth0 >"$share/plain.toml"
    topology cable eth0 >"$share/cable.toml"
    printf 'limit_s=%d\ncable="delay 5ms loss 2%%"\n' $((seconds * 3 + 120)) >"$share/settings"
    lab_say "the PC boots; its clock counts instructions"
    VM_NAME=wifi VM_VIRTUAL_TIME=1 vm_start "$share" qemu7
    if ! vm_wait "$WALL_LIMIT_S" "$VM_PID"; then
        lab_say "not done after $WALL_LIMIT_S s"
    fi
    lab_say "the PC is off, its script ended with $(vm_status "$share")"
    cat "$share/output.txt" 2>/dev/null
    [[ $(vm_status "$share") == 0 ]] || exit 1
    judge "$share" || exit 1
    lab_say "all of it held"
}

# Whatever happens, what is to be kept is kept and the rest removed.
finish() {
    lab_end
    if [[ -n "${SHARE:-}" ]]; then
        if [[ -n "$keep" ]]; then
            rm -f "$SHARE/hil-runtime"
            mkdir -p "$keep" && cp -r "$SHARE/." "$keep/"
        fi
        rm -rf "$SHARE"
    fi
}
trap finish EXIT
main
