"""A robot as an operator's console meets it: the real messages on a real Zenoh session, what they say made up."""

from __future__ import annotations

import json
import math
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robominer_slam import geometry
from robominer_slam.layout import WhiskerLayout, thesis_grid
from robominer_slam.publishing import cloud_messages, pose_messages, report_messages
from robominer_slam.publishing.bus_messages import Query, Reply
from robominer_slam.publishing.map_stream import MapStreamEncoder
from robominer_slam.publishing.pose_messages import StampedTransform
from robominer_slam.publishing.report_messages import Diagnostic, Level
from robominer_slam.publishing.telemetry import Health, Telemetry, encode
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSettings
from robominer_slam.saved_maps import SavedMaps

RATE_HZ = 25
RADIUS_M = 1.0
SPEED_M_S = 0.3
KEYFRAME_M = 0.12


@dataclass(frozen=True)
class MadeKeyframe:
    """What the map stream takes."""

    id: int
    stamp_ns: int
    points: np.ndarray


def ground(points: np.ndarray) -> np.ndarray:
    """Heights of a hilly ground, m; x and y of shape (m, 2)."""
    return -0.12 + 0.03 * np.sin(2.1 * points[:, 0]) * np.cos(1.7 * points[:, 1])


def keyframe(key: int, pose: np.ndarray, count: int, rng: np.random.Generator) -> MadeKeyframe:
    """Points of the ground around a pose (x, y, yaw)."""
    T = geometry.T_from_xyyaw(pose)
    points = np.zeros((count, 3))
    points[:, :2] = rng.uniform(-0.28, 0.28, (count, 2))
    in_map = geometry.transform_points(T, points)
    points[:, 2] = ground(in_map)
    return MadeKeyframe(key, time.time_ns(), points.astype(np.float32))


class PublishedRobot:
    """Drives in a circle and publishes; use it with `with`.

    Attributes:
        bend: inclination (rad) of whiskers that touch, by index.
        faults: whiskers that are left out, by index: as `status` says it.
        commands: what was asked for, in order: name and parameters.
        database: of saved maps; None: this robot has no store.
        obeys: whether commands are answered at all.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        remote: bool = False,
        points: int = 60,
        keyframe_m: float = KEYFRAME_M,
        most_keyframes: int | None = None,
        settings: ZenohSettings | None = None,
    ) -> None:
        self._most, self._made = most_keyframes, 0
        self._settings = settings or ZenohSettings(listen=(endpoint,))
        self.endpoint, self._remote, self._points, self._keyframe_m = endpoint, remote, points, keyframe_m
        self.bend: dict[int, float] = dict.fromkeys(range(16, 24), math.radians(20.0))
        self.faults: dict[int, str] = {}
        self.health = Health.FINE
        self.commands: list[tuple[str, dict[str, str]]] = []
        self.obeys = True
        self.waypoints: list[tuple[float, float]] = []
        self.simulated = False
        self.database: Path | None = None
        self.state = "tracking"
        self.layout: WhiskerLayout = thesis_grid()
        self.lock = threading.Lock()
        self.keyframes: list[MadeKeyframe] = []
        self.poses = np.zeros((0, 7))
        self.closures: list[tuple[int, int]] = []
        self.version = 0
        self.frames = 0
        self._encoder = MapStreamEncoder(0x1234)
        self._rng = np.random.default_rng(1)
        self._distance = 0.0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> PublishedRobot:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        self._stop.clear()
        self._bus = ZenohBus(self._settings, "robominer/rm3")
        mounts = geometry.from_rotation_translation(self.layout.R_base_whisker, self.layout.p_base)
        names = [f"whisker_{i // self.layout.cols}_{i % self.layout.cols}" for i in range(self.layout.count)]
        transforms = [
            StampedTransform(0, "base_link", name, geometry.to_vector7(T))
            for name, T in zip(names, mounts, strict=True)
        ]
        self._bus.latch("tf_static", pose_messages.transforms(transforms))
        self._bus.queryable("map/snapshot", lambda _: self._snapshot())
        self._bus.queryable("map/closures", lambda query: Reply(self._closures(int(query.parameters["first"]))))
        if self.database is not None:
            self._bus.queryable("map/saved", SavedMaps(self.database, lambda: 1, None).answer)
        if self.obeys:
            self._bus.queryable("cmd/*", self._command)
        if self.simulated:
            self._bus.queryable("sim/waypoint", self._waypoint)
        self._thread = threading.Thread(target=self._drive, name="published-robot")
        self._thread.start()

    def stop(self) -> None:
        """Cut the link."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            self._bus.close()

    def _snapshot(self) -> list[Reply]:
        with self.lock:
            messages = self._encoder.snapshot()
        return [Reply(b"".join(messages[k : k + 100])) for k in range(0, len(messages), 100)]

    def _closures(self, first: int) -> bytes:
        """Three to an answer."""
        with self.lock:
            return json.dumps({"total": len(self.closures), "pairs": self.closures[first : first + 3]}).encode()

    def _command(self, query: Query) -> Reply:
        name = query.key.rsplit("/", 1)[-1]
        self.commands.append((name, dict(query.parameters)))
        if name == "pause":
            self.health |= Health.PAUSED
        if name == "new_map":
            return Reply(b'{"ok": false, "message": "the map is frozen"}')
        return Reply(json.dumps({"ok": True, "message": f"{name} is done"}).encode())

    def _waypoint(self, query: Query) -> Reply:
        if "x" in query.parameters:
            self.waypoints.append((float(query.parameters["x"]), float(query.parameters["y"])))
        return Reply(b'{"ok": true, "message": "driven"}', "application/json")

    def pose(self) -> np.ndarray:
        """x, y, yaw on the circle."""
        angle = self._distance / RADIUS_M
        return np.array([RADIUS_M * math.sin(angle), RADIUS_M * (1.0 - math.cos(angle)), angle])

    def _drive(self) -> None:
        next_frame, sent_keyframes = time.monotonic(), -1
        next_telemetry = next_status = next_pose = 0.0
        while not self._stop.wait(max(0.0, next_frame - time.monotonic())):
            now = time.monotonic()
            # What could not be published in time is left out, as a robot's sensors would.
            next_frame = max(next_frame, now - 0.2) + 1.0 / RATE_HZ
            self.frames += 1
            self._distance += SPEED_M_S / RATE_HZ
            if int(self._distance / self._keyframe_m) != sent_keyframes:
                sent_keyframes = int(self._distance / self._keyframe_m)
                self.map_step()
            stamp = time.time_ns()
            if not self._remote or now >= next_pose:
                next_pose = now + 1.0
                self._publish_pose(stamp)
            if now >= next_telemetry:
                next_telemetry = now + 0.25
                self._publish_telemetry(stamp)
            if now >= next_status:
                next_status = now + 1.0
                self._publish_status(stamp)

    def map_step(self) -> None:
        """Another keyframe where the robot is."""
        with self.lock:
            made = keyframe(self._made, self.pose(), self._points, self._rng)
            self._made += 1
            vector = geometry.to_vector7(geometry.T_from_xyyaw(self.pose()))
            # A bounded map forgets its oldest.
            kept = slice(None) if self._most is None else slice(-self._most, None)
            self.publish_map([*self.keyframes, made][kept], np.vstack([self.poses, vector])[kept])

    def publish_map(self, keyframes: list[MadeKeyframe], poses: np.ndarray) -> None:
        """The caller holds the lock."""
        self.keyframes, self.poses = keyframes, poses
        self.version += 1
        for message in self._encoder.update(self.version, keyframes, poses):
            self._bus.put("map/updates", message)

    def begin_map(self) -> None:
        """Another map, empty at first."""
        with self.lock:
            self._made = 0
            self._encoder = MapStreamEncoder(0x5678)
            self.publish_map([], np.zeros((0, 7)))

    def preload(self, keyframes: list[MadeKeyframe], poses: np.ndarray) -> None:
        """A map that is there before the robot is switched on."""
        self.keyframes, self.poses = keyframes, poses
        self.version += 1
        self._made = len(keyframes)
        self._encoder.update(self.version, keyframes, poses)

    def _publish_pose(self, stamp: int) -> None:
        covariance = np.diag([4e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])
        pose = geometry.to_vector7(geometry.T_from_xyyaw(self.pose()))
        self._bus.put("pose", pose_messages.pose_with_covariance(stamp, "map", pose, covariance))
        if self._remote:
            return
        index = np.array([k for k in sorted(self.bend) if k not in self.faults], dtype=np.intp)
        inclination = np.array([self.bend[k] for k in index.tolist()])
        points, azimuth = np.zeros((len(index), 3)), np.full(len(index), math.pi)
        cloud = cloud_messages.contact_cloud(stamp, "base_link", points, index, inclination, azimuth)
        self._bus.put("whiskers/points", cloud)

    def _publish_telemetry(self, stamp: int) -> None:
        inclination = np.zeros(self.layout.count)
        for k, value in self.bend.items():
            inclination[k] = value
        inclination[list(self.faults)] = np.nan
        shape = (self.layout.rows, self.layout.cols)
        message = Telemetry(
            self.frames, stamp, self.state, geometry.to_vector7(geometry.T_from_xyyaw(self.pose())), np.full(6, 0.02),
            np.array([SPEED_M_S, 0.0, 0.0]), len(self.bend), inclination.reshape(shape), np.full(shape, math.pi),
            self.health, self.version, len(self.keyframes), len(self.closures),
        )  # fmt: skip
        self._bus.put("telemetry", encode(message))

    def _publish_status(self, stamp: int) -> None:
        cols = self.layout.cols
        left_out = {f"whisker ({k // cols}, {k % cols})": text for k, text in self.faults.items()}
        words = ", ".join(f"({k // cols}, {k % cols}) {text.split()[0]}" for k, text in self.faults.items())
        whiskers = (
            Diagnostic("whiskers", Level.WARN, f"{len(self.faults)} left out: {words}", {"invalid": "", **left_out})
            if self.faults
            else Diagnostic("whiskers", Level.OK, "all readings usable", {"invalid": ""})
        )
        process = {"cpu_s": f"{0.1 * self.frames / RATE_HZ:.2f}", "peak_memory_MB": "120.0", "clock.steps": "0",
                   "clock.offset_ns": "1"}  # fmt: skip
        entries = [
            Diagnostic("localization", Level.OK, self.state, {"localization.state": self.state}),
            Diagnostic("process", Level.OK, "running", process),
            Diagnostic("store", Level.OK, "12 keyframes stored", {"map_id": "1", "disk.free_MB": "5100"}),
            Diagnostic("device/whiskers", Level.OK, "streaming", {"clock.uncertainty_us": "90"}, "whiskers"),
            whiskers,
        ]
        self._bus.put("status", report_messages.diagnostics(stamp, entries))
