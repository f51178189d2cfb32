"""Stiffness of a whisker's joint from weights hung on it (Nagel 2021, section 3.4.2).

The whisker is held with its rod level; a mass m at the distance l2 from the joint turns it by dx to the angle x below
the level. The torque about the joint is T = m g l2 cos x. The joint's stiffness is T / dx, N m/rad. The thesis divides
by the lever l1 between the joint and the flexible membrane as well, k = m g l2 cos x / (dx l1): the membrane's force
per angle, N/rad. So the joint's stiffness is the thesis's value times l1, not times l1 squared; squared it would be
for a spring that is given in N/m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.fit import FitError

FloatArray = NDArray[np.float64]

#: Standard gravity, m/s2; it varies by 0.3 % over the Earth, less than weights and rulers do here.
GRAVITY = 9.80665


@dataclass(frozen=True, slots=True)
class Levers:
    """Lengths of the experiment, m.

    Attributes:
        l1: from the joint to the flexible membrane.
        l2: from the joint to the mass.
        l1_sigma, l2_sigma: their standard deviations.
    """

    l1: float
    l2: float
    l1_sigma: float = 0.0
    l2_sigma: float = 0.0


@dataclass(frozen=True, slots=True)
class WhiskerStiffness:
    """One whisker's joint.

    Attributes:
        whisker: its name in the table.
        loads: readings used.
        joint: stiffness, N m/rad.
        joint_sigma: its standard deviation from the scatter of the angles, N m/rad.
        rest_angle: angle without a load, rad.
        residual: RMS of the angles about the line, rad.
    """

    whisker: str
    loads: int
    joint: float
    joint_sigma: float
    rest_angle: float
    residual: float


@dataclass(frozen=True, slots=True)
class StiffnessReport:
    """Stiffness of the whiskers' joints.

    Attributes:
        whiskers: each by itself.
        joint: mean, N m/rad.
        joint_sigma: standard deviation of the mean, levers included, N m/rad.
        spread: standard deviation from whisker to whisker, N m/rad; zero for one whisker.
        thesis: mean as the thesis gives it, N/rad.
        thesis_sigma: its standard deviation, N/rad.
    """

    whiskers: tuple[WhiskerStiffness, ...]
    joint: float
    joint_sigma: float
    spread: float
    thesis: float
    thesis_sigma: float


def torque(mass: FloatArray, angle: FloatArray, lever: float) -> FloatArray:
    """Torque about the joint, N m, of masses (kg) at `lever` (m) on a rod `angle` (rad) below the level."""
    value: FloatArray = mass * GRAVITY * lever * np.cos(angle)
    return value


def whisker_stiffness(whisker: str, mass: FloatArray, angle: FloatArray, lever: float) -> WhiskerStiffness:
    """Regression of one whisker's angle on the torque: x = x0 + T / k.

    The angle is what is measured with noise, so it is regressed on the torque and not the other way round.

    Args:
        whisker: name, for messages.
        mass: shape (m,), kg; zeros are readings without a load.
        angle: shape (m,), rad, positive or negative.
        lever: l2, m.

    Raises:
        FitError: fewer than two different loads, or an angle that does not change with them.
    """
    if len(np.unique(mass)) < 2:
        raise FitError(f"whisker {whisker}: {len(np.unique(mass))} load, expected two or more (0 is one)")
    if (np.abs(angle) >= np.pi / 2).any() or not np.isfinite([mass, angle]).all() or (mass < 0).any():
        raise FitError(f"whisker {whisker}: expected masses of 0 or more and angles between -90 and 90 deg")
    load = torque(mass, angle, lever)
    features = np.column_stack([load, np.ones_like(load)])
    solution, *_ = np.linalg.lstsq(features, angle, rcond=None)
    compliance, rest = float(solution[0]), float(solution[1])
    error = angle - features @ solution
    freedom = len(mass) - 2
    variance = float(error @ error) / freedom if freedom > 0 else 0.0
    sigma = float(np.sqrt(variance * np.linalg.inv(features.T @ features)[0, 0]))
    if abs(compliance) <= 3.0 * sigma or np.ptp(angle) < 1e-9:
        raise FitError(f"whisker {whisker}: its angle does not change with the load: is it the right column?")
    return WhiskerStiffness(
        whisker,
        len(mass),
        1.0 / abs(compliance),
        sigma / compliance**2,
        rest,
        float(np.sqrt(np.mean(error**2))),
    )


def stiffness(whisker: Sequence[str], mass: FloatArray, angle: FloatArray, levers: Levers) -> StiffnessReport:
    """Stiffness of several whiskers; the mean weighs all alike, since they differ by more than the readings' noise.

    Args:
        whisker: name of each reading's whisker, length m.
        mass: shape (m,), kg.
        angle: shape (m,), rad.
        levers: lengths of the experiment.

    Raises:
        FitError: no readings, or a whisker that cannot be fitted.
    """
    if not len(mass):
        raise FitError("the table of weights has no rows")
    if not (levers.l1 > 0.0 and levers.l2 > 0.0):
        raise FitError(f"levers l1 = {levers.l1:g} m and l2 = {levers.l2:g} m: expected lengths above 0")
    names = np.asarray(whisker)
    each = tuple(
        whisker_stiffness(name, mass[names == name], angle[names == name], levers.l2) for name in dict.fromkeys(whisker)
    )
    values = np.array([one.joint for one in each])
    mean = float(values.mean())
    spread = float(values.std(ddof=1)) if len(each) > 1 else 0.0
    # With several whiskers their spread holds the readings' noise already.
    random = spread / np.sqrt(len(each)) if len(each) > 1 else each[0].joint_sigma
    joint_sigma = float(np.hypot(random, mean * levers.l2_sigma / levers.l2))
    thesis = mean / levers.l1
    thesis_sigma = thesis * float(np.hypot(joint_sigma / mean, levers.l1_sigma / levers.l1))
    return StiffnessReport(each, mean, joint_sigma, spread, thesis, thesis_sigma)
