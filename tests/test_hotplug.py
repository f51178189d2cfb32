"""Ports that vanish, come back under other names, carry the wrong device, or wedge."""

from __future__ import annotations

import logging
import os
import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest
import usb.backend
import usb.core

from drivers import port_resets, serial_reader
from drivers.measurement import HallFrame, ImuSample
from drivers.port_discovery import find_paths
from drivers.serial_reader import SerialReader
from drivers.settings import Carries, DeviceSettings
from drivers.usb_recovery import UsbResetError, reset
from tests.test_serial_reader import FakeDevice, first, wait_for_state

HALL = [(0x01, struct.pack("<BBHB12h", 2, 2, 600, 0x0F, *range(12)))]


def settings(folder: Path, kind: Carries) -> DeviceSettings:
    return DeviceSettings(kind, f"{folder}/tty*", carries=kind)


def test_two_devices_on_one_pattern_are_not_mixed_up(tmp_path):
    # The first name has the device that the first section does not want.
    imu, whiskers = FakeDevice(tmp_path / "tty0"), FakeDevice(tmp_path / "tty1", HALL)
    try:
        with SerialReader([settings(tmp_path, "whiskers"), settings(tmp_path, "imu")]) as reader:
            first(reader, HallFrame)
            first(reader, ImuSample)
            assert [Path(s.path or "").name for s in reader.status()] == ["tty1", "tty0"]
            end = time.monotonic() + 0.5
            while time.monotonic() < end:
                name, measurement = reader.get(1.0)
                assert name == ("whiskers" if isinstance(measurement, HallFrame) else "imu")
    finally:
        imu.close()
        whiskers.close()


def test_nothing_is_written_to_a_port_that_is_only_listened_to(tmp_path):
    """It may be a motor's."""
    pings = []

    class Motor(FakeDevice):
        def send(self, kind: int, sequence: int, payload: bytes) -> None:
            if kind == 0x71:
                pings.append(kind)
            else:
                super().send(kind, sequence, payload)

    motor = Motor(tmp_path / "tty0", [(0x33, b"not for us")])
    try:
        with SerialReader([settings(tmp_path, "whiskers")]) as reader:
            deadline = time.monotonic() + 3.0
            while "not found" not in reader.status()[0].fault and time.monotonic() < deadline:
                reader.get(0.02)
            status = reader.status()[0]
    finally:
        motor.close()
    assert "not found" in status.fault
    assert pings == []


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_twenty_replugs_half_of_them_under_another_name(tmp_path, caplog):
    other = FakeDevice(tmp_path / "tty_other", HALL)
    device = FakeDevice(tmp_path / "tty0")
    caplog.set_level(logging.INFO, serial_reader.__name__)
    took, name = [], "tty0"
    try:
        with SerialReader([settings(tmp_path, "imu"), settings(tmp_path, "whiskers")]) as reader:
            first(reader, ImuSample)
            first(reader, HallFrame)
            before = open_files()
            for cycle in range(20):
                device.close()
                (tmp_path / name).unlink(missing_ok=True)
                wait_for_state(reader, "absent")
                name = f"tty{cycle}" if cycle % 2 else name
                device = FakeDevice(tmp_path / name)
                back = time.monotonic()
                first(reader, ImuSample)
                took.append(time.monotonic() - back)
                first(reader, HallFrame)
            assert open_files() <= before
            assert reader.status()[1].counters.get("faults", 0) == 0
    finally:
        device.close()
        other.close()
    # A busy machine may stop all of this for a second, once.
    assert sorted(took)[-2] < 2.0
    assert sorted(took)[len(took) // 2] < 1.0
    # Gone, not there, found, streaming: four lines a cycle at most.
    assert len([r for r in caplog.records if "device imu" in r.getMessage()]) <= 4 * 20 + 4


AUTO_IN_A_NAMESPACE = """
import os, time
from pathlib import Path
from drivers.serial_reader import SerialReader
from drivers.settings import Carries, DeviceSettings
from tests.test_hotplug import HALL
from tests.test_serial_reader import FakeDevice, first, wait_for_state
from drivers.measurement import HallFrame, ImuSample
dev = Path("/dev")
imu, whiskers = FakeDevice(dev / "ttyACM0"), FakeDevice(dev / "ttyACM1", HALL)
with SerialReader([DeviceSettings(n, "auto", carries=n) for n in ("whiskers", "imu")]) as reader:
    first(reader, HallFrame), first(reader, ImuSample)
    assert [s.path for s in reader.status()] == ["/dev/ttyACM1", "/dev/ttyACM0"], reader.status()
    whiskers.close()
    (dev / "ttyACM1").unlink(missing_ok=True)
    wait_for_state(reader, "absent")
    whiskers = FakeDevice(dev / "ttyUSB7", HALL)
    back = time.monotonic()
    first(reader, HallFrame)
    assert time.monotonic() - back < 2.0
    assert [s.path for s in reader.status()] == ["/dev/ttyUSB7", "/dev/ttyACM0"], reader.status()
imu.close(); whiskers.close()
print("found")
"""
#: A /dev of its own with nothing but pseudo-terminals in it.
OWN_DEV = """
set -e
mount -t tmpfs none {new}
mkdir {new}/pts
mount --rbind /dev/pts {new}/pts
ln -s pts/ptmx {new}/ptmx
for one in null urandom random zero; do touch {new}/$one; mount --bind /dev/$one {new}/$one; done
mount --move {new} /dev
exec "$@"
"""


def test_auto_finds_devices_under_other_names_in_a_dev_of_their_own(tmp_path):
    if shutil.which("unshare") is None:
        pytest.skip("no unshare on this machine")
    enter = ["unshare", "-Urm", "sh", "-c", OWN_DEV.format(new=tmp_path), "sh"]
    trial = subprocess.run([*enter, "true"], capture_output=True, text=True, timeout=20, check=False)
    if trial.returncode:
        pytest.skip(f"the kernel does not let us mount in a namespace: {trial.stderr.strip()}")
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run(
        [*enter, sys.executable, "-c", AUTO_IN_A_NAMESPACE],
        capture_output=True, text=True, timeout=60, check=False, cwd=root, env={**os.environ, "PYTHONPATH": str(root)},
    )  # fmt: skip
    assert done.stdout.strip() == "found", done.stderr


class Descriptor:
    """What pyusb asks of a device descriptor."""

    def __init__(self, vendor: int, product: int, address: int) -> None:
        self.bLength, self.bDescriptorType, self.bcdUSB = 18, 1, 0x200
        self.bDeviceClass, self.bDeviceSubClass, self.bDeviceProtocol, self.bMaxPacketSize0 = 2, 0, 0, 64
        self.idVendor, self.idProduct, self.bcdDevice = vendor, product, 0x100
        self.iManufacturer, self.iProduct, self.iSerialNumber, self.bNumConfigurations = 0, 0, 0, 1
        self.address, self.bus, self.port_number, self.port_numbers, self.speed = address, 1, address, (address,), 2


class FakeUsb(usb.backend.IBackend):
    """A bus with these devices; notes which are reset."""

    def __init__(self, *devices: Descriptor, refuses: bool = False) -> None:
        self.devices, self.refuses, self.resets = devices, refuses, []

    def enumerate_devices(self):
        return iter(self.devices)

    def get_device_descriptor(self, dev):
        return dev

    def open_device(self, dev):
        if self.refuses:
            raise usb.core.USBError("Access denied (insufficient permissions)", errno=13)
        return dev

    def close_device(self, dev_handle):
        pass

    def reset_device(self, dev_handle):
        self.resets.append(dev_handle.address)


def test_the_right_usb_device_is_reset():
    bus = FakeUsb(Descriptor(0x2341, 0x43, 1), Descriptor(0x2341, 0x44, 2))
    reset(0x2341, 0x44, None, backend=bus)
    assert bus.resets == [2]


def test_a_reset_that_cannot_work_says_why():
    one = Descriptor(0x2341, 0x43, 1)
    with pytest.raises(UsbResetError, match="no USB device 2341:0044"):
        reset(0x2341, 0x44, None, backend=FakeUsb(one))
    with pytest.raises(UsbResetError, match="2 USB devices 2341:0043: name one by its serial number"):
        reset(0x2341, 0x43, None, backend=FakeUsb(one, Descriptor(0x2341, 0x43, 2)))
    with pytest.raises(UsbResetError, match=r"refused: .*Access denied"):
        reset(0x2341, 0x43, None, backend=FakeUsb(one, refuses=True))


@pytest.mark.parametrize("refuses", [False, True])
def test_a_wedged_device_is_reset_with_longer_and_longer_waits_while_others_go_on(tmp_path, monkeypatch, refuses):
    monkeypatch.setattr(port_resets, "usb_port", lambda path: (0x2341, 0x43, None) if "imu" in path else None)
    monkeypatch.setattr(serial_reader, "FIRST_RESET_NS", 200_000_000)
    monkeypatch.setattr("drivers.open_port.FIRST_RESET_NS", 200_000_000)
    bus = FakeUsb(Descriptor(0x2341, 0x43, 1), refuses=refuses)
    imu, whiskers = FakeDevice(tmp_path / "imu"), FakeDevice(tmp_path / "whiskers", HALL)
    try:
        names = [DeviceSettings(n, str(tmp_path / n)) for n in ("imu", "whiskers")]
        with SerialReader(names, usb_backend=bus) as reader:
            first(reader, ImuSample)
            # It hangs: open, but it says nothing and answers nothing.
            imu.stop.set()
            imu.thread.join()
            end, frames = time.monotonic() + 6.0, 0
            while reader.status()[0].counters.get("resets", 0) < 2 and time.monotonic() < end:
                item = reader.get(0.1)
                frames += item is not None and isinstance(item[1], HallFrame)
            assert reader.status()[0].counters["resets"] == 2
            wait_for_state(reader, "silent")
            assert frames > 50
            assert reader.status()[1].state == "streaming"
            # It is silent for a moment only: a third reset may have come meanwhile.
            assert set(bus.resets) == (set() if refuses else {1})
            assert len(bus.resets) <= 3
    finally:
        imu.close()
        whiskers.close()


def test_a_pattern_names_what_is_there(tmp_path):
    for name in ("ttyX1", "ttyX0", "other"):
        (tmp_path / name).touch()
    assert [Path(p).name for p in find_paths(f"{tmp_path}/ttyX*")] == ["ttyX0", "ttyX1"]
    assert find_paths(f"{tmp_path}/ttyX*", frozenset({str(tmp_path / "ttyX0")})) == [str(tmp_path / "ttyX1")]
