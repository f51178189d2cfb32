"""Other people's tables of a whisker's field as ours: columns by name, counts unwrapped and scaled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calibration.capture_labels import CaptureLabel, CaptureLabels, CaptureStep
from calibration.samples import FitError

FloatArray = NDArray[np.float64]

FIELD = ("bx", "by", "bz")
OPTIONAL = ("time", "inclination", "azimuth", "row", "col")
#: Time between readings where the table has none, s: the robot's frame rate.
DEFAULT_INTERVAL_S = 0.04
#: A part of the circle of counts this wide without a reading is where it can be cut.
CUT_SHARE = 0.05


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """How to read a table.

    Attributes:
        columns: `bx=NAME,by=NAME,bz=NAME` and `time`, `inclination`, `azimuth`, `row`, `col` where there are such.
        wrap: counts wrap at this number; None: they do not.
        scale: mT per count.
        offset_mT: subtracted after scaling.
        time_scale: s per unit of time.
        radians: whether angles are in radians instead of degrees.
    """

    columns: str
    wrap: float | None = None
    scale: float = 1.0
    offset_mT: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_scale: float = 1.0
    radians: bool = False


@dataclass(frozen=True, slots=True)
class Converted:
    """The table's readings, shape (m,) each and (m, 3), mT; angles in deg, NaN where there are none."""

    time_s: FloatArray
    row: NDArray[np.intp]
    col: NDArray[np.intp]
    inclination_deg: FloatArray
    azimuth_deg: FloatArray
    field_mT: FloatArray


def parse_columns(text: str) -> dict[str, str]:
    """The mapping of `ColumnMap.columns`.

    Raises:
        FitError: not such a text, an unknown name, or a field's component is missing.
    """
    pairs = [part.partition("=") for part in text.split(",") if part.strip()]
    mapping = {name.strip(): column.strip() for name, _, column in pairs}
    unknown = sorted(set(mapping) - {*FIELD, *OPTIONAL})
    if unknown or not all(mapping.values()):
        raise FitError(f"--columns {text}: expected NAME=COLUMN,... with NAME of {', '.join((*FIELD, *OPTIONAL))}")
    missing = [name for name in FIELD if name not in mapping]
    if missing:
        raise FitError(f"--columns {text}: lacks {', '.join(missing)}")
    return mapping


def unwrap(counts: FloatArray, period: float) -> FloatArray:
    """Counts that wrap at `period` without the wrap, shape (m,); most lie in the first turn.

    Where the values leave a part of the circle empty, the circle is cut in the widest such part: this needs no
    continuity in time, so that a recording may have gaps. Where they fill it, a step of more than half a turn from
    one reading to the next is a wrap.
    """
    turned = np.mod(counts, period)
    ordered = np.unique(turned)
    empty = np.diff(ordered, append=ordered[0] + period)
    widest = int(np.argmax(empty))
    if empty[widest] >= CUT_SHARE * period:
        # The last value before the gap; what lies beyond the gap came round from above zero.
        series = np.where(turned > ordered[widest], turned - period, turned)
    else:
        series = np.unwrap(counts, period=period)
    turns = float(np.floor(np.quantile(series, 0.5) / period))
    first: FloatArray = series - period * turns
    return first


def convert_rows(
    names: Sequence[str], records: Sequence[Mapping[str, str]], how: ColumnMap, where: str, *, need_angles: bool
) -> Converted:
    """Convert a table.

    Raises:
        FitError: a column is missing, a value is not a number, or times do not increase; names file and line.
    """
    mapping = parse_columns(how.columns)
    if need_angles and not {"inclination", "azimuth"} <= set(mapping):
        raise FitError(f"{where}: a jig table needs inclination=COLUMN and azimuth=COLUMN in --columns")
    absent = [column for column in mapping.values() if column not in names]
    if absent:
        raise FitError(f"{where}: lacks the columns {', '.join(absent)}; found {', '.join(names) or 'none'}")
    if not records:
        raise FitError(f"{where}: has no rows")
    values: dict[str, FloatArray] = {}
    for name, column in mapping.items():
        column_values = []
        for line, record in enumerate(records, start=2):
            try:
                column_values.append(float(record[column]))
            except (TypeError, ValueError):
                raise FitError(f"{where}, line {line}: {column} is {record[column]!r}, expected a number") from None
        values[name] = np.array(column_values)
    m = len(records)
    counts = [values[name] if how.wrap is None else unwrap(values[name], how.wrap) for name in FIELD]
    field = np.column_stack(counts) * how.scale - np.array(how.offset_mT)
    ticks = values["time"] * how.time_scale if "time" in values else np.arange(m) * DEFAULT_INTERVAL_S
    time = np.asarray(ticks, dtype=np.float64)
    if (np.diff(time) < 0.0).any():
        line = int(np.flatnonzero(np.diff(time) < 0.0)[0]) + 3
        raise FitError(f"{where}, line {line}: its time lies before that of the line above")
    nothing = np.full(m, np.nan)
    angles = [np.asarray(values.get(name, nothing), dtype=np.float64) for name in ("inclination", "azimuth")]
    factor = 180.0 / float(np.pi) if how.radians else 1.0
    degrees: list[FloatArray] = [angle * factor for angle in angles]
    place = [values.get(name, np.zeros(m)).astype(np.intp) for name in ("row", "col")]
    return Converted(time, place[0], place[1], degrees[0], degrees[1], field)


def jig_csv(table: Converted) -> str:
    """The table of `calibrate fit --jig`."""
    lines = ["row,col,inclination_deg,azimuth_deg,bx_mT,by_mT,bz_mT"]
    columns = zip(table.row, table.col, table.inclination_deg, table.azimuth_deg, table.field_mT, strict=True)
    for row, col, inclination, azimuth, (x, y, z) in columns:
        lines.append(f"{row},{col},{inclination:.10g},{azimuth:.10g},{x:.8g},{y:.8g},{z:.8g}")
    return "\n".join(lines) + "\n"


def labels_of(table: Converted, layout: str) -> CaptureLabels:
    """Labels of a recording of one whisker: a label for each run of readings at the same known angles."""
    labels: list[CaptureLabel] = []
    known = np.isfinite(table.inclination_deg)
    pose = np.column_stack([table.inclination_deg, table.azimuth_deg])
    stamps = np.round(table.time_s * 1e9).astype(np.int64)
    change = np.r_[True, np.any(np.nan_to_num(np.diff(pose, axis=0), nan=0.0) != 0.0, axis=1)]
    bounds = [*np.flatnonzero(change).tolist(), len(pose)]
    for start, end in pairwise(bounds):
        if known[start]:
            azimuth = float(pose[start, 1]) if np.isfinite(pose[start, 1]) else None
            step = CaptureStep("jig" if azimuth is not None else "rings", float(pose[start, 0]), azimuth)
            labels.append(CaptureLabel(len(labels), step, int(stamps[start]), int(stamps[end - 1])))
    method = "rings" if any(label.done.method == "rings" for label in labels) else "jig"
    return CaptureLabels("rings" if method == "rings" else "jig", layout, 1, 1, tuple(labels))
