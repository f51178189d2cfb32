# Sourced. A Debian root of another architecture, run under qemu-user as a Cortex-A7, and the counting of instructions.
# As root; needs debootstrap, qemu-user-static, qemu-user and a C compiler.
#   BOARD   folder for roots, about 1 GB each (default ~/.cache/robominer-board)
#   SUITE   bookworm (default) or trixie
BOARD=${BOARD:-$HOME/.cache/robominer-board}
SUITE=${SUITE:-bookworm}
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
source "$here/../../packaging/foreign_packages.sh"

say() { printf '[%4d s] %s\n' $SECONDS "$*"; }
fail() { say "FAILED: $*"; exit 1; }

emulate() { # kernel support for running other architectures' programs; it stays until the machine is restarted
  local register=/proc/sys/fs/binfmt_misc/register
  [[ -e $register ]] || mount -t binfmt_misc binfmt_misc /proc/sys/fs/binfmt_misc
  [[ -e /proc/sys/fs/binfmt_misc/qemu-$1 ]] || cat "/usr/lib/binfmt.d/qemu-$1.conf" >$register
}

bare_root() { # architecture: what debootstrap makes, kept for the next time
  local bare=$BOARD/bare-$SUITE-$1
  if [[ ! -e $bare/.complete ]]; then
    rm -rf "$bare"
    debootstrap --arch="$1" --variant=minbase --include=ca-certificates "$SUITE" "$bare" "$(debian_mirror)" \
      >"$BOARD/debootstrap-$SUITE-$1.log" || fail "debootstrap; see $BOARD/debootstrap-$SUITE-$1.log"
    rm -rf "$bare"/var/cache/apt/archives/*.deb
    touch "$bare/.complete"
  fi
}

unmount_root() {
  local mounted
  for mounted in dev/pts dev proc; do
    if mountpoint -q "$BOARD/$1/$mounted"; then umount "$BOARD/$1/$mounted"; fi
  done
}

fresh_root() { # name, architecture: a copy of the bare root, ready to be used
  local root=$BOARD/$1
  unmount_root "$1"
  rm -rf --one-file-system "$root"
  cp -a "$BOARD/bare-$SUITE-$2" "$root"
  mount_root "$1"
  cp -L /etc/resolv.conf "$root/etc/"
}

mount_root() {
  mountpoint -q "$BOARD/$1/proc" || mount -t proc proc "$BOARD/$1/proc"
  mountpoint -q "$BOARD/$1/dev" || mount --bind /dev "$BOARD/$1/dev"
  mountpoint -q "$BOARD/$1/dev/pts" || mount --bind /dev/pts "$BOARD/$1/dev/pts"
}

# A clean environment. One thread of OpenBLAS, as on a board that has other things to do with its second core.
inside=(env -i HOME=/root PATH=/usr/sbin:/usr/bin:/sbin:/bin LC_ALL=C.UTF-8 DEBIAN_FRONTEND=noninteractive
  OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 PYTHONHASHSEED=0 QEMU_CPU=cortex-a7)
on_root() { # name, command...
  local root=$BOARD/$1
  shift
  chroot "$root" "${inside[@]}" "$@"
}

size_MB() { # of a root, without what is mounted in it
  du -sxm --exclude="$BOARD/$1/proc" --exclude="$BOARD/$1/dev" "$BOARD/$1" | cut -f1
}

install_counter() { # root: qemu with its libraries, and the plugin; the static qemu of binfmt_misc takes no plugins
  local qemu=$BOARD/$1/opt/qemu
  mkdir -p "$qemu"
  gcc -O2 -shared -fPIC -fvisibility=hidden -o "$qemu/instruction_counter.so" "$here/instruction_counter.c"
  cp -L /usr/bin/qemu-arm "$qemu/"
  ldd /usr/bin/qemu-arm | awk '/=> \//{print $3} /ld-linux/{print $1}' | xargs -I{} cp -L {} "$qemu/"
}

counted() { # root, file for the counts, command...
  local root=$BOARD/$1 out=$2 rc=0
  shift 2
  setarch "$(uname -m)" -R chroot "$root" "${inside[@]}" PYTHONDONTWRITEBYTECODE=1 PYTHONPATH=/usr/lib/robominer-slam \
    "/opt/qemu/$(cd "$root/opt/qemu" && echo ld-linux*)" --library-path /opt/qemu /opt/qemu/qemu-arm -cpu cortex-a7 \
    -plugin /opt/qemu/instruction_counter.so,out=/tmp/counts.json "$@" || rc=$?
  cp "$root/tmp/counts.json" "$out"
  return $rc
}
