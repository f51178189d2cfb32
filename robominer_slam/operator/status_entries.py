"""What the robot says of itself in `status`, and what of it is a fault in words."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.ros_messages import deserialize
from robominer_slam.publishing.report_messages import DIAGNOSTIC_ARRAY, Level
from robominer_slam.publishing.telemetry import Health

#: Keys of single whiskers in the entry `whiskers`, as `status_report.py` writes them.
_WHISKER = re.compile(r"whisker \((\d+), (\d+)\)")
_PLACE = re.compile(r"\((\d+), (\d+)\)")

HEALTH_WORDS = {
    Health.WHISKERS_SILENT: "The whiskers' device sends nothing",
    Health.IMU_SILENT: "The IMU sends nothing",
    Health.SCREWS_SILENT: "The screws' encoders send nothing",
    Health.WHISKERS_FAULTY: "Some whiskers give no usable reading",
    Health.CLOCK_NOT_SYNCHRONISED: "A device's clock is not synchronised yet",
    Health.BACKEND_LATE: "Loop search is late: the map lags",
    Health.STORE_FAILING: "The map is not being stored on the robot's disk",
    Health.PAUSED: "Mapping is paused",
    Health.MEASUREMENTS_DROPPED: "The robot's computer is overloaded: measurements were dropped",
}


@dataclass(frozen=True, slots=True)
class StatusEntry:
    """One part of the robot's program: how it is, and figures."""

    name: str
    level: Level
    message: str
    values: Mapping[str, str]


def entries_of(payload: bytes) -> list[StatusEntry]:
    """The entries of a DiagnosticArray.

    Raises:
        MessageError: bytes that are none.
    """
    return [
        StatusEntry(
            str(entry.name),
            Level(int(entry.level)),
            str(entry.message),
            {value.key: value.value for value in entry.values},
        )
        for entry in deserialize(payload, DIAGNOSTIC_ARRAY).status
    ]


def whisker_faults(entries: Sequence[StatusEntry], cols: int) -> dict[int, str]:
    """Whiskers that are left out, by index: what the robot says of each, such as `stuck for 12 s`."""
    faults: dict[int, str] = {}
    for entry in entries:
        if entry.name != "whiskers":
            continue
        for row, col in _PLACE.findall(entry.values.get("invalid", "")):
            faults[int(row) * cols + int(col)] = "no usable reading"
        for key, state in entry.values.items():
            if found := _WHISKER.fullmatch(key):
                faults[int(found[1]) * cols + int(found[2])] = state
    return faults


def faults_in_words(entries: Sequence[StatusEntry], health: Health) -> list[str]:
    """What is wrong, worst first, one line each; what telemetry says is left out where an entry says more."""
    wrong = sorted((entry for entry in entries if entry.level is not Level.OK), key=lambda entry: -entry.level)
    words = [f"{entry.name}: {entry.message}" for entry in wrong]
    whiskers_told = any(entry.name == "whiskers" for entry in wrong)
    devices_told = any(entry.name.startswith("device/") for entry in wrong)
    store_told = any(entry.name == "store" for entry in wrong)
    told = Health.FINE
    if whiskers_told:
        told |= Health.WHISKERS_FAULTY
    if devices_told:
        told |= Health.WHISKERS_SILENT | Health.IMU_SILENT | Health.SCREWS_SILENT | Health.CLOCK_NOT_SYNCHRONISED
    if store_told:
        told |= Health.STORE_FAILING
    return words + [text for bit, text in HEALTH_WORDS.items() if health & bit & ~told]
