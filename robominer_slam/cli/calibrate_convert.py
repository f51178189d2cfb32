"""`robominer-slam calibrate convert`: CSV recordings of other people's whiskers to a jig table or a capture."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from calibration.convert import ColumnMap, Converted, convert_rows, jig_csv, labels_of
from drivers.measurement import HallFrame
from drivers.recording_writer import RecordingWriter
from robominer_slam import layout as layouts
from robominer_slam.capture.recording import LABELS, LAYOUT
from robominer_slam.cli.csv_table import read_records
from robominer_slam.layout import R_DOWN, WhiskerLayout

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
EPILOG = """
\b
Examples, raw counts of 16 bits that wrap, 0.00161 mT each; and a table in gauss with angles:
  robominer-slam calibrate convert run.csv --columns time=timestamp,bx=ss.x,by=ss.y,bz=ss.z \\
      --wrap 65536 --scale 0.00161 --out run.mcap
  robominer-slam calibrate convert jig.csv --columns bx=X,by=Y,bz=Z,inclination=Tilt,azimuth=Dir \\
      --scale 0.1 --out jig-table.csv
\b
The output's ending decides: .csv is the table of 'calibrate fit --jig', .mcap a recording of one whisker, with
labels where the angles are known.
"""


@click.command(epilog=EPILOG)
@click.argument("file", type=FILE)
@click.option("--columns", required=True, help="NAME=COLUMN,...: bx, by, bz, and time, inclination, azimuth, row, col.")
@click.option("--wrap", type=click.FloatRange(min=1.0), help="Counts wrap at this number: unwrap them.")
@click.option("--scale", default=1.0, show_default=True, help="mT per count.")
@click.option("--offset", type=(float, float, float), default=(0.0, 0.0, 0.0), help="Field to subtract, mT.")
@click.option("--time-scale", default=1.0, show_default=True, help="Seconds per unit of time.")
@click.option("--radians", is_flag=True, help="Angles are in radians.")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), required=True, help="FILE.csv or FILE.mcap.")
def convert(
    file: Path,
    columns: str,
    wrap: float | None,
    scale: float,
    offset: tuple[float, float, float],
    time_scale: float,
    radians: bool,
    out: Path,
) -> None:
    """Convert a CSV recording of a whisker to a jig table or a recording."""
    if out.suffix not in (".csv", ".mcap"):
        raise click.UsageError(f"--out {out}: expected FILE.csv or FILE.mcap")
    names, records = read_records(file)
    mapping = ColumnMap(columns, wrap, scale, offset, time_scale, radians)
    converted = convert_rows(names, records, mapping, str(file), need_angles=out.suffix == ".csv")
    if out.suffix == ".csv":
        out.write_text(jig_csv(converted), encoding="utf-8")
    else:
        _write_recording(converted, out)
    click.echo(f"{len(converted.field_mT)} readings; wrote {out}")


def _write_recording(converted: Converted, out: Path) -> None:
    layout = _single_whisker()
    if (converted.row != 0).any() or (converted.col != 0).any():
        raise click.UsageError("a recording is of one whisker: choose its rows, or write a .csv")
    with RecordingWriter(out, sensor_period_us=0.0, attachments={LAYOUT: layouts.to_json(layout).encode()}) as writer:
        stamps = np.round(converted.time_s * 1e9).astype(np.int64).tolist()
        for stamp, field in zip(stamps, converted.field_mT, strict=True):
            writer.write_measurement(HallFrame(stamp, field.reshape(1, 1, 3), np.ones((1, 1), dtype=np.bool_)))
        writer.attach(LABELS, labels_of(converted, layout.name).to_text().encode(), media_type="application/json")


def _single_whisker() -> WhiskerLayout:
    """One whisker under the origin, as the recording has no more to say."""
    return WhiskerLayout(
        "single-whisker", 1, 1, np.zeros((1, 3)), R_DOWN[None].copy(), np.full(1, 0.15), np.ones(1, dtype=np.bool_)
    )
