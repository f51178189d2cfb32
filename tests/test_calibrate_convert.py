"""`calibrate convert`, and the study of a real whisker on the public data set."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from calibration.convert import unwrap
from drivers.recording_reader import Recording
from robominer_slam.capture.recording import read_capture, samples_of
from tests.simulated_hall_array import run


@pytest.mark.parametrize("shift", [0, 20_000, 60_000])
def test_counts_are_unwrapped_over_gaps_in_the_recording(shift: int):
    # Two stretches far from each other, one of them around zero, as of a recording with pauses.
    true = np.r_[np.linspace(45_000, 51_000, 50), np.linspace(-3_500, 2_000, 50), np.linspace(47_000, 3_000, 60)]
    found = unwrap(np.mod(true + shift, 65536), 65536)
    np.testing.assert_allclose(np.diff(found), np.diff(true))


def test_a_steady_turn_all_round_is_unwrapped_by_its_steps():
    true = np.arange(0.0, 200_000.0, 500.0)
    np.testing.assert_allclose(np.diff(unwrap(np.mod(true, 65536), 65536)), 500.0)


def test_a_foreign_table_becomes_a_jig_table_and_a_capture(tmp_path: Path):
    rows = ["t,X,Y,Z,Tilt,Dir"]
    rows += [f"{k * 10},{100 + k},{65535 - k},{300},{10 * (k // 2)},{90}" for k in range(6)]
    (tmp_path / "theirs.csv").write_text("\n".join(rows))
    columns = "time=t,bx=X,by=Y,bz=Z,inclination=Tilt,azimuth=Dir"
    common = ("calibrate", "convert", tmp_path / "theirs.csv", "--columns", columns, "--wrap", 65536, "--scale", 0.1)
    code, _, error = run(*common, "--time-scale", 1e-3, "--out", tmp_path / "jig.csv")
    assert code == 0, error
    assert (tmp_path / "jig.csv").read_text().splitlines()[1] == "0,0,0,90,10,6553.5,30"
    code, _, error = run(*common, "--time-scale", 1e-3, "--out", tmp_path / "theirs.mcap")
    assert code == 0, error
    assert Recording(tmp_path / "theirs.mcap").duration_ns == 50_000_000
    capture = read_capture(tmp_path / "theirs.mcap")
    assert [len(field) for _, field, _ in capture.steps()] == [2, 2, 2]
    (samples,) = samples_of(capture)
    np.testing.assert_allclose(np.rad2deg(samples.inclination), [0, 0, 10, 10, 20, 20])


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--columns", "bx=X,by=Y,bz=W", "--out", "o.mcap"), "lacks the columns W"),
        (("--columns", "bx=X,by=Y", "--out", "o.mcap"), "lacks bz"),
        (("--columns", "bx=X,by=Y,bz=Z", "--out", "o.csv"), "needs inclination=COLUMN"),
        (("--columns", "bx=X,by=Y,bz=Z", "--out", "o.mcap"), "line 3: Z is 'high'"),
        (("--columns", "bx=X,by=Y,bz=Z", "--out", "o.txt"), "expected FILE.csv or FILE.mcap"),
    ],
)
def test_mistakes_are_one_line(tmp_path: Path, options: tuple[str, ...], expected: str):
    (tmp_path / "t.csv").write_text("X,Y,Z\n1,2,3\n1,2,high\n")
    arguments = [str(tmp_path / one) if one.startswith("o.") else one for one in options]
    code, _, error = run("calibrate", "convert", tmp_path / "t.csv", *arguments)
    assert code == 2
    assert expected in error


def test_the_real_whiskers_inner_groups_are_predicted_within_5_percent(shared_data: Path):
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "real_whisker.py"
    spec = importlib.util.spec_from_file_location("real_whisker", path)
    assert spec is not None
    assert spec.loader is not None
    study = importlib.util.module_from_spec(spec)
    sys.modules["real_whisker"] = study
    spec.loader.exec_module(study)
    readings = study.read(shared_data / "hall_real" / "openwhisker_dev.csv")
    good = readings.where(study.settled(readings))
    # Every 8th reading: they are many more than the fit needs.
    thin = good.where(np.arange(len(good.bend)) % 8 == 0)
    centres = study.groups(thin)
    assert [round(one, 1) for one in centres] == [10.3, 14.8, 19.3, 28.3]
    span = np.ptp(thin.bend)
    for centre in centres[1:3]:
        inside = np.abs(thin.distance - centre) < 1.0
        p = study.fit_lever(thin.where(~inside), shaft=False)
        test = thin.where(inside)
        error = study.lever(p, test.field, test.distance) - test.bend
        assert np.sqrt(np.mean(error**2)) < 0.05 * span
