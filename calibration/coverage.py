"""Whether a capture covers enough to determine the model; if not, what is missing, in one line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.polynomial import FloatArray
from calibration.samples import FitError, FloorFrames, JigSamples, RingSamples, Samples

#: Less than ten times the sensor's noise is no magnet.
MIN_REST_FIELD_MT = 1.5
MIN_SAMPLES = 24
MIN_INCLINATION_RANGE = np.deg2rad(20.0)
#: Inclination below which a sample counts as rest.
REST_INCLINATION = np.deg2rad(1.0)
AZIMUTH_SECTORS = 8
#: Azimuths farther apart than this leave the model to guess, rad; eight directions are 45 deg apart.
LARGEST_GAP = np.deg2rad(75.0)
MIN_DRAG_DIRECTIONS = 4
MIN_HEIGHTS = 2
MIN_RING_PLATES = 2
#: A drag shorter than this leaves the rods where they were laid, m.
MIN_DRAG = 0.02


@dataclass(frozen=True, slots=True)
class Coverage:
    """What the samples of one whisker cover: how many, largest inclination (rad), eighths of the azimuth visited.

    The eighths are centred on 0, 45, ... 315 deg.
    """

    samples: int
    max_inclination: float
    sectors: tuple[bool, ...]


def coverage_of(inclination: FloatArray, azimuth: FloatArray) -> Coverage:
    """Coverage of samples of one whisker, shape (m,) each, rad."""
    bent = inclination > REST_INCLINATION
    sector = np.round(azimuth[bent] / (2 * np.pi) * AZIMUTH_SECTORS).astype(int) % AZIMUTH_SECTORS
    visited = set(sector.tolist())
    reach = float(inclination.max(initial=0.0))
    return Coverage(len(inclination), reach, tuple(s in visited for s in range(AZIMUTH_SECTORS)))


def check_coverage(inclination: FloatArray, azimuth: FloatArray, whisker: str) -> None:
    """Refuse samples of one whisker that cannot determine the model.

    Raises:
        FitError: too few samples, no rest, too small a range of inclination, azimuths not visited.
    """
    found = coverage_of(inclination, azimuth)
    if found.samples < MIN_SAMPLES:
        raise FitError(f"{whisker}: {found.samples} samples, expected at least {MIN_SAMPLES}")
    if inclination.min() > REST_INCLINATION:
        raise FitError(f"{whisker}: no sample at rest (inclination up to {np.rad2deg(REST_INCLINATION):.0f} deg)")
    if found.max_inclination < MIN_INCLINATION_RANGE:
        reach = np.rad2deg(found.max_inclination)
        raise FitError(f"{whisker}: inclination reaches {reach:.0f} deg, expected at least 20 deg")
    around = np.sort(azimuth[inclination > REST_INCLINATION])
    gap = np.diff(np.append(around, around[0] + 2.0 * np.pi))
    wide = np.flatnonzero(gap > LARGEST_GAP)
    if len(wide):
        names = ", ".join(f"{np.rad2deg(around[k]):.0f} to {np.rad2deg(around[k] + gap[k]):.0f}" for k in wide)
        raise FitError(f"{whisker}: no samples at azimuths {names} deg")


def check_capture(samples: Sequence[Samples]) -> None:
    """Refuse a capture that cannot determine the model, whatever its number of samples.

    Raises:
        FitError: ring plates of one size, a floor at one height or in too few directions, no real drag.
    """
    if any(isinstance(each, JigSamples) for each in samples):
        return
    plates: set[float] = set()
    heights: set[float] = set()
    directions: set[int] = set()
    for each in samples:
        if isinstance(each, RingSamples):
            bent = each.inclination[each.inclination > REST_INCLINATION]
            plates |= set(np.round(np.rad2deg(bent), 1).tolist())
        elif isinstance(each, FloorFrames):
            dragged = each.dragged >= MIN_DRAG
            if not dragged.any():
                raise FitError(f"the floor capture has no drag of {MIN_DRAG * 1e2:.0f} cm or more: drag farther")
            heights |= set(np.round(each.height[dragged] * 1e3).tolist())
            degrees = np.round(np.rad2deg(each.direction[dragged]) / 10.0) % 36
            directions |= set(degrees.astype(int).tolist())
    if heights and len(heights) < MIN_HEIGHTS:
        raise FitError(f"the floor was dragged at one height only, expected at least {MIN_HEIGHTS}")
    if heights and len(directions) < MIN_DRAG_DIRECTIONS:
        raise FitError(
            f"the floor was dragged in {len(directions)} direction{'s' * (len(directions) > 1)} only, "
            f"expected at least {MIN_DRAG_DIRECTIONS}, all around"
        )
    if plates and not heights and len(plates) < MIN_RING_PLATES:
        raise FitError(f"ring plates of one size only ({min(plates):g} deg), expected at least {MIN_RING_PLATES}")
