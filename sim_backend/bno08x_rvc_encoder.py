"""A BNO080/085 in UART-RVC mode: attitude and specific force in packets of 19 bytes.

Written from the interface description alone (section 1.4, after the BNO08X data sheet's section on UART-RVC).
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]

HEADER = b"\xaa\xaa"
#: One milli-g, m/s2.
MILLI_G = 9.80665e-3
_BODY = struct.Struct("<B6h3x")
#: Below this share of the field there is no telling where down is, m/s2.
_LEAST_GRAVITY = 1.0


def packet(index: int, yaw_pitch_roll_deg: FloatArray, acceleration: FloatArray) -> bytes:
    """One packet.

    Args:
        index: counts packets, modulo 256.
        yaw_pitch_roll_deg: attitude, shape (3,), degrees; yaw is applied first, then pitch, then roll.
        acceleration: specific force, shape (3,), m/s2.
    """
    angles = _steps(yaw_pitch_roll_deg / 0.01)
    force = _steps(acceleration / MILLI_G)
    body = _BODY.pack(index & 0xFF, *angles, *force)
    return HEADER + body + bytes([sum(body) & 0xFF])


class Bno08xRvcEncoder:
    """Turns IMU samples into packets with attitude, as the chip's own filter would.

    The chip finds down well: roll and pitch come from the true direction of gravity. Its heading has no reference
    in this mode: yaw starts at zero and adds up the gyro's readings, with their bias and noise.
    """

    def __init__(self) -> None:
        """Switch the chip on."""
        self._index = 0
        self._attitude = Rotation.identity()
        self._before_ns: int | None = None

    def sample(
        self,
        time_ns: int,
        gyro: FloatArray,
        gravity: FloatArray,
        acceleration: FloatArray,
    ) -> bytes:
        """The packet for one sample.

        Args:
            time_ns: simulated time.
            gyro: angular rate in simulated time, shape (3,), rad/s, in the chip's axes.
            gravity: part of the specific force that gravity makes, shape (3,), m/s2; zero: roll and pitch are
                integrated too.
            acceleration: specific force to report, shape (3,), m/s2.
        """
        elapsed = 0.0 if self._before_ns is None else (time_ns - self._before_ns) * 1e-9
        self._before_ns = time_ns
        self._attitude = self._attitude * Rotation.from_rotvec(gyro * elapsed)
        strength = float(np.linalg.norm(gravity))
        if strength > _LEAST_GRAVITY:
            up = gravity / strength
            # The least rotation that brings up where gravity says it is leaves the heading alone.
            believed = self._attitude.apply(up)
            axis = np.cross(believed, [0.0, 0.0, 1.0])
            sine = float(np.linalg.norm(axis))
            if sine > 0.0:
                angle = np.arctan2(sine, believed[2])
                self._attitude = Rotation.from_rotvec(axis * (angle / sine)) * self._attitude
        made = packet(self._index, self._attitude.as_euler("ZYX", degrees=True), acceleration)
        self._index = (self._index + 1) & 0xFF
        return made


def _steps(values: FloatArray) -> list[int]:
    return [int(value) for value in np.clip(np.rint(values), -32768, 32767)]
