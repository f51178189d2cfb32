#!/usr/bin/env bash
# The package on an emulated board: from a bare armhf root to poses on Zenoh, the same trajectory as on x86, and what it
# costs in instructions and memory. As root, on x86-64; needs the packages in dist/ (make deb), debootstrap,
# qemu-user-static, qemu-user, gcc, and a network to Debian's mirror. A quarter of an hour.
#   benchmarks/board/board_test.sh PYTHON [STEP...]
# PYTHON has the project with its simulator. Steps, by default all but `source`, each upon what an earlier run has left:
#   install     the package into a fresh root, and doctor
#   source      this checkout's code in place of the package's: to count what is being worked at
#   daemon      with a simulated robot's devices, heard over Zenoh
#   trajectory  scenario 3 by replay, here and in an amd64 root with the same libraries
#   start       instructions to READY
#   counts      instructions by stage in scenario 3, or in its first FIRST=... seconds
#   memory      after scenario 5
#   removal     remove and purge
set -euo pipefail
source "$(dirname "$0")/root.sh"
python=$(realpath -s "${1:?path of the Python to use}")
shift
steps=("${@:-}")
[[ -n ${steps[0]} ]] || steps=(install daemon trajectory start counts memory removal)
project=$(cd "$here/../.." && pwd)
export PYTHONPATH=$project
case $SUITE in bookworm) debian=12 ;; trixie) debian=13 ;; esac
recordings=$project/tests/recordings
endpoint=tcp/127.0.0.1:17948
board=board-$SUITE x86=x86-$SUITE config=/etc/robominer-slam/config.toml
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

installed() { # root, architecture
  local deb from=$SECONDS
  deb=$(package "$2")
  fresh_root "$1" "$2"
  say "$2: bare root of $(size_MB "$1") MB, package of $(du -k "$deb" | cut -f1) kB"
  cp "$deb" "$BOARD/$1/opt/"
  on_root "$1" apt-get -qq update
  from=$SECONDS
  on_root "$1" apt-get -y --no-install-recommends install "/opt/${deb##*/}" >"$BOARD/install-$SUITE-$2.log" 2>&1 ||
    fail "installation; see $BOARD/install-$SUITE-$2.log"
  on_root "$1" apt-get clean
  say "$2: installed in $((SECONDS - from)) s; $(size_MB "$1") MB"
  tail -n 3 "$BOARD/install-$SUITE-$2.log" | grep 'robominer-slam doctor' >/dev/null || fail 'the next step is told'
}

replayed() { # root
  local from=$SECONDS
  cp "$recordings/scenario-3.mcap" "$BOARD/$1/tmp/"
  on_root "$1" robominer-slam replay /tmp/scenario-3.mcap --graph /tmp/graph.json --json >"$work/replay-$1.json" 2>"$work/err" ||
    fail "$(cat "$work/err")"
  say "$1: scenario 3 replayed in $((SECONDS - from)) s"
}

simulated_robot() { # its devices on this machine's pseudo-terminals, its configuration on the board
  local etc=$BOARD/$board/etc/robominer-slam link port
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
    on_root "$board" chgrp robominer-devices "$port"
    chmod 660 "$port"
  done
}

stop_last() {
  local pid=${started[-1]}
  unset 'started[-1]'
  kill "$pid" 2>/dev/null || true
  wait "$pid" 2>/dev/null || true
}

install() {
  bare_root armhf
  installed "$board" armhf
  if on_root "$board" robominer-slam doctor --config $config --json >"$work/doctor.json"; then fail 'doctor content too soon'; fi
  say 'doctor: not content, since the devices are not there'
  simulated_robot
  on_root "$board" robominer-slam doctor --config $config >"$work/doctor.txt" || fail "doctor: $(cat "$work/doctor.txt")"
  say 'doctor: content, with the devices of a simulated robot'
  stop_last
}

source_code() {
  local package
  for package in robominer_slam drivers calibration sim_backend; do
    rm -rf "$BOARD/$board/usr/lib/robominer-slam/$package"
    cp -r "$project/$package" "$BOARD/$board/usr/lib/robominer-slam/"
  done
  on_root "$board" py3compile -p robominer-slam /usr/lib/robominer-slam
}

daemon() {
  local heard
  simulated_robot
  on_root "$board" install -d -o robominer-slam -g robominer-slam -m 750 /var/lib/robominer-slam
  chroot --userspec=robominer-slam:robominer-slam --groups=robominer-devices "$BOARD/$board" "${inside[@]}" \
    robominer-slam run --config $config >"$work/daemon.log" 2>&1 &
  started+=($!)
  heard=$("$python" "$here/poses_heard.py" $endpoint 120) || fail "$heard $(tail -n 5 "$work/daemon.log")"
  say "the daemon as its own user: $heard"
  stop_last
  stop_last
  [[ -s $BOARD/$board/var/lib/robominer-slam/map.db ]] || fail 'no map is kept'
}

trajectory() {
  replayed "$board"
  bare_root amd64
  installed "$x86" amd64
  replayed "$x86"
  "$python" "$here/same_trajectory.py" "$BOARD/$board/tmp/graph.json" "$BOARD/$x86/tmp/graph.json" || missed+=(trajectory)
}

prepare_trial() {
  [[ -e $BOARD/$board/opt/qemu ]] || install_counter "$board"
  mkdir -p "$BOARD/$board/opt/trial"
  cp "$here"/{stages,counted_drive,counted_start}.py "$recordings"/scenario-[35].mcap "$BOARD/$board/opt/trial/"
}

start() {
  local million
  prepare_trial
  simulated_robot
  rm -rf "$BOARD/$board"/var/lib/robominer-slam/*
  counted "$board" "$work/start.json" /usr/bin/python3 /opt/trial/counted_start.py $config >"$work/start.log" 2>&1 ||
    fail "start: $(tail -n 3 "$work/start.log"; cat "$work/robot.log")"
  stop_last
  million=$("$python" -c "import json; print(round(sum(n for n, _ in json.load(open('$work/start.json'))['stages'][:2]) / 1e6))")
  say "start to READY: $million million instructions of 2500"
  ((million <= 2500)) || missed+=(start)
}

counts() {
  prepare_trial
  counted "$board" "$work/counts.json" /usr/bin/python3 /opt/trial/counted_drive.py /opt/trial/scenario-3.mcap ${FIRST:-} \
    >"$work/summary.json" 2>"$work/err" || fail "$(tail -n 3 "$work/err")"
  say 'scenario 3, by stage:'
  "$python" "$here/stage_table.py" "$work/counts.json" "$work/summary.json" || missed+=(instructions)
}

memory() {
  local resident
  prepare_trial
  mkfifo "$work/hold"
  chroot "$BOARD/$board" "${inside[@]}" QEMU_GUEST_BASE=0x400000000 PYTHONPATH=/usr/lib/robominer-slam \
    python3 /opt/trial/counted_drive.py /opt/trial/scenario-5.mcap 1000 hold <"$work/hold" >"$work/memory.json" 2>"$work/err" &
  started+=($!)
  exec 9>"$work/hold"
  until [[ -s $work/memory.json ]]; do kill -0 $! || fail "$(tail -n 3 "$work/err")"; sleep 1; done
  resident=$("$python" "$here/guest_memory.py" $!)
  exec 9>&-
  stop_last
  say "after scenario 5: $resident MB of guest memory of 110"
  ((${resident%.*} < 110)) || missed+=(memory)
}

removal() {
  local gone
  on_root "$board" apt-get -qq -y remove robominer-slam >"$work/remove.log" 2>&1
  for gone in var/lib/robominer-slam/map.db etc/robominer-slam/calibration.json; do
    [[ -e $BOARD/$board/$gone ]] || fail "removal took $gone"
  done
  # Not the whole folder: `source` may have put files there that no package knows.
  [[ ! -e $BOARD/$board/usr/lib/robominer-slam/zenoh ]] || fail 'removal left what it had installed'
  on_root "$board" apt-get -qq -y purge robominer-slam >"$work/purge.log" 2>&1
  for gone in var/lib/robominer-slam etc/robominer-slam; do
    [[ ! -e $BOARD/$board/$gone ]] || fail "purge left $gone"
  done
  say 'removal leaves maps and calibrations, purge does not'
}

mkdir -p "$BOARD"
emulate arm
[[ ! -e $BOARD/$board ]] || mount_root "$board"
for step in "${steps[@]}"; do
  case $step in
    source) source_code ;;
    install | daemon | trajectory | start | counts | memory | removal) "$step" ;;
    *) fail "step $step: expected install, source, daemon, trajectory, start, counts, memory or removal" ;;
  esac
done
((${#missed[@]} == 0)) || fail "missed: ${missed[*]}"
say 'all as it should be'
