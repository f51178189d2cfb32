"""Records a simulated drive straight into an MCAP file, as fast as the simulation goes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.ground_truth import GroundTruth, WhiskerTruth
from drivers.measurement import HallFrame, ImuSample, OdometrySample, ScrewAngles
from drivers.recording_repack import repack
from drivers.recording_writer import RecordingWriter
from sim_backend.events import EncoderEvent, Event, ImuEvent, OdometryEvent, TruthEvent, WhiskerEvent
from sim_backend.physics import ArrayReading

FloatArray = NDArray[np.float64]

#: Stamp of simulated time 0 in recordings, ns: 1 June 2021. It is fixed, so that the same seed gives the same file.
EPOCH_NS = 1_622_505_600_000_000_000
#: From the end of a measurement to its arrival over USB, ns.
ARRIVAL_LATENCY_NS = 1_000_000


def record(
    events: Iterator[Event],
    path: Path,
    *,
    array: tuple[int, int, int],
    attachments: Mapping[str, bytes],
    metadata: Mapping[str, str] | None = None,
    whisker_truth: bool = True,
    compact: bool = False,
    on_progress: Callable[[int], None] | None = None,
) -> dict[str, int]:
    """Write a recording (interfaces, section 3).

    Args:
        events: of a simulated robot.
        path: file to create.
        array: rows, columns and sensor period (us) of the whisker array.
        attachments: layout, calibration and configuration: name to content.
        metadata: further entries of the recording's metadata, such as world, scenario and seeds.
        whisker_truth: also write what the whiskers really did, where the events tell.
        compact: pack the file as tightly as it goes, which takes a few seconds for each minute of the drive.
        on_progress: called with the simulated time in ns at each whisker frame.

    Returns:
        Messages written, by topic.

    Raises:
        RecordingError: the file cannot be written.
    """
    rows, cols, period_us = array
    # Beside its place, so that a name stands for a whole recording.
    written = path.with_name(path.name + ".part") if compact else path
    with RecordingWriter(written, sensor_period_us=period_us, attachments=attachments, metadata=metadata) as writer:
        for event in events:
            stamp = EPOCH_NS + event.time_ns
            arrival = EPOCH_NS + event.ready_ns + ARRIVAL_LATENCY_NS
            match event:
                case WhiskerEvent():
                    frame = HallFrame(
                        stamp,
                        event.field_mT.reshape(rows, cols, 3),
                        event.valid.reshape(rows, cols),
                        1000 * period_us,
                    )
                    writer.write_measurement(frame, arrival)
                    if whisker_truth and event.truth is not None and event.contact_point is not None:
                        truth = _whisker_truth(stamp, event.truth, event.contact_point)
                        writer.write_whisker_truth(truth, arrival)
                    if on_progress is not None:
                        on_progress(event.time_ns)
                case ImuEvent():
                    writer.write_measurement(ImuSample(stamp, event.gyro, event.acceleration), arrival)
                case EncoderEvent():
                    writer.write_measurement(ScrewAngles(stamp, event.angle), arrival)
                case OdometryEvent():
                    writer.write_measurement(OdometrySample(stamp, event.velocity), arrival)
                case TruthEvent():
                    writer.write_ground_truth(_ground_truth(event, stamp), arrival)
    if compact:
        repack(written, path)
        written.unlink()
    return dict(writer.counts)


def _ground_truth(event: TruthEvent, stamp_ns: int) -> GroundTruth:
    pose = np.concatenate([event.position, event.orientation_xyzw])
    return GroundTruth(stamp_ns, pose, np.concatenate([event.velocity, event.angular_velocity]))


def _whisker_truth(stamp_ns: int, truth: ArrayReading, point: FloatArray) -> WhiskerTruth:
    return WhiskerTruth(
        stamp_ns, truth.contact, point, truth.contact_arm, truth.inclination, truth.azimuth, truth.hinge
    )
