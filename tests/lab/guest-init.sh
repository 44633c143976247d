#!/bin/bash
# Process 1 of an emulated PC: mounts what a program expects, runs /share/run.sh as root, leaves
# its output and exit code in /share, and switches the PC off. There is no service manager.
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/root
export LC_ALL=C.UTF-8
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
mkdir -p /dev/pts /dev/shm
mount -t devpts devpts /dev/pts
for folder in /dev/shm /run /tmp; do mount -t tmpfs -o mode=1777 tmpfs "$folder"; done
read -r line </proc/cmdline
for word in $line; do
    case $word in hil.name=*) echo "${word#hil.name=}" >/proc/sys/kernel/hostname ;; esac
done
# The guest is ours alone: real-time threads may have all of it.
echo -1 >/proc/sys/kernel/sched_rt_runtime_us
modprobe -a 9pnet_virtio 9p
if ! mount -t 9p -o trans=virtio,version=9p2000.L,msize=262144,cache=none share /share; then
    echo "no shared folder" >/dev/console
    busybox poweroff -f
fi
ip link set lo up
cd /tmp || exit 1
bash /share/run.sh >/share/output.txt 2>&1 </dev/null
echo $? >/share/status
sync
busybox poweroff -f
