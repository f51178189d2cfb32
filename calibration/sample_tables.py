"""From the table of samples to what the fits work on: as the device sends it, padded per whisker, checked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import FOLD_MARGIN_MT, as_sent
from calibration.coverage import MIN_REST_FIELD_MT, REST_INCLINATION, check_coverage
from calibration.polynomial import FloatArray
from calibration.samples import FitError, Pose

#: Near the fold (`FOLD_MARGIN_MT`) with directions alone, as a share of the field.
FOLD_MARGIN_DIRECTION = 0.06


def as_calibrated(table: Pose, representation: str, folded: bool) -> Pose:
    """The samples as the device of this representation sends them."""
    return replace(table, field_mT=as_sent(table.field_mT, representation, folded))


def near_fold(field_mT: FloatArray, representation: str) -> NDArray[np.bool_]:
    """Which readings are so near to Bz = 0 that noise decides whether they are folded; shape of field without 3."""
    margin = FOLD_MARGIN_MT if representation == "Cartesian" else FOLD_MARGIN_DIRECTION
    near: NDArray[np.bool_] = np.abs(field_mT[..., 2]) < margin
    return near


def padded(whisker: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Samples by whisker, all padded to the same number.

    Args:
        whisker: of each sample, shape (s,).

    Returns:
        whiskers that have samples, shape (k,); their samples, shape (k, m); 1 or 0 for a padding one, shape (k, m).
    """
    members, count = np.unique(whisker, return_counts=True)
    order = np.argsort(whisker, kind="stable")
    start = np.cumsum(count) - count
    slot = np.arange(int(count.max()))
    here = slot < count[:, None]
    index = order[np.where(here, start[:, None] + slot, start[:, None])]
    return members, index, here.astype(np.float64)


def check_each(table: Pose, index: NDArray[np.intp], weight: FloatArray, members: NDArray[np.intp], cols: int) -> None:
    """Refuse whiskers whose samples do not cover enough; raises FitError with the reason."""
    for i, samples, used in zip(members, index, weight, strict=True):
        mine = samples[used > 0.0]
        azimuth = table.azimuth[mine].copy()
        unknown = np.isinf(table.azimuth_sigma[mine])
        if unknown.any():
            # A dipole's transverse field points against its tilt: good enough for sectors.
            field = table.field_mT[mine]
            azimuth[unknown] = np.arctan2(-field[unknown, 1], -field[unknown, 0])
        check_coverage(table.inclination[mine], azimuth, f"whisker ({i // cols}, {i % cols})")


def rest_fields(
    table: Pose,
    index: NDArray[np.intp],
    weight: FloatArray,
    members: NDArray[np.intp],
    cols: int,
    representation: str,
) -> FloatArray:
    """Median field of the samples at rest, shape (k, 3), mT; of length 1 for directions.

    Raises:
        FitError: too weak a field for a magnet.
    """
    rest = np.zeros((len(members), 3))
    for k, (i, samples, used) in enumerate(zip(members, index, weight, strict=True)):
        mine = samples[used > 0.0]
        rest[k] = np.median(table.field_mT[mine[table.inclination[mine] <= REST_INCLINATION]], axis=0)
        strength = float(np.sqrt(np.square(rest[k]).sum()))
        if representation == "Direction":
            rest[k] /= strength
        elif strength < MIN_REST_FIELD_MT:
            raise FitError(f"whisker ({i // cols}, {i % cols}): {strength:.2f} mT at rest: is its magnet there?")
    return rest
