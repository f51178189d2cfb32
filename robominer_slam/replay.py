"""A recording through the pipeline, as fast as it goes; the same recording gives the same result, bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.polynomial import PolynomialModel
from drivers.recording_reader import Recording
from robominer_slam.assembly import build_pipeline
from robominer_slam.configuration import array, file
from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.configuration.model import Configuration
from robominer_slam.frame_result import FrameResult
from robominer_slam.layout import WhiskerLayout, from_json
from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.slam.keyframe import BackendResult
from robominer_slam.slam.saved_map import SavedMap

FloatArray = NDArray[np.float64]

CONFIGURATION, LAYOUT, CALIBRATION = "config.toml", "layout.json", "calibration.json"
KIND_DEVICES = {"HallFrame": "whiskers", "ImuSample": "imu", "OdometrySample": "odometry"}


@dataclass
class ReplayResult:
    """What a replay leaves: the map, and counts for the summary."""

    keyframe_map: KeyframeMap
    frames: int = 0
    localised_frames: int = 0
    late: int = 0
    dropped: int = 0
    backend_s: float = 0.0
    counters: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class ReplayInputs:
    """A recording with the configuration, layout and calibration that serve it."""

    recording: Recording
    configuration: Configuration
    layout: WhiskerLayout
    model: PolynomialModel


def prepare(path: Path, configuration_path: Path | None) -> ReplayInputs:
    """Open a recording; what no configuration file names comes from its attachments.

    Raises:
        RecordingError, ConfigurationError, LayoutError, CalibrationFileError: each with one clear line.
    """
    attachments = Recording(path).attachments()
    folder = Path.cwd()
    if configuration_path is not None:
        configuration = file.load(configuration_path)
        folder = configuration_path.parent
    elif CONFIGURATION in attachments:
        configuration = file.parse(attachments[CONFIGURATION].decode("utf-8", "replace"), f"{path}:{CONFIGURATION}")
    else:
        raise ConfigurationError(f"{path}: carries no configuration; give one with --config FILE.toml")
    if configuration_path is None and LAYOUT in attachments:
        layout = from_json(attachments[LAYOUT].decode("utf-8", "replace"), f"{path}:{LAYOUT}")
    else:
        layout = array.load_layout(configuration.robot.layout, folder)
    named = array.calibration_path(configuration, folder)
    if named is not None and configuration_path is not None:
        calibration = array.read_calibration(named, layout)
    elif CALIBRATION in attachments:
        text = attachments[CALIBRATION].decode("utf-8", "replace")
        calibration = array.load_calibration(text, f"{path}:{CALIBRATION}", layout)
    else:
        raise ConfigurationError(f"{path}: carries no calibration, and the configuration names none on a device")
    topics: dict[str, str] = dict(configuration.topics)
    return ReplayInputs(Recording(path, topics), configuration, layout, calibration.model)


def replay(
    inputs: ReplayInputs,
    on_frame: Callable[[FrameResult], None],
    on_message: Callable[[int], None] = lambda _: None,
    known: SavedMap | None = None,
    on_rest: Callable[[BackendResult], None] = lambda _: None,
) -> ReplayResult:
    """Run a recording through the pipeline.

    Args:
        inputs: from `prepare`.
        on_frame: called with each frame's result.
        on_message: called with each measurement's log time, ns, for progress.
        known: a saved map to start in, by the configuration's `slam.start`.
        on_rest: called with the back-end's results that were not due at the last frame.
    """
    pipeline = build_pipeline(inputs.configuration, inputs.layout, inputs.model, "synchronous", known)
    result = ReplayResult(KeyframeMap(inputs.configuration.map.point_voxel))
    if known is not None:
        result.keyframe_map.load(known)

    def frames() -> Iterator[FrameResult]:
        for log_time_ns, measurement in inputs.recording:
            on_message(log_time_ns)
            device = KIND_DEVICES.get(type(measurement).__name__, "screws")
            yield from pipeline.add(device, measurement)
        yield from pipeline.finish()

    for frame in frames():
        result.localised_frames += frame.state == "tracking"
        for backend_result in frame.backend_results:
            result.keyframe_map.take(backend_result)
        result.frames += 1
        on_frame(frame)
    if pipeline.runner is not None:
        for backend_result in pipeline.runner.close():
            result.keyframe_map.take(backend_result)
            on_rest(backend_result)
        result.backend_s = pipeline.runner.busy_s
    result.late, result.dropped = pipeline.reorder.late, pipeline.reorder.dropped
    result.counters = dict(inputs.recording.counters)
    return result
