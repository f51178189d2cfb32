#!/usr/bin/env bash
# The unit under a real systemd, as it is shipped and shut in: systemd as process 1 of namespaces of its own, with the
# host's network and a simulated robot. As root, on a machine with cgroup2 and overlayfs; a minute and a half.
#   benchmarks/service_trial.sh .venv/bin/python
# Not shown here: real serial devices (DeviceAllow=) and udev; pseudo-terminals are always allowed. Keys come by the
# lines that are commented out in the unit.
set -euo pipefail
python=$(realpath -s "${1:?path of the Python to use}")
root=$(cd "$(dirname "$0")/.." && pwd)
tcp=tcp/127.0.0.1:17947 tls=tls/127.0.0.1:17948

boot() { # inside the namespaces; $1: the robot's folder
  mount --make-rprivate /
  mount -t tmpfs tmpfs /mnt
  for d in etc opt var usr/bin; do
    mkdir -p /mnt/$d/upper /mnt/$d/work
    mount -t overlay overlay -o lowerdir=/$d,upperdir=/mnt/$d/upper,workdir=/mnt/$d/work /$d
  done
  mount -t tmpfs tmpfs /run
  umount -l /sys/fs/cgroup || true
  mount -t cgroup2 cgroup2 /sys/fs/cgroup
  mount --bind /proc/sys /proc/sys
  mount -o remount,bind,ro /proc/sys
  # Python may lie in a home, which the service does not see.
  mkdir -p /opt/python /opt/source /opt/packages /etc/robominer-slam
  mount --bind "$("$python" -c 'import sys; print(sys.base_prefix)')" /opt/python
  mount --bind "$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')" /opt/packages
  mount --bind "$root" /opt/source
  cat >/usr/bin/robominer-slam <<'PROGRAM'
#!/bin/sh
export LD_LIBRARY_PATH=/opt/python/lib PYTHONPATH=/opt/source:/opt/packages PYTHONDONTWRITEBYTECODE=1
exec /opt/python/bin/python3 -c 'from robominer_slam.cli.main import main; main()' "$@"
PROGRAM
  chmod 755 /usr/bin/robominer-slam
  cp "$1/calibration.json" /etc/robominer-slam/
  sed -e "s#^path = .*#path = \"/var/lib/robominer-slam/map.db\"#" -e "s#^listen = .*#listen = [\"$tcp\", \"$tls\"]#" \
    -e 's#^\[zenoh\]#&\ncredentials = "/run/credentials/robominer-slam.service"#' "$1/config.toml" \
    >/etc/robominer-slam/config.toml
  cp -r "$1/keys/holders/rm3" /etc/robominer-slam/keys
  chown -R 0:0 /etc/robominer-slam/keys
  systemd-sysusers "$root/systemd/sysusers.d/robominer-slam.conf"
  for link in "$1"/dev/*; do
    port=$(readlink -f "$link")
    chgrp robominer-devices "$port"
    chmod 660 "$port"
  done
  units=/run/systemd/system
  mkdir -p $units
  sed 's/^#LoadCredential=/LoadCredential=/' "$root/systemd/robominer-slam.service" >$units/robominer-slam.service
  for target in basic sysinit shutdown multi-user network-online; do
    printf '[Unit]\nDefaultDependencies=no\n' >$units/$target.target
  done
  printf '[Unit]\nDefaultDependencies=no\nWants=systemd-journald.service robominer-slam.service\n' >$units/trial.target
  cp /lib/systemd/system/systemd-journald{.service,.socket,-dev-log.socket} $units/
  sed -i 's/^Sockets=.*/Sockets=systemd-journald.socket systemd-journald-dev-log.socket/' $units/systemd-journald.service
  # Credentials reach a service's folder by a mount that spreads.
  mount --make-rshared /
  export container=trial SYSTEMD_UNIT_PATH=$units
  exec /lib/systemd/systemd --system --unit=trial.target --log-target=console </dev/null
}
if [[ ${2:-} == boot ]]; then
  boot "$3"
fi

[[ -d /sys/fs/cgroup/unified ]] && cgroup=/sys/fs/cgroup/unified/service-trial || cgroup=/sys/fs/cgroup/service-trial
# Not under /tmp, which is the service's own.
work=$(mktemp -d /srv/service-trial.XXXXXX)
simulator='' init=''
finish() {
  if [[ -n $simulator ]]; then
    kill -KILL "$simulator" || true
    wait "$simulator" 2>/dev/null || true
  fi
  [[ -z $init ]] || kill -KILL "$init" || true
  sleep 1
  rm -rf "$work"
  [[ ! -d $cgroup ]] || find "$cgroup" -depth -type d -exec rmdir {} \; || true
}
trap finish EXIT
chmod 755 "$work"
program=(env "PYTHONPATH=$root" "$python" -c 'from robominer_slam.cli.main import main; main()')
for words in init 'issue alice --role operator' 'issue rm3 --role robot --host 127.0.0.1'; do
  # shellcheck disable=SC2086
  "${program[@]}" keys $words --folder "$work/keys" >/dev/null
done
"${program[@]}" simulate --scenario 0 --engine quasi-static --out "$work" --listen $tcp --json >"$work/simulator.log" 2>&1 &
simulator=$!
until [[ -s $work/simulator.log ]]; do kill -0 $simulator; sleep 0.2; done
mkdir -p "$cgroup"
(echo $BASHPID >"$cgroup/cgroup.procs" && exec unshare -fpmiuC --mount-proc "$0" "$python" boot "$work") \
  >"$work/boot.log" 2>&1 &
outer=$!
until init=$(pgrep -P $outer) && [[ $(cat /proc/"$init"/comm) == systemd ]]; do kill -0 $outer; sleep 0.2; done
inside() { nsenter -t "$init" -m -p -u -i -C --wd=/ "$@"; }
property() { inside systemctl show --property="$1" --value robominer-slam; }
wait_for() { # seconds, what, command...
  local end=$((SECONDS + $1)) what=$2
  shift 2
  until "$@"; do
    if ((SECONDS > end)); then
      echo "FAILED: $what" >&2
      inside systemctl --no-pager status robominer-slam >&2 || true
      exit 1
    fi
    sleep 0.5
  done
  echo "ok: $what: $(property StatusText)"
}
is() { [[ $(property "$1" 2>/dev/null) == "$2" ]]; }
says() { [[ $(property StatusText) == *"$1"* ]]; }
wait_for 40 'ready, shut in' is SubState running
wait_for 20 'says so in words' says 'whiskers streaming'
by_keys() { "${program[@]}" status --connect $tls --credentials "$work/keys/holders/alice" --json >"$work/status.json"; }
wait_for 20 "an operator's keys are good for its, which systemd hands to it alone" by_keys
inside sed -i 's/^source = "fused"/source = "odometry"/' /etc/robominer-slam/config.toml
inside systemctl reload robominer-slam
named() { inside journalctl --no-pager -p warning -u robominer-slam | grep 'estimation.source .* needs a restart' >/dev/null; }
wait_for 10 'a reload names what needs a restart' named
inside journalctl --no-pager -u robominer-slam DEVICE=whiskers STATE=streaming | grep streaming >/dev/null
echo 'ok: the journal knows devices by field'
kill -STOP "$simulator"
wait_for 10 'a silent robot is said' says 'whiskers silent'
sleep 35
is NRestarts 0 || { echo 'FAILED: a silent sensor restarts nothing' >&2; exit 1; }
echo 'ok: a silent sensor restarts nothing within 35 s'
kill -CONT "$simulator"
wait_for 10 'the robot is back' says 'whiskers streaming'
inside kill -STOP "$(property MainPID)"
wait_for 60 'a daemon that stands still is started again' is NRestarts 1
traced() { inside journalctl --no-pager -u robominer-slam | grep 'Fatal Python error: Aborted' >/dev/null; }
wait_for 5 'the journal has where it stood' traced
wait_for 40 'and is ready again' is SubState running
inside systemctl stop robominer-slam
is Result success && echo 'ok: a clean end'
