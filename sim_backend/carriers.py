"""Motion of the whiskers' mounts that follows from the motion of the body they sit on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robominer_slam.layout import WhiskerLayout
from sim_backend.base_motion import BaseStates

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CarrierStates:
    """Mounts of n whiskers at m instants, in MuJoCo's coordinates of free joints.

    Attributes:
        pose: position in the map (m) and quaternion w x y z, shape (m, n, 7).
        velocity: of the mount in map axes, m/s, and angular in the whisker's axes, rad/s, shape (m, n, 6).
        acceleration: likewise, m/s2 and rad/s2, shape (m, n, 6).
        R: rotations, whisker frame to map, shape (m, n, 3, 3).
    """

    pose: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    R: FloatArray


def carrier_states(base: BaseStates, layout: WhiskerLayout) -> CarrierStates:
    """Motion of every whisker's mount: v + omega x r, a + alpha x r + omega x (omega x r)."""
    lever = np.einsum("mij,nj->mni", base.R, layout.p_base)
    omega, alpha = base.omega[:, None, :], base.alpha[:, None, :]
    swing = np.cross(omega, lever)
    R_map_whisker = np.einsum("mij,njk->mnik", base.R, layout.R_base_whisker)
    quaternion = np.einsum("nij,mj->mni", _right_factor(layout.R_base_whisker), _quaternion_wxyz(base.R))
    pose = np.concatenate([base.position[:, None, :] + lever, quaternion], axis=-1)
    velocity = base.velocity[:, None, :] + swing
    acceleration = base.acceleration[:, None, :] + np.cross(alpha, lever) + np.cross(omega, swing)
    return CarrierStates(
        pose,
        np.concatenate([velocity, np.einsum("mnji,mj->mni", R_map_whisker, base.omega)], axis=-1),
        np.concatenate([acceleration, np.einsum("mnji,mj->mni", R_map_whisker, base.alpha)], axis=-1),
        R_map_whisker,
    )


def _quaternion_wxyz(R: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) as quaternions w x y z, shape (n, 4)."""
    return np.roll(Rotation.from_matrix(R).as_quat(), 1, axis=-1)


def _right_factor(R: FloatArray) -> FloatArray:
    """Matrices M, shape (n, 4, 4), with M p = p q in quaternions w x y z, for the rotations' q."""
    w, x, y, z = np.moveaxis(_quaternion_wxyz(R), -1, 0)
    rows = [[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]]
    return np.moveaxis(np.array(rows), -1, 0)
