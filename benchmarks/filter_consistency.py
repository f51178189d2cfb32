"""Does the robust dead reckoning know how wrong it is? Monte-Carlo under the filter's own noise model.

Drives are drawn from the model (velocity walk or slip, biases, noise); the normalised estimation error squared of the
pose (x, y, yaw) in odom, averaged over the runs, must lie within its 95 % bounds for 95 % of the time steps.

Usage: python -m benchmarks.filter_consistency [--runs N] [--seconds S]
"""

from __future__ import annotations

import argparse
import math

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from drivers.measurement import ImuSample, OdometrySample, ScrewAngles
from robominer_slam import geometry
from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.estimation.robust_odometry import RobustOdometry, Source
from robominer_slam.estimation.screw_kinematics import forward_matrix

FloatArray = NDArray[np.float64]

MATRIX = forward_matrix(0.078, math.radians(30.0), 0.15, 0.30)
STEP_S, STEP_NS = 0.02, 20_000_000
KEYFRAME_EVERY = 50
#: A standing robot's creep in turning changes with the windows in which screws and gyro are compared.
CREEP_EVERY = 10
#: Time in which the walking velocity is pulled back to zero, s: slowly against the 0.1 s that the filter averages over.
PULL_S = 3.0


def fused_run(rng: np.random.Generator, seconds: float, settings: RobustEstimationSection) -> FloatArray:
    """NEES of the pose at each whisker frame of one drive with gyro and screws, shape (frames,)."""
    odometry = RobustOdometry(settings, "fused", None, MATRIX)
    inverse = np.linalg.inv(MATRIX)
    slip_mean = settings.slip_mean + rng.normal(0.0, settings.sigma_slip_mean, 3)
    slip = rng.normal(0.0, settings.sigma_slip, 3)
    bias = rng.normal(0.0, settings.sigma_gyro_bias)
    pose, angle, nees = np.zeros(3), np.zeros(4), []
    Q = MATRIX[:3] @ MATRIX[:3].T * settings.sigma_screw_speed**2
    root = np.linalg.cholesky(Q)
    creep = 0.0
    phase = rng.uniform(0.0, 2.0 * math.pi, 2)
    odometry.add(ImuSample(0, np.array([0.0, 0.0, bias]), None))
    odometry.add(ScrewAngles(0, angle))
    for k in range(1, round(seconds / STEP_S) + 1):
        stamp = k * STEP_NS
        driving = k > 100
        if k % CREEP_EVERY == 1:
            creep = rng.normal(0.0, settings.sigma_still)
        turn = 0.3 * math.sin(0.3 * k * STEP_S + phase[0]) if driving else creep
        screws = np.array([0.18, 0.03 * math.sin(0.2 * k * STEP_S + phase[1])]) * driving
        noise = root @ rng.normal(size=3)
        grip = 1.0 - slip_mean - slip
        moving = grip[:2] * screws + noise[:2] if driving else rng.normal(0.0, settings.sigma_still, 2)
        way = math.hypot(*moving) * STEP_S
        walked = rng.normal(0.0, settings.position_walk * math.sqrt(way), 2)
        pose = geometry.se2_compose(pose, geometry.se2_exp(np.array([*moving, turn]) * STEP_S))
        pose[:2] += walked
        for half in (1, 2):
            rate = turn + bias + rng.normal(0.0, settings.sigma_gyro)
            odometry.add(ImuSample(stamp - STEP_NS + half * STEP_NS // 2, np.array([0.0, 0.0, rate]), None))
        reading = np.array([*screws, turn / grip[2] + noise[2] if driving else 0.0, 0.0])
        angle = angle + inverse @ reading * STEP_S
        odometry.add(ScrewAngles(stamp, angle))
        way += abs(turn) * STEP_S * settings.slip_turn_arm
        kept = math.exp(-way / settings.slip_length)
        slip = kept * slip + rng.normal(0.0, settings.sigma_slip * math.sqrt(1.0 - kept * kept), 3)
        bias += rng.normal(0.0, settings.gyro_bias_walk * math.sqrt(STEP_S))
        if k % 2 == 0:
            nees.append(pose_nees(odometry, stamp, pose))
        if k % KEYFRAME_EVERY == 0:
            odometry.mark_keyframe(stamp)
    return np.array(nees)


def odometry_run(rng: np.random.Generator, seconds: float, settings: RobustEstimationSection) -> FloatArray:
    """The same with a ready-made odometry, whose velocity walks as the filter's does."""
    odometry = RobustOdometry(settings, "odometry", None, MATRIX)
    bias = rng.normal(0.0, settings.sigma_odometry_bias, 3)
    walk = np.array([settings.acceleration_walk] * 2 + [settings.angular_acceleration_walk]) * math.sqrt(STEP_S / 4)
    white = settings.sigma_odometry / math.sqrt(30.0 * STEP_S)
    pose, moving, nees = np.zeros(3), rng.normal(0.0, 0.01, 3), []
    odometry.add(OdometrySample(0, np.zeros(3)))
    for k in range(1, round(seconds / STEP_S) + 1):
        stamp = k * STEP_NS
        parts = []
        for _ in range(4):
            # A drive that stays bounded: the walk is pulled back, far slower than it walks.
            moving = moving * (1.0 - STEP_S / 4 / PULL_S) + rng.normal(0.0, 1.0, 3) * walk
            parts.append(moving)
            pose = geometry.se2_compose(pose, geometry.se2_exp(moving * STEP_S / 4))
            way = math.hypot(moving[0], moving[1]) * STEP_S / 4
            pose[:2] += rng.normal(0.0, settings.position_walk * math.sqrt(way), 2)
        odometry.add(OdometrySample(stamp, np.mean(parts, axis=0) + bias + rng.normal(0.0, white, 3)))
        if k % 2 == 0:
            nees.append(pose_nees(odometry, stamp, pose))
        if k % KEYFRAME_EVERY == 0:
            odometry.mark_keyframe(stamp)
    return np.array(nees)


def pose_nees(odometry: RobustOdometry, stamp: int, pose: FloatArray) -> float:
    state = odometry.state_at(stamp)
    error = pose - np.array([state.x, state.y, state.yaw])
    error[2] = float(geometry.wrap_angle(error[2]))
    return float(error @ np.linalg.solve(state.covariance, error))


def share_within(source: Source, runs: int, seconds: float, seed: int = 1) -> tuple[float, float]:
    """Share of time steps within the 95 % bounds, and the mean NEES (3 is right)."""
    settings = RobustEstimationSection()
    run = fused_run if source == "fused" else odometry_run
    nees = np.mean([run(np.random.default_rng([seed, k]), seconds, settings) for k in range(runs)], axis=0)
    low, high = chi2.ppf([0.025, 0.975], 3 * runs) / runs
    return float(np.mean((nees >= low) & (nees <= high))), float(nees.mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=40.0)
    chosen = parser.parse_args()
    print("| source | runs | within 95 % bounds (%) | mean NEES (3 is right) |\n|---|---|---|---|")
    sources: tuple[Source, ...] = ("fused", "odometry")
    for source in sources:
        share, mean = share_within(source, chosen.runs, chosen.seconds)
        print(f"| {source} | {chosen.runs} | {100.0 * share:.1f} | {mean:.2f} |", flush=True)


if __name__ == "__main__":
    main()
