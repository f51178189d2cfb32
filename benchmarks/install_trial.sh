#!/usr/bin/env bash
# The package under a running systemd: installed, started, upgraded, removed and purged by apt in a bare Debian root that
# has booted its own systemd and udev, in namespaces of its own and without a network; the devices are those of a
# simulated robot. As root, on x86-64 with cgroup2 and overlayfs; needs the amd64 package in dist/ (make deb) and
# debootstrap. A minute; some more the first time, when a root with all that the package needs is made and kept (1 GB; BOARD
# and SUITE as in board/root.sh).
#   benchmarks/install_trial.sh .venv/bin/python
# Not shown here: the drivers of modules-load.d, where the kernel has none, and rules at a real plug. The rules are run
# by `udevadm test` on a made-up /sys with an Arduino in it.
set -euo pipefail
python=$(realpath -s "${1:?path of the Python to use}")
source "$(dirname "$0")/board/root.sh"
project=$(cd "$here/../.." && pwd)
config=/etc/robominer-slam/config.toml name=robominer-slam

boot() { # inside the namespaces; $1: the root, $2: folder for what is changed in it
  local node
  mount --make-rprivate /
  mount -t overlay overlay -o "lowerdir=$1,upperdir=$2/upper,workdir=$2/work" "$2/merged"
  cd "$2/merged"
  mount -t proc proc proc
  mount --bind proc/sys proc/sys
  mount -o remount,bind,ro proc/sys
  # Writable: else udev does not start. What it would rename or set up there is only the loopback of these namespaces.
  mount -t sysfs sysfs sys
  mount -t cgroup2 cgroup2 sys/fs/cgroup
  mount -t tmpfs -o mode=755 tmpfs run
  # Not the machine's own /dev, where udev would set owners.
  mount -t tmpfs -o mode=755 tmpfs dev
  for node in 'null 1 3' 'zero 1 5' 'full 1 7' 'random 1 8' 'urandom 1 9' 'tty 5 0' 'ptmx 5 2'; do
    # shellcheck disable=SC2086
    mknod -m 666 dev/${node%% *} c ${node#* }
  done
  ln -s /proc/self/fd dev/fd
  mkdir dev/pts dev/shm
  mount --bind /dev/pts dev/pts
  mount -t tmpfs tmpfs dev/shm
  mkdir -p etc/systemd/system
  ln -sf /dev/null etc/systemd/system/console-getty.service
  pivot_root . mnt
  umount -l /mnt
  # Credentials reach a service's folder by a mount that spreads.
  mount --make-rshared /
  exec env -i container=trial PATH="$PATH" /lib/systemd/systemd --system --log-target=journal </dev/null
}
if [[ ${2:-} == boot ]]; then
  boot "$3" "$4"
fi

case $SUITE in bookworm) debian=12 ;; trixie) debian=13 ;; esac
deb=$(ls "$project"/dist/robominer-slam_*+deb"${debian}"_amd64.deb) || fail "no package; make deb SUITES=$SUITE ARCHITECTURES=amd64"
base=systemd-$SUITE
[[ -d /sys/fs/cgroup/unified ]] && cgroup=/sys/fs/cgroup/unified/install-trial || cgroup=/sys/fs/cgroup/install-trial
work=$(mktemp -d /var/tmp/install-trial.XXXXXX)
simulator='' init=''
finish() {
  local status=$?
  ((status == 0)) || { echo "FAILED; the last of apt, and of the journal:"; tail -n 30 "$work/apt.log"; said | tail -n 20; } >&2 || true
  if [[ -n $simulator ]]; then
    kill -KILL "$simulator" || true
    wait "$simulator" 2>/dev/null || true
  fi
  if [[ -n $init ]]; then
    kill -KILL "$init" || true
    wait "$outer" 2>/dev/null || true
  fi
  unmount_root "$base"
  rm -rf --one-file-system "$work"
  [[ ! -d $cgroup ]] || find "$cgroup" -depth -type d -exec rmdir {} \; || true
}
trap finish EXIT
program=(env "PYTHONPATH=$project" "$python" -c 'from robominer_slam.cli.main import main; main()')
ok() { echo "ok: $*"; }
environment=(env -i LC_ALL=C.UTF-8 PATH=/usr/sbin:/usr/bin:/sbin:/bin DEBIAN_FRONTEND=noninteractive)
inside() { nsenter -t "$init" -m -p -u -i -n -C -r -w "${environment[@]}" "$@"; }
said() { inside journalctl --no-pager -o cat -u $name; }
property() { inside systemctl show --property="$1" --value $name; }
is() { [[ $(property "$1") == "$2" ]]; }
tracking() { [[ $(property StatusText) == *'whiskers streaming'* ]] && is SubState running; }
wait_for() { # seconds, what, command...
  local end=$((SECONDS + $1)) what=$2
  shift 2
  until "$@"; do
    ((SECONDS <= end)) || fail "$what"
    sleep 0.5
  done
  ok "$what"
}
apt() { # what apt does, silent but for what a maintainer script may say
  inside apt-get -q -y --no-install-recommends -o Dpkg::Use-Pty=0 "$@" >"$work/apt.log" 2>&1 || fail "apt-get $*"
  ! grep -iE 'error|warning|fail|cannot|no such|not found|denied|unable' "$work/apt.log" || fail "apt-get $1 complains"
}

usb=pci0000:00/0000:00:1d.0/usb1/1-1 # where the Arduino is plugged in
made_up_sys() { # folder: what there would be of it in /sys
  local sys=$1
  entry() { # path, its kind, lines of uevent...
    mkdir -p "$sys/devices/$1" "$sys/$2"
    ln -s "/sys/$2" "$sys/devices/$1/subsystem"
    ln -s "/sys/devices/$1" "$sys/$2/${1##*/}"
    printf '%s\n' "${@:3}" >"$sys/devices/$1/uevent"
  }
  entry "${usb%/usb1*}" bus/pci DRIVER=ehci-pci
  entry "${usb%/*}" bus/usb DEVTYPE=usb_device
  entry $usb bus/usb DEVTYPE=usb_device MAJOR=189 MINOR=1 DEVNAME=bus/usb/001/002
  entry $usb/1-1:1.0 bus/usb DEVTYPE=usb_interface
  entry $usb/1-1:1.0/tty/ttyACM0 class/tty MAJOR=166 MINOR=0 DEVNAME=ttyACM0
  (cd "$sys/devices/$usb" && echo 2341 >idVendor && echo 0043 >idProduct && echo Arduino >manufacturer &&
    echo Uno >product && echo 85735313932351E0C1A1 >serial && echo 00 | tee 1-1:1.0/bInterface{Number,Class,SubClass,Protocol} >/dev/null)
}
plugged_in() { # path in /sys, name in /dev, major, minor: what udev's rules make of it
  inside unshare -m sh -c "mkdir -p /dev/${2%/*}; mknod -m 600 /dev/$2 c $3 $4; mount --bind /opt/sys /sys
    SYSTEMD_DEVICE_VERIFY_SYSFS=0 udevadm test --action=add /devices/$1" >"$work/udev.log" 2>&1 || fail "udevadm: $(cat "$work/udev.log")"
}
given() { # link or node in /dev; Debian 13's udevadm only says what it would do
  local rule='70-robominer-slam.rules:[0-9]* '
  grep "${rule}GROUP $(inside getent group robominer-devices | cut -d: -f3)$" "$work/udev.log" >/dev/null &&
    grep "${rule}MODE 0660" "$work/udev.log" >/dev/null || fail "udev: no rights for $1"
  [[ $1 != /dev/robominer/* ]] || grep -F "LINK '${1#/dev/}'" "$work/udev.log" >/dev/null || fail "udev: no $1"
  [[ $SUITE != bookworm || $(inside stat -Lc '%G %a' "$1") == 'robominer-devices 660' ]] || fail "udev: not done: $1"
}

if [[ ! -e $BOARD/$base/.complete ]]; then
  mkdir -p "$BOARD"
  bare_root amd64
  fresh_root "$base" amd64
  rm "$BOARD/$base/.complete"
  on_root "$base" apt-get -qq update
  on_root "$base" apt-get -qq -y --no-install-recommends install systemd-sysv udev dbus kmod >"$BOARD/$base.log" 2>&1 ||
    fail "systemd; see $BOARD/$base.log"
  touch "$BOARD/$base/.complete"
fi
mount_root "$base"
cp "$deb" "$BOARD/$base/opt/package.deb"
dpkg-deb -R "$deb" "$work/newer"
sed -i 's/^Version: .*/&.1/' "$work/newer/DEBIAN/control"
dpkg-deb -Znone -b "$work/newer" "$BOARD/$base/opt/newer.deb" >/dev/null
on_root "$base" apt-get -qq -y --no-install-recommends satisfy "$(dpkg-deb -f "$deb" Depends)" >"$work/apt.log" 2>&1 ||
  fail "Debian's packages that it needs; is $BOARD/$base too old?"
on_root "$base" apt-get clean
unmount_root "$base"

mkdir -p "$work"/{upper,work,merged} "$cgroup"
(echo $BASHPID >"$cgroup/cgroup.procs" && exec unshare -fpmiunC "$0" "$python" boot "$BOARD/$base" "$work") >"$work/boot.log" 2>&1 &
outer=$!
until init=$(pgrep -P $outer) && [[ $(cat /proc/"$init"/comm) == systemd ]]; do kill -0 $outer; sleep 0.2; done
booted() { inside systemctl is-system-running >"$work/running" 2>/dev/null || grep degraded "$work/running" >/dev/null; }
wait_for 60 'the root has booted its systemd' booted
inside udevadm control --ping || fail 'udev does not run'
ok 'udev runs in it'

apt install /opt/package.deb
tail -n 9 "$work/apt.log" | grep "$name doctor" >/dev/null || fail 'the next step is not told'
ok 'installed by apt; no maintainer script complains; the next step is told'
inside journalctl --no-pager -o cat -u systemd-modules-load | grep "module 'cdc_acm'" >/dev/null || fail 'its drivers are not loaded'
ok "systemd-modules-load has run with the package's list"
inside id $name >/dev/null && inside getent group robominer-devices >/dev/null || fail 'no user, or no group'
ok 'user and group are there'
[[ $(inside systemctl is-enabled $name) == enabled ]] && is InactiveExitTimestampMonotonic 0 || fail 'not enabled, or started'
ok 'enabled and not started, since doctor is not content'
system=/proc/$init/root
made_up_sys "$system/opt/sys"
echo 'ENV{ROBOMINER}=="1", ENV{ID_SERIAL_SHORT}=="85735313932351E0C1A1", SYMLINK+="robominer/whiskers"' \
  >"$system/etc/udev/rules.d/71-robominer-names.rules"
plugged_in $usb/1-1:1.0/tty/ttyACM0 ./ttyACM0 166 0
for port in by-serial/Arduino_Uno_85735313932351E0C1A1-if00 by-socket/pci-0000:00:1d.0-usb-0:1:1.0 whiskers; do
  given /dev/robominer/$port
done
plugged_in $usb bus/usb/001/002 189 1
given /dev/bus/usb/001/002
ok "udev's rules give a made-up Arduino its group and its names, by serial number, by socket and of one's own"

"${program[@]}" simulate --scenario 0 --engine quasi-static --out "$work/robot" --json >"$work/simulator.log" 2>&1 &
simulator=$!
until [[ -s $work/simulator.log ]]; do kill -0 $simulator; sleep 0.2; done
etc=$system/etc/$name
cp "$work/robot/calibration.json" "$etc/"
sed "s#^path = .*#path = \"/var/lib/$name/map.db\"#" "$work/robot/config.toml" >"$etc/config.toml"
for link in "$work"/robot/dev/*; do
  port=$(readlink -f "$link")
  sed -i "s#\"$link\"#\"$port\"#" "$etc/config.toml"
  inside chgrp robominer-devices "$port"
  chmod 660 "$port"
done
inside $name doctor --config $config >"$work/doctor.txt" || fail "doctor: $(cat "$work/doctor.txt")"
ok 'doctor is content with the devices of a simulated robot'
apt remove $name
apt install /opt/package.deb
wait_for 40 'installed again, it is started, and poses flow' tracking
before=$(property MainPID)
apt install /opt/newer.deb
another() { ! is MainPID "$before" && tracking; }
wait_for 40 'an upgrade restarts it, and poses flow' another
inside systemctl stop $name
apt --reinstall install /opt/newer.deb
is ActiveState inactive || fail 'what was stopped by hand is started by an upgrade'
ok 'an upgrade does not start what was stopped by hand'


inside systemctl start --no-block $name
wait_for 40 'started by hand, poses flow' tracking
apt remove $name
is MainPID 0 || fail 'removal leaves it running'
inside test -s /var/lib/$name/map.db -a -s /etc/$name/calibration.json -a -s $config || fail 'removal took maps or calibrations'
ok 'apt remove: stopped; maps, calibration and configuration stay'
echo 'no configuration' >"$etc/config.toml"
apt install /opt/package.deb
inside systemctl start --no-block $name
wait_for 20 'a mistake in the configuration is a failure, not tried again' is ActiveState failed
apt purge $name
inside systemctl daemon-reload
is LoadState not-found && [[ -z $(inside systemctl list-units --all --no-legend "$name*") ]] || fail 'systemctl knows it yet'
left=$(inside find / -xdev -name "*$name*" -not -path '/opt/*')
[[ -z $left ]] || fail "purge leaves $left"
ok 'apt purge: nothing is left of it, and systemctl knows nothing of it'
[[ -z $(inside systemctl --failed --no-legend) ]] || fail "units have failed: $(inside systemctl --failed --no-legend)"
ok 'nothing else has failed'
