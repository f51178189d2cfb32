"""The view in words and figures with units: what the page's fields show, by the field's name."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence

import numpy as np

from robominer_slam import geometry
from robominer_slam.operator.live_frame import LiveFrame
from robominer_slam.operator.robot_view import RobotView
from robominer_slam.operator.status_entries import StatusEntry, faults_in_words, whisker_faults
from robominer_slam.publishing.telemetry import Health

NOTHING = "–"
#: Beyond this the place counts as unknown, m.
UNKNOWN_SIGMA_M = 5.0

STATE_WORDS = {
    "tracking": "localised",
    "dead_reckoning": "dead reckoning",
    "relocalizing": "looking for its place",
    "lost": "lost",
    "": "not heard yet",
}


def place_fields(frame: LiveFrame | None) -> dict[str, str]:
    """Where a frame says the robot is, and how sure."""
    if frame is None:
        return dict.fromkeys(("x", "y", "z", "heading", "sigma", "sigma_heading", "touching"), NOTHING) | {
            "state": STATE_WORDS[""]
        }
    xx, xy, yy, yaw = frame.covariance
    # The longer half axis of the one-sigma ellipse.
    sigma = math.sqrt(max(0.0, 0.5 * (xx + yy) + math.sqrt(0.25 * (xx - yy) ** 2 + xy**2)))
    heading = math.degrees(float(geometry.yaw_of(geometry.from_vector7(frame.pose))))
    valid = int(np.isfinite(frame.inclination).sum())
    return {
        "state": STATE_WORDS.get(frame.state, frame.state),
        # Adding zero makes -0 a plain 0.
        "x": f"{round(float(frame.pose[0]), 2) + 0.0:.2f} m",
        "y": f"{round(float(frame.pose[1]), 2) + 0.0:.2f} m",
        "z": f"{round(float(frame.pose[2]), 2) + 0.0:.2f} m",
        "heading": f"{round(heading, 1) + 0.0:.1f}°",
        "sigma": f"± {100.0 * sigma:.1f} cm" if sigma < UNKNOWN_SIGMA_M else "unknown",
        "sigma_heading": f"± {math.degrees(math.sqrt(max(yaw, 0.0))):.1f}°",
        "touching": f"{frame.touching} of {valid} usable" if len(frame.inclination) else NOTHING,
    }


def link_fields(view: RobotView, now_s: float) -> dict[str, str]:
    """What the link carries, and how late; `now_s` by the monotonic clock."""
    traffic = view.traffic
    age = traffic.live_age_s(now_s)
    outages = f"{traffic.outage_count}"
    if traffic.outage_count:
        outages += f", {traffic.outage_total_s:.0f} s in all"
    return {
        "heard": NOTHING if age is None else f"{age:.1f} s ago",
        "latency": NOTHING if view.latency_s is None else f"{1000.0 * view.latency_s:.0f} ms",
        "rate_pose": f"{traffic.rate_hz('pose', now_s):.1f} Hz",
        "rate_telemetry": f"{traffic.rate_hz('telemetry', now_s):.1f} Hz",
        "rate_whiskers": f"{traffic.rate_hz('whiskers/points', now_s):.1f} Hz",
        "bandwidth": f"{traffic.kilobits_per_s(now_s):.0f} kbit/s",
        "bandwidth_map": f"{traffic.kilobits_per_s(now_s, 'map/updates'):.0f} kbit/s",
        "received": f"{traffic.bytes_total / 1e6:.1f} MB",
        "outages": outages,
    }


def map_fields(view: RobotView) -> dict[str, str]:
    """What is mapped, and how far was driven."""
    keyframes = int((view.map.poses[: view.map.count, 3] > 0.0).sum())
    closures = len(view.map.closures)
    if view.telemetry is not None:
        closures = max(closures, view.telemetry.closures)
    return {
        "driven": f"{view.driven_m:.1f} m",
        "keyframes": f"{keyframes:,}",
        "points": f"{view.map.points:,}",
        "closures": f"{closures:,}",
        "map_version": str(view.map.version),
    }


class ProcessorMeter:
    """Share of one core, from the CPU seconds that `status` tells."""

    def __init__(self) -> None:
        self._last: tuple[float, float] | None = None
        self._share = math.nan

    def share(self, cpu_s: float, now_s: float) -> float:
        """Per cent of one core since the figure changed last; NaN until there were two."""
        if self._last is None:
            self._last = (cpu_s, now_s)
        elif cpu_s != self._last[0]:
            self._share = 100.0 * (cpu_s - self._last[0]) / max(now_s - self._last[1], 1e-3)
            self._last = (cpu_s, now_s)
        return self._share


def robot_fields(status: Sequence[StatusEntry], meter: ProcessorMeter, now_s: float) -> dict[str, str]:
    """The robot's computer: CPU, memory, disk, clock; `now_s` is when the status was made, by any clock."""
    entries = {entry.name: entry for entry in status}
    process, store = _values(entries, "process"), _values(entries, "store")
    cpu = math.nan if "cpu_s" not in process else meter.share(float(process["cpu_s"]), now_s)
    offset = process.get("clock.offset_ns")
    synchronised = [
        values["clock.uncertainty_us"]
        for name, entry in entries.items()
        if name.startswith("device/") and "clock.uncertainty_us" in (values := entry.values)
    ]
    return {
        "cpu": NOTHING if math.isnan(cpu) else f"{cpu:.0f} % of one core",
        "memory": f"{process['peak_memory_MB']} MB at most" if "peak_memory_MB" in process else NOTHING,
        "disk": f"{store['disk.free_MB']} MB free" if "disk.free_MB" in store else NOTHING,
        "store": entries["store"].message if "store" in entries else NOTHING,
        "clock": NOTHING if offset is None else f"set {process.get('clock.steps', '0')} times",
        "device_clocks": f"within {max(map(float, synchronised)):.0f} µs" if synchronised else NOTHING,
        "map_id": store.get("map_id", NOTHING),
    }


def devices(status: Sequence[StatusEntry]) -> list[list[str]]:
    """Name, state in words and how bad it is (0 to 3), of each device."""
    return [
        [entry.name.removeprefix("device/"), entry.message, str(int(entry.level))]
        for entry in status
        if entry.name.startswith("device/")
    ]


def _past(view: RobotView, stamp_ns: int) -> tuple[Sequence[StatusEntry], Health, dict[str, str]]:
    """What the robot said at a moment of the session, and the fields of its computer then."""
    status, before = view.status_history.at(stamp_ns), view.status_history.before(stamp_ns)
    if status is None:
        return (), Health.FINE, robot_fields((), ProcessorMeter(), 0.0)
    meter = ProcessorMeter()
    if before is not None:
        robot_fields(before.entries, meter, before.stamp_ns * 1e-9)
    return status.entries, status.health, robot_fields(status.entries, meter, status.stamp_ns * 1e-9)


def readings(view: RobotView, meter: ProcessorMeter, seek_ns: int | None = None) -> dict[str, object]:
    """All fields, the faults, and the whiskers' health; holds the view's lock.

    Args:
        view: what is known.
        meter: of the robot's CPU, now.
        seek_ns: the moment that is looked at, UNIX ns: what the robot said of itself is of then, the link's figures
            are always of now; None: now.
    """
    with view.lock:
        now = time.monotonic()
        cols = view.layout.cols if view.layout is not None else 1
        # A recording has one status, which tells how its reading went.
        if seek_ns is None or view.progress is not None:
            status, health, computer = view.status, view.health(), robot_fields(view.status, meter, now)
        else:
            status, health, computer = _past(view, seek_ns)
        fields = link_fields(view, now) | map_fields(view) | computer
        return {
            "fields": fields,
            "faults": faults_in_words(status, health),
            "whiskers": whisker_faults(status, cols),
            "devices": devices(status),
            "events": [[event.stamp_ns // 1_000_000, event.text] for event in list(view.events)[-50:]],
            "age": view.traffic.live_age_s(now),
            # What was said then is not stale: it is what is looked at.
            "status_age": view.traffic.age_s("status", now) if seek_ns is None else 0.0,
            "progress": view.progress,
            "waypoints": view.waypoints,
            "paused": bool(view.health() & view.health().PAUSED),
        }


def _values(entries: Mapping[str, StatusEntry], name: str) -> Mapping[str, str]:
    return entries[name].values if name in entries else {}
