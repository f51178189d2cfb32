"""A guided capture: step by step, judged at once, repeated where it does not cover enough."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.capture_coverage import CoverageLimits, StepCoverage, step_coverage
from calibration.capture_labels import CaptureLabel, CaptureStep
from calibration.capture_plan import PlannedStep
from drivers.measurement import HallFrame
from robominer_slam.capture.operator import FrameSource, Operator

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class Screen(Protocol):
    """Shows the operator what to do and what is seen."""

    def step(self, number: int, count: int, step: CaptureStep, attempt: int) -> None:
        """A step begins: it waits for the operator."""
        ...

    def frame(self, frame: HallFrame, rest_mT: FloatArray | None, share: float) -> None:
        """A frame came; `share` of the step is done."""
        ...

    def judged(self, number: int, coverage: StepCoverage) -> None:
        """A step was captured, and what it shows."""
        ...


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """How long things take.

    Attributes:
        frames: frames of a step at one pose; 25 are one second of the robot's array.
        sweep_s: longest ring sweep, s; it ends earlier once it covers all.
        attempts: tries at a step without an operator, after which it goes on.
        auto_s: wait before each step without an operator, s; None waits for Enter.
        limits: what a step must show.
    """

    frames: int = 25
    sweep_s: float = 60.0
    attempts: int = 3
    auto_s: float | None = None
    limits: CoverageLimits = field(default_factory=CoverageLimits)


class CaptureSession:
    """Leads through the steps of a plan.

    Attributes:
        rest_mT: mean field of the last step at rest, shape (n, 3), mT; None before it.
        problems: what was still wrong with steps that were passed over, by step.
    """

    def __init__(
        self, source: FrameSource, screen: Screen, present: BoolArray, cols: int, settings: SessionSettings
    ) -> None:
        self._source, self._screen, self._present, self._cols = source, screen, present, cols
        self._settings = settings
        self._operator = Operator()
        self.rest_mT: FloatArray | None = None
        self.problems: dict[int, str] = {}

    def run(self, planned: Sequence[PlannedStep]) -> list[CaptureLabel]:
        """Do all steps; skipped ones have no label.

        Raises:
            CaptureError: the device is silent, or the input ends.
        """
        labels = []
        for number, one in enumerate(planned):
            label = self._do(number, len(planned), one)
            if label is not None:
                labels.append(label)
        return labels

    def _do(self, number: int, count: int, planned: PlannedStep) -> CaptureLabel | None:
        wait = planned.wait_s if planned.wait_s is not None else self._settings.auto_s
        attempt = 0
        while True:
            self._screen.step(number, count, planned.step, attempt)
            if not self._operator.wait(self._source, wait, self._show):
                self.problems[number] = "skipped"
                return None
            frames = self._collect(planned.step)
            fields, valid = stacked(frames)
            coverage = self._judge(planned.step, fields, valid)
            self._screen.judged(number, coverage)
            attempt += 1
            if coverage.problem and (wait is None or attempt < self._settings.attempts):
                continue
            if coverage.problem:
                self.problems[number] = coverage.problem
            if planned.step.is_rest:
                seen = np.maximum(np.count_nonzero(valid, axis=0), 1)
                self.rest_mT = (fields * valid[..., None]).sum(axis=0) / seen[:, None]
            return CaptureLabel(number, planned.step, frames[0].stamp_ns, frames[-1].stamp_ns)

    def _show(self, frame: HallFrame) -> None:
        self._screen.frame(frame, self.rest_mT, 0.0)

    def _collect(self, step: CaptureStep) -> list[HallFrame]:
        """Frames measured from now on: one pose's number of them, or a sweep until it covers all."""
        start_ns = time.monotonic_ns()
        sweep = step.method == "rings" and not step.is_rest
        frames: list[HallFrame] = []
        while True:
            frame = self._source.frame(0.1)
            if frame is None or frame.stamp_ns < start_ns:
                continue
            frames.append(frame)
            done = len(frames) / self._settings.frames
            if sweep:
                elapsed = (frame.stamp_ns - start_ns) * 1e-9 / self._settings.sweep_s
                if elapsed >= 1.0:
                    return frames
                # The sweep is judged now and then: it is all frames that are judged each time.
                complete = done >= 1.0 and len(frames) % self._settings.frames == 0
                if complete and not self._judge(step, *stacked(frames)).problem:
                    return frames
                done = elapsed
            elif done >= 1.0:
                return frames
            self._screen.frame(frame, self.rest_mT, done)

    def _judge(self, step: CaptureStep, field: FloatArray, valid: BoolArray) -> StepCoverage:
        wanted = self._present.copy()
        if step.row is not None and step.col is not None:
            wanted[:] = False
            wanted[step.row * self._cols + step.col] = True
        return step_coverage(step, field, valid, wanted, self.rest_mT, self._cols, self._settings.limits)


def stacked(frames: Sequence[HallFrame]) -> tuple[FloatArray, BoolArray]:
    """Fields, shape (m, n, 3), mT, and validity, shape (m, n), of some frames."""
    field = np.stack([frame.field_mT.reshape(-1, 3) for frame in frames])
    return field, np.stack([frame.valid.reshape(-1) for frame in frames])
