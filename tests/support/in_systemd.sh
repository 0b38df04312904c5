#!/usr/bin/env bash
# Runs a command beside a systemd of its own: in_systemd.sh FOLDER COMMAND...
#
# FOLDER/units holds all the units there are. The manager is a user's one, which sets nothing of the machine up,
# in namespaces and a control group of its own. It sees the whole machine read-only except FOLDER, so that
# nothing outside can be changed. Exits with 77 where this is not possible.
set -eu
folder=$1
shift
if [ "${STAGE:-0}" = 0 ]; then
  [ "$(id -u)" = 0 ] && [ -x /lib/systemd/systemd ] || exit 77
  STAGE=1 unshare --mount --propagation private bash "$0" "$folder" "$@"
  exit
fi
if [ "$STAGE" = 1 ]; then
  mkdir -p "$folder/cgroup"
  mount -t cgroup2 cgroup2 "$folder/cgroup" || exit 77
  own=$folder/cgroup/lanenet-test-$$
  mkdir "$own" || exit 77
  code=0
  (echo "$BASHPID" >"$own/cgroup.procs" && STAGE=2 exec unshare --mount --propagation private --cgroup --pid --fork \
    --kill-child bash "$0" "$folder" "$@") || code=$?
  for _ in $(seq 100); do
    find "$own" -depth -type d -exec rmdir {} + 2>/dev/null && break
    sleep 0.02
  done
  exit "$code"
fi
umount --lazy "$folder/cgroup"
mount --bind "$folder" "$folder"
while read -r _ _ _ _ point _; do
  [ "$point" = "$folder" ] || mount -o remount,bind,ro "$point" 2>/dev/null || true
done </proc/self/mountinfo
# Never without: a manager that is given the wrong units could empty /tmp.
for place in / /tmp /var/tmp /dev/shm "$folder/.."; do
  if touch "$place/lanenet-test-$$" 2>/dev/null; then
    rm -f "$place/lanenet-test-$$"
    exit 77
  fi
done
touch "$folder/inside" || exit 77
mount -t proc proc /proc || exit 77
umount --recursive --lazy /sys/fs/cgroup && mount -t cgroup2 cgroup2 /sys/fs/cgroup || exit 77
mount -t tmpfs tmpfs /run
mkdir -p /run/systemd/system /run/user
export SYSTEMD_UNIT_PATH=$folder/units XDG_RUNTIME_DIR=/run/user HOME=/run/user
/lib/systemd/systemd --user --unit=basic.target --log-target=console --log-level=err &
for _ in $(seq 100); do
  [ -S /run/user/systemd/private ] && break
  sleep 0.05
done
[ -S /run/user/systemd/private ] || exit 77
"$@"
