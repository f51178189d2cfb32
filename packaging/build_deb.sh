#!/usr/bin/env bash
# Builds robominer-slam_VERSION_ARCHITECTURE.deb. Nothing of the target is run: its wheels are unpacked, and small-gicp,
# where there is no wheel, is cross-compiled. On Debian 12 or later with debhelper.
#   packaging/build_deb.sh PYTHON ARCHITECTURE SUITE FOLDER_FOR_THE_PACKAGE
# PYTHON has the project installed (the manual page and completions are its help).
set -euo pipefail
python=$1 arch=$2 suite=$3 out=$4
root=$(cd "$(dirname "$0")/.." && pwd)
here=$root/packaging

case $suite in
  bookworm) target=3.11 next=3.12 debian=12 ;;
  trixie) target=3.13 next=3.14 debian=13 ;;
  *) echo "error: $suite: expected bookworm or trixie" >&2; exit 2 ;;
esac
case $arch in
  amd64) machine=x86_64 tools=x86_64-linux-gnu ;;
  arm64) machine=aarch64 tools=aarch64-linux-gnu ;;
  armhf) machine=armv7l tools=arm-linux-gnueabihf ;;
  *) echo "error: $arch: expected amd64, arm64 or armhf" >&2; exit 2 ;;
esac
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git -C "$root" log -1 --format=%ct)}
export SOURCE_DATE_EPOCH PYTHONDONTWRITEBYTECODE=1

work=$root/build/deb/$suite-$arch wheels=$root/build/wheels/$suite-$arch
rm -rf "$work"
mkdir -p "$work/debian" "$wheels" "$out"
out=$(realpath "$out")
tree=$work/tree library=$work/tree/usr/lib/robominer-slam
install -d "$library" "$tree"/usr/{bin,lib/sysusers.d,lib/udev/rules.d,lib/modules-load.d,lib/systemd/system} \
  "$tree/etc/robominer-slam"

"$here/compiled_wheels.sh" "$python" "$arch" $tools "$suite" "$target" "$wheels"
rm -f "$wheels"/robominer_slam-*.whl
"$python" -m pip wheel --quiet --no-deps -w "$wheels" "$root"
# Debian 12 has glibc 2.36: wheels for any up to that.
platforms=(--platform "manylinux2014_$machine" --platform "linux_$machine")
for minor in $(seq 17 36); do
  platforms+=(--platform "manylinux_2_${minor}_$machine")
done
"$python" -m pip install --quiet --no-deps --no-compile --only-binary=:all: --target "$library" --find-links "$wheels" \
  --implementation cp --python-version "$target" --abi "cp${target/./}" --abi abi3 --abi none "${platforms[@]}" \
  -r "$here/carried.txt" robominer-slam
rm -rf "$library/bin" "$library"/*.dist-info/{INSTALLER,REQUESTED,RECORD,direct_url.json,uv_build.json}

# Zenoh's comes with its symbols, a third of it.
if command -v $tools-strip >/dev/null; then
  find "$library" -name '*.so' -exec $tools-strip --strip-unneeded {} +
fi

install -m 755 "$here/robominer-slam" "$tree/usr/bin/"
install -m 644 "$here/config.toml" "$tree/etc/robominer-slam/"
install -m 644 "$root"/systemd/sysusers.d/*.conf "$tree/usr/lib/sysusers.d/"
install -m 644 "$root"/systemd/udev/*.rules "$tree/usr/lib/udev/rules.d/"
install -m 644 "$root"/systemd/modules-load.d/*.conf "$tree/usr/lib/modules-load.d/"
install -m 644 "$root"/systemd/*.service "$tree/usr/lib/systemd/system/"

completion() { # shell, file
  install -d "$tree/$(dirname "$2")"
  PYTHONPATH=$root _ROBOMINER_SLAM_COMPLETE=$1_source "$python" -c \
    'from robominer_slam.cli.main import cli; cli(prog_name="robominer-slam")' >"$tree/$2"
}
completion bash usr/share/bash-completion/completions/robominer-slam
completion zsh usr/share/zsh/vendor-completions/_robominer-slam
completion fish usr/share/fish/vendor_completions.d/robominer-slam.fish

cp "$here"/debian/* "$work/debian/"
mkdir "$work/documentation"
cp "$root"/docs/*.md "$root"/{README,CHANGELOG}.md "$work/documentation/"
PYTHONPATH=$root "$python" "$here/man_page.py" >"$work/debian/robominer-slam.1"
number=$("$python" -c "import tomllib; print(tomllib.load(open('$root/pyproject.toml', 'rb'))['project']['version'])")
cat >"$work/debian/changelog" <<CHANGELOG
robominer-slam ($number+deb$debian) $suite; urgency=medium

  * Release $number; see /usr/share/doc/robominer-slam/CHANGELOG.md.gz.

 -- The robominer-slam authors <robominer-slam@localhost>  $(date -u -R -d "@$SOURCE_DATE_EPOCH")
CHANGELOG

cd "$work"
PYTHON_DEPENDS="python3 (>= $target), python3 (<< $next)" dpkg-buildpackage --build=binary --no-sign --no-check-builddeps \
  --host-arch "$arch" --root-command= >build.log 2>&1 || { tail -n 30 build.log >&2; exit 1; }
cp "$work/../robominer-slam_$number+deb${debian}_$arch.deb" "$out/"
rm -f "$work"/../robominer-slam*_"$arch".{deb,buildinfo,changes}
ls -l "$out/robominer-slam_$number+deb${debian}_$arch.deb"
