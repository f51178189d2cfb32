"""Writes what the daemon needs to run on the simulated robot: configuration, calibration and jig table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import tomlkit
from scipy.spatial.transform import Rotation

from calibration.file_format import to_text
from calibration.fit import JigSamples, fit_array
from robominer_slam.layout import WhiskerLayout
from sim_backend.jig import jig_sweep, to_csv

CONFIGURATION, CALIBRATION, JIG_TABLE = "config.toml", "calibration.json", "jig.csv"
BAUD = 115200
#: A calibration of a simulated array was made on the day its recordings begin.
ROBOT_ID = "rm3"
CALIBRATION_DATE = "2021-06-01"


@dataclass(frozen=True, slots=True)
class Port:
    """A simulated device: what it measures (whiskers, imu, screws, odometry), and its keys in the configuration."""

    role: str
    keys: Mapping[str, str | int]


def framed_port(role: str, path: Path) -> Port:
    """A device of the `framed` protocol."""
    return Port(role, {"name": role, "port": str(path), "protocol": "framed", "baud": BAUD})


def configuration_text(
    ports: Sequence[Port],
    layout: str,
    *,
    ticks_per_turn: int,
    mount_rpy_deg: tuple[float, float, float],
    source: str,
    method: str | None,
    store: Path,
    listen: str,
    robot_id: str = ROBOT_ID,
) -> str:
    """A configuration for the daemon (interfaces, section 5).

    Args:
        ports: of the devices; one that the source does not use is left out.
        layout: of the array: a built-in name or a file.
        ticks_per_turn: of the screws' encoders.
        mount_rpy_deg: of the IMU.
        source: `fused` or `odometry`.
        method: of SLAM; None leaves the daemon's default.
        store: where the daemon keeps its map.
        listen: Zenoh endpoint of the daemon.
        robot_id: part of every Zenoh key.
    """
    document = tomlkit.document()
    document.add(tomlkit.comment("Written by `robominer-slam simulate` for the simulated robot."))
    document["robot"] = {"id": robot_id, "layout": layout, "role": "all"}
    devices = tomlkit.aot()
    for port in ports:
        name = port.role
        if name not in USED_BY_SOURCE[source]:
            continue
        device = tomlkit.table()
        device.update(port.keys)
        if name == "whiskers":
            device["calibration"] = CALIBRATION
        if name == "screws" and port.keys["protocol"] == "framed":
            device["ticks_per_turn"] = ticks_per_turn
        if name == "imu" and any(mount_rpy_deg):
            device["mount_rpy_deg"] = _mount_of_device(mount_rpy_deg, str(port.keys["protocol"]))
        devices.append(device)
    document["device"] = devices
    document["estimation"] = {"source": source}
    if method is not None:
        document["slam"] = {"method": method}
    document["store"] = {"path": str(store)}
    document["zenoh"] = {"listen": [listen], "connect": []}
    return tomlkit.dumps(document)


def _mount_of_device(mount_rpy_deg: tuple[float, float, float], protocol: str) -> list[float]:
    """Roll, pitch, yaw, deg, of the axes in which a device speaks: a MicroStrain's z points down (interfaces, 1.5)."""
    roll, pitch, yaw = mount_rpy_deg
    mount = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True)
    if protocol == "mip":
        mount = mount * Rotation.from_euler("X", 180.0, degrees=True)
    return [round(float(angle), 9) for angle in mount.as_euler("ZYX", degrees=True)[::-1]]


#: Devices that each source of odometry needs.
USED_BY_SOURCE = {"fused": ("whiskers", "imu", "screws"), "odometry": ("whiskers", "odometry")}


def write_calibration(folder: Path, layout: WhiskerLayout, seed: int) -> str:
    """Sweep the array that `seed` stands for in the jig and fit it, as a roboticist would.

    Writes the jig table and the calibration into `folder`.

    Returns:
        The calibration file's text.

    Raises:
        OSError: a file cannot be written.
    """
    rows = jig_sweep(layout, seed)
    (folder / JIG_TABLE).write_text(to_csv(rows), encoding="utf-8")
    report = fit_array([JigSamples.from_rows(rows.tolist())], layout)
    text = to_text(
        report,
        array_id=f"sim-{seed}",
        layout=layout.name,
        rows=layout.rows,
        cols=layout.cols,
        date=CALIBRATION_DATE,
    )
    (folder / CALIBRATION).write_text(text + "\n", encoding="utf-8")
    return text
