"""`calibrate stiffness`: the thesis's numbers, known springs, and a whisker that swings in the physics engine."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from calibration.fit import FitError
from calibration.oscillation import damping_ratio, decrement, fit_oscillation, thesis_damping
from calibration.stiffness import GRAVITY, Levers, stiffness, whisker_stiffness
from sim_backend.physics import TIME_STEP
from sim_backend.whisker_model import WhiskerMechanics
from tests.simulated_hall_array import run
from tests.test_sim_physics import hanging_free


def weighed(joint: float, masses: np.ndarray, lever: float, rest: float = 0.0) -> np.ndarray:
    """Angle below the level at which k (x - x0) = m g l2 cos x, by Newton's method."""
    x = np.full_like(masses, rest)
    for _ in range(50):
        load = masses * GRAVITY * lever
        x -= (joint * (x - rest) - load * np.cos(x)) / (joint + load * np.sin(x))
    return x


def damped(ratio: float, natural: float, t: np.ndarray, amplitude: float = 0.3) -> np.ndarray:
    omega = natural * np.sqrt(1 - ratio**2)
    ahead = ratio / np.sqrt(1 - ratio**2)
    return amplitude * np.exp(-ratio * natural * t) * (np.cos(omega * t) + ahead * np.sin(omega * t))


def test_the_thesiss_own_numbers_reproduce():
    assert damping_ratio(3.35) == pytest.approx(0.47, abs=0.005)
    assert thesis_damping(0.47, 0.008, 5.7) == pytest.approx(0.1, abs=0.005)
    assert decrement(damping_ratio(3.35)) == pytest.approx(3.35)
    code, out, _ = run(
        "calibrate", "stiffness", "--decrement", 3.35, "--thesis-stiffness", 5.7, "--mass", 0.008, "--l1", 0.0175,
        "--json",
    )  # fmt: skip
    damping = json.loads(out)["damping"]
    assert code == 0
    assert damping["damping_ratio"] == pytest.approx(0.47, abs=0.005)
    assert damping["thesis_formula"] == pytest.approx(0.1, abs=0.005)
    # 5.7 N/rad over a lever of 17.5 mm is 0.1 N m/rad; the physical coefficient is 40 times smaller.
    assert damping["joint_stiffness_Nm_per_rad"] == pytest.approx(0.1, abs=0.001)
    assert damping["physical_Nms_per_rad"] == pytest.approx(0.0023, abs=5e-5)


def test_stiffness_of_known_springs_with_an_honest_uncertainty(tmp_path: Path):
    rng = np.random.default_rng(2)
    masses = np.array([0.0, 2, 4, 6, 8, 10, 15, 20, 25]) * 1e-3
    springs = rng.normal(0.1, 0.008, 8)
    lines = ["whisker,mass_g,angle_deg"]
    inside = 0
    for k, joint in enumerate(springs):
        angle = weighed(joint, masses, 0.14, rest=0.02) + rng.normal(0, np.deg2rad(0.4), len(masses))
        lines += [f"w{k},{1000 * m:g},{np.rad2deg(a):.4f}" for m, a in zip(masses, angle, strict=True)]
        one = whisker_stiffness("w", masses, angle, 0.14)
        inside += abs(one.joint - joint) < 2.0 * one.joint_sigma
        assert one.joint == pytest.approx(joint, rel=0.05)
        assert one.rest_angle == pytest.approx(0.02, abs=0.02)
    assert inside >= 6
    (tmp_path / "weights.csv").write_text("\n".join(lines))
    code, out, error = run("calibrate", "stiffness", tmp_path / "weights.csv", "--l1", 0.0175, "--l2", 0.14, "--json")
    assert code == 0, error
    found = json.loads(out)["stiffness"]
    assert len(found["whiskers"]) == 8
    assert abs(found["joint"] - springs.mean()) < 0.002
    assert found["spread"] == pytest.approx(springs.std(ddof=1), rel=0.3)
    assert found["thesis"] == pytest.approx(found["joint"] / 0.0175)


def test_the_levers_uncertainty_is_in_the_result():
    masses = np.array([0.0, 5, 10, 15]) * 1e-3
    angle = weighed(0.1, masses, 0.14)
    report = stiffness(["1"] * 4, masses, angle, Levers(0.0175, 0.14, l1_sigma=0.00175, l2_sigma=0.0014))
    assert report.joint == pytest.approx(0.1, rel=1e-6)
    assert report.joint_sigma == pytest.approx(0.001, rel=0.01)
    assert report.thesis_sigma / report.thesis == pytest.approx(np.hypot(0.1, 0.01), rel=0.01)


@pytest.mark.parametrize("ratio", [0.05, 0.2, 0.47, 0.7])
def test_the_decrement_of_a_noisy_swing_with_an_offset(ratio: float):
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 2.0, 1 / 300)
    held = t < 0.5
    angle = 0.05 + np.where(held, 0.3, damped(ratio, 40.0, np.maximum(t - 0.5, 0.0))) + rng.normal(0, 0.003, len(t))
    angle[rng.integers(160, len(t), 8)] += 0.2
    found = fit_oscillation(t, angle)
    assert found.damping_ratio == pytest.approx(ratio, rel=0.04)
    assert abs(found.damping_ratio - ratio) < 4.0 * found.damping_ratio_sigma
    assert found.natural_rad_s == pytest.approx(40.0, rel=0.03)
    assert found.rest_angle == pytest.approx(0.05, abs=0.003)


def test_a_clean_swings_peaks_say_the_same_as_the_fit():
    t = np.arange(0.0, 1.5, 1 / 1000)
    found = fit_oscillation(t, damped(0.1, 40.0, t))
    assert found.peak_decrement == pytest.approx(decrement(0.1), rel=0.01)
    assert found.decrement == pytest.approx(decrement(0.1), rel=1e-3)


def test_a_whisker_of_the_physics_engine_has_the_damping_it_was_given(tmp_path: Path):
    mechanics = WhiskerMechanics()
    engine = hanging_free(frame_interval=TIME_STEP)
    engine._qpos[5, 7] = 0.1
    angle = [engine.read().hinge[5, 0] for _ in range(160)]
    rows = [f"{k * TIME_STEP:.6f},{np.rad2deg(a):.6f}" for k, a in enumerate(angle)]
    (tmp_path / "swing.csv").write_text("\n".join(["time_s,angle_deg", *rows]))
    code, out, error = run("calibrate", "stiffness", "--oscillation", tmp_path / "swing.csv", "--json")
    assert code == 0, error
    figures = json.loads(out)
    damping = figures["damping"]
    # The weight of the hanging rod stiffens its joint: m g L / 2 = 0.006 N m/rad.
    stiffness_with_weight = mechanics.stiffness + 0.008 * GRAVITY * 0.075
    inertia = mechanics.inertia(0.15)
    ratio = mechanics.damping(0.15) / (2.0 * np.sqrt(inertia * stiffness_with_weight))
    assert damping["damping_ratio"] == pytest.approx(ratio, rel=0.05)
    # The engine's own frequency is right within 5 % (`physics.TIME_STEP`); the stiffness goes with its square.
    assert figures["oscillation"]["natural_rad_s"] == pytest.approx(np.sqrt(stiffness_with_weight / inertia), rel=0.05)
    assert damping["joint_stiffness_Nm_per_rad"] == pytest.approx(
        inertia * figures["oscillation"]["natural_rad_s"] ** 2, rel=1e-9
    )
    assert damping["physical_Nms_per_rad"] == pytest.approx(mechanics.damping(0.15), rel=0.05)


@pytest.mark.parametrize(
    ("mass", "angle", "expected"),
    [
        ([0.01, 0.01], [0.1, 0.1], "1 load"),
        ([0.0, 0.01], [0.1, 0.1], "does not change"),
        ([0.0, 0.01], [0.1, 2.0], "between -90 and 90"),
    ],
)
def test_weights_that_say_nothing_are_refused(mass, angle, expected):
    with pytest.raises(FitError, match=expected):
        whisker_stiffness("3", np.array(mass), np.array(angle), 0.14)


def test_an_overdamped_whisker_is_refused():
    t = np.arange(0.0, 1.0, 0.005)
    with pytest.raises(FitError, match="no damped oscillation"):
        fit_oscillation(t, 0.3 * np.exp(-t / 0.1) + np.random.default_rng(0).normal(0, 0.002, len(t)))


@pytest.mark.parametrize(
    ("content", "arguments", "expected"),
    [
        ("mass_g,angle\n1,2\n", ("--l1", "0.01", "--l2", "0.1"), "expected a column angle_deg or"),
        ("mass_g,angle_deg\n1,x\n", ("--l1", "0.01", "--l2", "0.1"), "line 2: expected numbers"),
        ("mass_g,angle_deg\n1,2\n", (), "expected --l1 and --l2"),
    ],
)
def test_mistakes_in_the_table_are_one_line(tmp_path: Path, content: str, arguments: tuple[str, ...], expected: str):
    (tmp_path / "weights.csv").write_text(content)
    code, _, error = run("calibrate", "stiffness", tmp_path / "weights.csv", *arguments)
    assert code == 2
    assert expected in error
