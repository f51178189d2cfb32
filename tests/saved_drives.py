"""Drives with the method `robust` for the tests of saved maps: short, quasi-static, each made once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.random_drives import measurements, simulated_robot
from drivers.measurement import Measurement, ScrewAngles
from robominer_slam.assembly import build_pipeline
from robominer_slam.frame_result import FrameResult
from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.pipeline import Pipeline
from robominer_slam.replay import ReplayInputs, prepare
from robominer_slam.slam.saved_map import SavedMap
from sim_backend.events import TruthEvent

RECORDING = Path(__file__).parent / "recordings" / "scenario-1.mcap"

#: A loop of 2.3 m over the thesis's ground around the start, and back over its beginning.
LOOP = ((0.0, 0.0, 0.0), (0.75, 0.0, 0.0), (0.75, 0.4, 0.0), (0.0, 0.4, 0.0), (0.0, 0.0, 0.0), (0.4, 0.0, 0.0))

#: Starts at other places and headings than the map was made from.
TURNED = ((0.6, 0.3, 2.0), (0.2, 0.3, 2.0), (0.2, 0.1, 2.0), (0.65, 0.1, 2.6), (0.65, 0.35, 2.6), (0.2, 0.35, 2.6))
AWAY = ((0.35, 0.2, -0.5), (0.75, 0.2, -0.5), (0.75, 0.4, -0.5), (0.1, 0.4, -0.5), (0.1, 0.1, -0.5), (0.6, 0.1, -0.5))


@dataclass
class Followed:
    """What a pipeline said of a drive, with the truth.

    Attributes:
        frames: results.
        errors: of the position in map at each, m.
        way: driven up to each, m.
        map: at the end.
    """

    pipeline: Pipeline
    map: KeyframeMap
    frames: list[FrameResult] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    way: list[float] = field(default_factory=list)

    def saved(self) -> SavedMap:
        """The map as the store would give it back."""
        keyframes = tuple(k for k in self.entered)
        return SavedMap(keyframes, self.map.poses, self.map.edges, "test")

    @property
    def entered(self) -> list:
        return self._entered

    _entered: list = field(default_factory=list)


def robust_inputs(start: str = "new") -> ReplayInputs:
    inputs = prepare(RECORDING, None)
    c = inputs.configuration
    slam = c.slam.model_copy(update={"method": "robust", "start": start})
    return replace(inputs, configuration=c.model_copy(update={"slam": slam}))


@cache
def stream(world: str, waypoints: tuple, seed: int) -> list:
    """Measurements and truth of a drive."""
    return list(measurements(simulated_robot(world, np.array(waypoints), seed)))


def carried(first: Sequence, second: Sequence) -> Iterator[tuple[str, Measurement] | TruthEvent]:
    """Two drives one after the other by the same robot, carried in between within a second."""
    yield from first
    shift = max(m.time_ns for m in first if isinstance(m, TruthEvent)) + 1_000_000_000
    shift -= min(m.time_ns for m in second if isinstance(m, TruthEvent))
    turned = [m[1].angle for m in first if not isinstance(m, TruthEvent) and isinstance(m[1], ScrewAngles)][-1]
    begin = next(m[1].angle for m in second if not isinstance(m, TruthEvent) and isinstance(m[1], ScrewAngles))
    for item in second:
        if isinstance(item, TruthEvent):
            yield replace(item, time_ns=item.time_ns + shift)
            continue
        device, measurement = item
        measurement = replace(measurement, stamp_ns=measurement.stamp_ns + shift)
        if isinstance(measurement, ScrewAngles):
            measurement = replace(measurement, angle=measurement.angle - begin + turned)
        yield device, measurement


def follow(drive, known: SavedMap | None = None, start: str = "new", on_frame=lambda *_: None) -> Followed:
    """Run a drive through the pipeline; `on_frame(pipeline, frame)` may command it."""
    inputs = robust_inputs(start)
    pipeline = build_pipeline(inputs.configuration, inputs.layout, inputs.model, "synchronous", known)
    followed = Followed(pipeline, KeyframeMap(0.01))
    if known is not None:
        followed.map.load(known)
        followed._entered = list(known.keyframes)
    truth, last, driven = {}, None, 0.0

    def take(result) -> None:
        followed.map.take(result)
        followed._entered += result.new_keyframes

    for item in drive:
        if isinstance(item, TruthEvent):
            driven += 0.0 if last is None else float(np.hypot(*(item.position - last)[:2]))
            last = item.position
            truth[item.time_ns] = item.position, driven
            continue
        for frame in pipeline.add(*item):
            position, way = truth[frame.stamp_ns]
            followed.frames.append(frame)
            followed.errors.append(float(np.hypot(*(frame.T_map_base[:2, 3] - position[:2]))))
            followed.way.append(way)
            for result in frame.backend_results:
                take(result)
            on_frame(pipeline, frame)
    assert pipeline.runner is not None
    for result in pipeline.runner.close():
        take(result)
    return followed


@cache
def loop_map() -> SavedMap:
    """The map of LOOP."""
    return follow(stream("thesis", LOOP, 7)).saved()
