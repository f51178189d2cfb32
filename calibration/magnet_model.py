"""Physical whisker model: a cylinder magnet on a tilting lever over a 3-axis Hall sensor.

The rod turns about x, then about the turned y (Nagel 2021, figure 9). The magnet sits on the rod behind the joint;
its field outside is that of a dipole plus the next axial multipoles (l = 3, 5, 7) of two charged discs:

    B = k / r^3 (sum_l g_l P'_(l+1)(c) r_hat - sum_l g_l P'_l(c) a),    c = r_hat . a,
    g_l = <s^l P_l>_disc / (half_height r^(l-1)),    k = remanence volume / (4 pi)

(minus the gradient of c_l P_l / r^(l+1); Jackson, Classical Electrodynamics, chapters 3 and 5). Against the exact
cylinder this errs by less than 0.1 % at the nominal gap. The sensor is rotated, its axes have gains, and a constant
background (Earth, resting neighbours) adds to the field. Lengths here are in mm, fields in mT.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.polynomial import FloatArray

PARAMETERS = (
    "magnet_tilt_x_rad", "magnet_tilt_y_rad", "offset_x_mm", "offset_y_mm", "arm_mm", "gap_mm", "log_strength",
    "rotation_x_rad", "rotation_y_rad", "rotation_z_rad", "gain_x", "gain_y", "gain_z",
    "background_x_mT", "background_y_mT", "background_z_mT",
)  # fmt: skip
COUNT = len(PARAMETERS)
STRENGTH, ROTATION, GAIN, BACKGROUND = 6, slice(7, 10), slice(10, 13), slice(13, 16)
#: Steps of the finite differences: rad or mm; rounding and curvature are both below 1e-6 of the derivative.
STEP = 1e-5


@dataclass(frozen=True, slots=True)
class NominalWhisker:
    """Drawing of a whisker's foot, and how far one that was built may be from it (one standard deviation).

    Attributes:
        diameter_mm, height_mm: of the magnet.
        remanence_T: of the magnet, along the rod.
        arm_mm: distance of the magnet's centre behind the joint, away from the tip.
        gap_mm: distance from the magnet's centre to the sensor at rest.
        magnet_tilt_rad: spread of the magnet's axis against the rod, about x and about y.
        offset_spread_mm: spread of the magnet's centre across the rod.
        arm_spread_mm, gap_spread_mm: of the two distances.
        strength_spread: relative; wide, as the field at rest tells it anyway and magnets of other makes are used.
        rotation_spread_rad: of the sensor, about each axis.
        gain_spread: of each sensor axis, relative.
        background_spread_mT: Earth's field and all resting neighbours.
        noise_mT: of a reading, with the steps of its converter (TLV493D: 0.12 mT; 0.098 mT / sqrt(12)).
    """

    diameter_mm: float = 5.0
    height_mm: float = 4.0
    remanence_T: float = 1.2
    arm_mm: float = 0.75
    gap_mm: float = 7.5
    magnet_tilt_rad: float = float(np.deg2rad(2.5))
    offset_spread_mm: float = 0.25
    arm_spread_mm: float = 0.05
    gap_spread_mm: float = 0.3
    strength_spread: float = 0.3
    rotation_spread_rad: float = float(np.deg2rad(3.0))
    gain_spread: float = 0.03
    background_spread_mT: float = 0.3
    noise_mT: float = 0.123

    def mean(self) -> FloatArray:
        """Parameters of the drawing, shape (16,)."""
        mean = np.zeros(COUNT)
        mean[4], mean[5] = self.arm_mm, self.gap_mm
        mean[GAIN] = 1.0
        return mean

    def spread(self) -> FloatArray:
        """Standard deviations of the parameters, shape (16,)."""
        return np.array(
            [self.magnet_tilt_rad] * 2 + [self.offset_spread_mm] * 2
            + [self.arm_spread_mm, self.gap_spread_mm, self.strength_spread]
            + [self.rotation_spread_rad] * 3 + [self.gain_spread] * 3 + [self.background_spread_mT] * 3
        )  # fmt: skip

    @property
    def moment_mT_mm3(self) -> float:
        """Strength k of the dipole: on its axis the field is 2 k / r^3."""
        volume = np.pi * (self.diameter_mm / 2.0) ** 2 * self.height_mm
        return float(1e3 * self.remanence_T * volume / (4.0 * np.pi))

    def multipoles(self) -> tuple[float, float, float]:
        """<s^l P_l>_disc / half height for l = 3, 5, 7: mm2, mm4, mm6."""
        b, a = self.height_mm / 2.0, self.diameter_mm / 2.0
        # Mean over the disc: s^2 is uniform in [0, a^2]; four nodes are exact for these polynomials.
        node, weight = np.polynomial.legendre.leggauss(4)
        radius = np.sqrt(b * b + a * a * (node + 1.0) / 2.0)
        mean = [
            float(np.sum(weight * radius**degree * np.polynomial.Legendre.basis(degree)(b / radius))) / 2.0 / b
            for degree in (3, 5, 7)
        ]
        return mean[0], mean[1], mean[2]


def rod_direction(tilt: FloatArray) -> FloatArray:
    """Rod directions in the whisker frame, shape (..., 3), of tilt vectors (..., 2), rad."""
    phi = np.sqrt(np.square(tilt).sum(axis=-1))
    # np.sinc is sin(pi x) / (pi x), which is smooth at zero.
    return np.concatenate([tilt * np.sinc(phi / np.pi)[..., None], np.cos(phi)[..., None]], axis=-1)


class MagnetModel:
    """Fields of n whiskers for their tilts; all whiskers and samples at once."""

    def __init__(self, nominal: NominalWhisker, polarity: FloatArray) -> None:
        """Whiskers of this drawing; polarity, shape (n,), is -1 where the magnet is mounted the other way up."""
        self.nominal = nominal
        self.polarity = polarity
        self._moment = nominal.moment_mT_mm3
        self._multipoles = nominal.multipoles()

    def field(self, parameters: FloatArray, tilt: FloatArray) -> FloatArray:
        """Fields in sensor axes, shape (n, m, 3), mT.

        Args:
            parameters: shape (n, 16), as `PARAMETERS`.
            tilt: tilt vectors, shape (n, m, 2), rad.
        """
        return self._sense(parameters, self._own_field(parameters, tilt))

    def sensor_axes(self, parameters: FloatArray) -> FloatArray:
        """From whisker axes to readings, gains in them, shape (n, 3, 3)."""
        turned: FloatArray = Rotation.from_rotvec(-parameters[:, ROTATION]).as_matrix()
        return parameters[:, GAIN, None] * turned

    def moments_mT_mm3(self, parameters: FloatArray) -> FloatArray:
        """Strengths of the magnets, with their signs, shape (n,)."""
        strength: FloatArray = self.polarity * self._moment * np.exp(parameters[:, STRENGTH])
        return strength

    def linearised(self, parameters: FloatArray, tilt: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fields (n, m, 3), their derivatives by the parameters (n, m, 3, 16), and by the tilt (n, m, 3, 2)."""
        own = self._own_field(parameters, tilt)
        axes = self.sensor_axes(parameters)
        field = self._sense(parameters, own)
        by_parameter = np.empty((*field.shape, COUNT))
        for k in range(STRENGTH):
            moved = parameters.copy()
            moved[:, k] += STEP
            by_parameter[..., k] = _turn(axes, (self._own_field(moved, tilt) - own) / STEP)
        by_parameter[..., STRENGTH] = _turn(axes, own)
        whole = own + parameters[:, None, BACKGROUND]
        for k in range(3):
            moved = parameters.copy()
            moved[:, ROTATION.start + k] += STEP
            by_parameter[..., ROTATION.start + k] = _turn((self.sensor_axes(moved) - axes) / STEP, whole)
            by_parameter[..., GAIN.start + k] = 0.0
            by_parameter[..., k, GAIN.start + k] = field[..., k] / parameters[:, None, GAIN.start + k]
            by_parameter[..., BACKGROUND.start + k] = axes[:, None, :, k]
        return field, by_parameter, self._by_tilt(parameters, tilt, own, axes)

    def field_and_tilt_jacobian(self, parameters: FloatArray, tilt: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fields (n, m, 3) and their derivatives by the tilt (n, m, 3, 2)."""
        own = self._own_field(parameters, tilt)
        return self._sense(parameters, own), self._by_tilt(parameters, tilt, own, self.sensor_axes(parameters))

    def _by_tilt(self, parameters: FloatArray, tilt: FloatArray, own: FloatArray, axes: FloatArray) -> FloatArray:
        steps = np.eye(2) * STEP
        parts = [_turn(axes, (self._own_field(parameters, tilt + step) - own) / STEP) for step in steps]
        return np.stack(parts, axis=-1)

    def _sense(self, parameters: FloatArray, own: FloatArray) -> FloatArray:
        return _turn(self.sensor_axes(parameters), own + parameters[:, None, BACKGROUND])

    def _own_field(self, parameters: FloatArray, tilt: FloatArray) -> FloatArray:
        """Field of each whisker's own magnet at its sensor, whisker axes, shape (n, m, 3), mT."""
        tilt_x, tilt_y, offset_x, offset_y, arm, gap = (parameters[:, k, None] for k in range(STRENGTH))
        dx, dy, dz = np.moveaxis(rod_direction(tilt), -1, 0)
        c1 = np.sqrt(np.maximum(1.0 - dx * dx, 1e-12))
        s0, c0 = -dy / c1, dz / c1
        # Columns of the rod's rotation: (c1, s0 dx, -c0 dx), (0, c0, s0), (dx, dy, dz).
        angle = np.sqrt(tilt_x**2 + tilt_y**2)
        ax, ay, az = tilt_y * np.sinc(angle / np.pi), -tilt_x * np.sinc(angle / np.pi), np.cos(angle)
        axis = (ax * c1 + az * dx, ax * s0 * dx + ay * c0 + az * dy, -ax * c0 * dx + ay * s0 + az * dz)
        rx = -(offset_x * c1 - arm * dx)
        ry = -(offset_x * s0 * dx + offset_y * c0 - arm * dy)
        rz = -arm - gap - (-offset_x * c0 * dx + offset_y * s0 - arm * dz)
        inverse = 1.0 / np.sqrt(rx * rx + ry * ry + rz * rz)
        rx, ry, rz = rx * inverse, ry * inverse, rz * inverse
        c = rx * axis[0] + ry * axis[1] + rz * axis[2]
        x, near = c * c, inverse * inverse
        c3, c5, c7 = self._multipoles
        g3, g5, g7 = c3 * near, c5 * near**2, c7 * near**3
        along = c * (
            3.0
            + g3 * (35.0 * x - 15.0) / 2.0
            + g5 * ((1386.0 * x - 1260.0) * x + 210.0) / 16.0
            + g7 * (((51480.0 * x - 72072.0) * x + 27720.0) * x - 2520.0) / 128.0
        )
        back = (
            1.0
            + g3 * (15.0 * x - 3.0) / 2.0
            + g5 * ((315.0 * x - 210.0) * x + 15.0) / 8.0
            + g7 * (((3003.0 * x - 3465.0) * x + 945.0) * x - 35.0) / 16.0
        )
        scale = self.moments_mT_mm3(parameters)[:, None] * inverse**3
        along, back = scale * along, scale * back
        return np.stack([along * r - back * a for r, a in zip((rx, ry, rz), axis, strict=True)], axis=-1)


def _turn(matrix: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors (n, m, 3) by one matrix per whisker (n, 3, 3)."""
    turned: FloatArray = vectors @ matrix.swapaxes(-1, -2)
    return turned


def fold(field_mT: FloatArray) -> FloatArray:
    """What the RM3 firmware sends: all three components negated where Bz < 0 (interfaces, 1.2); shape (..., 3)."""
    folded: FloatArray = np.where(field_mT[..., 2:] < 0.0, -field_mT, field_mT)
    return folded
