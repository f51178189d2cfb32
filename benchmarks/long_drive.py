"""Memory and time per keyframe of the method `robust` on drives without end.

    python -m benchmarks.long_drive [--keyframes 100000] [--area yard|corridor] [--block 5000] [--seed 1]

Keyframes are made directly: a true path over rough ground (a sum of waves, the same everywhere and never repeating),
touches sampled from it with noise, dead reckoning with noise and constant biases. `yard` drives to random places in
20 x 20 m for ever; `corridor` goes 30 m on and 10 m back, and so leaves for ever. Printed per block of keyframes:
memory of the process, CPU time of the back-end per keyframe, that of map and map stream, the error of the newest pose
in the plane, and the median of its squared error by its covariance: 2.4 if that is right, less if it is too large.
Memory after the map is full must not grow, nor time, nor the error.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.configuration.model import MapSection
from robominer_slam.configuration.robust_slam_section import RobustSlamSection
from robominer_slam.estimation.keyframe_motion import KeyframeMotion
from robominer_slam.heap import give_large_blocks_back
from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.patch_pages import SqlitePages
from robominer_slam.publishing.map_stream import MapStreamEncoder
from robominer_slam.slam.keyframe import Keyframe
from robominer_slam.slam.robust import RobustBackend

FloatArray = NDArray[np.float64]

#: Way between keyframes, m, and time that it takes, s.
STEP, DURATION = 0.25, 2.5
#: Deviations of the dead reckoning per keyframe (m, m, rad), and of its biases (m/s, m/s, rad/s).
ODOMETRY_SIGMA = np.array([0.001, 0.001, 0.0008])
BIAS_SIGMA = np.array([0.0003, 0.0003, 0.0001])
TOUCH_SIGMA = 0.0012
#: Deviation of the ground from its mean, m.
RELIEF = 0.015
#: Turn per keyframe at most, rad.
MAX_TURN = 0.3
#: Lines of touches that the array draws in a keyframe, and touches along them, m.
LINES = np.linspace(-0.25, 0.25, 16)
ALONG = np.arange(-STEP - 0.15, 0.151, 0.01)


class Ground:
    """Heights as a sum of waves of 0.25 to 1 m."""

    def __init__(self, rng: np.random.Generator, waves: int = 40) -> None:
        length = rng.uniform(0.25, 1.0, waves)
        way = rng.uniform(0.0, 2.0 * np.pi, waves)
        self._k = 2.0 * np.pi / length * np.array([np.cos(way), np.sin(way)])
        self._phase = rng.uniform(0.0, 2.0 * np.pi, waves)
        self._size = np.full(waves, RELIEF * np.sqrt(2.0 / waves))

    def height(self, xy: FloatArray) -> FloatArray:
        """Heights at places (m, 2), m."""
        return np.asarray(np.sin(xy @ self._k + self._phase) @ self._size)


def yard(rng: np.random.Generator) -> Iterator[FloatArray]:
    """Places in 20 x 20 m, for ever."""
    while True:
        yield rng.uniform(-10.0, 10.0, 2)


def corridor(rng: np.random.Generator) -> Iterator[FloatArray]:
    """30 m on, 10 m back, 3 m wide, for ever."""
    x = 0.0
    while True:
        for step in (30.0, -10.0):
            x += step
            yield np.array([x, rng.uniform(-1.5, 1.5)])


def rounds(rng: np.random.Generator) -> Iterator[FloatArray]:
    """Round and round four corners 2.5 m apart, never quite the same way: for tests."""
    while True:
        for corner in ((2.5, 0.0), (2.5, 2.5), (0.0, 2.5), (0.0, 0.0)):
            yield np.array(corner) + rng.uniform(-0.15, 0.15, 2)


AREAS = {"rounds": rounds, "yard": yard, "corridor": corridor}


def drive(area: str, seed: int, count: int) -> Iterator[tuple[Keyframe, FloatArray]]:
    """Keyframes, and the true pose (x, y, yaw) of each."""
    rng = np.random.default_rng(seed)
    ground, goals = Ground(rng), AREAS[area](rng)
    bias = rng.normal(0.0, BIAS_SIGMA)
    true, odometry = np.zeros(3), np.zeros(3)
    goal = next(goals)
    for k in range(count):
        motion = None
        if k:
            while np.hypot(*(goal - true[:2])) < 0.5:
                goal = next(goals)
            way = np.arctan2(goal[1] - true[1], goal[0] - true[0])
            turn = float(np.clip(geometry.wrap_angle(way - true[2]), -MAX_TURN, MAX_TURN))
            moved = np.array([STEP, 0.0, turn])
            true = geometry.se2_compose(true, geometry.se2_exp(moved))
            measured = geometry.se2_exp(moved + bias * DURATION + rng.normal(0.0, ODOMETRY_SIGMA))
            odometry = geometry.se2_compose(odometry, measured)
            motion = _motion(k, measured)
        x, y = np.meshgrid(ALONG, LINES + rng.normal(0.0, 0.003, len(LINES)))
        points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
        c, s = np.cos(true[2]), np.sin(true[2])
        there = points[:, :2] @ np.array([[c, s], [-s, c]]) + true[:2]
        points[:, 2] = ground.height(there) + rng.normal(0.0, TOUCH_SIGMA, len(points))
        yield Keyframe(k, round(k * DURATION * 1e9), geometry.T_from_xyyaw(odometry), points, k * STEP, motion), true


def _motion(k: int, measured: FloatArray) -> KeyframeMotion:
    covariance = np.diag([0.0, 0.0, 1e-4, 1e-4, 1e-4, 0.0])
    planar = [0, 1, 5]
    covariance[planar, planar] = ODOMETRY_SIGMA**2
    jacobian = np.zeros((6, 3))
    jacobian[planar] = -DURATION * np.eye(3)
    none = np.zeros(3)
    return KeyframeMotion(
        round(k * DURATION * 1e9),
        geometry.T_from_xyyaw(measured),
        covariance,
        jacobian,
        none,
        none,
        np.diag(BIAS_SIGMA**2),
    )


def resident_mb() -> float:
    """Memory of this process that is in RAM, MB."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024.0
    raise OSError("/proc/self/status says nothing of VmRSS")


@dataclass
class Block:
    """What some keyframes took."""

    last: int
    backend_ms: list[float] = field(default_factory=list)
    map_ms: list[float] = field(default_factory=list)
    errors_m: list[float] = field(default_factory=list)
    squared: list[float] = field(default_factory=list)
    resident_mb: float = 0.0
    points: int = 0
    nodes: int = 0
    edges: int = 0
    closures: int = 0

    def line(self) -> str:
        """A row of the table."""
        backend = np.array(self.backend_ms)
        return (
            f"{self.last:>9} {self.nodes:>6} {self.edges:>6} {self.closures:>8} {self.points:>8} "
            f"{self.resident_mb:>8.1f} {backend.mean():>8.1f} {np.percentile(backend, 99):>8.1f} {backend.max():>8.1f} "
            f"{np.mean(self.map_ms):>7.2f} {np.mean(self.errors_m):>8.3f} {np.max(self.errors_m):>8.3f} "
            f"{np.median(self.squared):>8.2f}"
        )


HEAD = (
    f"{'keyframes':>9} {'nodes':>6} {'edges':>6} {'closures':>8} {'points':>8} {'RSS MB':>8} "
    f"{'mean ms':>8} {'p99 ms':>8} {'max ms':>8} {'map ms':>7} {'error m':>8} {'worst m':>8} {'squared':>8}"
)


def run(area: str, seed: int, count: int, block: int, parameters: RobustSlamSection) -> Iterator[Block]:
    """Drive, and say what each block of keyframes took."""
    backend = RobustBackend(parameters, SqlitePages())
    keyframes, stream = KeyframeMap(parameters.point_voxel), MapStreamEncoder(1, MapSection().stream_cell)
    current = Block(0)
    for keyframe, true in drive(area, seed, count):
        start = process_time()
        result = backend.process(keyframe)
        done = process_time()
        keyframes.take(result)
        stream.update(keyframes.version, keyframes.keyframes, geometry.to_vector7(keyframes.poses))
        current.backend_ms.append((done - start) * 1e3)
        current.map_ms.append((process_time() - done) * 1e3)
        x, y, yaw, _ = geometry.levelled(result.poses[-1])[0]
        error = np.array([x - true[0], y - true[1], geometry.wrap_angle(yaw - true[2])])
        current.errors_m.append(float(np.hypot(error[0], error[1])))
        if keyframe.id:
            current.squared.append(float(error @ np.linalg.solve(result.covariance, error)))
        if (keyframe.id + 1) % block == 0 or keyframe.id + 1 == count:
            current.last, current.resident_mb = keyframe.id + 1, resident_mb()
            current.nodes, current.edges = len(result.poses), len(result.edges)
            current.closures = sum(edge.kind == "loop" and edge.weight > 0.0 for edge in result.edges)
            current.points = sum(len(one.points) for one in keyframes.keyframes)
            yield current
            current = Block(0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, default=100_000)
    parser.add_argument("--area", choices=sorted(AREAS), default="yard")
    parser.add_argument("--block", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--max-keyframes", type=int, default=None, help="Another cap than the configuration's.")
    arguments = parser.parse_args()
    parameters = RobustSlamSection()
    if arguments.max_keyframes is not None:
        bounds = parameters.bounds.model_copy(update={"max_keyframes": arguments.max_keyframes})
        parameters = parameters.model_copy(update={"bounds": bounds})
    give_large_blocks_back()  # as the daemon does
    print(HEAD)
    for block in run(arguments.area, arguments.seed, arguments.keyframes, arguments.block, parameters):
        print(block.line(), flush=True)


if __name__ == "__main__":
    main()
