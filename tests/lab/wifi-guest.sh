#!/bin/bash
# Inside the emulated PC, as /share/run.sh: joins two simulated radios to an access point and a
# station in two network namespaces, runs one split shuttle between them, then over a cable,
# with 5 ms and 2 % loss where each end sends, then plain. wifi.sh judges what it leaves in /share.
set -u
share=/share
# shellcheck disable=SC1091
source "$share/settings"
say() { printf '[guest %s s] %s\n' "$(cut -d' ' -f1 /proc/uptime)" "$*"; }
fail() { say "error: $*"; exit 1; }

# Everything a run touches is in memory: on a clock that skips idle time a slow disk looks slower.
work=/lab
mkdir -p "$work" && mount -t tmpfs tmpfs "$work" || fail "no memory for the runs"
cp "$share/hil-runtime" "$share"/*.toml "$work/" || fail "no binary in the share"

# on SPACE COMMAND...: as a host of its own, with its network, shared memory and service files.
on() {
    local space=$1
    shift
    ip netns exec "$space" unshare --mount bash -c \
        'for folder in /dev/shm /run /tmp; do mount -t tmpfs tmpfs "$folder" || exit 1; done
         exec "$@"' on "$@"
}

# run_pair NAME CONTROL_SPACE ROBOT_SPACE: both hosts of topology NAME.toml at once.
run_pair() {
    local name=$1 host space processes=() result=0 process
    say "$name starts"
    for host in control-pc robot-pc; do
        space=$2
        [[ $host == control-pc ]] || space=$3
        mkdir -p "$work/$name/$host"
        (cd "$work/$name/$host" && on "$space" timeout -k 5 "$limit_s" "$work/hil-runtime" \
            --topology "$work/$name.toml" --host "$host" --quiet >report.txt 2>errors.txt) &
        processes+=($!)
    done
    for process in "${processes[@]}"; do wait "$process" || result=$?; done
    cp -r "$work/$name" "$share/"
    say "$name ended with $result"
    [[ $result == 0 ]] || tail -n 5 "$work/$name"/*/errors.txt
    return "$result"
}

radios() {
    modprobe mac80211_hwsim radios=2 || fail "no simulated radios in this kernel"
    iw reg set US
    ip netns add ap && ip netns add sta || fail "no network namespaces"
    iw phy phy0 set netns name ap && iw phy phy1 set netns name sta || fail "radios stay put"
    ip netns exec sta ip link show wlan0 >/dev/null 2>&1 ||
        ip netns exec sta ip link set wlan1 name wlan0 || fail "no interface at the station"
    mkdir -p /run/wifi
    cat >/run/wifi/ap.conf <<'AP'
interface=wlan0
driver=nl80211
ssid=hil
country_code=US
hw_mode=a
channel=36
ieee80211n=1
wmm_enabled=1
wpa=2
wpa_key_mgmt=WPA-PSK
rsn_pairwise=CCMP
wpa_passphrase=a-passphrase-for-tests
AP
    cat >/run/wifi/sta.conf <<'STA'
ctrl_interface=/run/wifi/control
country=US
network={
    ssid="hil"
    scan_freq=5180
    key_mgmt=WPA-PSK
    psk="a-passphrase-for-tests"
}
STA
    ip netns exec ap hostapd -B -f /run/wifi/ap.log /run/wifi/ap.conf ||
        { cat /run/wifi/ap.log; fail "no access point"; }
    ip netns exec sta wpa_supplicant -B -f /run/wifi/sta.log -i wlan0 -D nl80211 \
        -c /run/wifi/sta.conf || { cat /run/wifi/sta.log; fail "no station"; }
    address ap wlan0 1
    address sta wlan0 2
    ip netns exec sta iw dev wlan0 set power_save off
    local tries
    for ((tries = 0; tries < 60; tries++)); do
        ip netns exec sta wpa_cli -p /run/wifi/control -i wlan0 status 2>/dev/null |
            grep -q wpa_state=COMPLETED &&
            ip netns exec sta ping -c 1 -W 1 10.77.0.1 >/dev/null 2>&1 && return
        sleep 0.5
    done
    tail -n 20 /run/wifi/sta.log
    fail "the station did not associate in 30 s"
}

address() {
    ip netns exec "$1" ip link set lo up
    ip netns exec "$1" ip addr add "10.77.0.$3/24" dev "$2"
    ip netns exec "$1" ip link set "$2" up
}

# A cable between two more hosts.
cable() {
    modprobe -a veth sch_netem || fail "no veth or netem in this kernel"
    ip netns add left && ip netns add right || fail "no network namespaces"
    ip link add eth0 netns left type veth peer name eth0 netns right || fail "no cable"
    address left eth0 1
    address right eth0 2
}

radios
say "associated: $(ip netns exec sta iw dev wlan0 link | sed -n 's/^\t//p' | tr '\n' ' ')"
result=0
ip netns exec sta "$work/hil-runtime" doctor >"$share/doctor.txt" 2>&1
run_pair wifi ap sta || result=1
ip netns exec sta iw dev wlan0 station dump >"$share/wifi/station.txt"
cable
for space in left right; do
    # shellcheck disable=SC2086,SC2154
    ip netns exec "$space" tc qdisc add dev eth0 root netem $cable || fail "no netem"
done
run_pair cable left right || result=1
for space in left right; do ip netns exec "$space" tc qdisc del dev eth0 root; done
run_pair plain left right || result=1
exit "$result"
