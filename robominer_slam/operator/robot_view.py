"""What the console knows of the robot: filled by a link or a recording, read by the page; safe between threads."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robominer_slam.layout import WhiskerLayout
from robominer_slam.operator.array_model import default_layout
from robominer_slam.operator.live_frame import LiveFrame, covariance_of
from robominer_slam.operator.map_model import MapModel
from robominer_slam.operator.session_history import SessionHistory
from robominer_slam.operator.status_entries import StatusEntry
from robominer_slam.operator.status_history import PastStatus, StatusHistory
from robominer_slam.operator.traffic import Traffic
from robominer_slam.publishing.map_state import MapState
from robominer_slam.publishing.telemetry import Health, Telemetry

FloatArray = NDArray[np.float64]

#: Exact angles count before the coarse ones of telemetry while they are younger than this, s.
FRESH_ANGLES_S = 0.6
#: The way is summed in steps of this size, so that noise at rest does not add up, m; longer ones are jumps.
STEP_M, JUMP_M = 0.02, 0.5
KEPT_EVENTS = 200


@dataclass(frozen=True, slots=True)
class SessionEvent:
    """Something worth a line in the log: UNIX time in ns, and what happened."""

    stamp_ns: int
    text: str


class RobotView:
    """The robot as far as it is known here. Hold `lock` to read several attributes of one moment.

    Attributes:
        lock: to be held while reading what belongs together.
        live: the newest frame; None before the first.
        sequence: grows with every change of `live`.
        telemetry: the newest message; None before the first.
        status: the newest entries.
        layout: of the array; None while it is not known.
        map: the map.
        map_since_ns: stamp of the newest frame when another map began; 0 in the first.
        traffic: messages, bytes, outages.
        history: of the session.
        status_history: what the robot said of itself in it.
        events: log of what happened, the newest last.
        driven_m: since this console began to listen.
        latency_s: of the newest frame: arrival less its stamp, by both computers' clocks.
        waypoints: whether the robot is simulated and takes waypoints.
        progress: of a recording that is being read, 0 to 1; None where the robot is live.
    """

    def __init__(self, history: SessionHistory | None = None) -> None:
        self.lock = threading.RLock()
        self.live: LiveFrame | None = None
        self.sequence = 0
        self.telemetry: Telemetry | None = None
        self.status: Sequence[StatusEntry] = ()
        self.layout: WhiskerLayout | None = None
        self.layout_sequence = 0
        self.map = MapModel()
        self.map_since_ns = 0
        self.traffic = Traffic()
        self.history = history or SessionHistory()
        self.status_history = StatusHistory()
        self.events: deque[SessionEvent] = deque(maxlen=KEPT_EVENTS)
        self.driven_m = 0.0
        self.latency_s: float | None = None
        self.waypoints = False
        self.progress: float | None = None
        self._step_from: FloatArray | None = None
        self._exact_s = -math.inf
        self._invalid: NDArray[np.bool_] | None = None

    def take_layout(self, layout: WhiskerLayout) -> None:
        """The array as the robot describes it."""
        with self.lock:
            self.layout = layout
            self.layout_sequence += 1

    def take_pose(self, stamp_ns: int, pose: FloatArray, covariance: FloatArray) -> None:
        """A pose with its covariance (4,), from `pose`."""
        with self.lock:
            live = self.live
            if live is None:
                self._set(LiveFrame(stamp_ns, pose, covariance, self._state(), np.zeros(0), np.zeros(0)))
            elif stamp_ns > live.stamp_ns:
                self._set(replace(live, stamp_ns=stamp_ns, pose=pose, covariance=covariance))

    def take_angles(self, stamp_ns: int, inclination: FloatArray, azimuth: FloatArray) -> None:
        """Exact angles of the whiskers, from `whiskers/points`."""
        with self.lock:
            self._exact_s = time.monotonic()
            live = self.live
            if live is None or stamp_ns < live.stamp_ns:
                return
            if self._invalid is not None and len(self._invalid) == len(inclination):
                inclination = np.where(self._invalid & (inclination == 0.0), np.nan, inclination)
            self._set(replace(live, inclination=inclination, azimuth=azimuth))

    def take_telemetry(self, telemetry: Telemetry) -> None:
        """Telemetry: all there is on a remote link, and everywhere the state and the whiskers without a reading."""
        with self.lock:
            before = self.telemetry
            self.telemetry = telemetry
            self._note_changes(before, telemetry)
            rows, cols = telemetry.inclination.shape
            if self.layout is None and (layout := default_layout(rows, cols)) is not None:
                self.take_layout(layout)
            inclination, azimuth = telemetry.inclination.ravel(), telemetry.azimuth.ravel()
            self._invalid = np.isnan(inclination)
            live = self.live
            if live is None or telemetry.stamp_ns > live.stamp_ns:
                live = LiveFrame(
                    telemetry.stamp_ns, telemetry.pose, covariance_of(telemetry), telemetry.state, inclination, azimuth
                )
            if time.monotonic() - self._exact_s > FRESH_ANGLES_S or len(live.inclination) != len(inclination):
                live = replace(live, inclination=inclination, azimuth=azimuth)
            self._set(replace(live, state=telemetry.state))

    def take_frame(self, frame: LiveFrame) -> None:
        """A whole frame, from a recording."""
        with self.lock:
            self._set(frame)

    def take_status(self, entries: Sequence[StatusEntry]) -> None:
        """What the robot says of itself."""
        with self.lock:
            self.status = entries
            if self.live is not None:
                self.status_history.add(PastStatus(self.live.stamp_ns, entries, self.health()))

    def take_map(self, state: MapState) -> None:
        """The map's newest state."""
        with self.lock:
            if self.map.map_id not in (0, state.map_id):
                self.note(f"another map begins: {state.map_id:016x}")
                # Places of before mean nothing in it.
                self.map_since_ns = 0 if self.live is None else self.live.stamp_ns
            self.map.update(state)

    def take_closures(self, pairs: list[tuple[int, int]]) -> None:
        """Loop closures as pairs of keyframe ids."""
        with self.lock:
            self.map.set_closures(pairs)

    def note(self, text: str) -> None:
        """Add a line to the log."""
        with self.lock:
            self.events.append(SessionEvent(time.time_ns(), text))

    def health(self) -> Health:
        """The newest health bits."""
        with self.lock:
            return Health.FINE if self.telemetry is None else self.telemetry.health

    def _state(self) -> str:
        return "" if self.telemetry is None else self.telemetry.state

    def _set(self, frame: LiveFrame) -> None:
        self.live = frame
        self.sequence += 1
        self.history.add(frame)
        if self.progress is None:
            self.latency_s = (time.time_ns() - frame.stamp_ns) * 1e-9
        place = frame.pose[:3]
        if self._step_from is None:
            self._step_from = place
            return
        step = math.dist(place, self._step_from)
        if step >= STEP_M:
            self.driven_m += step if step < JUMP_M else 0.0
            self._step_from = place

    def _note_changes(self, before: Telemetry | None, now: Telemetry) -> None:
        if before is None:
            self.note(f"first heard of the robot: {now.state.replace('_', ' ')}")
            return
        if before.state != now.state:
            self.note(f"localisation: {before.state.replace('_', ' ')} to {now.state.replace('_', ' ')}")
        if now.closures > before.closures:
            self.note(f"loop closed: {now.closures} closures")
