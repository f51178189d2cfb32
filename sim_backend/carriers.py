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


class Carriers:
    """Motion of an array's mounts; products of many small matrices are done as one of large ones."""

    def __init__(self, layout: WhiskerLayout) -> None:
        """The mounts of this array."""
        self._n, self._p_base = layout.count, layout.p_base
        self._columns = layout.R_base_whisker.transpose(1, 0, 2).reshape(3, 3 * layout.count)
        self._factor = _right_factor(layout.R_base_whisker).reshape(4 * layout.count, 4).T

    def at(self, base: BaseStates) -> CarrierStates:
        """Motion of every mount: v + omega x r, a + alpha x r + omega x (omega x r)."""
        m, n = len(base.R), self._n
        lever = self._p_base @ base.R.swapaxes(1, 2)
        spin, change = _cross_matrix(base.omega).swapaxes(1, 2), _cross_matrix(base.alpha).swapaxes(1, 2)
        swing = lever @ spin
        R_map_whisker = (base.R.reshape(3 * m, 3) @ self._columns).reshape(m, 3, n, 3).swapaxes(1, 2)
        pose, velocity, acceleration = np.empty((m, n, 7)), np.empty((m, n, 6)), np.empty((m, n, 6))
        pose[..., :3] = base.position[:, None, :] + lever
        pose[..., 3:] = (_quaternion_wxyz(base.R) @ self._factor).reshape(m, n, 4)
        velocity[..., :3] = base.velocity[:, None, :] + swing
        acceleration[..., :3] = base.acceleration[:, None, :] + lever @ change + swing @ spin
        for rate, turning in ((base.omega, velocity), (base.alpha, acceleration)):
            in_body = (rate[:, None, :] @ base.R)[:, 0, :]
            turning[..., 3:] = (in_body @ self._columns).reshape(m, n, 3)
        return CarrierStates(pose, velocity, acceleration, R_map_whisker)


def carrier_states(base: BaseStates, layout: WhiskerLayout) -> CarrierStates:
    """Motion of every whisker's mount, once."""
    return Carriers(layout).at(base)


def _cross_matrix(v: FloatArray) -> FloatArray:
    """Matrices M, shape (m, 3, 3), with M r = v x r, for v of shape (m, 3)."""
    M = np.zeros((len(v), 3, 3))
    M[:, 0, 1], M[:, 0, 2], M[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    M[:, 1, 0], M[:, 2, 0], M[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return M


def _quaternion_wxyz(R: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) as quaternions w x y z, shape (n, 4)."""
    return np.roll(Rotation.from_matrix(R).as_quat(), 1, axis=-1)


def _right_factor(R: FloatArray) -> FloatArray:
    """Matrices M, shape (n, 4, 4), with M p = p q in quaternions w x y z, for the rotations' q."""
    w, x, y, z = np.moveaxis(_quaternion_wxyz(R), -1, 0)
    rows = [[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]]
    return np.moveaxis(np.array(rows), -1, 0)
