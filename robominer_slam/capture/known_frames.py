"""The frames of a capture with the angles that were given: for checking and for reports."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.capture_labels import CaptureStep
from calibration.check import KnownFrames
from calibration.samples import FloorFrames, poses
from robominer_slam.capture.recording import Capture
from robominer_slam.layout import WhiskerLayout

FloatArray = NDArray[np.float64]


def known_frames(capture: Capture) -> list[KnownFrames]:
    """Each step of a capture that has frames."""
    result = []
    for label, field, usable in capture.steps():
        if len(field):
            inclination, azimuth = given_angles(label.done, capture.layout)
            result.append(KnownFrames(field, usable, inclination, azimuth, label.done.is_rest))
    return result


def given_angles(step: CaptureStep, layout: WhiskerLayout) -> tuple[FloatArray, FloatArray]:
    """Inclination and azimuth that a step gives each whisker, shape (n,) each, rad; NaN where it gives none."""
    n = layout.count
    inclination, azimuth = np.full(n, np.nan), np.full(n, np.nan)
    if step.method == "floor" and not step.is_rest:
        one = FloorFrames(
            np.array([step.height_m or 0.0]),
            np.deg2rad([step.direction_deg or 0.0]),
            np.array([step.dragged_m or 0.0]),
            np.ones((1, n, 3)),
            np.ones((1, n), dtype=np.bool_),
        )
        table = poses([one], layout.rows, layout.cols, layout)
        inclination[table.whisker], azimuth[table.whisker] = table.inclination, table.azimuth
        return inclination, azimuth
    meant = layout.present.copy()
    if step.row is not None and step.col is not None:
        meant[:] = False
        meant[step.row * layout.cols + step.col] = True
    inclination[meant] = np.deg2rad(step.inclination_deg or 0.0)
    if step.azimuth_deg is not None:
        azimuth[meant] = np.deg2rad(step.azimuth_deg)
    return inclination, azimuth
