"""Roll and pitch: where `up` is in base_link, from gyro and specific force.

A complementary filter on the unit vector u (up in base_link's axes): du/dt = u x (omega - b + kp (f x u)), where f is
the direction of the specific force less the body's own acceleration, and db/dt = -kp^2 / 4 (f x u) finds the gyro's
horizontal bias (critically damped; Mahony, Hamel and Pflimlin, "Nonlinear complementary filters on the special
orthogonal group", 2008). At first kp = 1 / t, so that the start is the mean of what was measured.

Where gravity has been taken out of the acceleration (which shows: it is far below 9.81 m/s2), up comes from the IMU's
own attitude if it has one, and else from the gyro alone.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

GRAVITY = 9.81
#: An acceleration that differs from gravity by more than this is a shock, m/s2.
SHOCK = 2.0
LEVEL_UP = np.array([0.0, 0.0, 1.0])


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Vector product of two vectors (3,): numpy's own takes ten times as long on so few."""
    ax, ay, az = a
    bx, by, bz = b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


class Tilt:
    """Follows `up`.

    Args:
        time_constant: over which the specific force is averaged, s.

    Attributes:
        up: unit vector in base_link's axes, shape (3,).
        bias: of the gyro, rad/s, shape (3,); the vertical one is not found here.
    """

    def __init__(self, time_constant: float) -> None:
        self.up = LEVEL_UP.copy()
        self.bias = np.zeros(3)
        self._time_constant = time_constant
        self._age = 0.0

    def move(
        self,
        dt: float,
        rate: FloatArray | None,
        acceleration: FloatArray | None,
        own_acceleration: FloatArray,
        orientation_xyzw: FloatArray | None = None,
    ) -> None:
        """Go on by `dt` seconds.

        Args:
            dt: s.
            rate: mean of the gyro, rad/s, shape (3,); None without one.
            acceleration: mean measured, m/s2, shape (3,); None without one.
            own_acceleration: of the body, dv/dt + omega x v, m/s2, shape (3,).
            orientation_xyzw: attitude by the IMU itself; used where gravity is missing.
        """
        toward = self._measured_up(acceleration, own_acceleration, orientation_xyzw)
        turning = np.zeros(3) if rate is None else rate - self.bias
        if toward is not None:
            self._age += dt
            error = cross(toward, self.up)
            gain = 1.0 / min(max(self._age, dt), self._time_constant)
            turning = turning + gain * error
            if self._age >= self._time_constant:
                slow = 0.25 * gain * gain * dt
                self.bias = self.bias - slow * error
        up = self.up + dt * cross(self.up, turning)
        self.up = up / math.sqrt(up @ up)

    def _measured_up(
        self, acceleration: FloatArray | None, own: FloatArray, orientation_xyzw: FloatArray | None
    ) -> FloatArray | None:
        if acceleration is not None:
            force = acceleration - own
            size = math.sqrt(force @ force)
            if abs(size - GRAVITY) <= SHOCK:
                direction: FloatArray = force / size
                return direction
            if size > 0.5 * GRAVITY:
                return None
        if orientation_xyzw is None:
            return None
        x, y, z, w = orientation_xyzw
        return np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])

    def rotation(self) -> FloatArray:
        """From base_link to its levelled frame, Ry(pitch) Rx(roll), shape (3, 3)."""
        ux, uy, uz = self.up
        cos_pitch = math.sqrt(uy * uy + uz * uz)
        sin_roll, cos_roll = uy / cos_pitch, uz / cos_pitch
        sin_pitch = -ux
        return np.array(
            [
                [cos_pitch, sin_pitch * sin_roll, sin_pitch * cos_roll],
                [0.0, cos_roll, -sin_roll],
                [ux, uy, uz],
            ]
        )

    def turn_rate(self, rate: FloatArray) -> float:
        """Rate of the heading about the vertical, rad/s, for a body rate (3,); the vertical bias is left in."""
        _, uy, uz = self.up
        horizontal2 = uy * uy + uz * uz
        return float(((rate[1] - self.bias[1]) * uy + rate[2] * uz) / horizontal2)
