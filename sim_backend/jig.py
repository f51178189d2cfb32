"""The calibration jig: every whisker held at known angles while its sensor is read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.samples import RingSamples
from robominer_slam.layout import WhiskerLayout
from sim_backend.magnet import HallArray
from sim_backend.physics import hinge_angles
from sim_backend.random_streams import stream

FloatArray = NDArray[np.float64]

COLUMNS = ("row", "col", "inclination_deg", "azimuth_deg", "bx_mT", "by_mT", "bz_mT")
INCLINATIONS_DEG = tuple(range(0, 76, 5))
AZIMUTHS_DEG = tuple(range(-165, 181, 15))
PLATES_DEG = (15.0, 30.0, 45.0, 60.0, 72.0)
TOUCHES_DEG = (-180.0, -90.0, 0.0, 90.0)
#: A hand leads a rod to within this of where it should, and a hole has this much play, rad.
TOUCH_ERROR = float(np.deg2rad(5.0))
PLAY = float(np.deg2rad(0.2))


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


def ring_sweep(
    layout: WhiskerLayout,
    seed: int,
    *,
    plates_deg: Sequence[float] = PLATES_DEG,
    readings: int = 48,
    touches_deg: Sequence[float] = TOUCHES_DEG,
    touch_error: float = TOUCH_ERROR,
    play: float = PLAY,
    hall: HallArray | None = None,
) -> RingSamples:
    """Readings of whiskers led around in ring plates one at a time, all others at rest; azimuths are not noted.

    Args:
        layout, seed, hall: as with `jig_sweep`.
        plates_deg: inclinations of the plates' holes.
        readings: per plate, somewhere all round.
        touches_deg: azimuths to which the operator leads each whisker on the largest plate, as in the wizard.
        touch_error: how far from there the operator's hand is, one standard deviation, rad.
        play: of the rod in the hole, one standard deviation, rad.
    """
    array = hall or HallArray(layout, seed)
    rng = stream(seed, "rings")
    n = layout.count
    row, col = np.divmod(np.arange(n), layout.cols)
    nominal = np.deg2rad([0.0] * 5 + [each for each in plates_deg for _ in range(readings)])
    noted = np.full(len(nominal), np.nan)
    nominal = np.concatenate([nominal, np.full(len(touches_deg), np.deg2rad(max(plates_deg)))])
    noted = np.concatenate([noted, np.deg2rad(touches_deg)])
    field = np.empty((len(nominal), n, 3))
    for k, (inclination, azimuth) in enumerate(zip(nominal, noted, strict=True)):
        lean = inclination + (inclination > 0.0) * rng.normal(0.0, play, n)
        known = np.isfinite(azimuth)
        around = azimuth + rng.normal(0.0, touch_error, n) if known else rng.uniform(-np.pi, np.pi, n)
        field[k] = array.sample(array.jig_field(hinge_angles(lean, around)), rng)
    here = np.broadcast_to(layout.present, field.shape[:2])
    return RingSamples(
        np.broadcast_to(row, here.shape)[here],
        np.broadcast_to(col, here.shape)[here],
        np.broadcast_to(nominal[:, None], here.shape)[here],
        np.broadcast_to(noted[:, None], here.shape)[here],
        field[here],
        touch_error,
    )


def to_csv(rows: FloatArray) -> str:
    """The table as the text of a CSV file with a header."""
    lines = [f"{r:.0f},{c:.0f},{i:g},{a:g},{x:.3f},{y:.3f},{z:.3f}" for r, c, i, a, x, y, z in rows]
    return "\n".join([",".join(COLUMNS), *lines]) + "\n"
