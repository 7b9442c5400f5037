#!/usr/bin/env bash
# Run a command as PID 1 of a container: nothing is writable but the folders named, as a plain user
# without any capability.
#
#   unshare --fork --pid --mount --net --ipc container.sh PREFIX PYTHON SITE UID FOLDER... -- COMMAND...
#
# Everything that is mounted exists in these namespaces only.
set -euo pipefail
prefix=$1 python=$2 site=$3 user=$4
shift 4

mount --make-rprivate /
mount -t proc proc /proc
for place in /opt /run /var/lib; do mount -t tmpfs -o mode=755 tmpfs "$place"; done
mkdir /opt/{vram-arbiter,python,site-packages}
mount --bind "$prefix" /opt/vram-arbiter
mount --bind "$python" /opt/python
mount --bind "$site" /opt/site-packages
writable=
while [ "$1" != -- ]; do
    mkdir -p "$1"
    mount -t tmpfs -o "mode=1770,uid=$user,gid=$user" tmpfs "$1"
    writable="$writable $1 "
    shift
done
shift
while read -r _ place _; do
    case $place in /proc* | /dev* | /sys*) continue ;; esac
    case $writable in *" $place "*) continue ;; esac
    mount -o remount,bind,ro "$place"
done < <(tac /proc/self/mounts)
exec setpriv --reuid="$user" --regid="$user" --clear-groups --no-new-privs --inh-caps=-all \
    --bounding-set=-all "$@"
