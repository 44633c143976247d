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
# what images.sh names. Took 5 to 10 minutes on two cores with a load of 15; the PC is given 15.
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
[security]
hops = "plain"
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
    python3 "$LAB_DIR/wifi_check.py" "$share" || exit 1
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
