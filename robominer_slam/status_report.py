"""What `status` says: localisation, SLAM, devices, whiskers, process, in words and figures."""

from __future__ import annotations

import resource
import shutil
from collections.abc import Sequence

import numpy as np

from drivers.device import DeviceStatus
from robominer_slam.frame_result import FrameResult
from robominer_slam.layout import WhiskerLayout
from robominer_slam.load_shedding import WORDS, LoadShedding, Shed
from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.pipeline import Pipeline
from robominer_slam.publishing.report_messages import Diagnostic, Level
from robominer_slam.store import MapStore
from robominer_slam.wall_clock import WallClock

#: No whisker frame for this long: poses are stale.
STALE_S = 1.0


def device_diagnostic(status: DeviceStatus) -> Diagnostic:
    """One device."""
    level = Level.OK if status.state == "streaming" else Level.WARN if status.state == "synchronising" else Level.ERROR
    values = {
        "port": status.path or "",
        "firmware": status.firmware,
        "clock.offset_ns": str(status.clock_offset_ns),
        "clock.uncertainty_us": f"{status.clock_uncertainty_ns / 1000:.0f}",
        "clock.drift_ppm": f"{status.clock_drift * 1e6:.1f}",
        **{f"count.{name}": str(count) for name, count in sorted(status.counters.items())},
    }
    text = f"{status.state}: {status.fault}" if status.fault else status.state
    return Diagnostic(f"device/{status.name}", level, text, values, status.name)


def slam_diagnostic(
    frame: FrameResult | None, frame_age_s: float, pipeline: Pipeline, keyframe_map: KeyframeMap, digest: str
) -> Diagnostic:
    """Localisation and map."""
    values = {
        "localization.state": frame.state if frame is not None else "lost",
        "map.version": str(keyframe_map.version),
        "map.digest": digest,
        "keyframes": str(len(keyframe_map.keyframes)),
        "loop_closures": str(keyframe_map.closures),
        "paused": str(pipeline.paused).lower(),
        "late_measurements": str(pipeline.reorder.late),
        "dropped_measurements": str(pipeline.reorder.dropped),
        "wrong_size_frames": str(pipeline.wrong_size_frames),
        "stale_frames": str(pipeline.stale_frames),
        "out_of_range_readings": str(pipeline.angle_estimator.out_of_range),
    }
    if pipeline.runner is not None:
        values["backend.late"] = str(pipeline.runner.late)
        values["backend.max_late_s"] = f"{pipeline.runner.max_late_ns * 1e-9:.3f}"
        values["backend.busy_s"] = f"{pipeline.runner.busy_s:.3f}"
        values |= {f"backend.{name}": str(count) for name, count in sorted(pipeline.backend_counts.items())}
    if frame is None:
        return Diagnostic("localization", Level.WARN, "no whisker frame yet", values)
    values["sigma_xy_m"] = f"{np.sqrt(np.trace(frame.covariance[:2, :2])):.3f}"
    values["sigma_yaw_deg"] = f"{np.rad2deg(np.sqrt(frame.covariance[2, 2])):.2f}"
    values["contacts"] = str(len(frame.contacts.index))
    if frame_age_s > STALE_S:
        return Diagnostic("localization", Level.STALE, f"no whisker frame for {frame_age_s:.1f} s", values)
    if frame.state == "lost":
        return Diagnostic("localization", Level.ERROR, "lost: no odometry for 2 s or more", values)
    if frame.state == "relocalizing":
        return Diagnostic("localization", Level.WARN, "looking for the place in the map: drive", values)
    return Diagnostic("localization", Level.OK, frame.state, values)


def whiskers_diagnostic(frame: FrameResult, layout: WhiskerLayout, pipeline: Pipeline) -> Diagnostic:
    """Whiskers that are not believed, by row and column: state, and for how many seconds; and those out of range."""
    cols = layout.cols
    values = {"valid": str(int(frame.angles.valid.sum()))}
    words = []
    for i, (state, since_ns) in sorted(frame.whisker_states.items()):
        name, age_s = state.name.lower(), max(0.0, (frame.stamp_ns - since_ns) * 1e-9)
        values[f"whisker ({i // cols}, {i % cols})"] = f"{name} for {age_s:.0f} s"
        words.append(f"({i // cols}, {i % cols}) {name}")
    unusable = np.flatnonzero(layout.present & ~frame.angles.valid).tolist()
    invalid = [f"({i // cols}, {i % cols})" for i in unusable if i not in frame.whisker_states]
    values["invalid"] = " ".join(invalid)
    followed = np.rad2deg(np.hypot(*pipeline.monitor.rest.followed))
    values["rest.followed_max_deg"] = f"{followed.max():.2f}"
    bend = pipeline.monitor.flow.bend
    if bend is not None:
        values["flow.bend_deg"] = f"{np.rad2deg(np.hypot(*bend)):.1f}"
        values["flow.direction_deg"] = f"{np.rad2deg(np.arctan2(bend[1], bend[0])):.0f}"
    if words:
        return Diagnostic("whiskers", Level.WARN, f"{len(words)} left out: {', '.join(words)}", values)
    if invalid:
        text = f"{len(invalid)} without a usable reading: {' '.join(invalid)}"
        return Diagnostic("whiskers", Level.WARN, text, values)
    return Diagnostic("whiskers", Level.OK, "all readings usable", values)


def load_diagnostic(shedding: LoadShedding) -> Diagnostic:
    """Whether the computer keeps up with the robot, and what is left undone where it does not."""
    values = {
        "lag_s": f"{shedding.lag_s:.3f}",
        "backend.behind_s": f"{shedding.behind_s:.2f}",
        "level": str(int(shedding.level)),
        "times": str(shedding.times),
    }
    level = Level.OK if shedding.level is Shed.NOTHING else Level.WARN
    return Diagnostic("load", level, WORDS[shedding.level], values)


def store_diagnostic(store: MapStore) -> Diagnostic:
    """The database."""
    values = {"written": str(store.written), "dropped": str(store.dropped), "map_id": str(store.map_id)}
    try:
        values["disk.free_MB"] = str(shutil.disk_usage(store.folder).free // 1_000_000)
    except OSError as error:
        values["disk.fault"] = str(error)
    if store.salvage.reason:
        values["salvage"] = str(store.salvage)
    if store.fault:
        text = f"not stored, mapping in memory: {store.fault}"
        return Diagnostic("store", Level.ERROR, text, {**values, "waiting": str(store.unwritten)})
    if store.too_large:
        text = "the map alone is larger than [store] max_mb; it is stored all the same"
        return Diagnostic("store", Level.WARN, text, values)
    if store.salvage.reason:
        return Diagnostic("store", Level.WARN, f"{store.written} keyframes stored; the database was damaged", values)
    return Diagnostic("store", Level.OK, f"{store.written} keyframes stored", values)


def process_diagnostic(clock: WallClock, source_dropped: int) -> Diagnostic:
    """The process."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    values = {
        "cpu_s": f"{usage.ru_utime + usage.ru_stime:.2f}",
        "peak_memory_MB": f"{usage.ru_maxrss / 1024:.1f}",
        "clock.offset_ns": str(clock.offset_ns),
        "clock.steps": str(clock.steps),
        "queue.dropped": str(source_dropped),
    }
    level = Level.WARN if source_dropped else Level.OK
    return Diagnostic("process", level, "measurements dropped" if source_dropped else "running", values)


def worst(entries: Sequence[Diagnostic]) -> str:
    """One line for logs: the entries that are not well."""
    return "; ".join(f"{e.name}: {e.message}" for e in entries if e.level is not Level.OK)
