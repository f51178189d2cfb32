"""A recording instead of a robot: replayed through the same pipeline, as fast as it goes, into a `RobotView`."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from concurrent.futures import CancelledError
from pathlib import Path
from types import TracebackType

import numpy as np

from robominer_slam import geometry
from robominer_slam.frame_result import FrameResult
from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.operator.commands import CommandResult, Outcome
from robominer_slam.operator.live_frame import LiveFrame
from robominer_slam.operator.robot_view import RobotView
from robominer_slam.operator.saved_maps import SavedMapEntry
from robominer_slam.operator.status_entries import StatusEntry
from robominer_slam.publishing.bus_messages import QueryError
from robominer_slam.publishing.map_state import MapState
from robominer_slam.publishing.map_stream import MapStreamDecoder, MapStreamEncoder
from robominer_slam.publishing.report_messages import Level
from robominer_slam.replay import prepare, replay
from robominer_slam.slam.keyframe import BackendResult

log = logging.getLogger(__name__)

MAP_ID = 1
_PLANAR_TERMS = ([0, 0, 1, 2], [0, 1, 1, 2])


class RecordingSource:
    """Fills a view from a recording, in a thread named `operator-recording`; use it with `with`.

    Attributes:
        view: what has been read.
        robot: its id.
    """

    def __init__(self, path: Path, configuration: Path | None = None, view: RobotView | None = None) -> None:
        """Open the recording and begin to read.

        Raises:
            RecordingError, ConfigurationError, LayoutError, CalibrationFileError: each with one clear line.
        """
        self.view = view or RobotView()
        self.view.progress = 0.0
        self._name = path.name
        self._inputs = prepare(path, configuration)
        self.robot = self._inputs.configuration.robot.id
        self.view.take_layout(self._inputs.layout)
        self._map = KeyframeMap(self._inputs.configuration.map.point_voxel)
        self._encoder, self._decoder = MapStreamEncoder(MAP_ID), MapStreamDecoder()
        self._first_ns: int | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, name="operator-recording", daemon=True)
        self._thread.start()

    def __enter__(self) -> RecordingSource:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop reading."""
        self._stop.set()
        self._thread.join()

    def saved_maps(self) -> list[SavedMapEntry]:
        """A recording has no disk."""
        return []

    def saved_map(self, number: int) -> MapState:
        """There is none.

        Raises:
            QueryError: always.
        """
        raise QueryError(f"map {number}: this is a recording: there are no saved maps")

    def command(self, _name: str, _parameters: Mapping[str, str], /) -> CommandResult:
        """Nobody is there to do anything."""
        return CommandResult(Outcome.REFUSED, "this is a recording: there is no robot to command")

    def _read(self) -> None:
        try:
            result = replay(self._inputs, self._on_frame, self._on_message, on_rest=self._take)
        except CancelledError:
            return
        except Exception as error:
            # Whatever it is: the operator must see that the rest is missing, and the log why.
            log.exception("the recording could not be read to its end")
            self.view.note(f"{self._name} could not be read to its end: {error}")
            self._status(Level.ERROR, f"could not be read to its end: {error}", {})
            return
        counts = {name: str(count) for name, count in result.counters.items()}
        self._status(Level.OK, f"{self._name}: {result.frames} frames", counts)
        self.view.note(f"{self._name} read: {result.frames} frames")
        self.view.progress = 1.0

    def _on_message(self, log_time_ns: int) -> None:
        if self._stop.is_set():
            raise CancelledError
        if self._first_ns is None:
            self._first_ns = log_time_ns
        duration = max(self._inputs.recording.duration_ns, 1)
        self.view.progress = min(0.999, (log_time_ns - self._first_ns) / duration)

    def _on_frame(self, frame: FrameResult) -> None:
        for result in frame.backend_results:
            self._take(result)
        count = self._inputs.layout.count
        inclination = np.where(frame.angles.valid, 0.0, np.nan)
        inclination[frame.contacts.index] = frame.contacts.inclination
        azimuth = np.zeros(count)
        azimuth[frame.contacts.index] = frame.contacts.azimuth
        self.view.take_frame(
            LiveFrame(
                frame.stamp_ns,
                geometry.to_vector7(frame.T_map_base),
                frame.covariance[_PLANAR_TERMS],
                frame.state,
                inclination,
                azimuth,
            )
        )

    def _take(self, result: BackendResult) -> None:
        self._map.take(result)
        self._publish()

    def _publish(self) -> None:
        poses = geometry.to_vector7(self._map.poses)
        changed = False
        for message in self._encoder.update(self._map.version, self._map.keyframes, poses, 0):
            changed |= self._decoder.feed(message)
        if changed and self._decoder.state is not None:
            self.view.take_map(self._decoder.state)
        self.view.take_closures([(edge.i, edge.j) for edge in self._map.edges if edge.kind == "loop"])

    def _status(self, level: Level, message: str, values: dict[str, str]) -> None:
        self.view.take_status([StatusEntry("recording", level, message, values)])
