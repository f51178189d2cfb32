"""Broken sensors: turns a healthy robot's events into those of one with faults."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim_backend.events import EncoderEvent, Event, ImuEvent, WhiskerEvent
from sim_backend.fault_schedule import KINDS, SCREWS, Fault, FaultFileError
from sim_backend.random_streams import stream

FloatArray = NDArray[np.float64]

#: One step of the Hall sensor, mT; what a fault adds is quantised like everything else.
HALL_STEP_MT = 0.098
#: Noise of a healthy sensor, one standard deviation, mT.
HALL_NOISE_MT = 0.12
#: A screw slower than this stands still, rad/s; nothing slips then.
STANDSTILL = 0.1


class SensorFaults:
    """Applies the scheduled faults of sensors; holds what they have to remember."""

    def __init__(
        self,
        faults: Iterable[Fault],
        rest_field_mT: FloatArray,
        *,
        cols: int,
        ticks_per_turn: int = 4096,
        seed: int = 0,
    ) -> None:
        """Take the faults of one drive; those of devices are left to their lines.

        Args:
            faults: scheduled.
            rest_field_mT: what each sensor shows while its whisker is at rest, shape (rows * cols, 3), mT.
            cols: of the array.
            ticks_per_turn: of the screws' encoders.
            seed: of the faults' noise.

        Raises:
            FaultFileError: a fault names a whisker outside the array.
        """
        chosen = [fault for fault in faults if KINDS[fault.kind].target != "device"]
        self._whiskers: list[tuple[Fault, int]] = []
        for fault in chosen:
            if isinstance(fault.target, tuple):
                row, col = fault.target
                if col >= cols or row * cols + col >= len(rest_field_mT):
                    shape = f"{len(rest_field_mT) // cols} x {cols}"
                    raise FaultFileError(f"{fault.kind} at row {row}, column {col}: the array is {shape}")
                self._whiskers.append((fault, row * cols + col))
        self._slips = [(f, SCREWS.index(f.target)) for f in chosen if isinstance(f.target, str)]
        self._silences = [fault for fault in chosen if fault.kind == "imu_silent"]
        self._rest = rest_field_mT
        self._ticks_per_rad = ticks_per_turn / (2.0 * np.pi)
        self._rng = stream(seed, "sensor faults")
        self._stuck_at: dict[tuple[int, float], FloatArray] = {}
        self._extra_angle = np.zeros(4)
        self._encoder_before: EncoderEvent | None = None

    def apply(self, events: Iterable[Event]) -> Iterator[Event]:
        """The events with their faults, in the same order; the truth stays as it is."""
        for event in events:
            time = event.time_ns * 1e-9
            match event:
                case WhiskerEvent():
                    yield self._whisker_frame(event, time)
                case EncoderEvent():
                    yield self._encoders(event, time)
                case ImuEvent():
                    if not any(fault.active(time) for fault in self._silences):
                        yield event
                case _:
                    yield event

    def _whisker_frame(self, event: WhiskerEvent, time: float) -> WhiskerEvent:
        active = [(fault, k) for fault, k in self._whiskers if fault.active(time)]
        if not active:
            return event
        field, valid = event.field_mT.copy(), event.valid.copy()
        for fault, k in active:
            if fault.kind == "whisker_bus_error":
                valid[k] = False
            elif fault.kind == "whisker_stuck":
                field[k] = self._stuck_at.setdefault((k, fault.start), field[k].copy())
            else:
                field[k] = self._reading(fault, k, field[k])
        return replace(event, field_mT=field, valid=valid)

    def _reading(self, fault: Fault, k: int, field: FloatArray) -> FloatArray:
        match fault.kind:
            case "whisker_dead":
                return np.zeros(3)
            case "whisker_noisy":
                return _stepped(field + self._rng.normal(0.0, fault.number("sigma_mT"), 3))
            case "whisker_flipped":
                return field * [-1.0 if axis in fault.text("axes") else 1.0 for axis in "xyz"]
            case "whisker_broken":
                # The stump stays upright whatever the ground does; without the magnet next to nothing is left.
                left = self._rest[k] if fault.text("magnet") == "kept" else np.zeros(3)
                return _stepped(left + self._rng.normal(0.0, HALL_NOISE_MT, 3))
            case "whisker_bent":
                return _stepped(bent(field, fault.number("tilt_deg"), fault.number("azimuth_deg")))
        raise ValueError(f"{fault.kind} is no fault of a whisker's reading")

    def _encoders(self, event: EncoderEvent, time: float) -> EncoderEvent:
        before, self._encoder_before = self._encoder_before, event
        if before is not None and event.time_ns > before.time_ns:
            elapsed = (event.time_ns - before.time_ns) * 1e-9
            turning = np.abs(event.angle - before.angle).max() > STANDSTILL * elapsed
            for fault, screw in self._slips:
                if turning and fault.active(time):
                    self._extra_angle[screw] += fault.number("extra_rad_s") * elapsed
        if not self._extra_angle.any():
            return event
        extra_ticks = np.floor(self._extra_angle * self._ticks_per_rad).astype(np.int64)
        return replace(event, ticks=event.ticks + extra_ticks, angle=event.angle + extra_ticks / self._ticks_per_rad)


def bent(field_mT: FloatArray, tilt_deg: float, azimuth_deg: float) -> FloatArray:
    """The reading, shape (3,), mT, after the rod's rest direction has been bent.

    The magnet tilts with the rod; to first order the field at the sensor turns by an angle of the same size, here
    by exactly `tilt_deg` towards `azimuth_deg` (from the sensor's x axis).
    """
    azimuth = np.radians(azimuth_deg)
    axis = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    turned: FloatArray = Rotation.from_rotvec(np.radians(tilt_deg) * axis).apply(field_mT)
    return turned


def _stepped(field_mT: FloatArray) -> FloatArray:
    return np.round(field_mT / HALL_STEP_MT) * HALL_STEP_MT
