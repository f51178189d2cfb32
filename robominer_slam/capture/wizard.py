"""The first-run wizard: the operator bends one whisker after the other, and the layout comes out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.capture_labels import CaptureError
from calibration.mount_direction import bend_azimuth, bend_directions, mount_rotation, touched_sensor
from drivers.measurement import HallFrame
from robominer_slam.capture.operator import FrameSource, Operator
from robominer_slam.capture.session import stacked
from robominer_slam.layout import WhiskerLayout

FloatArray = NDArray[np.float64]
#: A frame in which more than half of the readings are missing says nothing of a sensor.
MIN_VALID_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class WizardEvent:
    """What the operator is told.

    Attributes:
        kind: `rest`, `bend`, `found` or `problem`.
        text: one sentence.
        row, col: the whisker's position in the plan, where one is meant.
        towards: the bend's direction.
        sensor: (row, col) of the sensor that was found.
    """

    kind: str
    text: str
    row: int | None = None
    col: int | None = None
    towards: str | None = None
    sensor: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class Found:
    """Whose sensor is where, and how it is turned."""

    sensor: int
    R_base_whisker: FloatArray
    disagreement: float


class Wizard:
    """Asks for two bends of every whisker of a plan."""

    def __init__(
        self,
        source: FrameSource,
        plan: WhiskerLayout,
        on_event: Callable[[WizardEvent], None],
        *,
        frames: int = 10,
        auto_s: float | None = None,
        attempts: int = 3,
    ) -> None:
        """Prepare.

        Args:
            source: of frames.
            plan: where whiskers are, and which way they point; which sensor reads which is unknown.
            on_event: takes what the operator is to be told.
            frames: of each pose.
            auto_s: wait before each pose without an operator, s; None waits for Enter.
            attempts: tries at a whisker without an operator.
        """
        self._source, self._plan, self._tell = source, plan, on_event
        self._frames, self._auto_s, self._attempts = frames, auto_s, attempts
        self._operator = Operator()

    def run(self) -> dict[int, Found]:
        """Place in the plan to what was found; whiskers left out are missing.

        Raises:
            CaptureError: the device is silent, the input ends, or without an operator a whisker cannot be found.
        """
        self._tell(WizardEvent("rest", "Let all whiskers hang free; nothing may touch. Enter: go on."))
        self._operator.wait(self._source, self._auto_s, _nothing)
        rest = self._mean()
        found: dict[int, Found] = {}
        for place in np.flatnonzero(self._plan.present).tolist():
            one = self._find(place, rest, found)
            if one is not None:
                found[place] = one
        return found

    def _find(self, place: int, rest: FloatArray, found: dict[int, Found]) -> Found | None:
        row, col = divmod(place, self._plan.cols)
        R = self._plan.R_base_whisker[place]
        attempt = 0
        while True:
            attempt += 1
            try:
                bends: dict[str, float] = {}
                sensors = set()
                for towards in bend_directions(R):
                    text = (
                        f"Bend whisker ({row}, {col}) {towards} and hold it.  Enter: go on; s and Enter: leave it out."
                    )
                    self._tell(WizardEvent("bend", text, row, col, towards))
                    if not self._operator.wait(self._source, self._auto_s, _nothing):
                        return None
                    field = self._mean()
                    sensor = touched_sensor(rest, field)
                    sensors.add(sensor)
                    bends[towards] = bend_azimuth(rest[sensor], field[sensor])
                if len(sensors) > 1:
                    raise CaptureError("the two bends moved different sensors: bend the same whisker twice")
                sensor = sensors.pop()
                taken = [other for other, one in found.items() if one.sensor == sensor]
                if taken:
                    other = divmod(taken[0], self._plan.cols)
                    raise CaptureError(f"this sensor was that of whisker {other} before: bend the right one")
                R_found, disagreement = mount_rotation(R, bends)
            except CaptureError as error:
                if self._auto_s is not None and attempt >= self._attempts:
                    raise
                if str(error).startswith(("no whisker frame", "the input ended")):
                    raise
                self._tell(WizardEvent("problem", f"Again: {error}", row, col))
                continue
            at = divmod(sensor, self._plan.cols)
            self._tell(WizardEvent("found", f"whisker ({row}, {col}) is sensor {at}", row, col, sensor=at))
            return Found(sensor, R_found, disagreement)

    def _mean(self) -> FloatArray:
        """Mean field of frames measured from now on, shape (n, 3), mT; zeros for a dead sensor."""
        start_ns = time.monotonic_ns()
        frames: list[HallFrame] = []
        while len(frames) < self._frames:
            frame = self._source.frame(0.1)
            if frame is not None and frame.stamp_ns >= start_ns:
                frames.append(frame)
        field, valid = stacked(frames)
        usable = valid & field.any(axis=-1)
        count = np.count_nonzero(usable, axis=0)
        mean: FloatArray = (field * usable[..., None]).sum(axis=0) / np.maximum(count, 1)[:, None]
        mean[count < MIN_VALID_SHARE * len(frames)] = 0.0
        return mean


def _nothing(frame: HallFrame) -> None:
    """Frames that come while the operator reads are of no use."""


def found_layout(plan: WhiskerLayout, found: dict[int, Found], name: str) -> WhiskerLayout:
    """The layout by sensors: each sensor's place gets the position and mount of the whisker that it reads."""
    p, R, length = plan.p_base.copy(), plan.R_base_whisker.copy(), plan.length.copy()
    present = np.zeros(plan.count, dtype=np.bool_)
    for place, one in found.items():
        p[one.sensor] = plan.p_base[place]
        R[one.sensor] = one.R_base_whisker
        length[one.sensor] = plan.length[place]
        present[one.sensor] = True
    return replace(plan, name=name, p_base=p, R_base_whisker=R, length=length, present=present)
