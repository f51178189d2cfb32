"""The robust dead reckoning is honest under its own noise model: the benchmark's study, with fewer runs."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection

RUNS, SECONDS = 40, 6.0
#: A drive's steps depend on each other, so in one batch of runs the share may be far from 95 % by chance: this seed was
#: taken for no other reason than that it came first, and nothing is random once it is fixed.
SEED = 1
#: What the benchmark draws with either source of motion.
DEVIATIONS = {
    "fused": ["sigma_gyro", "sigma_gyro_bias", "sigma_screw_speed", "sigma_still", "sigma_slip", "sigma_slip_mean"],
    "odometry": ["sigma_odometry", "sigma_odometry_bias", "position_walk"],
}


@pytest.fixture(scope="module")
def study():
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "filter_consistency.py"
    spec = importlib.util.spec_from_file_location("filter_consistency", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["filter_consistency"] = module
    spec.loader.exec_module(module)
    return module


def share(study, conditions, settings):
    return study.share_within(study.mean_nees(conditions, RUNS, SECONDS, settings, SEED), RUNS)


@pytest.mark.parametrize("whiskers", [False, True])
@pytest.mark.parametrize("source", ["fused", "odometry"])
def test_the_nees_is_within_its_bounds_at_95_percent_of_the_steps(study, source, whiskers):
    assert share(study, study.Conditions(source, whiskers), RobustEstimationSection()) >= 0.95


@pytest.mark.parametrize("factor", [1.5, 1.0 / 1.5])
@pytest.mark.parametrize("source", ["fused", "odometry"])
def test_noise_one_and_a_half_times_too_large_or_too_small_is_seen(study, source, factor):
    settings = RobustEstimationSection()
    drawn = settings.model_copy(update={name: factor * getattr(settings, name) for name in DEVIATIONS[source]})
    assert share(study, study.Conditions(source), drawn) < 0.5
