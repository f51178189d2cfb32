"""Replay: the same recording gives the same result; recordings that cannot be used are refused with one line."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from drivers.recording_reader import Recording
from robominer_slam import geometry
from robominer_slam.evaluation.metrics import trajectory_errors
from robominer_slam.evaluation.trajectory import Trajectory, parse_tum
from sim_backend.demo import program


def run(*arguments: str, expect: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(program(*arguments), capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == expect, done.stderr
    assert "Traceback" not in done.stderr
    return done


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    run("simulate", "--scenario", "2", "--max-time", "25", "--out", str(folder), "--record", str(folder / "drive.mcap"))
    return folder


def replay(recorded: Path, out: Path, *more: str) -> dict:
    done = run(
        "replay", str(recorded / "drive.mcap"), "--tum", str(out / "slam.tum"), "--odometry-tum",
        str(out / "odometry.tum"), "--graph", str(out / "graph.json"), "--json", *more,
    )  # fmt: skip
    return json.loads(done.stdout)


def test_two_replays_are_the_same_bit_for_bit(recorded, tmp_path):
    first, second = tmp_path / "a", tmp_path / "b"
    for folder in (first, second):
        folder.mkdir()
        summary = replay(recorded, folder)
        assert summary["frames"] == 625
        assert summary["keyframes"] >= 8
        assert (summary["late"], summary["dropped"]) == (0, 0)
    for name in ("slam.tum", "odometry.tum", "graph.json"):
        assert (first / name).read_bytes() == (second / name).read_bytes()


def test_evaluate_takes_the_truth_from_the_recording(recorded, tmp_path):
    replay(recorded, tmp_path)
    done = run("evaluate", "--truth", str(recorded / "drive.mcap"), "--odometry", str(tmp_path / "odometry.tum"),
               "--slam", str(tmp_path / "slam.tum"), "--graph", str(tmp_path / "graph.json"), "--figure",
               str(tmp_path / "path.png"), "--json")  # fmt: skip
    report = json.loads(done.stdout)
    assert report["slam"]["frames"] == 625
    assert report["odometry"]["position_m"]["mean"] < 0.2
    assert (tmp_path / "path.png").stat().st_size > 10_000


def test_replay_with_a_configuration_file_equals_the_recordings_own(recorded, tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "file").mkdir()
    replay(recorded, tmp_path / "own")
    replay(recorded, tmp_path / "file", "--config", str(recorded / "config.toml"))
    assert (tmp_path / "own/slam.tum").read_bytes() == (tmp_path / "file/slam.tum").read_bytes()


def test_without_slam_poses_are_the_odometry_and_near_the_truth(recorded, tmp_path):
    text = (recorded / "config.toml").read_text() + '\n[slam]\nmethod = "none"\n'
    config = recorded / "none.toml"
    config.write_text(text)
    replay(recorded, tmp_path, "--config", str(config))
    assert (tmp_path / "slam.tum").read_bytes() == (tmp_path / "odometry.tum").read_bytes()
    truths = [truth for _, truth in Recording(recorded / "drive.mcap").ground_truth()]
    truth = Trajectory(
        np.array([t.stamp_ns for t in truths]), geometry.from_vector7(np.array([t.pose for t in truths]))
    )
    estimate = parse_tum((tmp_path / "slam.tum").read_text().splitlines(), "slam.tum")
    errors = trajectory_errors(estimate, truth)
    assert len(errors.stamps_ns) == 625
    assert errors.position.max() < 0.25
    assert np.rad2deg(errors.heading.max()) < 2.5


def test_a_cut_recording_replays_as_far_as_it_goes(recorded, tmp_path):
    whole = (recorded / "drive.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: int(len(whole) * 0.6)])
    done = run(
        "replay", str(cut), "--config", str(recorded / "config.toml"), "--tum", str(tmp_path / "cut.tum"), "--json"
    )
    assert 200 < json.loads(done.stdout)["frames"] < 625


def test_what_is_no_recording_is_refused_with_one_line(recorded, tmp_path):
    (tmp_path / "text.mcap").write_text("this is a letter")
    done = run("replay", str(tmp_path / "text.mcap"), expect=2)
    assert len([line for line in done.stderr.splitlines() if line.startswith("error:")]) == 1
    run("replay", str(tmp_path / "none.mcap"), expect=2)


def test_the_same_seed_gives_the_same_recording_and_another_does_not(tmp_path):
    def record(name: str, seed: int) -> bytes:
        run("simulate", "--max-time", "2.5", "--seed", str(seed), "--out", str(tmp_path / name), "--record",
            str(tmp_path / f"{name}.mcap"))  # fmt: skip
        return (tmp_path / f"{name}.mcap").read_bytes()

    first = record("a", 5)
    assert first == record("b", 5)
    assert first != record("c", 6)


def test_calibrate_fit_and_angles_from_the_command_line(recorded, tmp_path):
    calibration = tmp_path / "array-07.json"
    done = run("calibrate", "fit", "--jig", str(recorded / "jig.csv"), "--layout", "thesis-grid", "--out",
               str(calibration), "--json")  # fmt: skip
    figures = json.loads(done.stdout)
    assert figures["whiskers"] == 64
    assert figures["rms_deg"] < 1.0
    lines = (recorded / "jig.csv").read_text().splitlines()
    sample = [line.split(",") for line in lines[1::700]]
    table = tmp_path / "readings.csv"
    table.write_text("row,col,bx_mT,by_mT,bz_mT\n" + "".join(f"{s[0]},{s[1]},{s[4]},{s[5]},{s[6]}\n" for s in sample))
    rows = run("calibrate", "angles", "--calibration", str(calibration), str(table)).stdout.splitlines()
    assert rows[0] == "row,col,bx_mT,by_mT,bz_mT,inclination_deg,azimuth_deg,sigma_deg"
    for row, truth in zip(rows[1:], sample, strict=True):
        assert abs(float(row.split(",")[5]) - float(truth[2])) < 4.0
    table.write_text("row,col,bx_mT\n0,0,1\n")
    done = run("calibrate", "angles", "--calibration", str(calibration), str(table), expect=2)
    assert "lacks the columns by_mT, bz_mT" in done.stderr
