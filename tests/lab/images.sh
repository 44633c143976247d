#!/usr/bin/env bash
# Makes, once, what the emulated PCs of the lab need: a Debian guest with its kernel, and QEMU.
#
#   tests/lab/images.sh [guest] [qemu7] [qemu10] [--fresh]     default: all three
#
#   guest    Debian 12 root image, kernel 6.1 and initramfs
#   qemu7    QEMU 7.2 of Debian 12          qemu10   QEMU 10 of its backports, whose igb card
#                                                    gives hardware transmit stamps
#   --fresh  makes the named ones again
#
# Needs root (file owners in the image), an x86-64 Debian 12 or newer, and some minutes and 1.5 GB
# the first time; then it returns at once. Packages are unpacked in the cache folder (see lib.sh)
# and never installed. Exit code 0, or 2 with the reason.
set -u -o pipefail
# shellcheck source=tests/lab/lib.sh
source "$(dirname "$0")/lib.sh"

# In the order a session needs them: links, Wi-Fi, clocks, watching.
GUEST_PACKAGES=iproute2,kmod,iputils-ping,ethtool,procps,busybox-static
GUEST_PACKAGES+=,hostapd,wpasupplicant,iw,wireless-regdb,linuxptp,tcpdump
# Folders of kernel modules, under lib/modules/VERSION/kernel.
GUEST_MODULES=(net crypto lib arch fs/9p fs/netfs fs/fscache fs/ext4 fs/jbd2 fs/mbcache.ko
    drivers/virtio drivers/block/virtio_blk.ko drivers/char/hw_random drivers/ptp drivers/pps
    drivers/i2c drivers/dca drivers/net)
# What finds the root file system.
ROOT_MODULES=(virtio_pci virtio_blk crc32c_generic ext4)

# What the guest is made of: an image of another recipe is made again.
guest_recipe() {
    { echo "$GUEST_PACKAGES ${GUEST_MODULES[*]} ${ROOT_MODULES[*]}"
      cat "$LAB_DIR/guest-init.sh"; } | sha256sum | cut -d ' ' -f 1
}

build_guest() {
    local work=$LAB_CACHE/guest.work root=$LAB_CACHE/guest.work/root version
    rm -rf "$work"
    mkdir -p "$work/kernel"
    lab_say "guest system (the longest step, some minutes)"
    timeout 1500 mmdebstrap --quiet --variant=minbase --include="$GUEST_PACKAGES" \
        --aptopt='APT::Install-Recommends "false"' --dpkgopt='path-exclude=/usr/share/doc/*' \
        --dpkgopt='path-exclude=/usr/share/man/*' --dpkgopt='path-exclude=/usr/share/locale/*' \
        "$LAB_SUITE" "$root" "$(lab_source "$LAB_SUITE")" >&2 ||
        lab_fail "mmdebstrap failed or took over 1500 s"
    lab_say "kernel"
    lab_download "$LAB_CACHE/kernel-packages" "$LAB_SUITE" linux-image-amd64
    dpkg-deb --extract "$(newest_kernel)" "$work/kernel" || lab_fail "kernel package unreadable"
    version=$(basename "$work"/kernel/lib/modules/*)
    cp "$work/kernel/boot/vmlinuz-$version" "$work/vmlinuz" || lab_fail "no kernel in its package"
    copy_modules "$work/kernel/lib/modules/$version" "$root/lib/modules/$version"
    chroot "$root" depmod "$version" || lab_fail "depmod failed"
    install -m 755 "$LAB_DIR/guest-init.sh" "$root/sbin/hil-init"
    mkdir -p "$root/share"
    build_initramfs "$root" "$version" "$work"
    lab_say "root image"
    mke2fs -q -t ext4 -O ^has_journal -m 0 -d "$root" "$work/guest.ext4" \
        "$(($(du -sm "$root" | cut -f1) * 5 / 4 + 128))M" || lab_fail "mke2fs failed"
    # The image last: it is what says that all three are there.
    guest_recipe >"$work/guest.recipe"
    mv "$work/vmlinuz" "$work/initramfs.gz" "$work/guest.recipe" "$work/guest.ext4" \
        "$LAB_CACHE/" || exit 2
    rm -rf "$work" "$LAB_CACHE/kernel-packages"
}

newest_kernel() {
    find "$LAB_CACHE/kernel-packages" -name 'linux-image-[0-9]*.deb' | sort -V | tail -n 1
}

copy_modules() {
    local from=$1 to=$2 part
    mkdir -p "$to/kernel"
    cp "$from"/modules.{builtin,builtin.modinfo,order} "$to/" || lab_fail "no module lists"
    for part in "${GUEST_MODULES[@]}"; do
        if [[ -e "$from/kernel/$part" ]]; then
            mkdir -p "$to/kernel/$(dirname "$part")"
            cp -r "$from/kernel/$part" "$to/kernel/$part" || lab_fail "copy of module $part failed"
        fi
    done
}

build_initramfs() {
    local root=$1 version=$2 work=$3 tree=$3/initramfs module
    mkdir -p "$tree"/{bin,dev,proc,root,modules}
    cp "$root/bin/busybox" "$tree/bin/" || lab_fail "no busybox in the guest"
    for module in "${ROOT_MODULES[@]}"; do
        chroot "$root" modprobe --set-version "$version" --show-depends "$module" ||
            lab_fail "the kernel has no module $module"
    done | awk '$1 == "insmod" && !seen[$2]++ { print $2 }' >"$work/modules"
    while read -r module; do
        cp "$root$module" "$tree/modules/" && basename "$module" >>"$tree/modules/order"
    done <"$work/modules"
    cat >"$tree/init" <<'INIT'
#!/bin/busybox sh
b=/bin/busybox
$b mount -t devtmpfs dev /dev
for module in $($b cat /modules/order); do $b insmod "/modules/$module"; done
tries=0
until [ -b /dev/vda ] || [ $tries -ge 500 ]; do $b usleep 20000; tries=$((tries + 1)); done
$b mount -t ext4 -o noatime /dev/vda /root && exec $b switch_root /root /sbin/hil-init
echo "no root file system"
$b poweroff -f
INIT
    chmod 755 "$tree/init"
    (cd "$tree" && find . | cpio --quiet -o -H newc | gzip -1) >"$work/initramfs.gz" ||
        lab_fail "initramfs could not be packed"
}

# build_qemu NAME SUITE
build_qemu() {
    local tree=$LAB_CACHE/$1.work package
    lab_say "$1 from $2"
    rm -rf "$tree" "$LAB_CACHE/${1:?}" "$LAB_CACHE/$1-packages"
    lab_download "$LAB_CACHE/$1-packages" "$2" qemu-system-x86
    mkdir -p "$tree"
    for package in "$LAB_CACHE/$1-packages"/*.deb; do
        # The C library must be the one of the loader, the host's.
        case $(basename "$package") in libc6_*) continue ;; esac
        dpkg-deb --extract "$package" "$tree" || lab_fail "$package is unreadable"
    done
    [[ -x "$tree/usr/bin/qemu-system-x86_64" ]] || lab_fail "no QEMU in the packages of $2"
    mv "$tree" "$LAB_CACHE/$1" || exit 2
    rm -rf "$LAB_CACHE/$1-packages"
}

main() {
    local wanted=() fresh= part
    for part in "$@"; do
        case $part in
            guest | qemu7 | qemu10) wanted+=("$part") ;;
            --fresh) fresh=yes ;;
            -h | --help) sed -n '2,/^set/{/^#/s/^# \{0,1\}//p}' "$0"; exit 0 ;;
            *) lab_fail "unknown part $part; the parts are guest, qemu7 and qemu10" ;;
        esac
    done
    [[ ${#wanted[@]} -gt 0 ]] || wanted=(guest qemu7 qemu10)
    mkdir -p "$LAB_CACHE" || lab_fail "cannot make $LAB_CACHE"
    exec 9>"$LAB_CACHE/lock"
    flock --wait 1800 9 || lab_fail "another build has held $LAB_CACHE/lock for 1800 s"
    for part in "${wanted[@]}"; do
        [[ -z "$fresh" ]] || rm -rf "$LAB_CACHE/${part:?}" "$LAB_CACHE/$part.ext4"
        case $part in
            guest) [[ -s "$LAB_CACHE/guest.ext4" &&
                $(cat "$LAB_CACHE/guest.recipe" 2>/dev/null) == "$(guest_recipe)" ]] ||
                { requirements; build_guest; } ;;
            qemu7) [[ -d "$LAB_CACHE/qemu7" ]] ||
                { requirements; build_qemu qemu7 "$LAB_SUITE"; } ;;
            qemu10) [[ -d "$LAB_CACHE/qemu10" ]] ||
                { requirements; build_qemu qemu10 "$LAB_SUITE-backports"; } ;;
        esac
    done
}

requirements() {
    [[ $(id -u) -eq 0 ]] || lab_fail "building needs root: file owners in the image"
    [[ $(uname -m) == x86_64 ]] || lab_fail "the lab is for x86-64 hosts, not $(uname -m)"
    [[ -r $LAB_KEYRING ]] ||
        lab_fail "$LAB_KEYRING is missing; install it with: apt-get install debian-archive-keyring"
    lab_need apt-get apt mmdebstrap mmdebstrap mke2fs e2fsprogs cpio cpio \
        dpkg-deb dpkg flock util-linux
}

main "$@"
