"""What the pipeline says after each whisker frame: all that is published of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.angle_estimator import WhiskerAngles
from robominer_slam.contacts import Contacts
from robominer_slam.estimation.odometry_state import OdometryState
from robominer_slam.slam.keyframe import BackendResult, Keyframe
from robominer_slam.whisker_health import WhiskerState

FloatArray = NDArray[np.float64]
LocalizationState = Literal["lost", "relocalizing", "dead_reckoning", "tracking"]


class FrameResult(NamedTuple):
    """The robot at the time of one whisker frame; a tuple, since it is made with every frame.

    Attributes:
        stamp_ns: time of the frame's first sensor, in the measurements' clock.
        odometry: dead reckoning's state.
        T_odom_base, T_map_odom, T_map_base: poses, shape (4, 4).
        covariance: of (x, y, yaw) in map, shape (3, 3).
        angles: of all whiskers; not valid where a whisker is not to be believed.
        whisker_states: whose readings are not believed and why: index to state and stamp of its beginning, ns.
        contacts: of those that touch.
        state: how sure the localisation is.
        keyframe: the keyframe that this frame completed, or None.
        backend_results: results of the back-end that took effect with this frame.
    """

    stamp_ns: int
    odometry: OdometryState
    T_odom_base: FloatArray
    T_map_odom: FloatArray
    T_map_base: FloatArray
    covariance: FloatArray
    angles: WhiskerAngles
    whisker_states: Mapping[int, tuple[WhiskerState, int]]
    contacts: Contacts
    state: LocalizationState
    keyframe: Keyframe | None
    backend_results: Sequence[BackendResult]
