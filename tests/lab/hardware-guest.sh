#!/bin/bash
# Inside one emulated PC of hardware-stamps.sh, as /share/run.sh: runs the shuttle with the other PC
# then ends programs roughly while they have set the card up, and at last looks at a PTP clock's
# datagrams with a probe. What it leaves in /share is judged by hardware_stamps_check.py. From /share/settings: host, address, nic, seconds, boot_limit.
set -u
share=/share
# shellcheck disable=SC1091
source "$share/settings"
hil=/tmp/hil-runtime
say() { printf '[guest %s s] %s\n' "$(cut -d' ' -f1 /proc/uptime)" "$*"; }

# examine NAME: what the doctor finds now.
examine() { "$hil" doctor --json >"$share/$1.json" 2>"$share/$1.txt"; }
# The program that guards a card while another has set it up.
guards() { pgrep -f card-guard >/dev/null; }
# until_so SECONDS COMMAND...
until_so() {
    local tries=$(($1 * 20))
    shift
    for _ in $(seq "$tries"); do "$@" && return; sleep 0.05; done
    return 1
}
unguarded() { ! guards; }
# shuttle SECONDS FOLDER: this PC's share of the loop.
shuttle() {
    exec "$hil" --topology /tmp/topologies/shuttle-split.toml --host "$host" \
        --set 'hosts.control-pc.interface="eth0"' --set 'hosts.robot-pc.interface="eth0"' \
        --set 'links.hop.timestamps="hardware"' --set 'security.hops="plain"' \
        --set "run.duration=\"$1 s\"" \
        --set "run.start_timeout=\"$boot_limit s\"" --set "run.record=\"$2\""
}
left() { echo "$1=$2" >>"$share/codes.txt"; }

# rough_end NAME VICTIM_HOST SIGNAL...: a run that the victim's supervisor leaves by these signals,
# one after the other; the other PC notices. The doctor looks before, and after the guard's end.
rough_end() {
    local name=$1 victim=$2 signal run
    shift 2
    (shuttle 120 "/tmp/$name") >"$share/$name-run.txt" 2>&1 &
    run=$!
    if [[ $host == "$victim" ]]; then
        until_so 60 guards || say "$name: no guard appeared"
        # The guard stands before the card is armed: the second look is certain to come later.
        sleep 1
        examine "doctor-$name-during"
        for signal in "$@"; do kill -s "$signal" "$run"; sleep 0.1; done
    fi
    wait "$run"
    left "$name" $?
    until_so 10 unguarded || say "$name: the guard stayed"
    [[ $host != "$victim" ]] || examine "doctor-$name-after"
}

# A doctor that is interrupted while it tries the card. What it sends is held up, so that it waits
# for stamps as long as it ever does: half a second, which an attempt may still miss.
interrupted_doctor() {
    local attempt doctor
    modprobe sch_netem
    tc qdisc add dev eth0 root netem delay 2s || say "nothing holds the probe up"
    for attempt in $(seq 10); do
        "$hil" doctor >"$share/interrupted-doctor.txt" 2>&1 &
        doctor=$!
        while kill -0 "$doctor" 2>/dev/null && ! guards; do :; done
        kill -s INT "$doctor" 2>/dev/null
        wait "$doctor"
        left interrupted_doctor $?
        until_so 10 unguarded || say "the doctor's guard stayed"
        grep -q 'without putting it back' "$share/interrupted-doctor.txt" && break
    done
    tc qdisc del dev eth0 root
    left interrupted_doctor_attempts "$attempt"
    examine doctor-interrupted-after
}

# probed_ptp: two PTP clocks that steer nothing, one on each PC, and a probe that asks for the card's
# stamps of what arrives. Somebody else has set the card up then, and it must stay so.
probed_ptp() {
    local clock role=()
    [[ $host == control-pc ]] || role=(--slaveOnly 1)
    ptp4l -m -l 4 -i eth0 --free_running 1 --logSyncInterval -3 --logMinDelayReqInterval -3 \
        "${role[@]}" >"$share/ptp.txt" 2>&1 &
    clock=$!
    sleep 15
    examine doctor-ptp-before
    "$hil" probe -i eth0 -o "$share/card.pcapng" --force --stamps card --flow udp:port=319 \
        --duration 10s --quiet >"$share/probe.txt" 2>&1
    left probe $?
    "$hil" probe analyse "$share/card.pcapng" --flow udp:port=319 --json >"$share/probe.json"
    examine doctor-ptp-after
    kill "$clock"
    wait "$clock"
}

modprobe "$nic"
until_so 10 test -e /sys/class/net/eth0
ip address add "$address/24" dev eth0 && ip link set eth0 up || exit 3
has_carrier() { [[ $(cat /sys/class/net/eth0/carrier) == 1 ]]; }
until_so 10 has_carrier
cp "$share/hil-runtime" /tmp/ && cp -r "$share/topologies" /tmp/
examine doctor
ethtool -S eth0 >"$share/card-before.txt"
(shuttle "$seconds" /tmp/record)
code=$?
ethtool -S eth0 >"$share/card-after.txt"
examine doctor-after
cp -r /tmp/record "$share/"
interrupted_doctor
rough_end killed control-pc KILL
rough_end twice robot-pc INT INT
probed_ptp
exit "$code"
