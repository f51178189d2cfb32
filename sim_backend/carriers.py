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
    """

    pose: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


def carrier_states(base: BaseStates, layout: WhiskerLayout) -> CarrierStates:
    """Motion of every whisker's mount: v + omega x r, a + alpha x r + omega x (omega x r)."""
    m, n = len(base.position), layout.count
    lever = np.einsum("mij,nj->mni", base.R, layout.p_base)
    omega, alpha = base.omega[:, None, :], base.alpha[:, None, :]
    swing = np.cross(omega, lever)
    R_map_whisker = np.einsum("mij,njk->mnik", base.R, layout.R_base_whisker)
    quaternion = Rotation.from_matrix(R_map_whisker.reshape(-1, 3, 3)).as_quat().reshape(m, n, 4)
    pose = np.concatenate([base.position[:, None, :] + lever, np.roll(quaternion, 1, axis=-1)], axis=-1)
    velocity = base.velocity[:, None, :] + swing
    acceleration = base.acceleration[:, None, :] + np.cross(alpha, lever) + np.cross(omega, swing)
    return CarrierStates(
        pose,
        np.concatenate([velocity, np.einsum("mnji,mj->mni", R_map_whisker, base.omega)], axis=-1),
        np.concatenate([acceleration, np.einsum("mnji,mj->mni", R_map_whisker, base.alpha)], axis=-1),
    )
