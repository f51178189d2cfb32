#!/usr/bin/env bash
# The package on an emulated board: from a bare armhf root to poses on Zenoh, the same trajectory as on x86, and what it
# costs in instructions and memory. As root, on x86-64; needs the packages in dist/ (make deb), debootstrap,
# qemu-user-static, qemu-user, gcc, and a network to Debian's mirror. A quarter of an hour.
#   benchmarks/board/board_test.sh PYTHON [SECONDS]
# PYTHON has the project with its simulator. SECONDS: count only the beginning of scenario 3, and leave out scenario 5.
set -euo pipefail
source "$(dirname "$0")/root.sh"
python=$(realpath -s "${1:?path of the Python to use}") seconds=${2:-}
project=$(cd "$here/../.." && pwd)
export PYTHONPATH=$project
case $SUITE in bookworm) debian=12 ;; trixie) debian=13 ;; esac
recordings=$project/tests/recordings
endpoint=tcp/127.0.0.1:17948
work=$(mktemp -d) missed=() started=()

finish() {
  local pid
  for pid in "${started[@]}"; do
    kill "$pid" 2>/dev/null && wait "$pid" || true
  done
  unmount_root "board-$SUITE"
  unmount_root "x86-$SUITE"
  rm -rf "$work"
}
trap finish EXIT

package() { # architecture
  ls "$project"/dist/robominer-slam_*+deb"${debian}_$1.deb" || fail "no package; make deb SUITES=$SUITE ARCHITECTURES=$1"
}

install() { # root, architecture
  local deb from=$SECONDS
  deb=$(package "$2")
  fresh_root "$1" "$2"
  say "$2: bare root of $(size_MB "$1") MB, package of $(du -k "$deb" | cut -f1) kB"
  cp "$deb" "$BOARD/$1/root/"
  on_root "$1" apt-get -qq update
  from=$SECONDS
  on_root "$1" apt-get -y --no-install-recommends install "/root/${deb##*/}" >"$BOARD/install-$SUITE-$2.log" 2>&1 ||
    fail "installation; see $BOARD/install-$SUITE-$2.log"
  on_root "$1" apt-get clean
  say "$2: installed in $((SECONDS - from)) s; $(size_MB "$1") MB"
  tail -n 3 "$BOARD/install-$SUITE-$2.log" | grep 'robominer-slam doctor' >/dev/null || fail 'the next step is told'
}

replay() { # root
  local from=$SECONDS
  cp "$recordings/scenario-3.mcap" "$BOARD/$1/tmp/"
  on_root "$1" robominer-slam replay /tmp/scenario-3.mcap --graph /tmp/graph.json --json >"$work/replay-$1.json" 2>"$work/err" ||
    fail "$(cat "$work/err")"
  say "$1: scenario 3 replayed in $((SECONDS - from)) s"
}

simulated_robot() { # its devices on this machine's pseudo-terminals, its configuration on the board
  local etc=$BOARD/$1/etc/robominer-slam link port
  rm -rf "$work/robot" "$work/robot.log"
  "$python" -c 'from robominer_slam.cli.main import main; main()' simulate --from "$recordings/scenario-3.mcap" --out "$work/robot" --listen $endpoint \
    --wait 600 --json >"$work/robot.log" 2>&1 &
  started+=($!)
  until [[ -s $work/robot.log ]]; do kill -0 $!; sleep 0.2; done
  cp "$work/robot/calibration.json" "$etc/"
  sed 's#^path = .*#path = "/var/lib/robominer-slam/map.db"#' "$work/robot/config.toml" >"$etc/config.toml"
  for link in "$work"/robot/dev/*; do
    port=$(readlink -f "$link")
    sed -i "s#\"$link\"#\"$port\"#" "$etc/config.toml"
    on_root "$1" chgrp robominer-devices "$port"
    chmod 660 "$port"
  done
}

stop_last() {
  local pid=${started[-1]}
  unset 'started[-1]'
  kill "$pid" 2>/dev/null || true
  wait "$pid" 2>/dev/null || true
}

mkdir -p "$BOARD"
emulate arm
bare_root armhf
bare_root amd64
board=board-$SUITE x86=x86-$SUITE config=/etc/robominer-slam/config.toml

install "$board" armhf
if on_root "$board" robominer-slam doctor --config $config --json >"$work/doctor.json"; then fail 'a doctor content too soon'; fi
say 'doctor: not content, since the devices are not there'
simulated_robot "$board"
on_root "$board" robominer-slam doctor --config $config >"$work/doctor.txt" || fail "doctor: $(cat "$work/doctor.txt")"
say 'doctor: content, with the devices of a simulated robot'

on_root "$board" install -d -o robominer-slam -g robominer-slam -m 750 /var/lib/robominer-slam
chroot --userspec=robominer-slam:robominer-slam --groups=robominer-devices "$BOARD/$board" "${inside[@]}" \
  robominer-slam run --config $config >"$work/daemon.log" 2>&1 &
started+=($!)
heard=$("$python" "$here/poses_heard.py" $endpoint 120) || fail "$heard $(tail -n 5 "$work/daemon.log")"
say "the daemon as its own user: $heard"
stop_last
stop_last
[[ -s $BOARD/$board/var/lib/robominer-slam/map.db ]] || fail 'no map is kept'

replay "$board"
install "$x86" amd64
replay "$x86"
"$python" "$here/same_trajectory.py" "$BOARD/$board/tmp/graph.json" "$BOARD/$x86/tmp/graph.json" || missed+=(trajectory)

install_counter "$board"
mkdir -p "$BOARD/$board/opt/trial"
cp "$here"/{stages,counted_drive,counted_start}.py "$recordings"/scenario-[35].mcap "$BOARD/$board/opt/trial/"
simulated_robot "$board"
counted "$board" "$work/start.json" python3 /opt/trial/counted_start.py $config >"$work/start.log" 2>&1 ||
  fail "$(tail -n 3 "$work/start.log")"
stop_last
start=$("$python" -c "import json; print(round(sum(n for n, _ in json.load(open('$work/start.json'))['stages'][:2]) / 1e6))")
say "start to READY: $start million instructions of 2500"
((start <= 2500)) || missed+=(start)

counted "$board" "$work/counts.json" python3 /opt/trial/counted_drive.py /opt/trial/scenario-3.mcap $seconds \
  >"$work/summary.json" 2>"$work/err" || fail "$(tail -n 3 "$work/err")"
say 'counted scenario 3'
"$python" "$here/stage_table.py" "$work/counts.json" "$work/summary.json" || missed+=(instructions)

if [[ -z $seconds ]]; then
  mkfifo "$work/hold"
  chroot "$BOARD/$board" "${inside[@]}" QEMU_GUEST_BASE=0x400000000 PYTHONPATH=/usr/lib/robominer-slam \
    python3 /opt/trial/counted_drive.py /opt/trial/scenario-5.mcap 1000 hold <"$work/hold" >"$work/memory.json" 2>"$work/err" &
  started+=($!)
  exec 9>"$work/hold"
  until [[ -s $work/memory.json ]]; do kill -0 $! || fail "$(tail -n 3 "$work/err")"; sleep 1; done
  memory=$("$python" "$here/guest_memory.py" $!)
  exec 9>&-
  say "after scenario 5: $memory MB of guest memory of 110"
  [[ ${memory%.*} -lt 110 ]] || missed+=(memory)
fi

on_root "$board" apt-get -qq -y remove robominer-slam >"$work/remove.log" 2>&1
[[ -e $BOARD/$board/var/lib/robominer-slam/map.db && -e $BOARD/$board/etc/robominer-slam/calibration.json ]] ||
  fail 'removal leaves maps and calibrations'
[[ ! -e $BOARD/$board/usr/lib/robominer-slam ]] || fail 'removal leaves nothing in /usr/lib'
on_root "$board" apt-get -qq -y purge robominer-slam >"$work/purge.log" 2>&1
[[ ! -e $BOARD/$board/var/lib/robominer-slam && ! -e $BOARD/$board/etc/robominer-slam ]] || fail 'purge takes them'
say 'removal leaves maps and calibrations, purge does not'

((${#missed[@]} == 0)) || fail "missed: ${missed[*]}"
say 'all within their budgets'
