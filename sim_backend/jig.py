"""The calibration jig: every whisker held at known angles while its sensor is read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robominer_slam.layout import WhiskerLayout
from sim_backend.magnet import HallArray
from sim_backend.physics import hinge_angles
from sim_backend.random_streams import stream

FloatArray = NDArray[np.float64]

COLUMNS = ("row", "col", "inclination_deg", "azimuth_deg", "bx_mT", "by_mT", "bz_mT")
INCLINATIONS_DEG = tuple(range(0, 76, 5))
AZIMUTHS_DEG = tuple(range(-165, 181, 15))


def jig_sweep(
    layout: WhiskerLayout,
    seed: int,
    *,
    inclinations_deg: Sequence[float] = INCLINATIONS_DEG,
    azimuths_deg: Sequence[float] = AZIMUTHS_DEG,
    hall: HallArray | None = None,
) -> FloatArray:
    """Readings of the array that `seed` stands for, one whisker deflected at a time, all others at rest.

    Returns:
        Rows of `COLUMNS`, shape (whiskers * inclinations * azimuths, 7), with noise and quantisation.
    """
    array = hall or HallArray(layout, seed)
    rng = stream(seed, "jig")
    row, col = np.divmod(np.arange(layout.count), layout.cols)
    blocks = []
    for inclination in inclinations_deg:
        for azimuth in azimuths_deg:
            hinge = hinge_angles(*np.deg2rad([inclination, azimuth]))
            field = array.sample(array.jig_field(np.broadcast_to(hinge, (layout.count, 2))), rng)
            angles = np.broadcast_to([inclination, azimuth], (layout.count, 2))
            blocks.append(np.column_stack([row, col, angles, field])[layout.present])
    return np.concatenate(blocks)


def to_csv(rows: FloatArray) -> str:
    """The table as the text of a CSV file with a header."""
    lines = [f"{r:.0f},{c:.0f},{i:g},{a:g},{x:.3f},{y:.3f},{z:.3f}" for r, c, i, a, x, y, z in rows]
    return "\n".join([",".join(COLUMNS), *lines]) + "\n"
