"""Which sensor is whose, and how it is turned, from an operator who bends one whisker after the other.

A magnet is the same all round its rod, so the field's turn tells the direction of the bend in the sensor's own axes:
the dipole's transverse field points against the tilt (`polynomial.dipole_coordinates`). Two bends in known directions
give the sensor's rotation about the rod, and whether they agree tells a mistaken bend or a sensor that is mirrored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.capture_labels import CaptureError
from calibration.polynomial import dipole_coordinates

FloatArray = NDArray[np.float64]

#: Directions in base_link that an operator understands.
DIRECTIONS: dict[str, FloatArray] = {
    "forward": np.array([1.0, 0.0, 0.0]),
    "left": np.array([0.0, 1.0, 0.0]),
    "up": np.array([0.0, 0.0, 1.0]),
}


@dataclass(frozen=True, slots=True)
class TouchLimits:
    """When a bend is taken for one.

    Attributes:
        change_mT: smallest change of the touched sensor's field, mT: ten times its noise.
        runner_up: largest change of any other sensor, relative; a second whisker must not be bent as well.
        disagreement: between the two bends, rad; hands are good for some 20 deg.
        along: cosine between rod and direction above which one cannot bend a rod that way.
    """

    change_mT: float = 1.2
    runner_up: float = 0.6
    disagreement: float = float(np.deg2rad(35.0))
    along: float = 0.7


def bend_directions(R_base_whisker: FloatArray, limits: TouchLimits | None = None) -> tuple[str, str]:
    """Names of the two directions in which to bend a whisker, of its mount rotation (3, 3)."""
    along = (limits or TouchLimits()).along
    usable = [name for name, d in DIRECTIONS.items() if abs(float(d @ R_base_whisker[:, 2])) < along]
    return usable[0], usable[1]


def touched_sensor(rest_mT: FloatArray, field_mT: FloatArray, limits: TouchLimits | None = None) -> int:
    """Place of the sensor whose field changed most.

    Args:
        rest_mT: shape (n, 3), mT; zeros where a sensor is dead.
        field_mT: mean field during the bend, shape (n, 3), mT.
        limits: see there.

    Raises:
        CaptureError: none changed enough, or two changed alike.
    """
    limit = limits or TouchLimits()
    alive = rest_mT.any(axis=1) & field_mT.any(axis=1)
    change = np.where(alive, np.linalg.norm(field_mT - rest_mT, axis=1), 0.0)
    order = np.argsort(change)[::-1]
    first = int(order[0])
    if change[first] < limit.change_mT:
        raise CaptureError(f"no sensor's field changed by {limit.change_mT:g} mT (the most was {change[first]:.2f} mT)")
    if len(order) > 1 and change[order[1]] > limit.runner_up * change[first]:
        raise CaptureError(
            f"two sensors changed alike ({change[first]:.1f} and {change[order[1]]:.1f} mT): bend one whisker only"
        )
    return first


def bend_azimuth(rest_mT: FloatArray, field_mT: FloatArray) -> float:
    """Direction of a bend in the sensor's own axes, rad, of one whisker's fields (3,), mT."""
    turned = dipole_coordinates(field_mT, rest_mT) - dipole_coordinates(rest_mT, rest_mT)
    return float(np.arctan2(-turned[1], -turned[0]))


def mount_rotation(
    R_base_whisker: FloatArray, bends: dict[str, float], limits: TouchLimits | None = None
) -> tuple[FloatArray, float]:
    """Mount rotation whose x-axis is the sensor's, from the nominal one and two bends.

    Args:
        R_base_whisker: nominal mount rotation, shape (3, 3); its z-axis is the rod at rest and stays.
        bends: direction's name to the azimuth measured (`bend_azimuth`), rad.
        limits: see there.

    Returns:
        The rotation, shape (3, 3), and the angle by which the bends disagree, rad.

    Raises:
        CaptureError: the bends do not agree.
    """
    limit = limits or TouchLimits()
    nominal = {}
    for name in bends:
        x, y, _ = R_base_whisker.T @ DIRECTIONS[name]
        nominal[name] = float(np.arctan2(y, x))
    turns = np.exp(1j * np.array([nominal[name] - bends[name] for name in bends]))
    disagreement = float(abs(np.angle(turns[0] * np.conj(turns[-1]))))
    if disagreement > limit.disagreement:
        mirrored = np.exp(1j * np.array([nominal[name] + bends[name] for name in bends]))
        hint = ""
        if abs(np.angle(mirrored[0] * np.conj(mirrored[-1]))) < limit.disagreement:
            hint = ": they are mirrored; was one bent to the other side?"
        raise CaptureError(
            f"the bends {' and '.join(bends)} disagree by {np.rad2deg(disagreement):.0f} deg, "
            f"expected at most {np.rad2deg(limit.disagreement):.0f}{hint}"
        )
    turn = float(np.angle(turns.sum()))
    c, s = np.cos(turn), np.sin(turn)
    R_nominal_sensor = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return R_base_whisker @ R_nominal_sensor, disagreement
