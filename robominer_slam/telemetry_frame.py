"""A frame's result as the telemetry message of remote links."""

from __future__ import annotations

import numpy as np

from robominer_slam import geometry
from robominer_slam.frame_result import FrameResult
from robominer_slam.layout import WhiskerLayout
from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.publisher import LEVEL_VARIANCE
from robominer_slam.publishing.telemetry import Health, Telemetry, encode


def telemetry(
    sequence: int,
    stamp_unix_ns: int,
    result: FrameResult,
    layout: WhiskerLayout,
    keyframe_map: KeyframeMap,
    health: Health,
) -> bytes:
    """The message, at most 200 bytes; free whiskers have inclination zero, unusable ones NaN."""
    shape = (layout.rows, layout.cols)
    x, y, yaw = result.covariance.diagonal().tolist()
    inclination = np.where(result.angles.valid, 0.0, np.nan)
    inclination[result.contacts.index] = result.contacts.inclination
    return encode(
        Telemetry(
            sequence=sequence,
            stamp_ns=stamp_unix_ns,
            state=result.state,
            pose=geometry.to_vector7(result.T_map_base),
            sigmas=np.sqrt([x, y, *LEVEL_VARIANCE, yaw]),
            velocity=result.odometry.velocity,
            contacts=len(result.contacts.index),
            inclination=inclination.reshape(shape),
            azimuth=result.angles.azimuth.reshape(shape),
            health=health,
            map_version=keyframe_map.version,
            keyframes=len(keyframe_map.keyframes),
            closures=keyframe_map.closures,
        )
    )
