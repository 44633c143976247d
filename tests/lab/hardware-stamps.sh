#!/usr/bin/env bash
# Hardware stamps for real: two emulated PCs, each with a network card that has a clock of its own
# (QEMU 10, igb), run the shuttle over the cable between them with timestamps = "hardware".
#
#   tests/lab/hardware-stamps.sh [--binary PATH] [--seconds N] [--output DIR] [--nic igb|e1000e]
#
#   --binary   hil-runtime to test (default: target/release/hil-runtime of this workspace)
#   --seconds  length of the run (20)
#   --output   folder for what the PCs leave, new or empty (default: a new one, named at the end)
#   --nic      card; e1000e advertises stamps that never come, and the report must say so
#
# It checks that the cards were armed and put back, that the sending card's stamps came, each
# matched to its message with the software stamp beside it, that missing receive stamps are
# labelled, that each card's clock is known within a bound, what the doctor says of the card, and that
# the card is as it was found after a run was killed outright or interrupted twice, after a doctor
# was interrupted, and after a probe beside a PTP clock.
# Needs root and the packages that images.sh names; the first time builds the images. Takes two or
# three minutes after that and never more than eight. Exit code 0 when all holds, 1 when something does
# not, 2 when the lab could not be set up.
set -u -o pipefail
# shellcheck source=tests/lab/lib.sh
source "$(dirname "$0")/lib.sh"

BOOT_LIMIT=150
SECONDS_OF_RUN=20
WORKSPACE=$(cd "$LAB_DIR/../.." && pwd)
BINARY=${CARGO_TARGET_DIR:-$WORKSPACE/target}/release/hil-runtime
OUTPUT=
NIC=igb

while [[ $# -gt 0 ]]; do
    case $1 in
        --binary) BINARY=${2:?} && shift 2 ;;
        --seconds) SECONDS_OF_RUN=${2:?} && shift 2 ;;
        --output) OUTPUT=${2:?} && shift 2 ;;
        --nic) NIC=${2:?} && shift 2 ;;
        -h | --help) sed -n '2,/^set/{/^#/s/^# \{0,1\}//p}' "$0"; exit 0 ;;
        *) lab_fail "unknown option $1" ;;
    esac
done
[[ $SECONDS_OF_RUN =~ ^[0-9]+$ && $SECONDS_OF_RUN -ge 5 && $SECONDS_OF_RUN -le 60 ]] ||
    lab_fail "--seconds $SECONDS_OF_RUN is outside 5..60"
[[ $NIC == igb || $NIC == e1000e ]] || lab_fail "--nic $NIC is neither igb nor e1000e"
[[ -x $BINARY ]] ||
    lab_fail "$BINARY is missing; build it with: cargo build --release --package hil-runtime"
lab_need python3 python3
[[ -z $OUTPUT || ! -e $OUTPUT || -d $OUTPUT ]] || lab_fail "--output $OUTPUT is no folder"
[[ -z $OUTPUT || ! -d $OUTPUT || -z $(ls -A "$OUTPUT") ]] ||
    lab_fail "--output $OUTPUT is not empty; what is in it is kept"
bash "$LAB_DIR/images.sh" guest qemu10 || exit 2
[[ -n $OUTPUT ]] || OUTPUT=$(mktemp -d "${TMPDIR:-/tmp}/hardware-stamps.XXXXXX")
mkdir -p "$OUTPUT" || exit 2

# prepare NAME ADDRESS: the shared folder of one PC.
prepare() {
    local share=$OUTPUT/$1
    mkdir -p "$share/topologies"
    { cp "$BINARY" "$share/hil-runtime" &&
        cp "$WORKSPACE"/deploy/topologies/*.toml "$share/topologies/"; } ||
        lab_fail "cannot fill $share"
    cp "$LAB_DIR/hardware-guest.sh" "$share/run.sh" || lab_fail "cannot fill $share"
    printf 'host=%s\naddress=%s\nnic=%s\nseconds=%d\nboot_limit=%d\n' \
        "$1" "$2" "$NIC" "$SECONDS_OF_RUN" "$BOOT_LIMIT" >"$share/settings"
}

# cable PC OTHER: QEMU's words for one end of the cable.
cable() {
    printf 'dgram,id=cable,local.type=unix,local.path=%s/cable-%s,' "$CABLE" "$1"
    printf 'remote.type=unix,remote.path=%s/cable-%s' "$CABLE" "$2"
}

# A socket's path must be short.
CABLE=$(mktemp -d /tmp/hil-cable.XXXXXX)
trap 'lab_end; rm -rf "$CABLE"' EXIT
prepare control-pc 10.77.0.1
prepare robot-pc 10.77.0.2
VM_NAME=control-pc vm_start "$OUTPUT/control-pc" qemu10 -netdev "$(cable a b)" \
    -device "$NIC,netdev=cable,romfile=,mac=52:54:00:48:49:01"
first=$VM_PID
VM_NAME=robot-pc vm_start "$OUTPUT/robot-pc" qemu10 -netdev "$(cable b a)" \
    -device "$NIC,netdev=cable,romfile=,mac=52:54:00:48:49:02"
lab_say "two PCs with $NIC cards started"
vm_wait $((BOOT_LIMIT + SECONDS_OF_RUN + 210)) "$first" "$VM_PID" ||
    lab_say "time limit reached; the PCs are ended"
lab_say "both PCs are off"

failed=0
for pc in control-pc robot-pc; do
    status=$(vm_status "$OUTPUT/$pc")
    rm -rf "$OUTPUT/$pc/hil-runtime" "$OUTPUT/$pc/topologies"
    if [[ $status != 0 ]]; then
        echo "FAILED  $pc ended with $status; its last words:"
        tail -n 20 "$OUTPUT/$pc/output.txt" 2>/dev/null
        failed=1
    fi
done
if [[ $failed -eq 0 ]]; then
    python3 "$LAB_DIR/hardware_stamps_check.py" "$NIC" "$OUTPUT" || failed=1
fi
echo "left in $OUTPUT"
exit "$failed"
