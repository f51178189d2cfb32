"""A recording as a drive: as events for the devices, or with other odometry noise as a new recording."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.ground_truth import GroundTruth
from drivers.measurement import HallFrame, ImuSample, OdometrySample, ScrewAngles
from drivers.recording_reader import Recording
from drivers.recording_writer import RecordingWriter
from robominer_slam.evaluation.trajectory import Trajectory, interpolate
from robominer_slam.geometry import from_vector7
from sim_backend.base_motion import BaseStates
from sim_backend.events import EncoderEvent, Event, ImuEvent, OdometryEvent, TruthEvent, WhiskerEvent
from sim_backend.imu import GRAVITY
from sim_backend.odometry import BiasedOdometry

FloatArray = NDArray[np.float64]

ODOMETRY_TOPIC = "odometry/twist"
#: A board that has measured sends within a millisecond.
ARRIVAL_LATENCY_NS = 1_000_000


class RecordedDriveError(ValueError):
    """A recording that cannot be driven again; one line that says what it lacks."""


def start_of(recording: Recording) -> int:
    """Stamp of the earliest truth or measurement, ns: simulated time zero."""
    first_truth = next((truth.stamp_ns for _, truth in recording.ground_truth()), None)
    first = next((measurement.stamp_ns for _, measurement in recording), None)
    stamps = [stamp for stamp in (first_truth, first) if stamp is not None]
    if not stamps:
        raise RecordedDriveError(f"{recording.path}: no measurements in it")
    return min(stamps)


def events_of(recording: Recording, ticks_per_turn: int) -> Iterator[Event]:
    """The recording's measurements and truth as events, ordered by the time at which they are ready."""
    start = start_of(recording)
    gravity = np.array([0.0, 0.0, GRAVITY])
    truths = recording.ground_truth()
    truth = next(truths, None)
    for log_time, measurement in recording:
        while truth is not None and truth[0] <= log_time:
            yield _truth_event(truth[1], start)
            truth = next(truths, None)
        begun, ready = measurement.stamp_ns - start, max(log_time, measurement.stamp_ns) - start
        match measurement:
            case HallFrame():
                yield WhiskerEvent(begun, ready, measurement.field_mT.reshape(-1, 3), measurement.valid.ravel(), None)
            case ImuSample(gyro=gyro, acceleration=acceleration) if gyro is not None and acceleration is not None:
                yield ImuEvent(begun, ready, gyro, acceleration, gravity)
            case ScrewAngles():
                ticks = np.rint(measurement.angle * ticks_per_turn / (2.0 * np.pi)).astype(np.int64)
                yield EncoderEvent(begun, ready, ticks, measurement.angle)
            case OdometrySample():
                yield OdometryEvent(begun, ready, measurement.velocity)
            case _:
                # Motor modules have no device of their own on the `framed` ports.
                continue
    if truth is not None:
        yield _truth_event(truth[1], start)
    for _, rest in truths:
        yield _truth_event(rest, start)


def with_other_odometry(recording: Recording, odometry_seed: int, out: Path) -> int:
    """Write the recording anew with the ready-made odometry of another seed, as the thesis did on one recording.

    Returns:
        Odometry samples written.

    Raises:
        RecordedDriveError: the recording has no ground truth to make an odometry from.
        RecordingError: the file cannot be written.
    """
    truths = [truth for _, truth in recording.ground_truth()]
    if len(truths) < 2:
        raise RecordedDriveError(f"{recording.path}: no ground truth in it, from which an odometry could be made")
    stamps, velocities = _odometry(truths, odometry_seed)
    metadata = {**recording.metadata, "odometry_seed": str(odometry_seed)}
    metadata.pop("sensor_period_us", None)
    with RecordingWriter(
        out,
        sensor_period_us=recording.sensor_period_ns / 1000,
        attachments=recording.attachments(),
        metadata=metadata,
    ) as writer:
        k = 0
        for raw in recording.raw_messages():
            while k < len(stamps) and stamps[k] + ARRIVAL_LATENCY_NS <= raw.log_time_ns:
                writer.write_measurement(
                    OdometrySample(int(stamps[k]), velocities[k]), int(stamps[k]) + ARRIVAL_LATENCY_NS
                )
                k += 1
            if raw.topic != ODOMETRY_TOPIC:
                writer.write(raw.topic, raw.typename, raw.data, raw.log_time_ns, raw.publish_time_ns)
    return k


def _odometry(truths: list[GroundTruth], seed: int) -> tuple[NDArray[np.int64], FloatArray]:
    """Stamps, shape (n,), ns, and body velocities, shape (n, 3), of the biased odometry along the truth."""
    trajectory = Trajectory(
        np.array([truth.stamp_ns for truth in truths], dtype=np.int64),
        from_vector7(np.array([truth.pose for truth in truths])),
    )
    noise = BiasedOdometry(seed)
    period_ns = 1e9 / noise.settings.rate
    span = int(trajectory.stamps_ns[-1] - trajectory.stamps_ns[0])
    grid = trajectory.stamps_ns[0] + np.rint(np.arange(int(span / period_ns) + 1) * period_ns).astype(np.int64)
    _, T = interpolate(trajectory, grid)
    still = np.zeros((len(T), 3))
    velocities = noise.sample(BaseStates(T[:, :3, 3], T[:, :3, :3], still, still, still, still))
    return grid[1 : len(T)], velocities


def _truth_event(truth: GroundTruth, start: int) -> TruthEvent:
    time = truth.stamp_ns - start
    return TruthEvent(time, time, truth.pose[:3], truth.pose[3:], truth.twist[:3], truth.twist[3:])
