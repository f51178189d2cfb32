"""Neighbours' magnets: what the field at every sensor gains when the other whiskers leave their rest positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.magnet_model import MagnetModel, NominalWhisker
from calibration.polynomial import FloatArray, PolynomialModel

MILLIMETRE = 1e-3


def neighbour_matrix(
    p_base: FloatArray, R_base_whisker: FloatArray, model: MagnetModel, parameters: FloatArray
) -> FloatArray:
    """Matrix from changes of the rods' directions to changes of the readings, shape (3 n, 3 n), mT.

    B = k / r^3 (3 r_hat (r_hat . d) - d) for a dipole along d (Jackson, Classical Electrodynamics, equation 5.56);
    at 39 mm a magnet is one, and it moves too little to change r.

    Args:
        p_base: positions of the joints, shape (n, 3), m.
        R_base_whisker: mount rotations, shape (n, 3, 3).
        model, parameters: of the whiskers, shape (n, 16).
    """
    n = len(p_base)
    below = parameters[:, 4] * MILLIMETRE
    p_magnet = p_base - below[:, None] * R_base_whisker[:, :, 2]
    p_sensor = p_magnet - parameters[:, 5, None] * MILLIMETRE * R_base_whisker[:, :, 2]
    r = (p_sensor[:, None, :] - p_magnet[None, :, :]) / MILLIMETRE
    distance = np.sqrt(np.square(r).sum(axis=-1))
    unit = r / distance[..., None]
    dipole = 3.0 * unit[..., :, None] * unit[..., None, :] - np.eye(3)
    dipole *= (model.moments_mT_mm3(parameters) / distance**3)[..., None, None]
    dipole[np.arange(n), np.arange(n)] = 0.0
    to_sensor = base_to_sensor(R_base_whisker, model, parameters)
    whole = np.einsum("aik,abkl,blj->aibj", to_sensor, dipole, R_base_whisker, optimize=True)
    return np.ascontiguousarray(whole.reshape(3 * n, 3 * n))


def base_to_sensor(R_base_whisker: FloatArray, model: MagnetModel, parameters: FloatArray) -> FloatArray:
    """Fields in base_link's axes to readings, shape (n, 3, 3)."""
    axes: FloatArray = model.sensor_axes(parameters) @ R_base_whisker.swapaxes(-1, -2)
    return axes


def with_array(
    model: PolynomialModel,
    nominal: NominalWhisker,
    polarity: FloatArray,
    parameters: FloatArray,
    geometry: tuple[FloatArray, FloatArray],
) -> PolynomialModel:
    """The model with what its whiskers do to each other, and with their sensors' axes for Earth's field.

    Args:
        model: of n whiskers; those that are not fitted neither give nor take.
        nominal: drawing of the whiskers.
        polarity: shape (n,).
        parameters: shape (n, 16).
        geometry: positions, shape (n, 3), m, and mount rotations, shape (n, 3, 3).
    """
    place = np.flatnonzero(model.fitted)
    magnets, found = MagnetModel(nominal, polarity[place]), parameters[place]
    p_base, R_base_whisker = geometry[0][place], geometry[1][place]
    n = len(model.fitted)
    matrix, axes = np.zeros((n, 3, n, 3)), np.zeros((n, 3, 3))
    inner = neighbour_matrix(p_base, R_base_whisker, magnets, found).reshape(len(place), 3, len(place), 3)
    matrix[place[:, None], :, place] = inner.transpose(0, 2, 1, 3)
    axes[place] = base_to_sensor(R_base_whisker, magnets, found)
    return replace(model, neighbours=matrix.reshape(3 * n, 3 * n), base_to_sensor=axes)
