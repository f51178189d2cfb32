"""Whether an existing calibration still holds, whisker by whisker, from a short fresh capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.angle_estimator import AngleEstimator
from calibration.polynomial import FloatArray, PolynomialModel, tilt_from_angles

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class CheckLimits:
    """What passes.

    Attributes:
        rest_deg: angle that the calibration reads from a whisker at rest, deg; more spoils every contact.
        noise_mT: standard deviation of the field at rest per axis, mT: three times a sensor's.
        direction_deg: RMS angle between given and predicted directions, deg, on top of which
        direction_sigmas: so many standard deviations of the calibration are allowed.
        missing: share of frames without an angle: a bus that drops more is a fault to mend first.
    """

    rest_deg: float = 2.0
    noise_mT: float = 0.36
    direction_deg: float = 2.0
    direction_sigmas: float = 2.0
    missing: float = 0.2


@dataclass(frozen=True, slots=True)
class KnownFrames:
    """Frames at one known pose.

    Attributes:
        field_mT: shape (k, n, 3), mT.
        usable: shape (k, n).
        inclination: shape (n,), rad; NaN where this whisker is not meant.
        azimuth: shape (n,), rad; NaN where it is not known.
        at_rest: whether nothing touches.
    """

    field_mT: FloatArray
    usable: BoolArray
    inclination: FloatArray
    azimuth: FloatArray
    at_rest: bool


@dataclass(frozen=True, slots=True)
class WhiskerCheck:
    """Figures of one whisker; NaN where the capture says nothing.

    Attributes:
        row, col: place in the array.
        rest_off_mT: change of the rest field since the calibration, mT.
        rest_off_deg: inclination that the calibration reads at rest, deg.
        noise_mT: standard deviation per axis at rest, mT.
        direction_deg: RMS angle between given and predicted directions away from rest, deg.
        worst_deg: the largest of these, deg.
        allowed_deg: limit of `direction_deg`.
        reason: why it fails; empty if it passes.
    """

    row: int
    col: int
    rest_off_mT: float
    rest_off_deg: float
    noise_mT: float
    direction_deg: float
    worst_deg: float
    allowed_deg: float
    reason: str

    @property
    def passed(self) -> bool:
        """Whether the calibration holds for this whisker."""
        return not self.reason


def angle_errors(
    estimator: AngleEstimator, frames: KnownFrames
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Errors of some frames.

    Returns:
        Angle between given and predicted direction (or inclinations, where the azimuth is not known), rad;
        predicted inclination and azimuth, rad; whether it was predicted at all. Shape (k, n) each.
    """
    found = [estimator.angles(field, usable) for field, usable in zip(frames.field_mT, frames.usable, strict=True)]
    inclination = np.array([one.inclination for one in found])
    azimuth = np.array([one.azimuth for one in found])
    valid = np.array([one.valid for one in found])
    known = np.isfinite(frames.azimuth)
    truth = _unit(frames.inclination, np.where(known, frames.azimuth, 0.0))
    cosine = np.sum(_unit(inclination, azimuth) * truth, axis=-1)
    direction = np.arccos(np.clip(cosine, -1.0, 1.0))
    error = np.where(known, direction, np.abs(inclination - frames.inclination))
    return np.where(valid, error, np.nan), inclination, azimuth, valid


def _unit(inclination: FloatArray, azimuth: FloatArray) -> FloatArray:
    tilt = tilt_from_angles(np.sin(inclination), azimuth)
    return np.concatenate([tilt, np.cos(inclination)[..., None]], axis=-1)


def check_array(
    model: PolynomialModel,
    estimator: AngleEstimator,
    cols: int,
    poses: Sequence[KnownFrames],
    limits: CheckLimits | None = None,
) -> list[WhiskerCheck]:
    """Check every calibrated whisker.

    Args:
        model: rest fields and sigmas of the calibration.
        estimator: the same calibration, applied.
        cols: of the array.
        poses: of the capture, one at rest among them.
        limits: what passes.
    """
    limit = limits or CheckLimits()
    n = len(model.rest_mT)
    rest_off, rest_deg, noise = (np.full(n, np.nan) for _ in range(3))
    errors: list[FloatArray] = []
    missing, asked = np.zeros(n, dtype=np.intp), np.zeros(n, dtype=np.intp)
    for pose in poses:
        error, inclination, _, valid = angle_errors(estimator, pose)
        meant = np.isfinite(pose.inclination)
        missing += np.count_nonzero(~valid, axis=0) * meant
        asked += len(pose.field_mT) * meant
        if pose.at_rest:
            count = np.maximum(np.count_nonzero(pose.usable, axis=0), 1)
            weight = pose.usable[..., None] / count[:, None]
            mean = (pose.field_mT * weight).sum(axis=0)
            seen = pose.usable.any(axis=0)
            rest_off = np.where(seen, np.linalg.norm(mean - model.rest_mT, axis=-1), np.nan)
            noise = np.where(seen, np.sqrt((np.square(pose.field_mT - mean) * weight).sum(axis=(0, 2)) / 3.0), np.nan)
            rest_deg = np.rad2deg(_nan_rms(np.where(valid, inclination, np.nan)))
        else:
            errors.append(np.where(meant, error, np.nan))
    stacked = np.rad2deg(np.concatenate(errors)) if errors else np.full((1, n), np.nan)
    direction = _nan_rms(stacked)
    worst = np.where(np.isfinite(stacked).any(axis=0), np.nan_to_num(stacked, nan=0.0).max(axis=0), np.nan)
    allowed = limit.direction_deg + limit.direction_sigmas * np.rad2deg(model.sigma)
    result = []
    for i in np.flatnonzero(model.fitted):
        reasons = []
        if missing[i] > limit.missing * asked[i]:
            reasons.append(f"no angle in {missing[i]} of {asked[i]} frames")
        if rest_deg[i] > limit.rest_deg:
            reasons.append(f"rest is off by {rest_deg[i]:.1f} deg")
        if noise[i] > limit.noise_mT:
            reasons.append(f"noise of {noise[i]:.2f} mT")
        if direction[i] > allowed[i]:
            reasons.append(f"directions are off by {direction[i]:.1f} deg")
        row, col = divmod(int(i), cols)
        result.append(
            WhiskerCheck(
                row=row,
                col=col,
                rest_off_mT=float(rest_off[i]),
                rest_off_deg=float(rest_deg[i]),
                noise_mT=float(noise[i]),
                direction_deg=float(direction[i]),
                worst_deg=float(worst[i]),
                allowed_deg=float(allowed[i]),
                reason="; ".join(reasons),
            )
        )
    return result


def _nan_rms(values: FloatArray) -> FloatArray:
    """RMS over the first axis without NaN; NaN where there is nothing else."""
    finite = np.isfinite(values)
    count = np.count_nonzero(finite, axis=0)
    total = np.sum(np.where(finite, values, 0.0) ** 2, axis=0)
    rms: FloatArray = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
    return rms
