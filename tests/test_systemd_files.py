"""The unit, udev rules and their like, judged by systemd's own tools."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "systemd"
UNIT = FOLDER / "robominer-slam.service"
GREATEST_EXPOSURE = 1.7


def tool(name: str) -> str:
    """A program of systemd. Where it is missing a test may be skipped by hand, never in CI."""
    found = shutil.which(name)
    if found is None:
        assert not os.environ.get("ROBOMINER_SLAM_CI"), f"{name} is missing: apt-get install systemd"
        pytest.skip(f"{name} is missing: apt-get install systemd")
    return found


def settings() -> dict[str, list[str]]:
    """The unit's keys with all their values."""
    found: dict[str, list[str]] = {}
    for line in UNIT.read_text().replace("\\\n", "").splitlines():
        if "=" in line and not line.startswith("#"):
            key, value = line.split("=", 1)
            found.setdefault(key, []).append(value)
    return found


def test_the_service_is_shut_in():
    done = subprocess.run(
        [tool("systemd-analyze"), "security", "--offline=true", "--no-pager", str(UNIT)],
        capture_output=True, text=True, timeout=30, check=True,
    )  # fmt: skip
    exposure = re.search(r"Overall exposure level for robominer-slam.service: ([0-9.]+)", done.stdout)
    assert exposure is not None, done.stdout
    assert float(exposure[1]) <= GREATEST_EXPOSURE, done.stdout


def test_systemd_understands_the_unit(tmp_path: Path):
    copy = tmp_path / UNIT.name
    program = settings()["ExecStart"][0].split()[0]
    copy.write_text(UNIT.read_text().replace(program, "/bin/true"))
    done = subprocess.run(
        [tool("systemd-analyze"), "verify", "--man=no", "--recursive-errors=no", str(copy)],
        capture_output=True, text=True, timeout=30, check=False,
    )  # fmt: skip
    said = done.stdout + done.stderr
    ours = [line for line in said.splitlines() if UNIT.name in line]
    assert not ours, said


def test_what_the_unit_promises():
    unit = settings()
    assert unit["Type"] == ["notify"]
    assert unit["Restart"] == ["on-failure"]
    assert int(unit["WatchdogSec"][0]) >= 10  # ten turns of the loop, which feeds once a second
    assert unit["ExecReload"] == ["/bin/kill -HUP $MAINPID"]
    assert int(unit["LogRateLimitBurst"][0]) > 0
    assert unit["StartLimitIntervalSec"] == ["0"]  # else systemd gives up after five failures


def delay(folder: Path, result: str, status: str) -> str:
    """What the unit's ExecStopPost sleeps after an end; nothing where it does not sleep."""
    script = settings()["ExecStopPost"][0].removeprefix("/bin/sh -c ").strip("'").replace("$$", "$")
    (folder / "sleep").write_text("#!/bin/sh\necho $1\n")
    (folder / "sleep").chmod(0o755)
    done = subprocess.run(
        ["/bin/sh", "-c", script], capture_output=True, text=True, check=False, timeout=10,
        env={"PATH": f"{folder}:/usr/bin:/bin", "RUNTIME_DIRECTORY": str(folder), "SERVICE_RESULT": result,
             "EXIT_STATUS": status},
    )  # fmt: skip
    assert not done.stderr
    return done.stdout.strip()


def test_restarts_back_off(tmp_path: Path):
    assert [delay(tmp_path, "watchdog", "ABRT") for _ in range(8)] == ["1", "2", "4", "8", "16", "20", "20", "20"]
    assert delay(tmp_path, "exit-code", "2") == ""  # the user's mistake: there will be no restart
    long_ago = time.time() - 660
    os.utime(tmp_path / "failures", (long_ago, long_ago))
    assert delay(tmp_path, "exit-code", "1") == "1"
    assert delay(tmp_path, "success", "0") == ""
    assert delay(tmp_path, "signal", "SEGV") == "1"


def test_the_units_group_is_the_one_that_is_made_and_given(tmp_path: Path):
    conf = FOLDER / "sysusers.d" / "robominer-slam.conf"
    (tmp_path / "etc").mkdir()
    subprocess.run([tool("systemd-sysusers"), f"--root={tmp_path}", str(conf)], check=True, timeout=30)
    group = (tmp_path / "etc" / "group").read_text().split(":")[0]
    assert group in settings()["SupplementaryGroups"][0].split()
    rules = (FOLDER / "udev" / "70-robominer-slam.rules").read_text()
    assert set(re.findall(r'GROUP="([^"]*)"', rules)) == {group}


def test_drivers_are_loaded_for_all_kinds_of_devices_that_are_allowed():
    lines = (FOLDER / "modules-load.d" / "robominer-slam.conf").read_text().splitlines()
    modules = {line for line in lines if line and not line.startswith("#")}
    allowed = set(settings()["DeviceAllow"])
    assert {"char-ttyACM rw", "char-ttyUSB rw"} <= allowed
    assert {"cdc_acm", "usbserial"} <= modules


def test_udev_rules_are_well_formed():
    """Every line is a list of KEY{attribute} operator "value", as udev(7) says."""
    term = r"(?:ACTION|SUBSYSTEM|SUBSYSTEMS|KERNEL|ENV\{\w+\}|ATTRS?\{\w+\}|GROUP|MODE|TAG|SYMLINK|IMPORT\{\w+\})"
    rule = re.compile(rf'{term}(?:==|!=|\+=|=)"[^"]*"(?:,\s*{term}(?:==|!=|\+=|=)"[^"]*")*')
    text = (FOLDER / "udev" / "70-robominer-slam.rules").read_text().replace("\\\n", "")
    rules = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert len(rules) >= 4
    for line in rules:
        assert rule.fullmatch(line), line
