"""Roll and pitch: where `up` is in base_link, from gyro and specific force.

A complementary filter on the unit vector u (up in base_link's axes): du/dt = u x (omega - b + kp (f x u)), where f is
the direction of the specific force less the body's own acceleration, and db/dt = -kp^2 / 4 (f x u) finds the gyro's
horizontal bias (critically damped; Mahony, Hamel and Pflimlin, "Nonlinear complementary filters on the special
orthogonal group", 2008). At first kp = 1 / t, so that the start is the mean of what was measured.

Where gravity has been taken out of the acceleration (which shows: it is far below 9.81 m/s2), up comes from the IMU's
own attitude if it has one, and else from the gyro alone.

Vectors are three floats here: numpy takes ten times as long on so few.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Vector: TypeAlias = tuple[float, float, float]
Rotation: TypeAlias = tuple[Vector, Vector, Vector]

GRAVITY = 9.81
#: An acceleration that differs from gravity by more than this is a shock, m/s2.
SHOCK = 2.0


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    ax, ay, az = a
    bx, by, bz = b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


class Tilt:
    """Follows `up`.

    Args:
        time_constant: over which the specific force is averaged, s.

    Attributes:
        up: unit vector in base_link's axes.
        bias: of the gyro, rad/s; the vertical one is not found here.
    """

    def __init__(self, time_constant: float) -> None:
        self.up: Vector = (0.0, 0.0, 1.0)
        self.bias: Vector = (0.0, 0.0, 0.0)
        self._time_constant = time_constant
        self._age = 0.0

    def move(
        self,
        dt: float,
        rate: Vector | None,
        acceleration: Vector | None,
        own_acceleration: Vector,
        orientation_xyzw: FloatArray | None = None,
    ) -> None:
        """Go on by `dt` seconds.

        Args:
            dt: s.
            rate: mean of the gyro, rad/s; None without one.
            acceleration: mean measured, m/s2; None without one.
            own_acceleration: of the body, dv/dt + omega x v, m/s2.
            orientation_xyzw: attitude by the IMU itself; used where gravity is missing.
        """
        toward = self._measured_up(acceleration, own_acceleration, orientation_xyzw)
        bx, by, bz = self.bias
        wx, wy, wz = (0.0, 0.0, 0.0) if rate is None else (rate[0] - bx, rate[1] - by, rate[2] - bz)
        if toward is not None:
            self._age += dt
            ex, ey, ez = cross(toward, self.up)
            gain = 1.0 / min(max(self._age, dt), self._time_constant)
            wx, wy, wz = wx + gain * ex, wy + gain * ey, wz + gain * ez
            if self._age >= self._time_constant:
                slow = 0.25 * gain * gain * dt
                self.bias = (bx - slow * ex, by - slow * ey, bz - slow * ez)
        x, y, z = self.up
        dx, dy, dz = cross(self.up, (wx, wy, wz))
        x, y, z = x + dt * dx, y + dt * dy, z + dt * dz
        size = math.sqrt(x * x + y * y + z * z)
        self.up = (x / size, y / size, z / size)

    def _measured_up(
        self, acceleration: Vector | None, own: Vector, orientation_xyzw: FloatArray | None
    ) -> Vector | None:
        if acceleration is not None:
            x, y, z = acceleration[0] - own[0], acceleration[1] - own[1], acceleration[2] - own[2]
            size = math.sqrt(x * x + y * y + z * z)
            if abs(size - GRAVITY) <= SHOCK:
                return x / size, y / size, z / size
            if size > 0.5 * GRAVITY:
                return None
        if orientation_xyzw is None:
            return None
        x, y, z, w = orientation_xyzw.tolist()
        return 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)

    def rotation(self) -> Rotation:
        """From base_link to its levelled frame, Ry(pitch) Rx(roll), row by row."""
        ux, uy, uz = self.up
        cos_pitch = math.sqrt(uy * uy + uz * uz)
        sin_roll, cos_roll = uy / cos_pitch, uz / cos_pitch
        sin_pitch = -ux
        ahead = cos_pitch, sin_pitch * sin_roll, sin_pitch * cos_roll
        return ahead, (0.0, cos_roll, -sin_roll), self.up

    def turn_rate(self, rate: Vector) -> float:
        """Rate of the heading about the vertical, rad/s, for a body rate; the vertical bias is left in."""
        _, uy, uz = self.up
        horizontal2 = uy * uy + uz * uz
        return ((rate[1] - self.bias[1]) * uy + rate[2] * uz) / horizontal2
