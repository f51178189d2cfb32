"""What goes wrong when: faults of sensors and lines, from a file or drawn from a seed.

A file is TOML, one table for each fault:

    [[fault]]
    kind = "whisker_dead"
    row = 3
    col = 5
    start = 10.0        # s of simulated time
    end = 20.0          # absent: a kind's usual length, or to the end of the drive
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

from sim_backend.random_streams import stream

Target: TypeAlias = Literal["whisker", "screw", "imu", "device"]
Value: TypeAlias = float | str
#: Screws by the index that a fault names them with.
SCREWS = ("front_right", "rear_right", "rear_left", "front_left")


class FaultFileError(ValueError):
    """A fault file that cannot be used; the text is one line for the user."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault: what it befalls, its parameters with their usual values, and its usual length, s.

    Parameters whose usual value is a text are texts; numbers must lie within `limits`.
    """

    target: Target
    parameters: Mapping[str, Value] = field(default_factory=dict)
    length: float = math.inf
    limits: tuple[float, float] = (0.0, math.inf)


#: A share of the bytes on a line.
_SHARE = Kind("device", {"rate": 0.001}, limits=(0.0, 1.0))

KINDS: dict[str, Kind] = {
    "whisker_dead": Kind("whisker"),
    "whisker_stuck": Kind("whisker"),
    "whisker_noisy": Kind("whisker", {"sigma_mT": 3.0}),
    "whisker_flipped": Kind("whisker", {"axes": "xyz"}),
    "whisker_broken": Kind("whisker", {"magnet": "kept"}),
    "whisker_bent": Kind("whisker", {"tilt_deg": 5.0, "azimuth_deg": 0.0}, limits=(-360.0, 360.0)),
    "whisker_bus_error": Kind("whisker"),
    "screw_slip": Kind("screw", {"extra_rad_s": 6.0}, limits=(-100.0, 100.0)),
    "imu_silent": Kind("imu"),
    "bytes_lost": _SHARE,
    "bytes_flipped": _SHARE,
    "bytes_duplicated": _SHARE,
    "stall": Kind("device", length=0.6),
    "unplugged": Kind("device", {"name": ""}, length=1.0),
    "clock_drift": Kind("device", {"ppm": 100.0}, limits=(-1e5, 1e5)),
    "clock_jump": Kind("device", {"seconds": 5.0}, limits=(-4000.0, 4000.0)),
    "clock_wrap": Kind("device"),
}


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes:
        kind: a key of `KINDS`.
        start: s of simulated time from the drive's beginning; for `clock_wrap`, from the device's power-up.
        end: when it is over; infinite where it lasts.
        target: (row, col) of a whisker, name of a screw or a device, or None for the IMU.
        parameters: all that the kind has.
    """

    kind: str
    start: float
    end: float = math.inf
    target: tuple[int, int] | str | None = None
    parameters: Mapping[str, Value] = field(default_factory=dict)

    def active(self, time: float) -> bool:
        """Whether it is there at that time, s."""
        return self.start <= time < self.end

    def number(self, name: str) -> float:
        """A parameter that is a number; the kind's usual value where the fault names none."""
        return float(self.parameters.get(name, KINDS[self.kind].parameters[name]))

    def text(self, name: str) -> str:
        """A parameter that is a text; the kind's usual value where the fault names none."""
        return str(self.parameters.get(name, KINDS[self.kind].parameters[name]))


@dataclass(frozen=True, slots=True)
class FaultSchedule:
    """Everything that goes wrong in one drive, ordered by start."""

    faults: tuple[Fault, ...] = ()

    def of_sensors(self) -> tuple[Fault, ...]:
        """Those that the sensors' readings show."""
        return tuple(fault for fault in self.faults if KINDS[fault.kind].target != "device")

    def of_device(self, *names: str) -> tuple[Fault, ...]:
        """Those of a device's line and clock, by any of its names."""
        return tuple(f for f in self.faults if KINDS[f.kind].target == "device" and f.target in names)


def load_faults(path: Path) -> FaultSchedule:
    """The schedule in a file.

    Raises:
        FaultFileError: it cannot be read, or a fault in it makes no sense.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FaultFileError(f"{path}: cannot read the faults: {error.strerror}") from error
    except ValueError as error:
        raise FaultFileError(f"{path}: not a TOML file: {error}") from error
    tables = document.pop("fault", [])
    if document or not isinstance(tables, list):
        unknown = ", ".join(document) or "fault"
        raise FaultFileError(f"{path}: expected only [[fault]] tables, found {unknown!r}")
    return _ordered(_parsed(table, f"{path}: fault {number}") for number, table in enumerate(tables, 1))


def random_faults(
    seed: int,
    duration: float,
    *,
    rows: int = 8,
    cols: int = 8,
    devices: tuple[str, ...] = ("whiskers", "imu", "screws"),
    count: int = 12,
) -> FaultSchedule:
    """A drive's worth of faults of any kinds: the same for the same arguments.

    Args:
        seed: of the draw.
        duration: of the drive, s; every fault begins in its first nine tenths and lasts 2 s to a fifth of it,
            or as long as its kind usually does.
        rows, cols: of the array.
        devices: whose lines may fail.
        count: of faults.
    """
    rng = stream(seed, "faults")
    names = list(KINDS)
    drawn = []
    for _ in range(count):
        name = names[int(rng.integers(len(names)))]
        kind = KINDS[name]
        start = round(float(rng.uniform(0.0, 0.9 * duration)), 3)
        lasts = round(float(rng.uniform(2.0, max(2.0, 0.2 * duration))), 3)
        target: tuple[int, int] | str | None = None
        match kind.target:
            case "whisker":
                target = int(rng.integers(rows)), int(rng.integers(cols))
            case "screw":
                target = SCREWS[int(rng.integers(len(SCREWS)))]
            case "device":
                target = devices[int(rng.integers(len(devices)))]
        end = start + (lasts if math.isinf(kind.length) else kind.length)
        parameters = dict(kind.parameters)
        if name == "unplugged" and rng.random() < 0.5:
            parameters["name"] = f"{target}-again"
        drawn.append(Fault(name, start, end, target, parameters))
    return _ordered(drawn)


def faults_from_option(text: str, duration: float, *, rows: int = 8, cols: int = 8) -> FaultSchedule:
    """The schedule that a command line names: a file, or `seed:N`; arguments as of `random_faults`.

    Raises:
        FaultFileError: no such schedule.
    """
    if not text.startswith("seed:"):
        return load_faults(Path(text))
    number = text.removeprefix("seed:")
    if not number.isdecimal():
        raise FaultFileError(f"{text!r}: expected a file or seed:N with a whole number N")
    return random_faults(int(number), duration, rows=rows, cols=cols)


def _ordered(faults: Iterable[Fault]) -> FaultSchedule:
    return FaultSchedule(tuple(sorted(faults, key=lambda fault: fault.start)))


def _parsed(table: object, where: str) -> Fault:
    if not isinstance(table, dict):
        raise FaultFileError(f"{where}: expected a table")
    rest = dict(table)
    name = rest.pop("kind", None)
    if not isinstance(name, str) or name not in KINDS:
        raise FaultFileError(f"{where}: kind is {name!r}, expected one of {', '.join(KINDS)}")
    kind, where = KINDS[name], f"{where} ({name})"
    target = _target(kind.target, rest, where)
    start = _number(rest.pop("start", 0.0), "start", (0.0, math.inf), where)
    end = _number(rest.pop("end", start + kind.length), "end", (start, math.inf), where)
    parameters: dict[str, Value] = {}
    for key, usual in kind.parameters.items():
        value = rest.pop(key, usual)
        parameters[key] = (
            _text(value, key, where) if isinstance(usual, str) else _number(value, key, kind.limits, where)
        )
    if rest:
        known = ", ".join(kind.parameters) or "none"
        raise FaultFileError(f"{where}: unknown key {next(iter(rest))!r}; its parameters: {known}")
    return Fault(name, start, end, target, parameters)


def _target(kind: Target, rest: dict[str, object], where: str) -> tuple[int, int] | str | None:
    match kind:
        case "whisker":
            return _index(rest.pop("row", None), "row", where), _index(rest.pop("col", None), "col", where)
        case "screw":
            screw = rest.pop("screw", None)
            if screw not in SCREWS:
                raise FaultFileError(f"{where}: screw is {screw!r}, expected one of {', '.join(SCREWS)}")
            return str(screw)
        case "device":
            device = rest.pop("device", None)
            if not isinstance(device, str) or not device:
                raise FaultFileError(f"{where}: device is {device!r}, expected a device's name, such as 'whiskers'")
            return device
    return None


def _index(value: object, key: str, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise FaultFileError(f"{where}: {key} is {value!r}, expected a whole number from 0")
    return value


def _number(value: object, key: str, limits: tuple[float, float], where: str) -> float:
    low, high = limits
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise FaultFileError(f"{where}: {key} is {value!r}, expected a number from {low:g} to {high:g}")
    return float(value)


def _text(value: object, key: str, where: str) -> str:
    if key == "axes" and (not isinstance(value, str) or not value or set(value) - set("xyz")):
        raise FaultFileError(f"{where}: axes is {value!r}, expected some of the letters x, y, z")
    if key == "magnet" and value not in ("kept", "lost"):
        raise FaultFileError(f"{where}: magnet is {value!r}, expected 'kept' or 'lost'")
    if not isinstance(value, str) or "/" in value:
        raise FaultFileError(f"{where}: {key} is {value!r}, expected a name without '/'")
    return value
