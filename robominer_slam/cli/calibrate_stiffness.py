"""`robominer-slam calibrate stiffness`: stiffness of a whisker's joint from weights, damping from an oscillation."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from calibration import oscillation as swings
from calibration.angle_estimator import AngleEstimator
from calibration.fit import FitError
from calibration.oscillation import Oscillation
from calibration.polynomial import tilt_from_angles
from calibration.stiffness import Levers, StiffnessReport
from calibration.stiffness import stiffness as fit_stiffness
from robominer_slam.capture.recording import whisker_frames
from robominer_slam.cli.csv_table import first_of, read_records, read_table
from robominer_slam.configuration.calibration_file import read_calibration_file

FloatArray = NDArray[np.float64]
FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
DEGREE = float(np.pi / 180.0)
ANGLES = {"angle_deg": DEGREE, "inclination_deg": DEGREE, "angle_rad": 1.0, "inclination_rad": 1.0}
EPILOG = """
\b
Examples:
  robominer-slam calibrate stiffness weights.csv --l1 0.0175 --l2 0.14 --oscillation swing.csv
  robominer-slam calibrate stiffness --recording swing.mcap --calibration array-07.json --whisker 3,4
  robominer-slam calibrate stiffness --decrement 3.35 --thesis-stiffness 5.7 --mass 0.008
\b
WEIGHTS has the columns mass_kg or mass_g, angle_deg (or inclination_deg, angle_rad), and whisker if there are
several; an oscillation has time_s and an angle.
"""


@click.command(epilog=EPILOG)
@click.argument("weights", type=FILE, required=False)
@click.option("--l1", type=click.FloatRange(min=0.0, min_open=True), help="From the joint to the membrane, m.")
@click.option("--l2", type=click.FloatRange(min=0.0, min_open=True), help="From the joint to the weight, m.")
@click.option("--l1-sigma", default=0.0, help="Standard deviation of l1, m.")
@click.option("--l2-sigma", default=0.0, help="Standard deviation of l2, m.")
@click.option("--oscillation", "oscillation_file", type=FILE, help="CSV of a free oscillation.")
@click.option("--recording", type=FILE, help="Recording of a whisker swinging; with --calibration and --whisker.")
@click.option("--calibration", "calibration_file", type=FILE, help="Calibration for --recording.")
@click.option("--whisker", help="Whisker of --recording as ROW,COL.")
@click.option("--decrement", type=click.FloatRange(min=0.0, min_open=True), help="A decrement known already.")
@click.option("--thesis-stiffness", type=click.FloatRange(min=0.0, min_open=True), help="Known stiffness, N/rad.")
@click.option("--joint-stiffness", type=click.FloatRange(min=0.0, min_open=True), help="Known stiffness, N m/rad.")
@click.option("--mass", default=0.008, show_default=True, help="Of the rod, kg.")
@click.option("--length", default=0.15, show_default=True, help="Of the rod, m.")
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
def stiffness(
    weights: Path | None,
    l1: float | None,
    l2: float | None,
    l1_sigma: float,
    l2_sigma: float,
    oscillation_file: Path | None,
    recording: Path | None,
    calibration_file: Path | None,
    whisker: str | None,
    decrement: float | None,
    thesis_stiffness: float | None,
    joint_stiffness: float | None,
    mass: float,
    length: float,
    as_json: bool,
) -> None:
    """Stiffness of a whisker's joint from weights, damping from a free oscillation, as in the thesis."""
    if weights is None and oscillation_file is None and recording is None and decrement is None:
        raise click.UsageError("expected WEIGHTS, --oscillation, --recording or --decrement")
    figures: dict[str, object] = {}
    report: StiffnessReport | None = None
    if weights is not None:
        if l1 is None or l2 is None:
            raise click.UsageError("with WEIGHTS expected --l1 and --l2, m")
        report = _from_weights(weights, Levers(l1, l2, l1_sigma, l2_sigma))
        thesis_stiffness, joint_stiffness = report.thesis, report.joint
        figures["stiffness"] = asdict(report)
    elif thesis_stiffness is not None and joint_stiffness is None and l1 is not None:
        joint_stiffness = thesis_stiffness * l1
    swing: Oscillation | None = None
    if oscillation_file is not None:
        swing = swings.fit_oscillation(*_from_csv(oscillation_file))
    elif recording is not None:
        if calibration_file is None or whisker is None:
            raise click.UsageError("with --recording expected --calibration FILE and --whisker ROW,COL")
        swing = swings.fit_oscillation(*_from_recording(recording, calibration_file, whisker))
    if swing is not None:
        figures["oscillation"] = asdict(swing)
    if swing is not None or decrement is not None:
        inertia = swings.rod_inertia(mass, length)
        sigma = report.joint_sigma if report is not None else 0.0
        figures["damping"] = _damping(swing, decrement, mass, inertia, thesis_stiffness, joint_stiffness, sigma)
    click.echo(json.dumps(figures) if as_json else _text(report, swing, figures))


def _damping(
    swing: Oscillation | None,
    decrement: float | None,
    mass: float,
    inertia: float,
    thesis_stiffness: float | None,
    joint_stiffness: float | None,
    joint_sigma: float,
) -> dict[str, float | None]:
    ratio = swing.damping_ratio if swing is not None else swings.damping_ratio(decrement or 0.0)
    ratio_sigma = swing.damping_ratio_sigma if swing is not None else 0.0
    if joint_stiffness is None and swing is not None:
        # Without weights the frequency tells the stiffness of a rod of known inertia.
        joint_stiffness = inertia * swing.natural_rad_s**2
    physical = None if joint_stiffness is None else swings.physical_damping(ratio, inertia, joint_stiffness)
    relative = 0.0 if not joint_stiffness else float(np.hypot(ratio_sigma / ratio, 0.5 * joint_sigma / joint_stiffness))
    return {
        "damping_ratio": ratio,
        "damping_ratio_sigma": ratio_sigma,
        "inertia_kg_m2": inertia,
        "joint_stiffness_Nm_per_rad": joint_stiffness,
        "physical_Nms_per_rad": physical,
        "physical_sigma_Nms_per_rad": None if physical is None else physical * relative,
        "thesis_formula": None if thesis_stiffness is None else swings.thesis_damping(ratio, mass, thesis_stiffness),
    }


def _text(report: StiffnessReport | None, swing: Oscillation | None, figures: dict[str, object]) -> str:
    lines = []
    if report is not None:
        lines += [
            f"whisker {one.whisker}: {one.joint:.4g} +- {one.joint_sigma:.2g} N m/rad from {one.loads} readings, "
            f"residual {np.rad2deg(one.residual):.2f} deg"
            for one in report.whiskers
        ]
        lines.append(
            f"joint stiffness {report.joint:.4g} +- {report.joint_sigma:.2g} N m/rad"
            + (f" (spread {report.spread:.2g} over {len(report.whiskers)} whiskers)" if report.spread else "")
            + f"; as the thesis gives it {report.thesis:.4g} +- {report.thesis_sigma:.2g} N/rad"
        )
    if swing is not None:
        peaks = "" if swing.peak_decrement is None else f" (from peaks {swing.peak_decrement:.2f})"
        lines.append(
            f"logarithmic decrement {swing.decrement:.3g} +- {swing.decrement_sigma:.2g}{peaks}, damped frequency "
            f"{swing.frequency_hz:.4g} +- {swing.frequency_sigma_hz:.2g} Hz, residual "
            f"{np.rad2deg(swing.residual):.2f} deg over {swing.samples} readings"
        )
    damping = figures.get("damping")
    if isinstance(damping, dict):
        lines.append(f"damping ratio {damping['damping_ratio']:.3g} +- {damping['damping_ratio_sigma']:.2g}")
        if damping["physical_Nms_per_rad"] is not None:
            lines.append(
                f"viscous damping 2 zeta sqrt(I k) = {damping['physical_Nms_per_rad']:.3g} +- "
                f"{damping['physical_sigma_Nms_per_rad']:.2g} N m s/rad "
                f"with I = {damping['inertia_kg_m2']:.3g} kg m2, "
                f"k = {damping['joint_stiffness_Nm_per_rad']:.3g} N m/rad"
            )
        if damping["thesis_formula"] is not None:
            lines.append(f"by the thesis's formula zeta sqrt(m k) = {damping['thesis_formula']:.3g}")
    return "\n".join(lines)


def _from_weights(path: Path, levers: Levers) -> StiffnessReport:
    names, records = read_records(path)
    mass, kilograms = first_of(path, names, {"mass_kg": 1.0, "mass_g": 1e-3})
    angle, radians = first_of(path, names, ANGLES)
    table = np.array(read_table(path, (mass, angle))).reshape(-1, 2)
    whiskers = [record.get("whisker") or "1" for record in records]
    return fit_stiffness(whiskers, table[:, 0] * kilograms, table[:, 1] * radians, levers)


def _from_csv(path: Path) -> tuple[FloatArray, FloatArray]:
    names, _ = read_records(path)
    time, seconds = first_of(path, names, {"time_s": 1.0, "time_ms": 1e-3, "time_us": 1e-6})
    angle, radians = first_of(path, names, ANGLES)
    table = np.array(read_table(path, (time, angle))).reshape(-1, 2)
    return table[:, 0] * seconds, table[:, 1] * radians


def _from_recording(path: Path, calibration_file: Path, whisker: str) -> tuple[FloatArray, FloatArray]:
    """Times, s, and the signed tilt along the direction in which the whisker swings, rad."""
    calibration = read_calibration_file(calibration_file)
    try:
        row, col = (int(part) for part in whisker.split(","))
    except ValueError:
        raise click.UsageError(f"--whisker {whisker}: expected ROW,COL as in 3,4") from None
    if not (0 <= row < calibration.rows and 0 <= col < calibration.cols):
        raise click.UsageError(f"--whisker {whisker}: the array is {calibration.rows} x {calibration.cols}")
    stamps, field, valid, period_ns = whisker_frames(path)
    estimator = AngleEstimator(calibration.model)
    if field.shape[1] != estimator.count:
        raise FitError(f"{path}: frames of {field.shape[1]} whiskers, the calibration has {estimator.count}")
    i = row * calibration.cols + col
    times, tilts = [], []
    for stamp, one, usable in zip(stamps, field, valid, strict=True):
        angles = estimator.angles(one, usable)
        if angles.valid[i]:
            times.append((stamp + i * period_ns) * 1e-9)
            tilts.append(tilt_from_angles(angles.inclination[i], angles.azimuth[i]))
    if not times:
        raise FitError(f"{path}: whisker ({row}, {col}) has no valid reading")
    tilt = np.array(tilts)
    centred = tilt - np.median(tilt, axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    return np.array(times), tilt @ direction
