#!/usr/bin/env bash
# Wheels of what their makers publish for no board, compiled on this machine for another: cobs (its compiled part,
# which decodes a frame of the whiskers with 4 thousand instructions instead of 168), and for 32-bit ARM small-gicp, with
# the patch beside, which it needs there. Two minutes and a half; needs the architecture's compiler, such as
# g++-arm-linux-gnueabihf.
#   packaging/compiled_wheels.sh PYTHON ARCHITECTURE COMPILER_PREFIX SUITE PYTHON_VERSION FOLDER_FOR_THE_WHEELS
set -euo pipefail
python=$1 arch=$2 tools=$3 suite=$4 target=$5 out=$6
here=$(cd "$(dirname "$0")" && pwd)
source "$here/foreign_packages.sh"
tag=cp${target/./}
case $arch in
  amd64) machine=x86_64 cpu=() ;;
  arm64) machine=aarch64 cpu=() ;;
  armhf) machine=armv7l cpu=(-mcpu=cortex-a7 -mfpu=neon-vfpv4 -mfloat-abi=hard) ;;
esac
mkdir -p "$out"
out=$(realpath "$out")
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

version() { sed -n "s/^$1==\([^ ]*\).*/\1/p" "$here/carried.txt"; }
wheel() { echo "$out/$1-$2-$tag-$tag-linux_$machine.whl"; }

prepare() { # once: headers of the target, and what packs wheels
  [[ ! -e $work/target ]] || return 0
  unpack_foreign "$arch" "$suite" "$work/target" "libpython$target-dev" libeigen3-dev
  # Python's configuration is found by architecture, beside the common headers.
  mkdir "$work/include"
  ln -s "$work/target/usr/include/$tools" "$work/include/"
  headers=(-isystem "$work/target/usr/include/python$target" -isystem "$work/include")
  common=(-O3 -DNDEBUG -fPIC "${cpu[@]}" "-ffile-prefix-map=$work=.")
  "$python" -m pip install --quiet --target "$work/tools" wheel
}

source_of() { # name, version; unpacked in $work/name-version
  "$python" -m pip download --quiet --no-deps --no-binary=:all: -d "$work" "$1==$2"
  tar -xzf "$work/${1/-/_}-$2.tar.gz" -C "$work"
}

pack() { # name, version, folder with what it installs, licence
  local info=$3/$1-$2.dist-info
  mkdir "$info"
  cp "$4" "$info/"
  printf 'Metadata-Version: 2.1\nName: %s\nVersion: %s\n' "$1" "$2" >"$info/METADATA"
  printf 'Wheel-Version: 1.0\nGenerator: compiled_wheels.sh\nRoot-Is-Purelib: false\nTag: %s-%s-linux_%s\n' \
    "$tag" "$tag" "$machine" >"$info/WHEEL"
  "$tools-strip" $(find "$3" -name '*.so')
  PYTHONPATH=$work/tools "$python" -m wheel pack --dest-dir "$out" "$3"
}

cobs() {
  local number source module tree=$work/cobs
  number=$(version cobs)
  [[ ! -e $(wheel cobs "$number") ]] || return 0
  prepare
  source_of cobs "$number"
  source=$work/cobs-$number
  mkdir "$tree"
  cp -r "$source/src/cobs" "$tree/"
  for module in cobs cobsr; do
    "$tools-gcc" -shared "${common[@]}" "${headers[@]}" "$source/src/ext/_${module}_ext.c" \
      -o "$tree/cobs/$module/_${module}_ext.cpython-${target/./}-$tools.so"
  done
  pack cobs "$number" "$tree" "$source/LICENSE.txt"
}

small_gicp() {
  local number source tree=$work/small_gicp flags
  number=$(version small-gicp)
  [[ ! -e $(wheel small_gicp "$number") ]] || return 0
  prepare
  source_of small-gicp "$number"
  source=$work/small_gicp-$number
  patch -p1 -d "$source" <"$here/small_gicp_32_bit.patch"
  "$python" -m pip install --quiet --no-deps --target "$work/pybind11" pybind11==3.1.0
  # Not through its CMake files: what they look for would be this machine's Python.
  flags=(-std=c++17 -fopenmp -fvisibility=hidden -Wno-psabi -Dsmall_gicp_python_EXPORTS "${common[@]}" "${headers[@]}"
    -I"$source/include" -I"$work/pybind11/pybind11/include" -isystem "$work/target/usr/include/eigen3")
  mkdir "$work/objects" "$tree"
  (cd "$source" && printf '%s\n' src/small_gicp/registration/{registration,registration_helper}.cpp \
    src/python/{pointcloud,kdtree,voxelmap,preprocess,result,align,factors,misc,python}.cpp) |
    OBJECTS=$work/objects COMPILER=$tools-g++ SOURCE=$source xargs -P "${JOBS:-$(nproc)}" -I{} \
      sh -c '"$COMPILER" "$@" -c "$SOURCE/{}" -o "$OBJECTS/$(basename {}).o"' - "${flags[@]}"
  "$tools-g++" -shared -fopenmp "${cpu[@]}" -Wl,-z,relro,-z,now "$work"/objects/*.o \
    -o "$tree/small_gicp.cpython-${target/./}-$tools.so"
  pack small_gicp "$number" "$tree" "$source/LICENSE"
}

cobs
[[ $arch != armhf ]] || small_gicp
