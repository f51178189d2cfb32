"""`doctor` on the robot: ports, rights, drivers, calibration, clock, disk, memory; each with what mends it."""

from __future__ import annotations

import json
import os
import pty
import shutil
import stat
from collections import namedtuple
from pathlib import Path

import pytest
from click.testing import CliRunner

from robominer_slam.cli.doctor import doctor
from robominer_slam.configuration.device_section import DeviceSection
from robominer_slam.doctor import board_checks, device_checks

Usage = namedtuple("Usage", "total used free")


def device(port: str) -> DeviceSection:
    return DeviceSection(name="imu", port=port)


def test_a_port_that_is_there():
    ours, theirs = pty.openpty()
    found = device_checks.port(device(os.ttyname(theirs)))
    os.close(ours)
    os.close(theirs)
    assert (found.check, found.level) == ("device imu", "ok")


def test_a_port_that_is_not_there_or_can_never_be(tmp_path: Path):
    found = device_checks.port(device(str(tmp_path / "ttyACM0")))
    assert (found.level, "is not there" in found.message) == ("error", True)
    assert "/dev/robominer" in found.mend
    assert "expected an absolute path" in device_checks.port(device("ttyACM0")).message


@pytest.mark.parametrize(
    ("mode", "group", "mend"),
    [(0o660, "dialout", "usermod -aG dialout $USER"), (0o600, "dialout", "udevadm"), (0o660, "root", "udevadm")],
)
def test_a_port_that_one_may_not_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode, group, mend):
    path = tmp_path / "ttyACM0"
    path.touch(mode)
    path.chmod(mode)
    monkeypatch.setattr(device_checks.os, "access", lambda *_: False)  # root may open everything
    monkeypatch.setattr(device_checks.grp, "getgrgid", lambda _: namedtuple("Group", "gr_name")(group))
    found = device_checks.port(device(str(path)))
    assert found.level == "error"
    assert f"group {group}" in found.message
    assert f"mode {stat.S_IMODE(mode):o}" in found.message
    assert mend in found.mend


def test_drivers_of_the_kinds_of_ports_that_are_named(tmp_path: Path):
    (tmp_path / "sys/module/cdc_acm").mkdir(parents=True)
    assert list(device_checks.modules([device("/dev/ttyS1")], tmp_path)) == []
    found = list(device_checks.modules([device("/dev/ttyACM0")], tmp_path))
    assert [(f.level, f.message) for f in found] == [("ok", "cdc_acm is loaded")]
    found = list(device_checks.modules([device("usb:2341:0043")], tmp_path))
    assert [f.level for f in found] == ["ok", "warning"]
    assert "modprobe usbserial" in found[1].mend


def test_a_clock_that_nobody_keeps():
    assert board_checks.clock(0).level == "ok"
    found = board_checks.clock(board_checks.TIME_ERROR)
    assert found.level == "warning"
    assert "chrony" in found.mend
    assert board_checks._clock_state() in range(6)  # the kernel's real answer


@pytest.mark.parametrize(("free_MB", "level"), [(10, "error"), (200, "warning"), (5000, "ok")])
def test_room_for_the_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free_MB: int, level: str):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(0, 0, free_MB * 1_000_000))
    found = board_checks.disk(tmp_path / "not" / "yet" / "map.db")
    assert found.level == level
    assert f"{tmp_path}: {free_MB} MB free" in found.message


@pytest.mark.parametrize(("available_kB", "level"), [(100_000, "warning"), (800_000, "ok")])
def test_memory(tmp_path: Path, available_kB: int, level: str):
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/meminfo").write_text(
        f"MemTotal: 1000000 kB\nMemAvailable: {available_kB} kB\nHugePages_Total: 0\n"
    )
    assert board_checks.memory(tmp_path).level == level


def test_the_whole_on_a_configuration(tmp_path: Path):
    config = tmp_path / "config.toml"
    config.write_text(
        f'[store]\npath = "{tmp_path}/map.db"\n'
        '[[device]]\nname = "whiskers"\nport = "/dev/robominer/nothing"\ncalibration = "calibration.json"\n'
    )
    done = CliRunner().invoke(doctor, ["--config", str(config), "--json"])
    found = {f["check"]: f for f in json.loads(done.output)}
    assert done.exit_code == 1
    assert {"configuration", "network", "device whiskers", "calibration", "clock", "disk", "memory"} <= set(found)
    assert "calibrate fit" in found["calibration"]["mend"]
    assert all(f["mend"] for f in found.values() if f["level"] != "ok")
    config.write_text(config.read_text().replace("[store]", '[robot]\nrole = "drivers"\n[store]'))
    done = CliRunner().invoke(doctor, ["--config", str(config), "--json"])
    assert "calibration" not in {f["check"] for f in json.loads(done.output)}  # that board needs none
