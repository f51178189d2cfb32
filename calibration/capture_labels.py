"""What is known about the whiskers during a capture, step by step: the labels that make a recording a calibration."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias, get_args

FORMAT = "robominer-slam capture"
VERSION = 1

Method: TypeAlias = Literal["jig", "rings", "floor"]
METHODS: tuple[Method, ...] = get_args(Method)


class CaptureError(ValueError):
    """A capture that cannot be made or used; one line: what, where, what to do."""


@dataclass(frozen=True, slots=True)
class CaptureStep:
    """One thing that the operator does.

    Attributes:
        method: how the truth is known: `jig` (given angles), `rings` (a plate with one hole per whisker, moved about
            so that each rod leans at its hole's rim: inclination known, azimuth free), `floor` (array lowered on a
            flat plate and dragged).
        inclination_deg: given inclination; 0 is rest; None where it is not known (floor).
        azimuth_deg: given azimuth from the whisker's x-axis (jig).
        height_m: of the joints above the plate (floor).
        dragged_m: how far the array is dragged that way before the reading begins (floor).
        direction_deg: in which the array is dragged, from base_link's x-axis to the left (floor).
        row, col: the only whisker that this is about; None for the whole array.
    """

    method: Method
    inclination_deg: float | None = None
    azimuth_deg: float | None = None
    height_m: float | None = None
    direction_deg: float | None = None
    dragged_m: float | None = None
    row: int | None = None
    col: int | None = None

    @property
    def is_rest(self) -> bool:
        """Whether nothing touches."""
        return self.inclination_deg == 0.0

    def instruction(self) -> str:
        """What the operator is to do, one sentence."""
        who = "all whiskers" if self.row is None else f"whisker ({self.row}, {self.col})"
        if self.is_rest:
            return f"Let {who} hang free; nothing may touch."
        match self.method:
            case "jig":
                return f"Hold {who} at inclination {self.inclination_deg:g} deg, azimuth {self.azimuth_deg:g} deg."
            case "rings":
                return (
                    f"Put on the ring plate of {self.inclination_deg:g} deg; move it slowly in full circles with "
                    f"{who} leaning at the rims."
                )
            case "floor":
                return (
                    f"Lower the array to {1000.0 * (self.height_m or 0.0):g} mm above the plate, drag it by "
                    f"{1000.0 * (self.dragged_m or 0.0):g} mm towards {self.direction_deg:g} deg (0 forward, 90 left), "
                    "and hold it there."
                )


@dataclass(frozen=True, slots=True)
class CaptureLabel:
    """A step as it was done.

    Attributes:
        step: number of the step, from 0.
        done: what was done.
        start_ns, end_ns: first and last frame that belong to it, in the recording's clock.
    """

    step: int
    done: CaptureStep
    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class CaptureLabels:
    """All labels of a capture, and the array that they are about."""

    method: Method
    layout: str
    rows: int
    cols: int
    labels: tuple[CaptureLabel, ...]

    def to_text(self) -> str:
        """The attachment `capture.json` of a capture's recording."""
        content: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "method": self.method,
            "layout": self.layout,
            "rows": self.rows,
            "cols": self.cols,
            "labels": [
                {
                    "step": label.step,
                    "start_ns": label.start_ns,
                    "end_ns": label.end_ns,
                    **{key: value for key, value in asdict(label.done).items() if value is not None},
                }
                for label in self.labels
            ],
        }
        return json.dumps(content, indent=1)


def labels_from_text(text: str, where: str) -> CaptureLabels:
    """Parse the attachment `capture.json`.

    Raises:
        CaptureError: not one, another version, or a field that is missing or does not fit.
    """
    try:
        content = json.loads(text)
    except ValueError as error:
        raise CaptureError(f"{where}: not JSON ({error}); expected the labels of a capture") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CaptureError(f"{where}: not the labels of a capture; make one with 'robominer-slam calibrate capture'")
    if content.get("version") != VERSION:
        raise CaptureError(f"{where}: version {content.get('version')}, expected {VERSION}; update the program")
    try:
        if content["method"] not in METHODS:
            raise CaptureError(f"{where}: method {content['method']!r}, expected one of {', '.join(METHODS)}")
        labels = []
        for entry in content["labels"]:
            fields = dict(entry)
            step, start, end = int(fields.pop("step")), int(fields.pop("start_ns")), int(fields.pop("end_ns"))
            labels.append(CaptureLabel(step, CaptureStep(**fields), start, end))
        return CaptureLabels(
            content["method"], str(content["layout"]), int(content["rows"]), int(content["cols"]), tuple(labels)
        )
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, CaptureError):
            raise
        raise CaptureError(f"{where}: a field is missing or does not fit ({error!r})") from error
