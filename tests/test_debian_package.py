"""What can be told of the Debian package without building it; `make board-test` and install_trial.sh install it."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.metadata import requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from robominer_slam.configuration.file import load
from robominer_slam.doctor.configuration_checks import check_configuration

ROOT = Path(__file__).resolve().parents[1]
PACKAGING = ROOT / "packaging"
#: Debian's packages by the names that Python's have.
DEBIAN = {
    "lz4": "python3-lz4",
    "numpy": "python3-numpy",
    "pyserial": "python3-serial",
    "pyusb": "python3-usb",
    "scipy": "python3-scipy",
    "zstandard": "python3-zstandard",
}
#: Named by what is carried, and not needed for what is used of it; `carried.txt` says why.
NOT_NEEDED = {
    "python-dateutil": {"tzdata"},
    "rosbags": {"apsw", "backports-zstd", "ruamel-yaml"},
    "sqlite-utils": {"pip"},
}


def carried() -> dict[str, str]:
    """Versions that the package carries, by name."""
    lines = (line.split("#")[0].strip() for line in (PACKAGING / "carried.txt").read_text().splitlines())
    return {canonicalize_name(name): version for name, version in (line.split("==") for line in lines if line)}


def depends() -> set[str]:
    """Packages that Debian installs with it."""
    control = (PACKAGING / "debian" / "control").read_text()
    field = re.search(r"^Depends:\n((?: .*\n)+)", control, re.MULTILINE)
    assert field is not None
    return {line.strip().rstrip(",").split(" ")[0] for line in field[1].splitlines()}


def test_every_dependency_is_carried_or_debians():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    has, installs = carried(), depends()
    for text in project["dependencies"]:
        wanted = Requirement(text)
        name = canonicalize_name(wanted.name)
        if name in DEBIAN:
            assert DEBIAN[name] in installs
        else:
            assert wanted.specifier.contains(has[name]), f"{text}: carried is {has[name]}"


def test_what_is_carried_has_what_it_needs():
    installs = depends()
    for name in carried():
        for text in requires(name) or []:
            needed = Requirement(text)
            if needed.marker is not None and not needed.marker.evaluate({"extra": ""}):
                continue
            other = canonicalize_name(needed.name)
            known = other in carried() or DEBIAN.get(other) in installs or other in NOT_NEEDED.get(name, ())
            assert known, f"{name} needs {text}"


def test_maintainer_scripts_are_shell_and_need_no_running_systemd():
    for name in ("preinst", "postinst", "prerm", "postrm"):
        script = PACKAGING / "debian" / name
        subprocess.run(["/bin/sh", "-n", str(script)], check=True)
        lines = script.read_text().splitlines()
        assert "set -e" in lines
        assert "#DEBHELPER#" in lines
        for line in lines:
            if re.match(r"\s*(systemctl|udevadm) ", line):
                assert line.endswith("|| true"), line


def test_build_scripts_are_shell():
    for script in (*PACKAGING.glob("*.sh"), *(ROOT / "benchmarks").rglob("*.sh")):
        subprocess.run(["bash", "-n", str(script)], check=True)


def test_everything_of_systemd_is_in_the_package():
    build = (PACKAGING / "build_deb.sh").read_text()
    for path in (ROOT / "systemd").rglob("*.*"):
        if path.is_file():
            folder = path.parent.relative_to(ROOT)
            assert f'"$root"/{folder}/*{path.suffix} "$tree/usr/lib/' in build, f"{path}: not packed"


def test_the_unit_starts_the_packages_program():
    unit = (ROOT / "systemd" / "robominer-slam.service").read_text()
    assert "ExecStart=/usr/bin/robominer-slam run --config /etc/robominer-slam/config.toml\n" in unit
    assert "robominer-slam.conf" in (PACKAGING / "debian" / "postinst").read_text()
    user = re.search(r"^User=(.*)$", unit, re.MULTILINE)
    assert user is not None
    assert f"u {user[1]} " in (ROOT / "systemd" / "sysusers.d" / "robominer-slam.conf").read_text()


def test_the_packaged_configuration_is_one_that_doctor_is_not_content_with_yet(tmp_path: Path):
    path = tmp_path / "config.toml"
    path.write_text((PACKAGING / "config.toml").read_text())
    configuration = load(path)
    assert {device.name for device in configuration.device} == {"whiskers", "imu", "screws"}
    found = {finding.check: finding for finding in check_configuration(path)}
    assert found["configuration"].level == "ok"
    assert found["device whiskers"].level == "error"
    assert found["calibration"].level == "error"
    # As the maintainer script asks.
    program = "from robominer_slam.cli.main import main; main()"
    arguments = [sys.executable, "-c", program, "doctor", "--config", str(path)]
    done = subprocess.run(arguments, capture_output=True, check=False, timeout=60, env={"PYTHONPATH": str(ROOT)})
    assert done.returncode == 1


def test_the_manual_page_has_every_command():
    done = subprocess.run(
        [sys.executable, str(PACKAGING / "man_page.py")], capture_output=True, text=True, check=True, timeout=60
    )
    for heading in (".SS run ", ".SS doctor ", ".SS map export ", ".SS calibrate fit ", ".SH FILES"):
        assert f"\n{heading}" in done.stdout


@pytest.mark.parametrize("command", ["simulate", "world"])
def test_a_missing_extra_is_one_line(command: str, tmp_path: Path):
    # A module of this name that fails as one that is not there does.
    for module in ("mujoco", "magpylib", "matplotlib"):
        (tmp_path / f"{module}.py").write_text(f"raise ModuleNotFoundError('no', name={module!r})\n")
    program = "from robominer_slam.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, command],
        capture_output=True, text=True, check=False, timeout=60, env={"PYTHONPATH": f"{tmp_path}:{ROOT}"}, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert re.fullmatch(r"error: this needs \w+, which is not installed: pip install '[^']*\[\w+\]'\n", done.stderr)
