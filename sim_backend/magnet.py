"""Hall sensors under tilting magnets: what each whisker's sensor reads for its hinge angles.

A whisker's foot carries a small cylinder magnet that tilts with the rod about the joint; under it sits a 3-axis
Hall sensor (Infineon TLV493D). The fields are magpylib's for finite cylinders.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import magpylib
import numpy as np
from numpy.typing import NDArray
from scipy.constants import mu_0
from scipy.spatial.transform import Rotation

from robominer_slam.layout import WhiskerLayout
from sim_backend.random_streams import stream

FloatArray = NDArray[np.float64]
MILLITESLA = 1e3


@dataclass(frozen=True, slots=True)
class MagnetGeometry:
    """Nominal magnet and sensor of a whisker.

    Chosen so that a tilt at rest shows as 0.29 deg per least significant bit, the field stays within a third of
    the sensor's range, and Bz stays positive up to 75 deg, so that firmware that folds negative Bz (interfaces,
    1.2) has nothing to fold.

    Attributes:
        diameter, height: of the magnet, m.
        polarization: remanence along the rod, T (sintered NdFeB).
        arm: distance of the magnet's centre behind the joint, away from the tip, m.
        gap: distance from the magnet's centre to the sensor behind it at rest, m.
    """

    diameter: float = 0.005
    height: float = 0.004
    polarization: float = 1.2
    arm: float = 0.00075
    gap: float = 0.0075


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Manufacturing tolerances, one standard deviation.

    Attributes:
        magnet_tilt: of the magnet against the rod, about x and about y, rad.
        magnet_offset: of the magnet across the rod, in x and in y, m.
        strength: of the magnet, relative.
        sensor_rotation: about each axis, rad.
        gain: of each sensor axis, relative.
        gap: of the sensor's distance, m.
    """

    magnet_tilt: float = float(np.deg2rad(2.5))
    magnet_offset: float = 0.00025
    strength: float = 0.05
    sensor_rotation: float = float(np.deg2rad(3.0))
    gain: float = 0.03
    gap: float = 0.0003


@dataclass(frozen=True, slots=True)
class SensorElectronics:
    """Reading of a TLV493D: noise and step per axis and range, mT (Infineon data sheet, 12 bit)."""

    noise_mT: float = 0.12
    step_mT: float = 0.098
    range_mT: float = 130.0


#: Earth's field in the map frame, mT: 50 uT down and 15 uT horizontal, 30 deg to the left of the map's x-axis.
EARTH_MT = np.array([0.0130, 0.0075, -0.0500])


class HallArray:
    """The Hall sensors of a whole array; every whisker's magnet and sensor are a little different."""

    def __init__(
        self,
        layout: WhiskerLayout,
        seed: int,
        geometry: MagnetGeometry | None = None,
        tolerances: Tolerances | None = None,
        electronics: SensorElectronics | None = None,
    ) -> None:
        """Build the array; the same seed makes the same array."""
        self.layout = layout
        self.geometry = geometry or MagnetGeometry()
        self.electronics = electronics or SensorElectronics()
        spread = tolerances or Tolerances()
        rng = stream(seed, "array tolerances")
        n, g = layout.count, self.geometry
        tilt = np.column_stack([rng.normal(0.0, spread.magnet_tilt, (n, 2)), np.zeros(n)])
        self._R_rod_magnet = Rotation.from_rotvec(tilt)
        self._p_magnet = np.column_stack([rng.normal(0.0, spread.magnet_offset, (n, 2)), np.full(n, -g.arm)])
        strength = g.polarization * (1.0 + rng.normal(0.0, spread.strength, n))
        self._polarization = np.outer(strength, [0.0, 0.0, 1.0])
        self._R_whisker_sensor = Rotation.from_rotvec(rng.normal(0.0, spread.sensor_rotation, (n, 3)))
        self._gain = 1.0 + rng.normal(0.0, spread.gain, (n, 3))
        gap = g.gap + rng.normal(0.0, spread.gap, n)
        self._p_sensor = np.column_stack([np.zeros((n, 2)), -g.arm - gap])
        self._dimensions = np.tile([g.diameter, g.height], (n, 1))
        self._moment = strength / mu_0 * np.pi * (g.diameter / 2.0) ** 2 * g.height
        self._neighbours = self._neighbour_matrix()

    def field(self, hinge: FloatArray, R_map_base: FloatArray) -> FloatArray:
        """Noise-free field at every sensor in its own axes, shape (n, 3), mT.

        Args:
            hinge: hinge angles about x and y of every whisker, shape (n, 2), rad.
            R_map_base: attitude of the robot, shape (3, 3); it turns Earth's field.
        """
        R = _rod_rotation(hinge)
        own = self._own_field(R)
        return self._in_sensor_axes(own + self._neighbour_field(R) + self._earth(R_map_base))

    def sample(self, field_mT: FloatArray, rng: np.random.Generator) -> FloatArray:
        """A reading of fields of shape (..., 3), mT: noise, saturation and the steps of the converter."""
        e = self.electronics
        noisy = field_mT + rng.normal(0.0, e.noise_mT, field_mT.shape)
        largest = np.floor(e.range_mT / e.step_mT)
        reading: FloatArray = np.clip(np.round(noisy / e.step_mT), -largest, largest) * e.step_mT
        return reading

    def jig_field(self, hinge: FloatArray) -> FloatArray:
        """Noise-free field of each whisker held at `hinge`, shape (n, 2), while all others rest; (n, 3), mT."""
        rest = self._neighbour_field(_rod_rotation(np.zeros_like(hinge)))
        return self._in_sensor_axes(self._own_field(_rod_rotation(hinge)) + rest + self._earth(np.eye(3)))

    def _own_field(self, R: Rotation) -> FloatArray:
        """Field of each whisker's own magnet at its sensor, whisker axes, shape (n, 3), mT."""
        # magpylib comes without types.
        cylinder_field: Callable[..., FloatArray] = magpylib.func.cylinder_field
        field = cylinder_field(
            field="B",
            observers=self._p_sensor,
            dimensions=self._dimensions,
            polarizations=self._polarization,
            positions=R.apply(self._p_magnet),
            orientations=R * self._R_rod_magnet,
        )
        return MILLITESLA * field

    def _neighbour_field(self, R: Rotation) -> FloatArray:
        """Field of all other magnets, whisker axes, shape (n, 3), mT: dipoles, as 39 mm is ten magnets away."""
        axis = (R * self._R_rod_magnet).apply([0.0, 0.0, 1.0])
        field: FloatArray = self._neighbours @ (self._moment[:, None] * axis).ravel()
        return field.reshape(-1, 3)

    def _neighbour_matrix(self) -> FloatArray:
        """Moments of all magnets, in their whiskers' axes, A m2, to fields at the sensors, shape (3 n, 3 n), mT.

        B = mu_0 / (4 pi r^3) (3 r_hat (r_hat . m) - m); magnets move less than a millimetre, so it is constant.
        """
        R_base, n = self.layout.R_base_whisker, self.layout.count
        p_magnet = self.layout.p_base + np.einsum("nij,nj->ni", R_base, self._p_magnet)
        p_sensor = self.layout.p_base + np.einsum("nij,nj->ni", R_base, self._p_sensor)
        r = p_sensor[:, None, :] - p_magnet[None, :, :]
        distance = np.linalg.norm(r, axis=-1)
        unit = r / distance[..., None]
        dipole = 3.0 * unit[..., :, None] * unit[..., None, :] - np.eye(3)
        dipole *= (MILLITESLA * mu_0 / (4.0 * np.pi) / distance**3)[..., None, None]
        dipole[np.arange(n), np.arange(n)] = 0.0
        dipole[:, ~self.layout.present] = 0.0
        whisker_axes = np.einsum("aki,abkl,blj->aibj", R_base, dipole, R_base)
        return np.ascontiguousarray(whisker_axes.reshape(3 * n, 3 * n))

    def _earth(self, R_map_base: FloatArray) -> FloatArray:
        """Earth's field, whisker axes, shape (n, 3), mT."""
        field: FloatArray = np.einsum("nji,j->ni", self.layout.R_base_whisker, R_map_base.T @ EARTH_MT)
        return field

    def _in_sensor_axes(self, field: FloatArray) -> FloatArray:
        turned: FloatArray = self._gain * self._R_whisker_sensor.inv().apply(field)
        return turned


def _rod_rotation(hinge: FloatArray) -> Rotation:
    """Rotations of the rods in their whisker frames: about x, then about the turned y (Nagel 2021, figure 9)."""
    return Rotation.from_euler("XY", hinge)
