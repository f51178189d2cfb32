"""`calibrate wizard`: sensors that are permuted and turned are found, on a simulated array on a pseudo-terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.capture_labels import CaptureError
from calibration.mount_direction import bend_directions, mount_rotation, touched_sensor
from robominer_slam import layout as layouts
from tests.simulated_hall_array import Program, SimulatedHallArray, small_layout, write_configuration

#: Whisker to the sensor that reads it, and the turn of that sensor about the rod, deg.
SENSOR_OF_WHISKER = np.array([2, 0, 3, 1, 5, 4])
TURN_DEG = np.array([0.0, 90.0, -130.0, 45.0, 180.0, -20.0])
#: Azimuth of a bend in the frame of a floor whisker, whose y-axis points right, deg.
AZIMUTH_DEG = {"forward": 0.0, "left": -90.0}


def permuted_and_turned(field: np.ndarray) -> np.ndarray:
    """What the sensors send: each in its own axes, at its own place."""
    R_sensor_whisker = Rotation.from_euler("z", -TURN_DEG[:, None], degrees=True).as_matrix()
    turned = np.einsum("nij,nj->ni", R_sensor_whisker, field)
    sent = np.zeros_like(field)
    sent[SENSOR_OF_WHISKER] = turned
    return sent


@pytest.fixture
def array(tmp_path: Path):
    device = SimulatedHallArray(tmp_path / "whiskers", small_layout(2, 3), seen=permuted_and_turned)
    yield device
    device.close()


def operate(array: SimulatedHallArray, out: Path, mistakes: dict[int, tuple[int, str]]) -> tuple[list[dict], int, str]:
    """Do what the wizard asks for; `mistakes` maps the number of a bend to another whisker and direction."""
    config = write_configuration(out.parent, array.layout)
    program = Program("calibrate", "wizard", "--config", config, "--out", out, "--json")
    events, bends = [], 0
    for event in program.events():
        events.append(event)
        if event.get("kind") == "rest":
            array.hold(0.0, 0.0)
            program.enter()
        elif event.get("kind") == "bend":
            whisker, towards = mistakes.get(bends, (event["row"] * 3 + event["col"], event["towards"]))
            # A hand is good for some 10 deg.
            array.hold(25.0 + bends % 3, AZIMUTH_DEG[towards] + 10.0 * (-1) ** bends, whisker=whisker)
            bends += 1
            program.enter()
    return events, *program.end()


def test_the_layout_has_each_whisker_at_its_sensors_place_and_turn(array: SimulatedHallArray, tmp_path: Path):
    events, code, error = operate(array, tmp_path / "layout.json", {})
    assert code == 0, error
    assert not [event for event in events if event.get("kind") == "problem"]
    found = layouts.from_json((tmp_path / "layout.json").read_text(), "layout.json")
    plan = array.layout
    for whisker, sensor in enumerate(SENSOR_OF_WHISKER):
        np.testing.assert_allclose(found.p_base[sensor], plan.p_base[whisker], atol=1e-12)
        true = plan.R_base_whisker[whisker] @ Rotation.from_euler("z", TURN_DEG[whisker], degrees=True).as_matrix()
        off = Rotation.from_matrix(true.T @ found.R_base_whisker[sensor]).magnitude()
        # Magnets are tilted by 2.5 deg and sensors turned by 3 deg, and the two bends err by 10 deg to either side.
        assert np.rad2deg(off) < 12.0
    assert events[-1]["elsewhere"] == 6


def test_mistakes_are_said_at_once_and_the_whisker_is_asked_for_again(array: SimulatedHallArray, tmp_path: Path):
    mistakes = {1: (0, "forward"), 5: (0, "left"), 6: (0, "forward"), 7: (0, "left")}
    events, code, error = operate(array, tmp_path / "layout.json", mistakes)
    assert code == 0, error
    problems = [event["text"] for event in events if event.get("kind") == "problem"]
    assert len(problems) == 3
    assert "disagree by" in problems[0]
    assert "different sensors" in problems[1]
    assert "was that of whisker (0, 0) before" in problems[2]
    found = [tuple(event["sensor"]) for event in events if event.get("kind") == "found"]
    assert found == [divmod(int(sensor), 3) for sensor in SENSOR_OF_WHISKER]


def test_a_mirrored_bend_is_told():
    nominal = layouts.R_DOWN
    with pytest.raises(CaptureError, match="mirrored"):
        mount_rotation(nominal, {"forward": 0.0, "left": np.pi / 2})
    R, off = mount_rotation(nominal, {"forward": 0.3, "left": -np.pi / 2 + 0.3})
    np.testing.assert_allclose(R @ [np.cos(0.3), np.sin(0.3), 0.0], [1.0, 0.0, 0.0], atol=1e-12)
    assert off == pytest.approx(0.0, abs=1e-12)


def test_no_touch_and_two_touches_are_refused():
    rest = np.tile([0.0, 0.0, 40.0], (4, 1))
    with pytest.raises(CaptureError, match="no sensor's field changed"):
        touched_sensor(rest, rest + 0.2)
    both = rest.copy()
    both[1, 0], both[2, 1] = 8.0, 7.0
    with pytest.raises(CaptureError, match="bend one whisker only"):
        touched_sensor(rest, both)


def test_whiskers_on_walls_are_bent_where_they_can_be():
    rm3 = layouts.rm3()
    assert bend_directions(rm3.R_base_whisker[0]) == ("forward", "left")
    assert bend_directions(rm3.R_base_whisker[6 * 8]) == ("forward", "up")
    assert bend_directions(rm3.R_base_whisker[9 * 8]) == ("left", "up")
