"""Edges of the keyframe graph: what the odometry measured since the last keyframe, what a closure found, how surely."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.estimation.keyframe_motion import KeyframeMotion
from robominer_slam.slam.bias_walk import faded_noise
from robominer_slam.slam.closure_search import Closure
from robominer_slam.slam.keyframe import Keyframe
from robominer_slam.slam.level_edges import LevelEdge
from robominer_slam.slam.published_edges import PLANAR

FloatArray = NDArray[np.float64]

#: Least variance of an odometry edge in x, y (m2) and heading (rad2): a keyframe's instant is known to 5 ms or so.
EDGE_FLOOR = np.square([0.001, 0.001, 0.001])
#: Deviation of the height from one keyframe to the next, m, where the odometry does not say.
HEIGHT_WALK = 0.002
#: And of a closure's height, m.
HEIGHT_SIGMA = 0.003


def motion_of(keyframe: Keyframe) -> KeyframeMotion:
    """Its motion since the last.

    Raises:
        ValueError: the odometry gives none.
    """
    if keyframe.motion is None:
        raise ValueError("the method needs the motion between keyframes; its odometry does not give it")
    return keyframe.motion


def odometry_edge(last: Keyframe, keyframe: Keyframe, biases: int) -> LevelEdge:
    """The edge from one keyframe to the next.

    Args:
        last, keyframe: its ends.
        biases: how many of the odometry's biases are unknowns of the graph: all or 0, then their uncertainty is the
            edge's noise.
    """
    motion = motion_of(keyframe)
    start, _ = geometry.levelled(last.T_odom_base)
    end, _ = geometry.levelled(keyframe.T_odom_base)
    covariance, by_bias = motion.covariance[np.ix_(PLANAR, PLANAR)], motion.bias_jacobian[PLANAR]
    if not biases:
        covariance = covariance + by_bias @ motion.bias_covariance @ by_bias.T
    slack = None
    if motion.bias_walk is not None and biases:
        unknown = motion.bias_covariance[:biases, :biases]
        slack = faded_noise(by_bias[:, :biases], unknown, motion.bias_walk[:biases, :biases])
    return LevelEdge(
        "odometry",
        last.id,
        keyframe.id,
        geometry.se2_compose(geometry.se2_inverse(start[:3]), end[:3]),
        symmetric_inverse(covariance + np.diag(EDGE_FLOOR)),
        float(end[3] - start[3]),
        1.0 / HEIGHT_WALK**2,
        by_bias[:, :biases],
        motion.bias[:biases],
        slack=slack,
    )


def loop_edge(closure: Closure, biases: int) -> LevelEdge:
    """The edge of a closure; it says nothing of the odometry's biases, which are so many."""
    return LevelEdge(
        "loop",
        closure.i,
        closure.j,
        closure.Z,
        symmetric_inverse(closure.covariance),
        closure.dz,
        1.0 / HEIGHT_SIGMA**2,
        np.zeros((3, biases)),
        np.zeros(biases),
    )


def symmetric_inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of a covariance or an information matrix, symmetric to the bit."""
    inverse = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    return 0.5 * (inverse + inverse.T)
