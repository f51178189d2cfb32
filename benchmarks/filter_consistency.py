"""Does the robust dead reckoning know how wrong it is? Monte-Carlo under the filter's own noise model, and with slip.

Drives are drawn from the model that the filter has, interval by interval:

- `fused`: in an interval the body moves by (1 - mean slip - varying slip) times what the screws say, plus white noise
  of the screws' (or of a standing robot's creep), and walks by the way driven; the gyro is sampled at its own times,
  biased and noisy, and the body turns by the trapezoids through its samples; a standing robot's creep in turning is
  drawn anew for each window in which screws and gyro are compared.
- `odometry`: velocity and biases are walks with a jump at the start of each interval of the filter; a sample measures
  the velocity in the middle of its time, biased and noisy.
- with whiskers: their directions are drawn as the measurement that the filter takes them for, sideways velocities in
  front of the base and behind it, white, that say nothing of the motion ahead.
- with slip: one second in five, what measures the motion reads twice the true velocity, of which no model knows.

The normalised estimation error squared (NEES) of the pose (x, y, yaw) in odom, averaged over 100 runs, is to lie within
its 95 % bounds at 95 % of the time steps (Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and
Navigation", 2001, section 5.4). The steps of a drive depend on each other, as a pose keeps its errors: even a perfect
filter has 95 % only on average over many batches of 100 runs, in one batch it may well have 80 or 100. So the table
has the mean over some batches, with its standard error, and the worst and best of them.

Usage: python -m benchmarks.filter_consistency [--runs N] [--batches B] [--seconds S]
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from drivers.measurement import ImuSample, OdometrySample, ScrewAngles
from robominer_slam import geometry
from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.contacts import Contacts
from robominer_slam.estimation.drag_direction import DragDirection
from robominer_slam.estimation.drag_information import DragInformation
from robominer_slam.estimation.robust_odometry import RobustOdometry, Source
from robominer_slam.estimation.screw_kinematics import forward_matrix

FloatArray = NDArray[np.float64]

MATRIX = forward_matrix(0.078, math.radians(30.0), 0.15, 0.30)
STEP_S, STEP_NS = 0.02, 20_000_000
KEYFRAME_EVERY, FRAME_EVERY = 50, 2
#: Intervals that the robot stands for before it drives.
STANDING = 100
#: Intervals of a window in which screws and gyro are compared (ten of 0.02 s add up to a little less than its 0.2 s),
#: and which of them is the first: the filter begins its first window once it has seen an interval with a gyro.
WINDOW, FIRST = 11, 2
#: Intervals of slip, in so many, and by what factor the true velocity is then read.
SLIPPING, SLIP_EVERY, SLIP_FACTOR = 50, 250, 2.0
#: Deviation of a drawn sideways velocity, m/s (2 deg at 0.15 m/s), and where it is drawn, ahead of the base, m.
SIDEWAYS_SIGMA, TIPS = 0.005, (0.25, -0.25)
#: The direction that counts as ahead swings by so much, rad, so fast, rad/s.
DIRECTION_SWING, DIRECTION_RATE = 0.3, 0.5
NO_CONTACTS = Contacts(np.zeros((0, 3)), np.zeros(0, dtype=np.intp), np.zeros(0), np.zeros(0), np.zeros((3, 0)))


@dataclass(frozen=True, slots=True)
class Conditions:
    """What is drawn: source of motion, with whiskers or not, with slip that no model knows or not."""

    source: Source
    whiskers: bool = False
    slipping: bool = False


class DrawnDirections(DragDirection):
    """Whiskers whose directions are white noise about the true motion, as the filter takes them."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        #: True vx, vy (m/s), wz (rad/s), shape (3,).
        self.moving: FloatArray = np.zeros(3)

    def measure(
        self,
        stamp_ns: int,
        _contacts: Contacts,
        velocity: FloatArray,
        _covariance: FloatArray,
    ) -> DragInformation | None:
        """Sideways velocity of two places, less the estimated one."""
        # Not the true direction of motion: it would share its noise with the state.
        heading = DIRECTION_SWING * math.sin(DIRECTION_RATE * stamp_ns * 1e-9)
        ahead = np.array([math.cos(heading), math.sin(heading)])
        H = np.array([[-ahead[1], ahead[0], ahead[0] * place] for place in TIPS]) / SIDEWAYS_SIGMA
        innovation = H @ (self.moving - velocity) + self._rng.normal(size=len(TIPS))
        return DragInformation(H.T @ H, H.T @ innovation, len(TIPS), ahead)


class Drive:
    """One drive: the filter, the true pose and the NEES at each whisker frame."""

    def __init__(self, rng: np.random.Generator, settings: RobustEstimationSection, conditions: Conditions) -> None:
        self.rng, self.settings, self._conditions = rng, settings, conditions
        self._whiskers = DrawnDirections(rng) if conditions.whiskers else None
        # The drawn directions are no rods that could rest.
        own = RobustEstimationSection(standstill=False)
        self.odometry = RobustOdometry(own, conditions.source, self._whiskers, MATRIX)
        self._pose = np.zeros(3)
        self.nees: list[float] = []
        # The filter's time begins here.
        self.odometry.state_at(0)

    def read_as(self, step: int) -> float:
        """Factor by which velocity is read too large."""
        slips = self._conditions.slipping and step % SLIP_EVERY >= SLIP_EVERY - SLIPPING
        return SLIP_FACTOR if slips else 1.0

    def move(self, moving: FloatArray, seconds: float, way: float) -> None:
        """Go on with the velocity (vx, vy, wz), and walk by a way in m."""
        heading = self._pose[2] + 0.5 * moving[2] * seconds
        c, s = math.cos(heading), math.sin(heading)
        ahead, left = moving[:2] * seconds
        self._pose += [c * ahead - s * left, s * ahead + c * left, moving[2] * seconds]
        self._pose[:2] += self.rng.normal(0.0, self.settings.position_walk * math.sqrt(way), 2)

    def judge(self, step: int, moving: FloatArray) -> None:
        """Compare with the filter at the end of an interval, in which the true velocity was `moving`."""
        stamp = step * STEP_NS
        if self._whiskers is not None and step % FRAME_EVERY == 0:
            self._whiskers.moving = moving
            self.odometry.add_contacts(stamp, NO_CONTACTS)
        state = self.odometry.state_at(stamp)
        if step % FRAME_EVERY == 0:
            error = self._pose - np.array([state.x, state.y, state.yaw])
            error[2] = float(geometry.wrap_angle(error[2]))
            self.nees.append(float(error @ np.linalg.solve(state.covariance, error)))
        if step % KEYFRAME_EVERY == 0:
            self.odometry.mark_keyframe(stamp)


def fused_drive(drive: Drive, seconds: float) -> None:
    """A drive with gyro and screws, whose screws make the robot stand, then wind along."""
    rng, settings, odometry = drive.rng, drive.settings, drive.odometry
    inverse = np.linalg.inv(MATRIX)
    slip_mean = settings.slip_mean + rng.normal(0.0, settings.sigma_slip_mean, 3)
    slip = rng.normal(0.0, settings.sigma_slip, 3)
    bias = rng.normal(0.0, settings.sigma_gyro_bias)
    noise_root = np.linalg.cholesky(MATRIX[:3] @ MATRIX[:3].T * settings.sigma_screw_speed**2)
    phase = rng.uniform(0.0, 2.0 * math.pi, 2)
    angle, creep, last_rate = np.zeros(4), 0.0, 0.0
    odometry.add(ImuSample(0, np.array([0.0, 0.0, bias + rng.normal(0.0, settings.sigma_gyro)]), None))
    odometry.add(ScrewAngles(0, angle))
    for step in range(1, round(seconds / STEP_S) + 1):
        driving = step > STANDING
        if step % WINDOW == FIRST:
            creep = rng.normal(0.0, settings.sigma_still)
        # The trapezoids of two gyro samples make the turn of an interval.
        times = (step - 0.5) * STEP_S, step * STEP_S
        rates = [0.3 * math.sin(0.3 * time + phase[0]) if driving else creep for time in times]
        turn = 0.25 * last_rate + 0.5 * rates[0] + 0.25 * rates[1]
        last_rate = rates[1]
        for time, rate in zip(times, rates, strict=True):
            reading = rate + bias + rng.normal(0.0, settings.sigma_gyro)
            odometry.add(ImuSample(round(time * 1e9), np.array([0.0, 0.0, reading]), None))
        screws = np.array([0.18, 0.03 * math.sin(0.2 * step * STEP_S + phase[1])]) * driving
        noise = noise_root @ rng.normal(size=3)
        grip = 1.0 - slip_mean - slip
        read_as = drive.read_as(step)
        planar = grip[:2] / read_as * screws + noise[:2] if driving else rng.normal(0.0, settings.sigma_still, 2)
        way = math.hypot(*(grip[:2] / read_as * screws)) * STEP_S
        moving = np.array([*planar, turn])
        drive.move(moving, STEP_S, way)
        turning = read_as * turn / grip[2] + noise[2] if driving else 0.0
        angle = angle + inverse @ np.array([*screws, turning, 0.0]) * STEP_S
        odometry.add(ScrewAngles(step * STEP_NS, angle))
        passed = way + abs(turn) * STEP_S * settings.slip_turn_arm * driving
        kept = math.exp(-passed / settings.slip_length)
        slip = kept * slip + rng.normal(0.0, settings.sigma_slip * math.sqrt(1.0 - kept * kept), 3)
        bias += rng.normal(0.0, settings.gyro_bias_walk * math.sqrt(STEP_S))
        drive.judge(step, moving)


def odometry_drive(drive: Drive, seconds: float) -> None:
    """A drive with a ready-made odometry; the filter predicts to the middle of a sample's time, then to its end."""
    rng, settings, odometry = drive.rng, drive.settings, drive.odometry
    half = 0.5 * STEP_S
    walk = np.array([settings.acceleration_walk] * 2 + [settings.angular_acceleration_walk]) * math.sqrt(half)
    white = settings.sigma_odometry / math.sqrt(30.0 * STEP_S)
    bias = rng.normal(0.0, settings.sigma_odometry_bias, 3)
    moving = rng.normal(0.0, 0.01, 3)
    odometry.add(OdometrySample(0, np.zeros(3)))
    for step in range(1, round(seconds / STEP_S) + 1):
        halves = []
        for _ in range(2):
            way = math.hypot(moving[0], moving[1]) * half
            moving = moving + rng.normal(0.0, 1.0, 3) * walk
            bias = bias + rng.normal(0.0, settings.odometry_bias_walk * math.sqrt(half), 3)
            drive.move(moving, half, way)
            halves.append((moving, bias))
        middle, middle_bias = halves[0]
        reading = middle * drive.read_as(step) + middle_bias + rng.normal(0.0, white, 3)
        odometry.add(OdometrySample(step * STEP_NS, reading))
        drive.judge(step, moving)


def mean_nees(
    conditions: Conditions, runs: int, seconds: float, settings: RobustEstimationSection, seed: int = 1
) -> FloatArray:
    """NEES at each whisker frame, mean over the runs, shape (frames,); `settings` are what is drawn from."""
    run = fused_drive if conditions.source == "fused" else odometry_drive
    found = []
    for k in range(runs):
        drive = Drive(np.random.default_rng([seed, k]), settings, conditions)
        run(drive, seconds)
        found.append(drive.nees)
    return np.asarray(np.mean(found, axis=0))


def share_within(nees: FloatArray, runs: int) -> float:
    """Share of the steps at which the mean over the runs lies within its 95 % bounds."""
    low, high = chi2.ppf([0.025, 0.975], 3 * runs) / runs
    return float(np.mean((nees >= low) & (nees <= high)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--batches", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=8.0)
    chosen = parser.parse_args()
    settings = RobustEstimationSection()
    print("| source | whiskers | slip | within 95 % bounds (%) | worst to best batch (%) | mean NEES (3 is right) |")
    print("|---|---|---|---|---|---|")
    sources: tuple[Source, ...] = ("fused", "odometry")
    for slipping in (False, True):
        for conditions in (Conditions(source, w, slipping) for source in sources for w in (False, True)):
            nees = [mean_nees(conditions, chosen.runs, chosen.seconds, settings, k) for k in range(chosen.batches)]
            share = 100.0 * np.array([share_within(batch, chosen.runs) for batch in nees])
            error = share.std(ddof=1) / math.sqrt(len(share)) if len(share) > 1 else math.nan
            print(
                f"| {conditions.source} | {'yes' if conditions.whiskers else 'no'} | {'yes' if slipping else 'no'} "
                f"| {share.mean():.1f} +- {error:.1f} | {share.min():.1f} to {share.max():.1f} "
                f"| {np.mean(nees):.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
