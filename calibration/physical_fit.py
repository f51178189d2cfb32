"""Fits the physical whisker model: Gauss-Newton over the parameters of all whiskers at once, poses as unknowns too.

A sample's pose is known up to its standard deviations P (jig: little; ring: azimuth not at all; floor: both a
little). Its tilt t is an unknown of its own that is eliminated (Triggs et al., "Bundle Adjustment", 2000, section
6.1): with J_t the field's derivative by the tilt, the residual B - f(t) - J_t (t_known - t) has the covariance
S = s^2 I + J_t P J_t^T. Parameters have priors at the drawing's values. Outliers are weighed down by Geman and
McClure's kernel on the residual's Mahalanobis distance, with s taken from the median.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.magnet_model import COUNT, STRENGTH, MagnetModel
from calibration.polynomial import FloatArray
from calibration.robust import used_median

ITERATIONS = 12
WARM_ITERATIONS = 4
#: Iterations end when no parameter moves by this share of its prior's standard deviation.
CONVERGED = 0.003
#: Scale of the kernel: a sample at Mahalanobis distance^2 of 16 (3 is usual) counts a quarter.
KERNEL = 16.0
#: Median of a chi-square variable of three degrees of freedom.
MEDIAN_CHI2 = 2.366
#: Largest step of a parameter, in its prior's standard deviations.
LARGEST_STEP = 2.0
#: An unknown azimuth, rad.
UNKNOWN = np.pi


@dataclass(frozen=True, slots=True)
class PaddedSamples:
    """Samples of n whiskers, padded to the same number m; weight 0 where there is none.

    Attributes:
        field_mT: shape (n, m, 3), mT.
        inclination, inclination_sigma, azimuth, azimuth_sigma: shape (n, m), rad.
        weight: 1 or 0, shape (n, m).
        direction_only: fields are unit vectors: the firmware sent no magnitude.
        folded: fields are negated where Bz < 0.
    """

    field_mT: FloatArray
    inclination: FloatArray
    inclination_sigma: FloatArray
    azimuth: FloatArray
    azimuth_sigma: FloatArray
    weight: FloatArray
    direction_only: bool = False
    folded: bool = False


@dataclass(frozen=True, slots=True)
class PhysicalFit:
    """Result of a fit of n whiskers.

    Attributes:
        parameters: shape (n, 16), as `magnet_model.PARAMETERS`.
        covariance: of the parameters, shape (n, 16, 16).
        tilt: of every sample, as the fit sees it, shape (n, m, 2), rad.
        noise_mT: scatter of the fields about the model, shape (n,), mT.
        chi2: squared Mahalanobis distance of every sample, shape (n, m).
    """

    parameters: FloatArray
    covariance: FloatArray
    tilt: FloatArray
    noise_mT: FloatArray
    chi2: FloatArray


def observe(
    field: FloatArray, by: list[FloatArray], samples: PaddedSamples
) -> tuple[FloatArray, list[FloatArray], FloatArray]:
    """Fields and derivatives as the device sends them, and the noise's scale, shape (n, m, 1): folded, direction."""
    scale = np.ones((*field.shape[:-1], 1))
    if samples.folded:
        sign = np.where(field[..., 2:] < 0.0, -1.0, 1.0)
        field, by = field * sign, [each * sign[..., None] for each in by]
    if samples.direction_only:
        scale = 1.0 / np.maximum(np.sqrt(np.square(field).sum(axis=-1, keepdims=True)), 1e-6)
        unit = field * scale
        by = [(each - unit[..., :, None] * (unit[..., None, :] @ each)) * scale[..., None] for each in by]
        field = unit
    return field, by, scale


class PhysicalFitter:
    """Gauss-Newton on padded samples; start it cold, or warm from another fit of nearly the same samples."""

    def __init__(self, model: MagnetModel, samples: PaddedSamples) -> None:
        """Prepare; samples of n whiskers for a model of n whiskers."""
        self.model, self._samples = model, samples
        self._mean, self._spread = model.nominal.mean(), model.nominal.spread()

    def start(self, rest_mT: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Parameters and tilts to start with, from the drawing and the strength at rest, shape (n, 3), mT."""
        s = self._samples
        parameters = np.tile(self._mean, (len(rest_mT), 1))
        if not s.direction_only:
            upright = self.model.field(parameters, np.zeros((len(rest_mT), 1, 2)))[:, 0]
            ratio = np.linalg.norm(rest_mT, axis=-1) / np.linalg.norm(upright, axis=-1)
            parameters[:, STRENGTH] = np.log(np.maximum(ratio, 1e-3))
        azimuth = s.azimuth
        if np.isinf(s.azimuth_sigma).any():
            # A dipole's transverse field points against its tilt.
            upright = self.model.polarity[:, None, None] * s.field_mT
            seen = np.arctan2(-upright[..., 1], -upright[..., 0])
            azimuth = np.where(np.isinf(s.azimuth_sigma), seen, azimuth)
        tilt = s.inclination[..., None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
        return parameters, tilt

    def fit(
        self, parameters: FloatArray, tilt: FloatArray, weight: FloatArray | None = None, iterations: int = ITERATIONS
    ) -> PhysicalFit:
        """Run from these parameters and tilts; `weight`, shape (n, m), 0 leaves samples out."""
        s = self._samples
        used = s.weight if weight is None else s.weight * weight
        parameters, tilt = parameters.copy(), tilt.copy()
        H = np.tile(np.eye(COUNT), (len(parameters), 1, 1))
        scatter = np.ones(len(parameters))
        chi2 = np.zeros_like(used)
        for _ in range(iterations):
            field, by_parameter, by_tilt = self.model.linearised(parameters, tilt)
            field, (by_parameter, by_tilt), scale = observe(field, [by_parameter, by_tilt], s)
            noise = self.model.nominal.noise_mT * scale
            known, frame_t, variance = self._known(tilt)
            J = by_tilt @ frame_t / noise[..., None]  # by the tilt along and across the azimuth
            innovation = (s.field_mT - field) / noise
            residual = innovation - (J @ known[..., None])[..., 0]
            # The information that the pose's uncertainty leaves: (I + J P J^T)^-1 = I - J (P^-1 + J^T J)^-1 J^T.
            inner = J.swapaxes(-1, -2) @ J
            inner[..., 0, 0] += 1.0 / variance[..., 0]
            inner[..., 1, 1] += 1.0 / variance[..., 1]
            gain = _inverse(inner) @ J.swapaxes(-1, -2)
            whitened = residual - (J @ (gain @ residual[..., None]))[..., 0]
            chi2 = np.maximum((residual * whitened).sum(axis=-1), 0.0)
            scatter = np.maximum(used_median(chi2, used) / MEDIAN_CHI2, 1.0)
            robust = used / np.square(1.0 + chi2 / scatter[:, None] / KERNEL)
            share = robust / scatter[:, None]
            A = by_parameter / noise[..., None]
            A_white = (A - J @ (gain @ A)) * share[..., None, None]
            n = len(parameters)
            H = A_white.reshape(n, -1, COUNT).swapaxes(-1, -2) @ A.reshape(n, -1, COUNT)
            b = A_white.reshape(n, -1, COUNT).swapaxes(-1, -2) @ residual.reshape(n, -1, 1)
            H = H * self._spread[:, None] * self._spread + np.eye(COUNT)
            z = (parameters - self._mean) / self._spread
            step = np.linalg.solve(H, self._spread[:, None] * b - z[..., None])[..., 0]
            step = np.clip(step, -LARGEST_STEP, LARGEST_STEP) * self._spread
            parameters += step
            # Back-substitution: the poses follow what the parameters leave.
            left = residual - (A @ step[:, None, :, None])[..., 0]
            move = known + (gain @ left[..., None])[..., 0]
            tilt += (frame_t @ np.clip(move, -0.3, 0.3)[..., None])[..., 0]
            if np.abs(step / self._spread).max() < CONVERGED:
                break
        covariance = np.linalg.inv(H) * self._spread[:, None] * self._spread
        noise_mT = self.model.nominal.noise_mT * np.sqrt(scatter)
        return PhysicalFit(parameters, covariance, tilt, noise_mT, chi2)

    def invert(self, parameters: FloatArray, tilt: FloatArray, steps: int = 4) -> FloatArray:
        """Tilts from the fields alone, shape (n, m, 2), rad: least squares from these tilts."""
        s, tilt = self._samples, tilt.copy()
        for _ in range(steps):
            field, by_tilt = self.model.field_and_tilt_jacobian(parameters, tilt)
            field, (J,), _ = observe(field, [by_tilt], s)
            JT = J.swapaxes(-1, -2)
            move = (_inverse(JT @ J) @ (JT @ (s.field_mT - field)[..., None]))[..., 0]
            tilt += np.clip(move, -0.3, 0.3)
        return tilt

    def _known(self, tilt: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """How far the known pose is from these tilts, along and across the azimuth; those axes; their variances."""
        s = self._samples
        phi = np.sqrt(np.square(tilt).sum(axis=-1))
        # At rest, the azimuth means nothing: any axes do.
        radial = np.where(phi[..., None] > 1e-6, tilt / np.maximum(phi, 1e-9)[..., None], np.array([1.0, 0.0]))
        axes = np.stack([radial, np.stack([-radial[..., 1], radial[..., 0]], axis=-1)], axis=-1)
        unknown = np.isinf(s.azimuth_sigma)
        turn = s.azimuth - np.arctan2(radial[..., 1], radial[..., 0])
        turn = np.where(unknown, 0.0, (turn + np.pi) % (2.0 * np.pi) - np.pi)
        across = np.where(s.inclination > 1e-6, phi * turn, 0.0)
        known = np.stack([s.inclination - phi, across], axis=-1)
        sigma_across = np.where(unknown, UNKNOWN, s.azimuth_sigma) * s.inclination
        sigma_across = np.maximum(sigma_across, s.inclination_sigma)
        return known, axes, np.stack([s.inclination_sigma**2, sigma_across**2], axis=-1)


def tilt_covariance(model: MagnetModel, fit: PhysicalFit, tilt: FloatArray) -> FloatArray:
    """Covariance of the tilts that the parameters' uncertainty makes, shape (n, m, 2, 2), rad2."""
    _, by_parameter, by_tilt = model.linearised(fit.parameters, tilt)
    JT = by_tilt.swapaxes(-1, -2)
    lever = _inverse(JT @ by_tilt) @ (JT @ by_parameter)
    return lever @ fit.covariance[:, None] @ lever.swapaxes(-1, -2)


def _inverse(matrix: FloatArray) -> FloatArray:
    """Inverses of symmetric 2 x 2 matrices, shape (..., 2, 2)."""
    a, b, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    determinant = np.maximum(a * d - b * b, 1e-300)
    result = np.empty_like(matrix)
    result[..., 0, 0], result[..., 1, 1] = d / determinant, a / determinant
    result[..., 0, 1] = result[..., 1, 0] = -b / determinant
    return result
