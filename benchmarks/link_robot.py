"""A robot as far as the link sees it: TLS, telemetry, poses, status, and a map that grows. Run by remote_link.py.

    python -m benchmarks.link_robot --credentials FOLDER --listen tls/ADDRESS:PORT [--keyframes 4000] [--step 1.7]

No SLAM, so that the map can be of any size at once and the machine has time for the link. Poses come 25 times a
second and telemetry four times, as from the daemon. Ends with its input.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.long_drive import drive
from robominer_slam import geometry
from robominer_slam.configuration.model import ZenohSection
from robominer_slam.publishing import pose_messages, report_messages
from robominer_slam.publishing.bus_messages import Query, Reply
from robominer_slam.publishing.map_publisher import MapPublisher
from robominer_slam.publishing.report_messages import Diagnostic, Level
from robominer_slam.publishing.robot_settings import robot_settings
from robominer_slam.publishing.telemetry import Telemetry, encode
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.remote_status import RemoteStatus, short_status

PREFIX = "robominer/rm3"
MAP_ID = 73
CELL = 0.03
FRAME_S = 0.04
#: Frames between telemetry messages, and between the map's chances of a status.
TELEMETRY_FRAMES, STATUS_FRAMES = 6, 25
#: Correction of the whole map, as by a loop closure: of so many keyframes, m.
CORRECTION_M = 0.02


@dataclass(frozen=True, slots=True)
class Source:
    """A keyframe as the encoder takes it."""

    id: int
    stamp_ns: int
    points: NDArray[np.floating]


class GrowingMap:
    """A corridor, keyframe by keyframe, and its stream."""

    def __init__(self, bus: ZenohBus, total: int) -> None:
        self.publisher = MapPublisher(bus, MAP_ID, CELL)
        self._drive = drive("corridor", 1, total)
        self._sources: list[Source] = []
        self._poses: list[NDArray[np.float64]] = []

    def grow(self, count: int = 1, shift_m: float = 0.0) -> None:
        """Some more keyframes in one version, after moving the whole map by some metres."""
        for _ in range(count):
            keyframe, _ = next(self._drive)
            self._sources.append(Source(keyframe.id, time.time_ns(), keyframe.points))
            self._poses.append(geometry.to_vector7(keyframe.T_odom_base))
        if shift_m:
            for pose in self._poses:
                pose[0] += shift_m
        self.publisher.update(self.publisher.state.version + 1, self._sources, np.array(self._poses))


def serve(
    bus: ZenohBus, world: GrowingMap, step_s: float, hurry_s: float, correct_every: int, stop: threading.Event
) -> None:
    """Publish until told to stop."""
    lock = threading.Lock()

    def answer(query: Query) -> list[Reply]:
        with lock:
            return world.publisher.answer(query)

    paused = threading.Event()

    def pause(_: Query) -> Reply:
        paused.set()
        return Reply(b'{"ok": true, "message": "paused"}')

    bus.queryable("map/snapshot", answer)
    bus.queryable("cmd/pause", pause)
    status = RemoteStatus()
    none = np.zeros((8, 8))
    begun, frame, keyframe_s, keyframes = time.monotonic(), 0, time.monotonic(), 0
    while not stop.wait(max(0.0, begun + frame * FRAME_S - time.monotonic())):
        now_ns, pose = time.time_ns(), np.array([0.0, 0, 0, 0, 0, 0, 1])
        state = world.publisher.state
        bus.put("pose", pose_messages.pose_with_covariance(now_ns, "map", pose, np.eye(6)))
        if frame % TELEMETRY_FRAMES == 0:
            message = Telemetry(
                frame // TELEMETRY_FRAMES, now_ns, "tracking", pose, np.ones(6), np.zeros(3), 0, none, none,
                map_version=state.version, keyframes=len(state.keyframes),
            )  # fmt: skip
            bus.put("telemetry", encode(message))
        if frame % STATUS_FRAMES == 0:
            values = {"localization.state": "tracking", "paused": str(paused.is_set()).lower()}
            values |= {"map.version": str(state.version), "map.digest": state.digest().hex()}
            entries = [Diagnostic("localization", Level.OK, "tracking", values)]
            bus.put("status", report_messages.diagnostics(now_ns, entries) + bytes(400))
            if status.due(time.monotonic_ns(), entries, bus.remote_links()):
                bus.put("status", short_status(now_ns, entries))
        if hurry_s and time.monotonic() - begun > hurry_s:
            step_s, hurry_s = 10.0 * step_s, 0.0
        if step_s and not paused.is_set() and time.monotonic() - keyframe_s >= step_s:
            keyframe_s += step_s
            keyframes += 1
            shift = CORRECTION_M if correct_every and keyframes % correct_every == 0 else 0.0
            with lock:
                world.grow(1, shift)
        frame += 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--credentials", type=Path, required=True)
    parser.add_argument("--listen", required=True)
    parser.add_argument("--keyframes", type=int, default=0, help="In the map from the beginning.")
    parser.add_argument("--step", type=float, default=1.7, help="Seconds between keyframes; 0: none.")
    parser.add_argument("--hurry", type=float, default=0.0, help="After so many seconds, ten times as slow; 0: never.")
    parser.add_argument("--correct-every", type=int, default=0, help="Keyframes between corrections of the whole map.")
    arguments = parser.parse_args()
    section = ZenohSection(credentials=str(arguments.credentials), listen=(arguments.listen,))
    stop = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), name="end-of-input", daemon=True).start()
    with ZenohBus(robot_settings(section, Path.cwd(), PREFIX), PREFIX) as bus:
        world = GrowingMap(bus, arguments.keyframes + 100_000)
        if arguments.keyframes:
            world.grow(arguments.keyframes)
        whole = world.publisher.answer(Query("map/snapshot", {}, b""))
        size = sum(len(reply.payload) for reply in whole)
        points = sum(len(one.points) for one in world.publisher.state.keyframes.values())
        print(json.dumps({"ready": True, "snapshot_bytes": size, "points": points}), flush=True)
        serve(bus, world, arguments.step, arguments.hurry, arguments.correct_every, stop)


if __name__ == "__main__":
    main()
