"""A capture's recording: raw frames, and labels and layout as attachments."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.capture_labels import CaptureError, CaptureLabel, CaptureLabels, labels_from_text
from calibration.samples import FloorFrames, JigSamples, RingSamples, Samples
from drivers.measurement import HallFrame
from drivers.recording_reader import Recording
from drivers.spherical import cartesian_frame
from robominer_slam import layout as layouts
from robominer_slam.layout import WhiskerLayout

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

LABELS = "capture.json"
LAYOUT = "layout.json"
#: Readings of a step at one pose that the fit gets: their noise is the live readings' noise, and more of the same
#: pose say nothing new.
READINGS_PER_POSE = 5
#: Readings of a ring sweep that the fit gets.
READINGS_PER_SWEEP = 120


@dataclass(frozen=True, slots=True)
class Capture:
    """A capture as it was recorded.

    Attributes:
        labels: what was known, step by step.
        layout: the array.
        stamp_ns: of the frames, shape (m,).
        field_mT: shape (m, n, 3), mT.
        valid: shape (m, n).
    """

    labels: CaptureLabels
    layout: WhiskerLayout
    stamp_ns: NDArray[np.int64]
    field_mT: FloatArray
    valid: BoolArray

    def steps(self) -> Iterator[tuple[CaptureLabel, FloatArray, BoolArray]]:
        """Each label with its frames: field, shape (k, n, 3), mT; usable, shape (k, n)."""
        for label in self.labels.labels:
            inside = (self.stamp_ns >= label.start_ns) & (self.stamp_ns <= label.end_ns)
            field = self.field_mT[inside]
            yield label, field, self.valid[inside] & field.any(axis=-1)


def whisker_frames(path: Path) -> tuple[NDArray[np.int64], FloatArray, BoolArray, int]:
    """Frames of a recording: stamps (m,), ns; fields (m, n, 3), mT; validity (m, n); time between sensors, ns.

    Raises:
        RecordingError: not a recording.
        CaptureError: no whisker frames in it.
    """
    frames = [cartesian_frame(one) for _, one in Recording(path) if isinstance(one, HallFrame)]
    if not frames:
        raise CaptureError(f"{path}: no whisker frames in this recording")
    field = np.stack([frame.field_mT.reshape(-1, 3) for frame in frames])
    valid = np.stack([frame.valid.reshape(-1) for frame in frames])
    stamps = np.array([frame.stamp_ns for frame in frames], dtype=np.int64)
    return stamps, field, valid, frames[0].sensor_period_ns


def read_capture(path: Path) -> Capture:
    """Read a capture's recording.

    Raises:
        RecordingError, LayoutError: not a recording, or its layout cannot be used.
        CaptureError: a recording that is no capture.
    """
    attachments = Recording(path).attachments()
    for name in (LABELS, LAYOUT):
        if name not in attachments:
            raise CaptureError(
                f"{path}: carries no {name}: not a capture; make one with 'robominer-slam calibrate capture'"
            )
    labels = labels_from_text(attachments[LABELS].decode("utf-8", "replace"), f"{path}:{LABELS}")
    layout = layouts.from_json(attachments[LAYOUT].decode("utf-8", "replace"), f"{path}:{LAYOUT}")
    stamps, field, valid, _ = whisker_frames(path)
    if field.shape[1] != layout.count or (labels.rows, labels.cols) != (layout.rows, layout.cols):
        raise CaptureError(f"{path}: frames of {field.shape[1]} whiskers, its layout has {layout.count}")
    return Capture(labels, layout, stamps, field, valid)


def samples_of(capture: Capture) -> list[Samples]:
    """The capture's readings with what is known of each, for the fit.

    Raises:
        CaptureError: a label without frames.
    """
    single: list[FloatArray] = []
    floor: list[tuple[CaptureLabel, FloatArray, BoolArray]] = []
    for label, field, usable in capture.steps():
        if not len(field):
            raise CaptureError(f"step {label.step + 1} of the capture has no frames: was the recording cut?")
        step = label.done
        sweep = step.method == "rings" and not step.is_rest
        count = min(len(field), READINGS_PER_SWEEP if sweep else READINGS_PER_POSE)
        chosen = np.linspace(0, len(field) - 1, count).round().astype(int)
        if step.method == "floor":
            floor.append((label, field[chosen], usable[chosen]))
            continue
        azimuth = np.nan if step.azimuth_deg is None else step.azimuth_deg
        for i in np.flatnonzero(_concerned(capture, label)):
            readings = field[chosen, i][usable[chosen, i]]
            row, col = divmod(int(i), capture.layout.cols)
            known = np.broadcast_to([row, col, step.inclination_deg or 0.0, azimuth], (len(readings), 4))
            single.append(np.column_stack([known, readings]))
    result: list[Samples] = []
    if single:
        table = np.concatenate(single)
        kind = RingSamples if capture.labels.method == "rings" else JigSamples
        place = table[:, :2].astype(np.intp)
        inclination, angle = np.deg2rad(table[:, 2]), np.deg2rad(table[:, 3])
        result.append(kind(place[:, 0], place[:, 1], inclination, angle, table[:, 4:]))
    if floor:
        result.append(_floor(capture, floor))
    return result


def _floor(capture: Capture, steps: list[tuple[CaptureLabel, FloatArray, BoolArray]]) -> FloorFrames:
    def spread(values: list[float]) -> FloatArray:
        return np.repeat(values, [len(field) for _, field, _ in steps])

    # A free whisker at rest is a frame of its own: far above the plate.
    free = 2.0 * float(capture.layout.length.max())
    done = [label.done for label, _, _ in steps]
    return FloorFrames(
        spread([free if step.is_rest else step.height_m or 0.0 for step in done]),
        np.deg2rad(spread([step.direction_deg or 0.0 for step in done])),
        spread([step.dragged_m or 0.0 for step in done]),
        np.concatenate([field for _, field, _ in steps]),
        np.concatenate([usable for _, _, usable in steps]),
    )


def _concerned(capture: Capture, label: CaptureLabel) -> BoolArray:
    wanted = capture.layout.present.copy()
    if label.done.row is not None and label.done.col is not None:
        wanted[:] = False
        wanted[label.done.row * capture.layout.cols + label.done.col] = True
    return wanted
