"""The steps of a capture, in the order in which they are least work; and plans that the user wrote."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calibration.capture_labels import CaptureError, CaptureStep, Method

#: Columns of a plan in a CSV file; only those that the method needs must be there.
PLAN_COLUMNS = ("wait_s", "row", "col", "inclination_deg", "azimuth_deg", "height_m", "direction_deg", "dragged_m")
NEEDED: dict[Method, tuple[str, ...]] = {
    "jig": ("inclination_deg", "azimuth_deg"),
    "rings": ("inclination_deg",),
    "floor": ("height_m", "direction_deg", "dragged_m"),
}


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """Poses of the built-in plans.

    Attributes:
        jig_inclinations_deg: five make the fifth-degree polynomial determined, from rest to where whiskers still
            touch with their tips.
        azimuths_deg: jig and floor; one in each eighth of the circle.
        ring_inclinations_deg: of the ring plates; two or more sizes.
        floor_tilts_deg: inclinations that the heights stand for.
        drag_m: way of each drag, m: a rod that lay aside by 20 deg has then turned behind it.
    """

    jig_inclinations_deg: tuple[float, ...] = (15.0, 30.0, 45.0, 60.0, 72.0)
    azimuths_deg: tuple[float, ...] = (-180.0, -135.0, -90.0, -45.0, 0.0, 45.0, 90.0, 135.0)
    ring_inclinations_deg: tuple[float, ...] = (15.0, 30.0, 45.0, 60.0)
    floor_tilts_deg: tuple[float, ...] = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
    drag_m: float = 0.06


@dataclass(frozen=True, slots=True)
class PlannedStep:
    """A step, and how long to wait before it without an operator, s; None waits for Enter."""

    step: CaptureStep
    wait_s: float | None = None


def plan(
    method: Method,
    *,
    length: float,
    whiskers: Sequence[tuple[int, int]] = (),
    settings: PlanSettings | None = None,
) -> list[PlannedStep]:
    """The built-in plan of a method; it begins at rest.

    Args:
        method: see `CaptureStep`.
        length: of the rods, m, for the heights of the floor.
        whiskers: with a jig that holds one whisker at a time: which; empty for a jig that holds all at once.
        settings: poses.
    """
    poses = settings or PlanSettings()
    rest = CaptureStep(method, 0.0, 0.0 if method == "jig" else None)
    steps = [rest]
    match method:
        case "jig":
            places: list[tuple[int | None, int | None]] = list(whiskers) or [(None, None)]
            steps += [
                CaptureStep("jig", inclination, azimuth, row=row, col=col)
                for row, col in places
                for inclination in poses.jig_inclinations_deg
                for azimuth in poses.azimuths_deg
            ]
        case "rings":
            steps += [CaptureStep("rings", inclination) for inclination in poses.ring_inclinations_deg]
        case "floor":
            steps += [
                CaptureStep("floor", height_m=round(height, 4), direction_deg=direction, dragged_m=poses.drag_m)
                for height in (length * math.cos(math.radians(tilt)) for tilt in poses.floor_tilts_deg)
                for direction in poses.azimuths_deg
            ]
    return [PlannedStep(step) for step in steps]


def check_plan(inclination_deg: float | None = 30.0) -> list[PlannedStep]:
    """The plan of a short check: rest, and with an inclination four bends of a jig that holds all whiskers."""
    bends = () if inclination_deg is None else (0.0, 90.0, 180.0, -90.0)
    steps = [CaptureStep("jig", 0.0, 0.0), *(CaptureStep("jig", inclination_deg, azimuth) for azimuth in bends)]
    return [PlannedStep(step) for step in steps]


def plan_from_rows(method: Method, rows: Sequence[Mapping[str, str]], where: str) -> list[PlannedStep]:
    """A plan from the rows of a CSV file.

    Raises:
        CaptureError: a column is missing or unknown, or a value is not a number; names file and line.
    """
    planned = []
    for line, row in enumerate(rows, start=2):
        unknown = sorted(set(row) - set(PLAN_COLUMNS), key=str)
        if unknown:
            raise CaptureError(f"{where}: unknown columns {unknown}; expected {', '.join(PLAN_COLUMNS)}")
        try:
            values = {key: float(value) for key, value in row.items() if value not in (None, "")}
        except (TypeError, ValueError):
            raise CaptureError(f"{where}, line {line}: expected numbers") from None
        is_rest = values.get("inclination_deg") == 0.0
        missing = [] if is_rest else [name for name in NEEDED[method] if name not in values]
        if missing:
            raise CaptureError(f"{where}, line {line}: --method {method} needs {', '.join(missing)}")
        wait = values.pop("wait_s", None)
        place = {name: int(values.pop(name)) for name in ("row", "col") if name in values}
        if len(place) == 1:
            raise CaptureError(f"{where}, line {line}: expected row and col, or neither of them")
        if is_rest and method == "jig":
            values.setdefault("azimuth_deg", 0.0)
        step = CaptureStep(
            method,
            inclination_deg=values.get("inclination_deg"),
            azimuth_deg=values.get("azimuth_deg"),
            height_m=values.get("height_m"),
            direction_deg=values.get("direction_deg"),
            dragged_m=values.get("dragged_m"),
            row=place.get("row"),
            col=place.get("col"),
        )
        planned.append(PlannedStep(step, wait))
    if not any(one.step.is_rest for one in planned):
        raise CaptureError(f"{where}: no step at rest; begin with inclination_deg = 0")
    return planned
