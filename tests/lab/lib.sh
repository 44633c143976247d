# shellcheck shell=bash
# Sourced by the lab scripts: where the cache is, how a download is made, and how one emulated PC
# is started and waited for. It builds nothing itself; images.sh does.
#
#   HIL_LAB_CACHE    folder for all downloads and images (default /var/tmp/hil-lab-cache, about
#                    1.5 GB); removing it removes the lab, nothing else of the host is touched
#   HIL_LAB_MIRROR   Debian archive to use instead of the one the host's own apt sources name

LAB_DIR=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
LAB_CACHE=${HIL_LAB_CACHE:-/var/tmp/hil-lab-cache}
LAB_SUITE=bookworm
LAB_KEYRING=/usr/share/keyrings/debian-archive-keyring.gpg
LAB_STARTED=$SECONDS
export PATH="$PATH:/usr/sbin:/sbin"

lab_say() { printf '[lab %4d s] %s\n' "$((SECONDS - LAB_STARTED))" "$*" >&2; }
lab_fail() { printf '[lab] error: %s\n' "$*" >&2; exit 2; }

# lab_need COMMAND PACKAGE [COMMAND PACKAGE ...]: all that is missing, in one message.
lab_need() {
    local missing=()
    while [[ $# -gt 1 ]]; do
        command -v "$1" >/dev/null || missing+=("$2")
        shift 2
    done
    [[ ${#missing[@]} -eq 0 ]] ||
        lab_fail "this host lacks Debian packages; install them with: apt-get install ${missing[*]}"
}

lab_mirror() {
    local uri=${HIL_LAB_MIRROR:-}
    # The archive proper ends in /debian; the security and third-party ones do not.
    [[ -n "$uri" ]] || uri=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' |
        sed -n 's:/*$::; /\/debian$/{p;q}')
    [[ -n "$uri" ]] ||
        lab_fail "the apt sources of this host name no Debian archive; set HIL_LAB_MIRROR to one"
    printf '%s\n' "$uri"
}

# One line of an apt source list for SUITE.
lab_source() { printf 'deb [signed-by=%s] %s %s main\n' "$LAB_KEYRING" "$(lab_mirror)" "$1"; }

# lab_download FOLDER SUITE PACKAGE...: the packages and all they depend on as .deb files. The
# host's own package state is neither read nor changed.
lab_download() {
    local folder=$1 suite=$2 apt=$LAB_CACHE/apt options option
    shift 2
    mkdir -p "$apt/lists/partial" "$apt/cache" "$folder/partial"
    { lab_source "$LAB_SUITE"; lab_source "$LAB_SUITE-backports"; } >"$apt/sources.list"
    : >"$apt/status"
    options=()
    for option in "Dir::Etc::sourcelist=$apt/sources.list" Dir::Etc::sourceparts=/dev/null \
        Dir::Etc::preferencesparts=/dev/null Dir::Etc::preferences=/dev/null \
        "Dir::State::lists=$apt/lists" "Dir::State::status=$apt/status" \
        "Dir::Cache=$apt/cache" "Dir::Cache::archives=$folder" \
        APT::Sandbox::User=root APT::Install-Recommends=false; do
        options+=(-o "$option")
    done
    if [[ -z $(find "$apt/lists" -maxdepth 1 -name '*Packages*' -mmin -1440) ]]; then
        timeout 300 apt-get "${options[@]}" -qq update >&2 ||
            lab_fail "apt-get update for $(lab_mirror) failed or took over 300 s"
    fi
    timeout 900 apt-get "${options[@]}" -qq -y --download-only -t "$suite" install "$@" >&2 ||
        lab_fail "download of $* from $suite failed or took over 900 s"
}

# vm_start SHARE QEMU [ARGUMENT...]: boots one PC in the background and sets VM_PID. QEMU is
# qemu7 or qemu10; the arguments are QEMU's. The guest runs SHARE/run.sh as root with SHARE
# mounted at /share, and leaves SHARE/output.txt and SHARE/status (the exit code) there.
#   VM_NAME host name (pc)   VM_PROCESSORS (2)   VM_MEMORY_MIB (768)
#   VM_VIRTUAL_TIME=1        the guest's clock counts instructions, on one processor: what it
#                            measures does not depend on the load of the host
vm_start() {
    local share=$1 root=$LAB_CACHE/$2 libraries machine=(-accel "tcg,thread=multi")
    local processors=${VM_PROCESSORS:-2} lib=usr/lib/x86_64-linux-gnu
    shift 2
    [[ -f "$share/run.sh" ]] || lab_fail "$share/run.sh is missing"
    if [[ -n "${VM_VIRTUAL_TIME:-}" ]]; then
        machine=(-accel "tcg,thread=single" -icount "shift=1,sleep=off")
        processors=1
    fi
    libraries=$root/$lib:$root/lib/x86_64-linux-gnu
    libraries+=$(find "$root/$lib" -mindepth 1 -maxdepth 1 -type d -printf ':%p')
    rm -f "$share/output.txt" "$share/status"
    env "LD_LIBRARY_PATH=$libraries" "QEMU_MODULE_DIR=$root/$lib/qemu" \
        "$root/usr/bin/qemu-system-x86_64" -L "$root/usr/share/qemu" -L "$root/usr/share/seabios" \
        -M pc,vmport=off "${machine[@]}" -cpu max -smp "$processors" \
        -m "${VM_MEMORY_MIB:-768}" -nodefaults -no-user-config -display none -no-reboot \
        -kernel "$LAB_CACHE/vmlinuz" -initrd "$LAB_CACHE/initramfs.gz" \
        -append "console=ttyS0 quiet loglevel=4 net.ifnames=0 tsc=reliable nowatchdog \
mitigations=off cryptomgr.notests random.trust_cpu=on panic=-1 hil.name=${VM_NAME:-pc}" \
        -serial "file:$share/console.txt" \
        -drive "file=$LAB_CACHE/guest.ext4,format=raw,if=none,id=root,snapshot=on" \
        -device virtio-blk-pci,drive=root \
        -fsdev "local,id=share,path=$share,security_model=none" \
        -device virtio-9p-pci,fsdev=share,mount_tag=share \
        -object rng-random,id=random,filename=/dev/urandom -device virtio-rng-pci,rng=random \
        "$@" </dev/null >"$share/qemu.txt" 2>&1 &
    VM_PID=$!
}

# vm_wait SECONDS PID...: until all PCs are off. Fails when that takes longer; the exit trap then
# ends them.
vm_wait() {
    local end=$((SECONDS + $1)) pid
    shift
    for pid in "$@"; do
        while kill -0 "$pid" 2>/dev/null; do
            [[ $SECONDS -lt $end ]] || return 1
            sleep 0.2
        done
    done
}

# vm_status SHARE: the exit code of run.sh, or what kept the PC from giving one.
vm_status() {
    if [[ -s "$1/status" ]]; then
        cat "$1/status"
    else
        printf 'none (see %s/console.txt and qemu.txt)\n' "$1"
    fi
}

lab_end() {
    local pid running
    # Only what still runs: the number of an ended PC may be another process's by now.
    mapfile -t running < <(jobs -pr)
    for pid in "${running[@]}"; do kill -TERM "$pid" 2>/dev/null; done
    for pid in "${running[@]}"; do
        timeout 3 tail --pid="$pid" -f /dev/null || kill -KILL "$pid" 2>/dev/null
    done
}
trap lab_end EXIT
trap 'exit 130' INT TERM
