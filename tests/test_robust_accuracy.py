"""The method `robust` on a recorded drive: accuracy, closures and repeatability, by both sources of odometry."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robominer_slam.configuration.overrides import overridden
from robominer_slam.evaluation.metrics import trajectory_errors
from robominer_slam.evaluation.pose_graph_errors import LEAST_WEIGHT, closure_errors
from robominer_slam.evaluation.trajectory import Trajectory, interpolate
from robominer_slam.evaluation.trajectory_files import truth_of
from robominer_slam.frame_result import FrameResult
from robominer_slam.graph_json import graph_json
from robominer_slam.replay import prepare, replay

RECORDING = Path(__file__).parent / "recordings" / "scenario-2.mcap"


def replayed(source: str) -> tuple[list[FrameResult], dict]:
    """Frames and the graph at the end."""
    inputs = prepare(RECORDING, None)
    configuration = overridden(inputs.configuration, {"slam.method": "robust", "estimation.source": source}, "test")
    frames: list[FrameResult] = []
    result = replay(replace(inputs, configuration=configuration), frames.append)
    return frames, json.loads(graph_json(result.keyframe_map, 0))


# Bounds are about twice what the method reaches: a change that costs accuracy is seen, a change of luck is not.
@pytest.mark.parametrize(
    ("source", "mean", "greatest", "heading"), [("fused", 0.03, 0.06, 1.5), ("odometry", 0.06, 0.12, 4.0)]
)
def test_a_drive_is_followed_to_centimetres_with_true_closures_and_repeats_bit_for_bit(source, mean, greatest, heading):
    frames, graph = replayed(source)
    truth = truth_of(RECORDING)
    stamps = np.array([frame.stamp_ns for frame in frames])
    inside, T_true = interpolate(truth, stamps)
    T = np.array([frame.T_map_base for frame in frames])
    errors = trajectory_errors(Trajectory(stamps[inside], T[inside]), Trajectory(stamps[inside], T_true))
    closures = closure_errors(graph, truth)
    used = closures.weight > LEAST_WEIGHT
    assert errors.position.mean() < mean
    assert errors.position.max() < greatest
    assert np.rad2deg(errors.heading).mean() < heading
    assert not (used & closures.wrong).any()
    assert int(used.sum()) >= 5

    again, graph_again = replayed(source)
    np.testing.assert_array_equal(T, np.array([frame.T_map_base for frame in again]))
    np.testing.assert_array_equal(frames[-1].covariance, again[-1].covariance)
    assert graph == graph_again
