"""Hall sensors under tilting magnets: what each whisker's sensor reads for its hinge angles.

A whisker's foot carries a small cylinder magnet that tilts with the rod about the joint; under it sits a 3-axis
Hall sensor (Infineon TLV493D). The fields are magpylib's for finite cylinders.
"""

from __future__ import annotations

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
        self._R_rod_magnet: FloatArray = Rotation.from_rotvec(tilt).as_matrix()
        self._p_magnet = np.column_stack([rng.normal(0.0, spread.magnet_offset, (n, 2)), np.full(n, -g.arm)])
        strength = g.polarization * (1.0 + rng.normal(0.0, spread.strength, n))
        self._polarization = strength
        R_whisker_sensor = Rotation.from_rotvec(rng.normal(0.0, spread.sensor_rotation, (n, 3)))
        self._R_sensor_whisker: FloatArray = R_whisker_sensor.inv().as_matrix()
        self._gain = 1.0 + rng.normal(0.0, spread.gain, (n, 3))
        gap = g.gap + rng.normal(0.0, spread.gap, n)
        self._p_sensor = np.column_stack([np.zeros((n, 2)), -g.arm - gap])
        self._moment = strength / mu_0 * np.pi * (g.diameter / 2.0) ** 2 * g.height
        self._neighbours = self._neighbour_matrix()

    def field(self, hinge: FloatArray, R_map_base: FloatArray) -> FloatArray:
        """Noise-free field at every sensor in its own axes, shape (..., n, 3), mT.

        Many frames at once take a small part of the time that they take one by one.

        Args:
            hinge: hinge angles about x and y of every whisker, shape (..., n, 2), rad.
            R_map_base: attitudes of the robot, shape (..., 3, 3); they turn Earth's field.
        """
        R = rod_rotation(hinge)
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
        rest = self._neighbour_field(rod_rotation(np.zeros_like(hinge)))
        return self._in_sensor_axes(self._own_field(rod_rotation(hinge)) + rest + self._earth(np.eye(3)))

    def _own_field(self, R: FloatArray) -> FloatArray:
        """Field of each whisker's own magnet at its sensor, whisker axes, shape (..., n, 3), mT.

        Args:
            R: rotations of the rods in their whisker frames, shape (..., n, 3, 3).
        """
        R_magnet = R @ self._R_rod_magnet
        from_magnet = self._p_sensor - (R @ self._p_magnet[:, :, None])[..., 0]
        # The magnet is round: in its own axes, the field has a part along it and one away from it.
        local = (from_magnet[..., None, :] @ R_magnet)[..., 0, :]
        away = np.sqrt(local[..., 0] ** 2 + local[..., 1] ** 2)
        radius = self.geometry.diameter / 2.0
        half_height = np.full(away.size, self.geometry.height / 2.0 / radius)
        radial, _, axial = magpylib.core.magnet_cylinder_axial_Bfield(
            z0=half_height, r=(away / radius).ravel(), z=(local[..., 2] / radius).ravel()
        )
        outwards = radial.reshape(away.shape) / np.maximum(away, 1e-12)
        field = np.stack([outwards * local[..., 0], outwards * local[..., 1], axial.reshape(away.shape)], axis=-1)
        field *= MILLITESLA * self._polarization[:, None]
        return _turned(R_magnet, field)

    def _neighbour_field(self, R: FloatArray) -> FloatArray:
        """Field of all other magnets, whisker axes, shape (..., n, 3), mT: dipoles, as 39 mm is ten magnets away."""
        moment = self._moment[:, None] * _turned(R, self._R_rod_magnet[:, :, 2])
        field: FloatArray = moment.reshape(*moment.shape[:-2], -1) @ self._neighbours.T
        return field.reshape(moment.shape)

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
        """Earth's field, whisker axes, shape (..., n, 3), mT."""
        in_base = EARTH_MT @ R_map_base
        field: FloatArray = np.einsum("nji,...j->...ni", self.layout.R_base_whisker, in_base)
        return field

    def _in_sensor_axes(self, field: FloatArray) -> FloatArray:
        return self._gain * _turned(self._R_sensor_whisker, field)


def rod_rotation(hinge: FloatArray) -> FloatArray:
    """Rotations of the rods in their whisker frames, shape (..., 3, 3), for hinge angles (..., 2), rad.

    About x, then about the turned y (Nagel 2021, figure 9).
    """
    sines, cosines = np.sin(hinge), np.cos(hinge)
    s0, s1, c0, c1 = sines[..., 0], sines[..., 1], cosines[..., 0], cosines[..., 1]
    R = np.zeros((*s0.shape, 3, 3))
    R[..., 0, 0], R[..., 0, 2] = c1, s1
    R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = s0 * s1, c0, -s0 * c1
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = -c0 * s1, s0, c0 * c1
    return R


def _turned(R: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors of shape (..., 3) turned by rotations of shape (..., 3, 3)."""
    turned: FloatArray = (R @ vectors[..., None])[..., 0]
    return turned
