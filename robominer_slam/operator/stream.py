"""What one page gets over its WebSocket: JSON for what is small, binary for points and poses; only what changed.

A page that reads slowly gets fewer messages, never a queue of old ones: each turn sends the newest of everything
and waits until that has left.

Text messages are objects with `kind`: `array`, `live`, `readings`, `map`, `closures`, `trail`. Binary ones begin
with three u32: 1 (points), chunk, count, then count x 4 x i16; or 2 (poses), first slot, count, then count x 8 x f32.
"""

from __future__ import annotations

import asyncio
import json
import struct
import time
from typing import Protocol

import numpy as np

from robominer_slam.operator.live_frame import LiveFrame
from robominer_slam.operator.readings import ProcessorMeter, place_fields, readings
from robominer_slam.operator.robot_view import RobotView
from robominer_slam.publishing.map_state import POINT_UNIT_M

#: The least time between two turns: twice as often as the fastest array is read, s.
TURN_S = 0.02
READINGS_S = 0.3
#: Map changes are sent at most so often, s.
MAP_S = 0.1
TRAIL_S, TRAIL_POINTS = 2.0, 2000
#: Chunks to a turn, so that a large map does not hold up the poses.
CHUNKS_PER_TURN = 8
_HEAD = struct.Struct("<III")
POINTS, POSES = 1, 2


class Socket(Protocol):
    """The part of a WebSocket that is used."""

    async def send_text(self, data: str) -> None:
        """Send text; returns when the connection can take more."""

    async def send_bytes(self, data: bytes) -> None:
        """Send bytes; returns when the connection can take more."""


class PageStream:
    """Follows a view for one page.

    Attributes:
        seek_ns: the moment that the page looks at; None: now.
    """

    def __init__(self, view: RobotView, socket: Socket, meter: ProcessorMeter) -> None:
        self.seek_ns: int | None = None
        self._view, self._socket, self._meter = view, socket, meter
        self._layout_sequence = self._generation = -1
        self._live_shown: tuple[int, int | None] = (-1, None)
        self._map_revision = self._closures_revision = -1
        self._chunks: dict[int, int] = {}
        self._waiting: list[int] = []
        self._due = dict.fromkeys(("readings", "map", "trail"), 0.0)
        self._range = (0.0, 0.0)

    async def run(self) -> None:
        """Send until the connection ends, which raises."""
        while True:
            begin = time.monotonic()
            await self._array()
            await self._live()
            if self._is_due("map", MAP_S):
                await self._map()
            await self._points()
            if self._is_due("trail", TRAIL_S):
                await self._trail()
            if self._is_due("readings", READINGS_S):
                await self._json("readings", **readings(self._view, self._meter, self.seek_ns))
            await asyncio.sleep(max(0.001, TURN_S - (time.monotonic() - begin)))

    def _is_due(self, name: str, interval_s: float) -> bool:
        now = time.monotonic()
        if now < self._due[name]:
            return False
        self._due[name] = now + interval_s
        return True

    async def _json(self, kind: str, **values: object) -> None:
        await self._socket.send_text(json.dumps({"kind": kind, **values}, separators=(",", ":")))

    async def _array(self) -> None:
        layout = self._view.layout
        if layout is None or self._view.layout_sequence == self._layout_sequence:
            return
        self._layout_sequence = self._view.layout_sequence
        await self._json(
            "array",
            rows=layout.rows,
            cols=layout.cols,
            base=np.round(layout.p_base, 4).tolist(),
            rotation=np.round(layout.R_base_whisker, 5).reshape(-1, 9).tolist(),
            length=layout.length.tolist(),
            present=layout.present.tolist(),
        )

    async def _live(self) -> None:
        view = self._view
        with view.lock:
            # A moment of the past is the same until another is asked for.
            shown = (view.sequence if self.seek_ns is None else -2, self.seek_ns)
            if shown == self._live_shown:
                return
            frame = view.live if self.seek_ns is None else view.history.at(self.seek_ns)
            slots = view.map.count if self.seek_ns is None else view.map.slots_until(self.seek_ns)
            span = view.history.span_ns
        self._live_shown = shown
        if frame is not None and span is not None:
            await self._json("live", **_frame_json(frame), slots=slots, past=self.seek_ns is not None, span=_ms(span))

    async def _map(self) -> None:
        view = self._view
        with view.lock:
            model = view.map
            if model.generation != self._generation:
                self._generation = model.generation
                self._map_revision = self._closures_revision = -1
                self._chunks, self._waiting = {}, []
                reset = True
            else:
                reset = False
            if model.revision == self._map_revision and not reset:
                return
            moved = np.flatnonzero(model.pose_revision[: model.count] > self._map_revision)
            self._map_revision = model.revision
            first, last = (int(moved[0]), int(moved[-1]) + 1) if len(moved) else (0, 0)
            poses = model.poses[first:last].tobytes()
            bounds, heights = np.round(model.bounds(), 3).tolist(), model.height_range()
            changed = [k for k, revision in enumerate(model.chunk_revision) if self._chunks.get(k, -1) < revision]
            # The newest ground first: it is where the robot is.
            self._waiting = sorted(set(changed), reverse=True)
            closures = None
            if model.closures_revision > self._closures_revision:
                self._closures_revision, closures = model.closures_revision, model.closures.ravel().tolist()
            count, points, spacing = model.count, model.points, round(model.spacing(), 4)
        await self._json(
            "map",
            reset=reset,
            slots=count,
            points=points,
            unit=POINT_UNIT_M,
            spacing=spacing,
            bounds=bounds,
            heights=self._steady(heights),
        )
        if last > first:
            await self._socket.send_bytes(_HEAD.pack(POSES, first, last - first) + poses)
        if closures is not None:
            await self._json("closures", pairs=closures)

    async def _points(self) -> None:
        for _ in range(min(CHUNKS_PER_TURN, len(self._waiting))):
            index = self._waiting.pop(0)
            with self._view.lock:
                model = self._view.map
                if model.generation != self._generation:
                    return
                self._chunks[index] = model.chunk_revision[index]
                points = model.chunk(index)
            await self._socket.send_bytes(_HEAD.pack(POINTS, index, len(points)) + points.tobytes())

    async def _trail(self) -> None:
        with self._view.lock:
            trail = self._view.history.trail(TRAIL_POINTS, self._view.map_since_ns)
        await self._json("trail", points=np.round(trail, 3).ravel().tolist())

    def _steady(self, heights: tuple[float, float]) -> tuple[float, float]:
        """The range of heights, which follows only when it has moved by a tenth: colours must not flicker."""
        low, high = self._range
        span = heights[1] - heights[0]
        if abs(heights[0] - low) > 0.1 * span or abs(heights[1] - high) > 0.1 * span:
            self._range = (round(heights[0], 3), round(heights[1], 3))
        return self._range


def _ms(span_ns: tuple[int, int]) -> list[int]:
    return [stamp // 1_000_000 for stamp in span_ns]


def _frame_json(frame: LiveFrame) -> dict[str, object]:
    """Angles in tenths of a degree; null where there is no valid reading."""
    inclination = np.rint(np.rad2deg(frame.inclination) * 10.0)
    azimuth = np.rint(np.rad2deg(frame.azimuth) * 10.0)
    valid = np.isfinite(inclination)
    return {
        "stamp": frame.stamp_ns / 1e6,
        "pose": [round(float(value), 5) for value in frame.pose],
        "covariance": [float(f"{value:.4g}") for value in frame.covariance],
        "state": frame.state,
        "inclination": [int(v) if ok else None for v, ok in zip(inclination, valid, strict=True)],
        "azimuth": [int(v) if ok else 0 for v, ok in zip(azimuth, valid & np.isfinite(azimuth), strict=True)],
        "place": place_fields(frame),
    }
