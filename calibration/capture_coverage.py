"""Whether what was captured in a step is enough: per whisker, at once, so that the operator can repeat it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.capture_labels import CaptureStep
from calibration.polynomial import dipole_coordinates

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

SECTORS = 8


@dataclass(frozen=True, slots=True)
class CoverageLimits:
    """What a step must show.

    Attributes:
        frames: fewest readings of a whisker in a step at one pose.
        still_mT: largest standard deviation of a held whisker's field, mT: three times the sensor's noise.
        moved_mT: smallest change from rest that counts as bent, mT: five times the sensor's noise.
        ring_sectors: fewest of the eight sectors of azimuth that a ring sweep must visit.
        ring_tilt_deg: dipole tilt above which a reading tells its azimuth.
    """

    frames: int = 5
    still_mT: float = 0.4
    moved_mT: float = 0.6
    ring_sectors: int = 8
    ring_tilt_deg: float = 3.0


@dataclass(frozen=True, slots=True)
class StepCoverage:
    """What a step showed, per whisker; shapes (n,).

    Attributes:
        frames: valid readings.
        deviation_mT: standard deviation of the field over the step (all axes), mT.
        change_mT: largest change of the field from rest, mT; NaN before rest is known.
        sectors: sectors of azimuth visited.
        enough: whether this whisker's readings are enough.
        problem: what is wrong, in one sentence that names whiskers; empty if nothing.
    """

    frames: NDArray[np.intp]
    deviation_mT: FloatArray
    change_mT: FloatArray
    sectors: NDArray[np.intp]
    enough: BoolArray
    problem: str


def step_coverage(
    step: CaptureStep,
    field_mT: FloatArray,
    valid: BoolArray,
    wanted: BoolArray,
    rest_mT: FloatArray | None,
    cols: int,
    limits: CoverageLimits | None = None,
) -> StepCoverage:
    """Judge a step.

    Args:
        step: what was to be done.
        field_mT: shape (m, n, 3), mT.
        valid: shape (m, n).
        wanted: whiskers that the step is about and that exist, shape (n,).
        rest_mT: field at rest, shape (n, 3), mT; None before it is known.
        cols: of the array, for names.
        limits: what is asked for.
    """
    limit = limits or CoverageLimits()
    usable = valid & field_mT.any(axis=-1)
    frames = np.count_nonzero(usable, axis=0)
    weight = usable[..., None] / np.maximum(frames, 1)[:, None]
    mean = (field_mT * weight).sum(axis=0)
    deviation = np.sqrt((np.square(field_mT - mean) * weight).sum(axis=(0, 2)))
    n = len(wanted)
    change, sectors = np.full(n, np.nan), np.zeros(n, dtype=np.intp)
    if rest_mT is not None and len(field_mT):
        change = np.where(usable, np.linalg.norm(field_mT - rest_mT, axis=-1), 0.0).max(axis=0)
        u = dipole_coordinates(field_mT, rest_mT) - dipole_coordinates(rest_mT, rest_mT)
        sector = np.floor((np.arctan2(u[..., 1], u[..., 0]) + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS
        tells = usable & (np.hypot(u[..., 0], u[..., 1]) > np.deg2rad(limit.ring_tilt_deg))
        sectors = np.array([len(np.unique(sector[tells[:, i], i])) for i in range(n)], dtype=np.intp)
    faults: dict[str, BoolArray] = {f"fewer than {limit.frames} readings": frames < limit.frames}
    held = step.method == "jig" or step.is_rest
    if held:
        faults["not held still"] = deviation > limit.still_mT
    if not step.is_rest and rest_mT is not None:
        faults["not bent: the field is that of rest"] = change < limit.moved_mT
    if step.method == "rings" and not step.is_rest:
        faults[f"not all round: fewer than {limit.ring_sectors} of 8 sectors"] = sectors < limit.ring_sectors
    bad = np.zeros(n, dtype=np.bool_)
    parts = []
    for reason, mask in faults.items():
        found = np.flatnonzero(mask & wanted & ~bad)
        if len(found):
            parts.append(f"{reason}: {_names(found, cols)}")
            bad[found] = True
    return StepCoverage(frames, deviation, change, sectors, ~bad, "; ".join(parts))


def _names(places: NDArray[np.intp], cols: int) -> str:
    shown = ", ".join(f"({i // cols}, {i % cols})" for i in places[:6])
    return shown if len(places) <= 6 else f"{shown} and {len(places) - 6} more"
