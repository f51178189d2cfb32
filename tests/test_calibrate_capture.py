"""`calibrate capture`, `fit --capture`, `check` and `report` on a simulated array behind a pseudo-terminal."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from calibration.capture_labels import CaptureError, labels_from_text
from calibration.capture_plan import plan, plan_from_rows
from drivers.recording_reader import Recording
from robominer_slam.capture.recording import read_capture, samples_of
from tests.simulated_hall_array import (
    Program,
    SimulatedHallArray,
    run,
    small_layout,
    write_configuration,
)


@pytest.fixture
def array(tmp_path: Path):
    device = SimulatedHallArray(tmp_path / "whiskers", small_layout())
    yield device
    device.close()


def capture_with_operator(array: SimulatedHallArray, out: Path, *options: object) -> list[dict]:
    """Run a capture; the whiskers are held as each step says before Enter is pressed."""
    config = write_configuration(out.parent, array.layout)
    program = Program("calibrate", "capture", "--config", config, "--out", out, "--json", "--frames", 8, *options)
    events = []
    for event in program.events():
        events.append(event)
        if event["event"] == "step":
            if event["method"] == "rings":
                array.circle(event["inclination_deg"])
            elif event["method"] == "jig":
                array.hold(event["inclination_deg"], event["azimuth_deg"])
            elif "height_m" in event:
                # The tip trails behind the drag; the floor whisker's y points right.
                inclination = np.rad2deg(np.arccos((event["height_m"] - 0.0015) / 0.1485))
                array.hold(inclination, -(event["direction_deg"] + 180.0))
            else:
                array.hold(0.0, 0.0)
            program.enter()
    code, error = program.end()
    assert code == 0, error
    return events


def test_a_jig_capture_is_fitted_checked_and_reported(array: SimulatedHallArray, tmp_path: Path):
    events = capture_with_operator(array, tmp_path / "jig.mcap", "--method", "jig")
    captured = [event for event in events if event["event"] == "captured"]
    assert len(captured) == 41
    assert all(event["problem"] == "" for event in captured)
    capture = read_capture(tmp_path / "jig.mcap")
    assert [len(field) for _, field, _ in capture.steps()] == [8] * 41

    code, out, error = run(
        "calibrate", "fit", "--capture", tmp_path / "jig.mcap", "--out", tmp_path / "cal.json", "--json"
    )
    assert code == 0, error
    assert json.loads(out)["whiskers"] == 4
    assert json.loads(out)["rms_deg"] < 1.0

    check = ("calibrate", "check", "--calibration", tmp_path / "cal.json")
    code, out, error = run(*check, "--capture", tmp_path / "jig.mcap", "--json")
    assert code == 0, out + error
    assert all(one["direction_deg"] < 1.0 for one in json.loads(out)["whiskers"])

    report = ("calibrate", "report", tmp_path / "cal.json", "--out", tmp_path / "report.html")
    code, out, error = run(*report, "--capture", tmp_path / "jig.mcap")
    assert code == 0, error
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64") == 5
    assert "http" not in page

    # A whisker knocked askew after the calibration, checked live.
    array.hold(12.0, 30.0, whisker=2)
    config = write_configuration(tmp_path, array.layout, calibration="cal.json")
    code, out, error = run("calibrate", "check", "--config", config, "--auto", 0, "--frames", 8, "--json")
    assert code == 1, out + error
    verdicts = {(one["row"], one["col"]): one for one in json.loads(out)["whiskers"]}
    assert [at for at, one in verdicts.items() if not one["passed"]] == [(1, 0)]
    assert verdicts[1, 0]["rest_off_deg"] == pytest.approx(12.0, abs=2.0)
    array.hold(0.0, 0.0)
    assert run("calibrate", "check", "--config", config, "--auto", 0, "--frames", 8)[0] == 0


@pytest.mark.parametrize("method", ["rings", "floor"])
def test_other_methods_capture_what_the_fit_takes(array: SimulatedHallArray, tmp_path: Path, method: str):
    events = capture_with_operator(array, tmp_path / "c.mcap", "--method", method)
    problems = [event["problem"] for event in events if event["event"] == "captured" and event["problem"]]
    assert not problems
    (samples,) = samples_of(read_capture(tmp_path / "c.mcap"))
    assert len(samples.field_mT) > 100
    code, _, error = run("calibrate", "fit", "--capture", tmp_path / "c.mcap", "--out", tmp_path / "cal.json")
    assert code == 0, error
    code, out, error = run(
        "calibrate", "check", "--calibration", tmp_path / "cal.json", "--capture", tmp_path / "c.mcap", "--json"
    )
    assert code == 0, out + error


def test_a_step_that_does_not_cover_enough_is_asked_for_again(array: SimulatedHallArray, tmp_path: Path):
    script = tmp_path / "plan.csv"
    script.write_text("inclination_deg,azimuth_deg\n0,0\n30,90\n")
    config = write_configuration(tmp_path, array.layout)
    program = Program(
        "calibrate", "capture", "--config", config, "--out", tmp_path / "c.mcap", "--json", "--frames", 5,
        "--method", "jig", "--script", script,
    )  # fmt: skip
    seen = []
    for event in program.events():
        if event["event"] == "step":
            if event["number"] == 1 and event["attempt"] == 0:
                array.hold(30.0, 90.0, whisker=1)
            else:
                array.hold(event["inclination_deg"], event["azimuth_deg"])
            program.enter()
        else:
            seen.append(event["problem"])
    assert program.end()[0] == 0
    assert seen == ["", "not bent: the field is that of rest: (0, 0), (1, 0), (1, 1)", ""]
    labels = labels_from_text(Recording(tmp_path / "c.mcap").attachments()["capture.json"].decode(), "c")
    assert [label.done.inclination_deg for label in labels.labels] == [0.0, 30.0]


def test_a_dead_whisker_is_named(array: SimulatedHallArray, tmp_path: Path):
    array.valid[3] = False
    config = write_configuration(tmp_path, array.layout)
    (tmp_path / "plan.csv").write_text("inclination_deg,azimuth_deg,wait_s\n0,0,0\n")
    code, out, error = run(
        "calibrate", "capture", "--config", config, "--out", tmp_path / "c.mcap", "--method", "jig",
        "--script", tmp_path / "plan.csv", "--frames", 5,
    )  # fmt: skip
    assert code == 0, error
    assert "step 1: fewer than 5 readings: (1, 1)" in out


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("capture", "--config", "{}/none.toml", "--method", "jig", "--out", "x.mcap"), "none.toml"),
        (("check", "--calibration", "{}/small.json", "--capture", "{}/small.json"), "not a calibration file"),
        (("fit", "--capture", "{}/small.json", "--out", "x.json"), "not a recording"),
        (("check",), "expected one of --capture"),
        (("capture", "--config", "{}/config.toml", "--device", "arm", "--method", "jig", "--out", "{}/x.mcap"), "arm"),
        (("capture", "--config", "{}/config.toml", "--method", "floor", "--out", "{}/x.mcap", "--whisker", "0,0"),
         "goes with --method jig"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line_and_exit_code_2(tmp_path: Path, arguments: tuple[str, ...], expected: str):
    write_configuration(tmp_path, small_layout())
    code, _, error = run("calibrate", *(argument.format(tmp_path) for argument in arguments))
    assert code == 2
    lines = [line for line in error.splitlines() if line.lower().startswith("error")]
    assert len(lines) == 1
    assert expected in error


@pytest.mark.parametrize("tool", ["capture", "check", "convert", "fit", "report", "stiffness", "wizard"])
def test_every_tool_has_help_with_an_example(tool: str):
    code, out, _ = run("calibrate", tool, "--help")
    assert code == 0
    assert f"robominer-slam calibrate {tool}" in out


def test_a_script_with_a_mistake_names_file_and_line():
    with pytest.raises(CaptureError, match=r"plan.csv, line 3: expected numbers"):
        plan_from_rows("rings", [{"inclination_deg": "0"}, {"inclination_deg": "much"}], "plan.csv")
    with pytest.raises(CaptureError, match="needs azimuth_deg"):
        plan_from_rows("jig", [{"inclination_deg": "30"}], "plan.csv")
    with pytest.raises(CaptureError, match="no step at rest"):
        plan_from_rows("rings", [{"inclination_deg": "30"}], "plan.csv")


def test_a_plan_for_single_whiskers_names_each():
    steps = plan("jig", length=0.15, whiskers=[(0, 1), (3, 2)])
    assert len(steps) == 1 + 2 * 40
    assert {(one.step.row, one.step.col) for one in steps} == {(None, None), (0, 1), (3, 2)}
