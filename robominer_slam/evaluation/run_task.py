"""One replay to be evaluated: what it is made of, and how it is made."""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.model import Configuration
from robominer_slam.configuration.overrides import Override, overridden
from robominer_slam.evaluation.consistency import consistency
from robominer_slam.evaluation.height_errors import HeightFunction, height_errors
from robominer_slam.evaluation.metrics import ErrorStatistics, TrajectoryErrors, relative_errors, trajectory_errors
from robominer_slam.evaluation.pose_graph_errors import LEAST_WEIGHT, ClosureErrors, closure_errors
from robominer_slam.evaluation.run_record import ClosureCounts, RunKey, RunRecord
from robominer_slam.evaluation.run_result import RunResult
from robominer_slam.evaluation.trajectory import Trajectory, TrajectoryError, interpolate
from robominer_slam.evaluation.trajectory_files import truth_of
from robominer_slam.frame_result import FrameResult
from robominer_slam.graph_json import graph_json
from robominer_slam.mapping.height_grid import HeightGrid, height_grid
from robominer_slam.replay import ReplayInputs, ReplayResult, prepare, replay

FloatArray = NDArray[np.float64]
#: From a recording's metadata to the true surface, where somebody knows it.
SurfaceOf = Callable[[Mapping[str, str]], HeightFunction | None]

#: Cells of the map that is kept for the figures, m.
FIGURE_CELL_M = 0.02
#: Places in x and y at which the true surface is told from another, m.
SAMPLED_M = np.linspace(-1.0, 4.0, 21)
#: Frames over which drift is measured: a second of whisker frames.
RELATIVE_FRAMES = 25


@dataclass(frozen=True, slots=True)
class RunTask:
    """A recording, a method, a source of odometry, and keys of the configuration that are set otherwise."""

    path: Path
    key: RunKey
    overrides: tuple[Override, ...] = ()

    @property
    def file_name(self) -> str:
        """Of the saved run."""
        parts = (self.path.stem, self.key.source, self.key.method, self.key.variant)
        return "_".join(re.sub(r"[^A-Za-z0-9.-]+", "-", part) for part in parts if part) + ".npz"

    def configured(self, configuration: Configuration) -> Configuration:
        """The recording's configuration as this run has it.

        Raises:
            ConfigurationError: a method, source or override that the configuration refuses.
        """
        keys = {"slam.method": self.key.method, "estimation.source": self.key.source, **dict(self.overrides)}
        return overridden(configuration, keys, self.path.name)

    def fingerprint(self, code: str, surface_of: SurfaceOf | None) -> str:
        """Tells whether a saved run was made from the same recording, configuration, program and true surface."""
        inputs = prepare(self.path, None)
        recording = hashlib.sha256(self.path.read_bytes()).hexdigest()
        surface = surface_of(inputs.recording.metadata) if surface_of is not None else None
        # Two surfaces that agree at so many places are the same.
        heights = "" if surface is None else repr(np.round(surface(*np.meshgrid(SAMPLED_M, SAMPLED_M)), 9).tolist())
        configuration = self.configured(inputs.configuration).model_dump_json()
        parts = [code, recording, configuration, repr(self.key), heights]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()


@dataclass
class _Frames:
    """What is kept of every frame."""

    stamps: list[int] = field(default_factory=list)
    slam: list[FloatArray] = field(default_factory=list)
    odometry: list[FloatArray] = field(default_factory=list)
    covariance: list[FloatArray] = field(default_factory=list)
    states: list[str] = field(default_factory=list)
    keyframe: list[bool] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(self, frame: FrameResult, seconds: float) -> None:
        self.stamps.append(frame.stamp_ns)
        self.slam.append(frame.T_map_base)
        self.odometry.append(frame.T_odom_base)
        self.covariance.append(frame.covariance)
        self.states.append(frame.state)
        self.keyframe.append(frame.keyframe is not None)
        self.seconds.append(seconds)


def evaluate_run(task: RunTask, surface_of: SurfaceOf | None = None) -> RunResult:
    """Replay and compare with the truth.

    Raises:
        RecordingError, ConfigurationError, LayoutError, CalibrationFileError: the recording cannot be replayed so.
        TrajectoryError: it has no ground truth that covers it.
    """
    inputs = prepare(task.path, None)
    inputs = replace(inputs, configuration=task.configured(inputs.configuration))
    truth = truth_of(task.path)
    cpu_start = time.process_time()
    frames, result, seconds = _replay(inputs)
    cpu_s = time.process_time() - cpu_start
    if not frames.stamps:
        raise TrajectoryError(f"{task.path}: no whisker frames in it")
    stamps = np.array(frames.stamps, dtype=np.int64)
    inside, T_truth = interpolate(truth, stamps)
    if not inside.any():
        raise TrajectoryError(f"{task.path}: its ground truth and its whisker frames do not overlap in time")
    own_truth = Trajectory(stamps[inside], T_truth)
    slam = Trajectory(stamps[inside], np.array(frames.slam)[inside])
    odometry = Trajectory(stamps[inside], np.array(frames.odometry)[inside])
    graph = json.loads(graph_json(result.keyframe_map, 0))
    try:
        closures = closure_errors(graph, truth)
    except ValueError as error:
        raise TrajectoryError(f"{task.path}: {error}") from error
    cloud = result.keyframe_map.cloud()
    surface = surface_of(inputs.recording.metadata) if surface_of is not None else None
    slam_errors, odometry_errors = trajectory_errors(slam, own_truth), trajectory_errors(odometry, own_truth)
    states = np.array(frames.states)[inside]
    with_keyframe, time_s = np.array(frames.keyframe), np.array(frames.seconds)
    record = RunRecord(
        key=task.key,
        recording=task.path.stem,
        frames=len(slam),
        duration_s=float(stamps[-1] - stamps[0]) * 1e-9,
        distance_m=float(np.linalg.norm(np.diff(T_truth[:, :2, 3], axis=0), axis=1).sum()),
        replay_s=seconds,
        cpu_s=cpu_s,
        slam_position_m=ErrorStatistics.of(slam_errors.position),
        slam_heading_deg=_heading(slam_errors),
        odometry_position_m=ErrorStatistics.of(odometry_errors.position),
        odometry_heading_deg=_heading(odometry_errors),
        slam_distance_m=ErrorStatistics.of(slam_errors.distance),
        slam_rotation_deg=ErrorStatistics.of(np.rad2deg(slam_errors.rotation)),
        slam_relative_m=_statistics(relative_errors(slam, own_truth, RELATIVE_FRAMES)[0]),
        odometry_relative_m=_statistics(relative_errors(odometry, own_truth, RELATIVE_FRAMES)[0]),
        keyframes=len(graph["keyframes"]),
        closures=_counts(closures),
        height=height_errors(cloud, surface) if surface is not None else None,
        consistency=consistency(slam_errors, np.array(frames.covariance)[inside]),
        states={str(state): float(np.mean(states == state)) for state in sorted(set(frames.states))},
        frame_s=_statistics(time_s[~with_keyframe]),
        keyframe_s=_statistics(time_s[with_keyframe]),
    )
    grid = height_grid(cloud, FIGURE_CELL_M)
    true_heights = surface(*_centres(grid)) if surface is not None and len(cloud) else None
    return RunResult(record, own_truth, odometry, slam, graph, closures.wrong, grid, true_heights)


def _replay(inputs: ReplayInputs) -> tuple[_Frames, ReplayResult, float]:
    frames = _Frames()
    start = last = time.perf_counter()

    def on_frame(frame: FrameResult) -> None:
        nonlocal last
        now = time.perf_counter()
        frames.add(frame, now - last)
        last = now

    result = replay(inputs, on_frame)
    return frames, result, time.perf_counter() - start


def _centres(grid: HeightGrid) -> tuple[FloatArray, FloatArray]:
    """X and y of the cells' centres, of the grid's shape, m."""
    ny, nx = grid.height.shape
    x = grid.origin[0] + (np.arange(nx) + 0.5) * grid.cell
    y = grid.origin[1] + (np.arange(ny) + 0.5) * grid.cell
    px, py = np.meshgrid(x, y)
    return px, py


def _heading(errors: TrajectoryErrors) -> ErrorStatistics:
    return ErrorStatistics.of(np.rad2deg(errors.heading))


def _statistics(values: FloatArray) -> ErrorStatistics | None:
    return ErrorStatistics.of(values) if len(values) else None


def _counts(closures: ClosureErrors) -> ClosureCounts:
    alive = closures.weight > LEAST_WEIGHT
    wrong = int((alive & closures.wrong).sum())
    return ClosureCounts(len(closures), int(alive.sum()) - wrong, wrong)
