#!/usr/bin/env bash
# Become PID 1 of a machine of its own: systemd in fresh namespaces, above a throw-away copy of this system.
#
#   unshare --fork --pid --mount --uts --ipc --net --cgroup boot_machine.sh SCRATCH TREE PREFIX PYTHON SITE
#
# Everything that is mounted or written exists in these namespaces only: the root is an overlay, /proc/sys is read-only,
# and the one folder shared with the outside is SCRATCH/notify, where systemd says that it is up.
set -euo pipefail
scratch=$1 tree=$2 prefix=$3 python=$4 site=$5

mount --make-rprivate /
mount -t tmpfs -o mode=755 tmpfs "$scratch/layers"
mkdir "$scratch"/layers/{upper,work,root}
mount -t overlay -o "lowerdir=/,upperdir=$scratch/layers/upper,workdir=$scratch/layers/work" overlay "$scratch/layers/root"
root=$scratch/layers/root

mount -t proc proc "$root/proc"
mount --bind "$root/proc/sys" "$root/proc/sys"
mount -o remount,bind,ro "$root/proc/sys"
mount -t sysfs -o ro sysfs "$root/sys"
mount -t cgroup2 cgroup2 "$root/sys/fs/cgroup"

mount -t tmpfs -o mode=755 tmpfs "$root/dev"
for device in null zero full random urandom tty; do
    touch "$root/dev/$device"
    mount --bind "/dev/$device" "$root/dev/$device"
done
mkdir "$root"/dev/{pts,shm}
mount -t devpts -o newinstance,ptmxmode=0666,mode=620 devpts "$root/dev/pts"
mount -t tmpfs -o mode=1777 tmpfs "$root/dev/shm"
ln -s pts/ptmx "$root/dev/ptmx"
ln -s /proc/self/fd "$root/dev/fd"

put() { # put SOURCE PLACE: read-only
    mkdir -p "$root$2"
    mount --bind "$1" "$root$2"
    mount -o remount,bind,ro "$root$2"
}
# Units that a system has of its own are not started: only targets, and what `vramctl install` writes.
mount -t tmpfs -o mode=755 tmpfs "$root/etc/systemd"
mkdir "$root"/etc/systemd/{system,user}
mkdir -p "$root/opt"
mount -t tmpfs -o mode=755 tmpfs "$root/opt"
mount -t tmpfs -o mode=755 tmpfs "$root/usr/local/bin"
put "$prefix" /opt/vram-arbiter
put "$python" /opt/python
put "$site" /opt/site-packages
put "$tree" /opt/tree
echo /opt/python/lib >"$root/etc/ld.so.conf.d/opt-python.conf"
chroot "$root" ldconfig

mount -t tmpfs -o mode=755 tmpfs "$root/run"
mount -t tmpfs -o mode=1777 tmpfs "$root/tmp"
mkdir "$root"/run/{outside,targets,user}
mount --bind "$scratch/notify" "$root/run/outside"
for target in basic sysinit shutdown umount; do
    printf '[Unit]\nDefaultDependencies=no\n' >"$root/run/targets/$target.target"
done
printf '[Unit]\nRequires=sysinit.target\nAfter=sysinit.target\n' >"$root/run/targets/basic.target"
printf '[Unit]\nRequires=basic.target\nAfter=basic.target\nAllowIsolate=yes\n' >"$root/run/targets/multi-user.target"

cd "$root"
mkdir -p run/old-root
pivot_root . run/old-root
umount --lazy /run/old-root
exec env -i container=vram-test PATH=/usr/sbin:/usr/bin:/sbin:/bin \
    SYSTEMD_UNIT_PATH=/etc/systemd/system:/run/targets NOTIFY_SOCKET=/run/outside/socket \
    SYSTEMD_LOG_TARGET=console SYSTEMD_LOG_COLOR=0 \
    /lib/systemd/systemd --system --unit=multi-user.target
