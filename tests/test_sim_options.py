"""Worlds, engines, faults and protocols from the command line of `simulate`."""

from __future__ import annotations

import json
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest

from drivers.measurement import HallFrame
from drivers.recording_reader import Recording
from sim_backend.demo import program


def run(*arguments: str, expect: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(program(*arguments), capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == expect, done.stderr
    assert "Traceback" not in done.stderr
    return done


@pytest.mark.parametrize("world", ["thesis", "random:3", "flat", "corridor", "tunnel", "mine"])
def test_every_world_records_with_the_fast_engine(world, tmp_path):
    target = tmp_path / "drive.mcap"
    run("simulate", "--world", world, "--engine", "quasi-static", "--max-time", "6", "--out", str(tmp_path), "--record",
        str(target))  # fmt: skip
    frames = [m for _, m in Recording(target) if isinstance(m, HallFrame)]
    assert len(frames) == 150
    assert np.isfinite(frames[-1].field_mT).all()
    assert Recording(target).metadata["world"] == world


def test_a_dead_whisker_reads_zeros_from_its_time_on(tmp_path):
    faults = tmp_path / "faults.toml"
    faults.write_text('[[fault]]\nkind = "whisker_dead"\nrow = 3\ncol = 5\nstart = 2.0\n')
    run("simulate", "--engine", "quasi-static", "--max-time", "4", "--faults", str(faults), "--out", str(tmp_path),
        "--record", str(tmp_path / "drive.mcap"))  # fmt: skip
    frames = [m for _, m in Recording(tmp_path / "drive.mcap") if isinstance(m, HallFrame)]
    dead = np.array([not frame.field_mT[3, 5].any() for frame in frames])
    assert not dead[:49].any()
    assert dead[51:].all()
    assert all(frame.field_mT[3, 4].any() for frame in frames)


def test_other_protocols_are_served_and_written_into_the_configuration(tmp_path):
    done = run(
        "simulate", "--engine", "quasi-static", "--max-time", "1", "--wait", "0", "--out", str(tmp_path), "--json",
        "--protocol", "whiskers=rm3-compressed", "--protocol", "screws=rm3-motor",
    )  # fmt: skip
    ready = json.loads(done.stdout.splitlines()[0])
    assert {"whiskers", "imu", "screw_front_right", "screw_rear_left"} <= set(ready["ports"])
    devices = tomllib.loads(Path(ready["configuration"]).read_text())["device"]
    spoken = {device["name"]: device["protocol"] for device in devices}
    assert spoken["whiskers"] == "rm3-compressed"
    assert spoken["screw_front_left"] == "rm3-motor"
    assert spoken["imu"] == "framed"
    assert next(d for d in devices if d["name"] == "whiskers")["representation"] == "spherical"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--world", "moon"], "moon"),
        (["--scenario", "9"], "9"),
        (["--faults", "none.toml"], "none.toml: cannot read the faults"),
        (["--faults", "seed:x"], "seed:N"),
        (["--protocol", "whiskers=morse"], "whiskers cannot speak 'morse'"),
        (["--protocol", "whiskers"], "expected DEVICE=PROTOCOL"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments, expected, tmp_path):
    done = run("simulate", "--engine", "quasi-static", "--out", str(tmp_path), "--wait", "0", *arguments, expect=2)
    assert expected in done.stderr
