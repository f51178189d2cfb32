"""The robot's devices: ports, who may open them, their drivers, and the whiskers' calibration."""

from __future__ import annotations

import grp
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from calibration.file_format import CalibrationFileError
from drivers.port_discovery import PortNameError, check_port_name, find_paths
from robominer_slam.configuration.array import calibrated_array
from robominer_slam.configuration.device_section import DeviceSection
from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.configuration.model import Configuration
from robominer_slam.doctor.finding import Finding
from robominer_slam.layout import LayoutError

#: Kernel modules by the names that they give their ports.
MODULES = {"ttyACM": "cdc_acm", "ttyUSB": "usbserial"}
#: The group of the udev rules in `systemd/`; where it is missing they are not installed.
GROUP = "robominer-devices"


def check_devices(configuration: Configuration, folder: Path, root: Path = Path("/")) -> Iterator[Finding]:
    """Check every device of a configuration.

    Args:
        configuration: the daemon's.
        folder: of its file.
        root: of the file system, for /sys.
    """
    for device in configuration.device:
        yield port(device)
    yield from modules(configuration.device, root)
    if configuration.robot.role != "drivers":
        yield calibration(configuration, folder)


def port(device: DeviceSection) -> Finding:
    """Whether a device's port is there and may be opened."""
    check = f"device {device.name}"
    try:
        check_port_name(device.port)
    except PortNameError as error:
        return Finding(check, "error", str(error), "edit the configuration")
    paths = find_paths(device.port)
    if not paths:
        mend = "plug it in; ls -l /dev/robominer/*/ shows what is there; dmesg | tail says why one is not"
        return Finding(check, "error", f"{device.port} is not there", mend)
    openable = [path for path in paths if os.access(path, os.R_OK | os.W_OK)]
    if not openable:
        return _closed(check, paths[0])
    return Finding(check, "ok", f"{device.port} is there" + (f": {', '.join(openable)}" * (openable != [device.port])))


def _closed(check: str, path: str) -> Finding:
    status = Path(path).stat()
    try:
        group = grp.getgrgid(status.st_gid).gr_name
    except KeyError:
        group = str(status.st_gid)
    text = f"you may not open {path} (mode {status.st_mode & 0o777:o}, group {group})"
    if group == "root" or status.st_mode & 0o060 != 0o060:
        mend = "install systemd/udev/70-robominer-slam.rules, then: udevadm control --reload && udevadm trigger"
        return Finding(check, "error", text, mend)
    return Finding(check, "error", text, f"sudo usermod -aG {group} $USER, and log in anew")


def modules(devices: Sequence[DeviceSection], root: Path = Path("/")) -> Iterator[Finding]:
    """Drivers of the ports: without them the service's DeviceAllow= means nothing when it starts."""
    named = {module for tty, module in MODULES.items() if any(tty in _real(device.port) for device in devices)}
    if any(device.port == "auto" or device.port.startswith("usb:") for device in devices):
        named = set(MODULES.values())
    for module in sorted(named):
        if (root / "sys/module" / module).exists():
            yield Finding("kernel", "ok", f"{module} is loaded")
        else:
            mend = f"sudo modprobe {module}; install systemd/modules-load.d/robominer-slam.conf"
            yield Finding("kernel", "warning", f"{module} is not loaded: no port of its kind can be used", mend)


def _real(port_name: str) -> str:
    return str(Path(port_name).resolve()) if port_name.startswith("/") else port_name


def calibration(configuration: Configuration, folder: Path) -> Finding:
    """Whether the whiskers' calibration is there and of this layout."""
    try:
        array = calibrated_array(configuration, folder)
    except (ConfigurationError, CalibrationFileError, LayoutError) as error:
        text = " ".join(str(error).split())
        return Finding("calibration", "error", text, "robominer-slam calibrate fit, or mend robot.layout")
    layout = array.layout
    whiskers = int(layout.present.sum())
    return Finding(
        "calibration", "ok", f"of layout {layout.name}: {whiskers} whiskers on {layout.rows} x {layout.cols}"
    )
