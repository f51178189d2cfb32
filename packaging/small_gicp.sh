#!/usr/bin/env bash
# small-gicp for 32-bit ARM as a wheel: its makers publish none, and unpatched it does not compile (the patch beside).
# Cross-compiled on this machine, two minutes; needs g++-arm-linux-gnueabihf.
#   packaging/small_gicp.sh PYTHON VERSION SUITE PYTHON_VERSION FOLDER_FOR_THE_WHEEL
set -euo pipefail
python=$1 version=$2 suite=$3 target=$4 out=$5
here=$(cd "$(dirname "$0")" && pwd)
source "$here/foreign_packages.sh"
tag=cp${target/./}
wheel=small_gicp-$version-$tag-$tag-linux_armv7l.whl
[[ ! -e $out/$wheel ]] || exit 0
mkdir -p "$out"
out=$(realpath "$out")
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

unpack_foreign armhf "$suite" "$work/target" "libpython$target-dev" libeigen3-dev
"$python" -m pip download --quiet --no-deps --no-binary=small-gicp -d "$work" "small-gicp==$version"
"$python" -m pip install --quiet --no-deps --target "$work/pybind11" pybind11==3.1.0
tar -xzf "$work/small_gicp-$version.tar.gz" -C "$work"
source=$work/small_gicp-$version
patch -p1 -d "$source" <"$here/small_gicp_32_bit.patch"

# Not through its CMake files: what they look for would be this machine's Python.
mkdir -p "$work/objects" "$work/include" "$work/wheel"
ln -s "$work/target/usr/include/arm-linux-gnueabihf" "$work/include/"
cpu=(-mcpu=cortex-a7 -mfpu=neon-vfpv4 -mfloat-abi=hard)
flags=(-std=c++17 -O3 -DNDEBUG -fPIC -fopenmp -fvisibility=hidden -Dsmall_gicp_python_EXPORTS "${cpu[@]}"
  -Wno-psabi "-ffile-prefix-map=$work=." -I"$source/include" -I"$work/pybind11/pybind11/include"
  -isystem "$work/target/usr/include/eigen3" -isystem "$work/target/usr/include/python$target" -isystem "$work/include")
cd "$source"
printf '%s\n' src/small_gicp/registration/{registration,registration_helper}.cpp \
  src/python/{pointcloud,kdtree,voxelmap,preprocess,result,align,factors,misc,python}.cpp |
  OBJECTS=$work/objects xargs -P "${JOBS:-$(nproc)}" -I{} \
    sh -c 'arm-linux-gnueabihf-g++ "$@" -c {} -o "$OBJECTS/$(basename {}).o"' - "${flags[@]}"
module=$work/wheel/small_gicp.cpython-${target/./}-arm-linux-gnueabihf.so
arm-linux-gnueabihf-g++ -shared -fopenmp "${cpu[@]}" -Wl,-z,relro,-z,now -o "$module" "$work"/objects/*.o
arm-linux-gnueabihf-strip "$module"

info=$work/wheel/small_gicp-$version.dist-info
mkdir "$info"
cp LICENSE "$info/"
printf 'Metadata-Version: 2.1\nName: small_gicp\nVersion: %s\n' "$version" >"$info/METADATA"
printf 'Wheel-Version: 1.0\nGenerator: small_gicp.sh\nRoot-Is-Purelib: false\nTag: %s-%s-linux_armv7l\n' "$tag" "$tag" \
  >"$info/WHEEL"
"$python" -m pip install --quiet --target "$work/tools" wheel
PYTHONPATH=$work/tools "$python" -m wheel pack --dest-dir "$out" "$work/wheel"
