"""Whisker scans summed by odometry into composite scans, which become keyframes (thesis, section 3.4.4)."""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
import small_gicp
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.slam.keyframe import Keyframe

FloatArray = NDArray[np.float64]
Vector: TypeAlias = tuple[float, float, float]

#: A scan taken where the robot already stood adds nothing but its noise: standing still must not fill the memory.
MIN_MOVE_M = 0.002
MIN_TURN_RAD = 0.003
#: Bound on a keyframe's points; a full turn on the spot makes about 6000.
MAX_POINTS = 20_000


def voxel_filter(points: FloatArray, voxel: float) -> FloatArray:
    """Mean of the points in each occupied voxel, shape (m, 3); all points where `voxel` is 0 m."""
    if voxel <= 0.0 or len(points) == 0:
        return points
    sampled: FloatArray = np.asarray(small_gicp.voxelgrid_sampling(points, voxel).points(), dtype=np.float64)[:, :3]
    return sampled


class Stance(NamedTuple):
    """A pose of base_link in odom in plain floats: position, m, and where its x and y axes point."""

    position: Vector
    ahead: Vector
    left: Vector


class CompositeScan:
    """Collects scans until the robot has moved far enough, then hands out a keyframe.

    Args:
        distance: along odom's x or y, m.
        angle: of the heading, rad.
        scan_voxel: voxel filter of each scan, m; 0 for none.
        first_id: of the first keyframe.
    """

    def __init__(self, distance: float, angle: float, scan_voxel: float, first_id: int = 0) -> None:
        self._distance = distance
        self._angle = angle
        self._voxel = scan_voxel
        self._scans: list[FloatArray] = []
        self._floor: list[NDArray[np.bool_]] = []
        self._count = 0
        self._start: Stance | None = None
        self._last: Stance | None = None
        self._added: Stance | None = None
        self._travelled = 0.0
        self._next_id = first_id
        self.dropped_points = 0

    def add(
        self, stamp_ns: int, T_odom_base: FloatArray, points: FloatArray, floor: NDArray[np.bool_] | None = None
    ) -> Keyframe | None:
        """Add a scan.

        Args:
            stamp_ns: its time.
            T_odom_base: pose in odom, shape (4, 4).
            points: contacts in base_link, shape (m, 3), m; may be empty.
            floor: which are of whiskers that point down, shape (m,); only without a voxel filter.

        Returns:
            The keyframe that this scan completes, or None.
        """
        here = _stance(T_odom_base)
        if self._last is None or self._start is None:
            self._start = self._last = here
        self._travelled += math.dist(here.position, self._last.position)
        self._last = here
        if len(points) and self._moved(here):
            self._added = here
            scan = voxel_filter(points, self._voxel)
            if self._count + len(scan) > MAX_POINTS:
                self.dropped_points += len(scan)
            else:
                self._scans.append(geometry.transform_points(T_odom_base, scan))
                if floor is not None and self._voxel <= 0.0:
                    self._floor.append(floor)
                self._count += len(scan)
        if not self._complete(here):
            return None
        self._start = here
        if not self._scans:
            return None
        odom_points = np.concatenate(self._scans)
        self._scans, self._count = [], 0
        points_base = geometry.transform_points(geometry.inverse(T_odom_base), odom_points)
        floor_points = np.concatenate(self._floor) if self._floor else None
        self._floor = []
        keyframe = Keyframe(self._next_id, stamp_ns, T_odom_base, points_base, self._travelled, floor=floor_points)
        self._next_id += 1
        return keyframe

    @property
    def next_id(self) -> int:
        """Of the next keyframe."""
        return self._next_id

    def restart(self) -> None:
        """Forget the scans since the last keyframe: the robot has been carried."""
        self._scans, self._floor, self._count = [], [], 0
        self._start = self._added = None

    def _moved(self, here: Stance) -> bool:
        added = self._added
        if added is None:
            return True
        return math.dist(here.position, added.position) >= MIN_MOVE_M or _turn(added, here) >= MIN_TURN_RAD

    def _complete(self, here: Stance) -> bool:
        start = self._start
        if start is None:
            return False
        (x, y, _), (from_x, from_y, _) = here.position, start.position
        return max(abs(x - from_x), abs(y - from_y)) >= self._distance or _turn(start, here) >= self._angle


def _stance(T: FloatArray) -> Stance:
    (ahead_x, left_x, _, x), (ahead_y, left_y, _, y), (ahead_z, left_z, _, z), _ = T.tolist()
    return Stance((x, y, z), (ahead_x, ahead_y, ahead_z), (left_x, left_y, left_z))


def _turn(a: Stance, b: Stance) -> float:
    """Heading change between two poses, rad, 0 to pi."""
    x, y, z = b.ahead
    (ahead_x, ahead_y, ahead_z), (left_x, left_y, left_z) = a.ahead, a.left
    return abs(math.atan2(left_x * x + left_y * y + left_z * z, ahead_x * x + ahead_y * y + ahead_z * z))
