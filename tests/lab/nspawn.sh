# shellcheck shell=bash
# Sourced by lab scripts after lib.sh: PCs with systemd as their first process, as containers on this
# machine's kernel. Each has a root file system of its own above a shared one, a network namespace and a
# control group. It needs root, and leaves nothing behind (pcs_end).
#
# Containers and not emulated PCs: they boot in a second and run at this machine's speed.

PC_ROOT=$LAB_CACHE/systemd-root
# systemd-container is in the root file system to be run from there: the host may be of another
# release, or not have it.
PC_PACKAGES=systemd,systemd-sysv,systemd-container,dbus,iproute2,procps
PC_WORK=
PC_ID=hil$$
declare -A PC_JOB=() PC_LEADER=()
PC_NAMES=()

# lab_install COMMAND PACKAGE [COMMAND PACKAGE ...]: installs what this host lacks.
lab_install() {
    local missing=()
    while [[ $# -gt 1 ]]; do
        command -v "$1" >/dev/null || missing+=("$2")
        shift 2
    done
    [[ ${#missing[@]} -gt 0 ]] || return 0
    lab_say "installing ${missing[*]}"
    { timeout 300 apt-get -qq update && DEBIAN_FRONTEND=noninteractive timeout 600 apt-get -qq \
        --yes --no-install-recommends install "${missing[@]}"; } >&2 ||
        lab_fail "${missing[*]} cannot be installed; install them with: apt-get install ${missing[*]}"
}

pcs_requirements() {
    [[ $(id -u) -eq 0 ]] || lab_fail "containers with systemd need root"
    [[ $(uname -m) == x86_64 ]] || lab_fail "the lab is for x86-64 hosts, not $(uname -m)"
    lab_install mmdebstrap mmdebstrap ip iproute2 nsenter util-linux flock util-linux pgrep procps
    [[ -r $LAB_KEYRING ]] ||
        lab_fail "$LAB_KEYRING is missing; install it with: apt-get install debian-archive-keyring"
}

# What the root file system is made of: one of another recipe is made again.
pcs_recipe() { { echo "$LAB_SUITE $PC_PACKAGES" && declare -f pcs_root; } | sha256sum | cut -d ' ' -f 1; }

# Makes the shared root file system, once.
pcs_root() {
    local new=$PC_ROOT.new unit
    mkdir -p "$LAB_CACHE" || lab_fail "cannot make $LAB_CACHE"
    exec 9>"$LAB_CACHE/systemd-root.lock"
    flock --wait 1200 9 || lab_fail "another build has held $LAB_CACHE/systemd-root.lock for 1200 s"
    if [[ $(cat "$PC_ROOT.recipe" 2>/dev/null) != "$(pcs_recipe)" ]]; then
        lab_say "root file system with systemd (about two minutes)"
        # An interrupted build may have left what it had mounted.
        umount --recursive --lazy "$new"/{dev,proc,sys} 2>/dev/null
        rm -rf --one-file-system "$PC_ROOT" "$new"
        # In the background, so that an interrupt ends it (lab_end).
        timeout 1000 mmdebstrap --quiet --variant=minbase --include="$PC_PACKAGES" \
            --aptopt='APT::Install-Recommends "false"' "$LAB_SUITE" "$new" \
            "$(lab_source "$LAB_SUITE")" >&2 &
        wait $! || lab_fail "mmdebstrap failed or took over 1000 s"
        # Timers and terminals that a container does not have.
        for unit in apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer fstrim.timer \
            console-getty.service getty@.service systemd-logind.service; do
            ln -sf /dev/null "$new/etc/systemd/system/$unit"
        done
        mkdir -p "$new/var/log/journal"
        : >"$new/etc/fstab"
        mv "$new" "$PC_ROOT" && pcs_recipe >"$PC_ROOT.recipe" || lab_fail "cannot fill $LAB_CACHE"
    fi
    exec 9>&-
}

# pcs_begin: a place for what the PCs write.
pcs_begin() {
    PC_WORK=$(mktemp -d "$LAB_CACHE/pcs.XXXXXX") || exit 2
    trap 'pcs_end; lab_end' EXIT
}

# pc_make NAME: a PC that does not run yet, with a network namespace of its own.
pc_make() {
    local name=$1 folder=$PC_WORK/$1
    mkdir -p "$folder"/{root,upper/etc,work} || exit 2
    PC_NAMES+=("$name")
    mount -t overlay overlay "$folder/root" \
        -o "lowerdir=$PC_ROOT,upperdir=$folder/upper,workdir=$folder/work" ||
        lab_fail "this kernel mounts no overlay file system at $folder"
    echo "$name" >"$folder/root/etc/hostname"
    tr -d - </proc/sys/kernel/random/uuid >"$folder/root/etc/machine-id"
    ip netns add "$PC_ID-$name" || lab_fail "no network namespace can be made"
    ip -n "$PC_ID-$name" link set lo up
}

# pcs_cable NAME ADDRESS NAME ADDRESS: eth0 to eth0.
pcs_cable() {
    ip link add eth0 netns "$PC_ID-$1" type veth peer name eth0 netns "$PC_ID-$3" ||
        lab_fail "no cable can be made"
    ip -n "$PC_ID-$1" addr add "$2/24" dev eth0
    ip -n "$PC_ID-$3" addr add "$4/24" dev eth0
    ip -n "$PC_ID-$1" link set eth0 up
    ip -n "$PC_ID-$3" link set eth0 up
}

# Folders of control groups that a container may have for itself, whichever versions are mounted:
# in one group, two systemds would end each other's processes.
pc_groups() {
    local tree
    for tree in /sys/fs/cgroup /sys/fs/cgroup/unified /sys/fs/cgroup/systemd; do
        if [[ -e $tree/cgroup.procs ]]; then echo "$tree/$PC_ID-$1"; fi
    done
}

# pc_boot NAME: starts it and waits until systemd has started everything.
pc_boot() {
    local name=$1 groups root=$PC_WORK/$1/root lib=$PC_ROOT/usr/lib/x86_64-linux-gnu
    mapfile -t groups < <(pc_groups "$name")
    mkdir -p "${groups[@]}" || lab_fail "no control group can be made"
    # Of the boot before.
    rmdir "/run/systemd/nspawn/propagate/$PC_ID-$name" 2>/dev/null
    local nspawn=("$PC_ROOT/lib64/ld-linux-x86-64.so.2" --library-path "$lib:$lib/systemd"
        "$PC_ROOT/usr/bin/systemd-nspawn" --quiet --directory="$root" --boot --register=no
        --keep-unit --machine="$PC_ID-$name" --hostname="$name" --console=pipe
        --network-namespace-path="/run/netns/$PC_ID-$name" --resolv-conf=off --timezone=off
        --link-journal=no --rlimit=RLIMIT_RTPRIO=99 --rlimit=RLIMIT_MEMLOCK=infinity
        --capability=CAP_NET_ADMIN,CAP_IPC_LOCK,CAP_SYS_NICE
        # Reading how the clock is steered; setting it would need a right that is not given.
        --system-call-filter="adjtimex clock_adjtime")
    SYSTEMD_NSPAWN_UNIFIED_HIERARCHY=1 bash -c \
        'for group in $0; do echo $$ >"$group/cgroup.procs"; done; exec "$@"' \
        "${groups[*]}" "${nspawn[@]}" </dev/null >>"$PC_WORK/$name/console.txt" 2>&1 &
    PC_JOB[$name]=$!
    lab_until 60 pc_finds_leader "$name" && lab_until 60 pc_is_up "$name" ||
        lab_fail "$name did not boot; $(tail -n 5 "$PC_WORK/$name/console.txt")"
}

pc_finds_leader() {
    local child
    for child in $(pgrep -P "${PC_JOB[$1]}"); do
        if [[ $(awk '$1 == "NSpid:" { print $NF }' "/proc/$child/status" 2>/dev/null) == 1 ]]; then
            PC_LEADER[$1]=$child
            return 0
        fi
    done
    return 1
}

pc_is_up() { [[ $(pc "$1" systemctl is-system-running 2>/dev/null) =~ ^(running|degraded)$ ]]; }

# pc NAME COMMAND...: as root on that PC.
pc() {
    local name=$1
    shift
    timeout -k 5 "${PC_TIMEOUT:-120}" nsenter --target "${PC_LEADER[$name]}" --mount --uts --ipc --net \
        --pid --cgroup --root --wdns=/ \
        env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin LC_ALL=C.UTF-8 HOME=/root DEBIAN_FRONTEND=noninteractive \
        "$@"
}

# pc_is_off NAME: its container has ended, be it to start again.
pc_is_off() { ! kill -0 "${PC_JOB[$1]}" 2>/dev/null; }

# lab_until SECONDS COMMAND...: true as soon as the command is; false when it is not within the time.
lab_until() {
    local end=$((SECONDS + $1))
    shift
    until "$@"; do
        [[ $SECONDS -lt $end ]] || return 1
        sleep 0.2
    done
}

# pcs_end: ends all PCs and removes everything of them.
pcs_end() {
    local name group
    for name in "${PC_NAMES[@]}"; do
        if [[ -n ${PC_JOB[$name]:-} ]] && ! pc_is_off "$name"; then
            # The first process of a container takes the others with it.
            kill -KILL "${PC_LEADER[$name]:-${PC_JOB[$name]}}" 2>/dev/null
            lab_until 10 pc_is_off "$name" || kill -KILL "${PC_JOB[$name]}" 2>/dev/null
        fi
    done
    for name in "${PC_NAMES[@]}"; do
        umount --recursive "$PC_WORK/$name/root" 2>/dev/null ||
            umount --recursive --lazy "$PC_WORK/$name/root" 2>/dev/null
        ip netns delete "$PC_ID-$name" 2>/dev/null
        rmdir "/run/systemd/nspawn/propagate/$PC_ID-$name" 2>/dev/null
        for group in $(pc_groups "$name"); do
            [[ ! -d $group ]] || find "$group" -depth -type d -exec rmdir {} \; 2>/dev/null
        done
    done
    [[ -z $PC_WORK ]] || rm -rf "$PC_WORK"
    PC_NAMES=()
}
