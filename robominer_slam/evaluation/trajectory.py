"""Trajectories: stamped poses, their TUM text form, and truth at the times of an estimate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry

FloatArray = NDArray[np.float64]


class TrajectoryError(ValueError):
    """A trajectory that cannot be used; one line that says what and where."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Stamped poses.

    Attributes:
        stamps_ns: ascending, shape (n,).
        T: poses, shape (n, 4, 4).
    """

    stamps_ns: NDArray[np.int64]
    T: FloatArray

    def __len__(self) -> int:
        return len(self.stamps_ns)


def tum_line(stamp_ns: int, T: FloatArray) -> str:
    """One line of a TUM trajectory: timestamp (s) tx ty tz qx qy qz qw, with its newline."""
    values = " ".join(f"{value:.9f}" for value in geometry.to_vector7(T))
    # The stamp is written from integers: a float of UNIX seconds has only 0.2 us of resolution.
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d} {values}\n"


def parse_tum(lines: Iterable[str], where: str) -> Trajectory:
    """Parse TUM lines; `#` starts a comment.

    Raises:
        TrajectoryError: a line that is not eight numbers, or stamps that do not ascend.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        text = line.split("#", 1)[0].split()
        if not text:
            continue
        try:
            whole, _, fraction = text[0].partition(".")
            stamp = int(whole) * 1_000_000_000 + int((fraction + "0" * 9)[:9])
            values = [float(value) for value in text[1:]]
        except ValueError:
            values, stamp = [], 0
        if len(values) != 7 or not np.isfinite(values).all():
            raise TrajectoryError(f"{where}, line {number}: expected timestamp tx ty tz qx qy qz qw")
        if stamps and stamp <= stamps[-1]:
            raise TrajectoryError(f"{where}, line {number}: expected ascending stamps")
        stamps.append(stamp)
        rows.append(values)
    if not rows:
        raise TrajectoryError(f"{where}: no poses in it")
    return Trajectory(np.array(stamps, dtype=np.int64), geometry.from_vector7(np.array(rows)))


def interpolate(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> tuple[NDArray[np.bool_], FloatArray]:
    """Poses at other times, along the geodesic between neighbours.

    Returns:
        (inside, T): which stamps lie within the trajectory, shape (m,), and their poses, shape (sum(inside), 4, 4).
    """
    own = trajectory.stamps_ns
    inside = (stamps_ns >= own[0]) & (stamps_ns <= own[-1])
    wanted = stamps_ns[inside]
    after = np.clip(np.searchsorted(own, wanted), 1, max(len(own) - 1, 1))
    if len(own) == 1:
        return inside, np.broadcast_to(trajectory.T[0], (len(wanted), 4, 4)).copy()
    before = after - 1
    share = (wanted - own[before]) / (own[after] - own[before])
    T_before = trajectory.T[before]
    step = geometry.se3_log(geometry.inverse(T_before) @ trajectory.T[after])
    return inside, T_before @ geometry.se3_exp(share[:, None] * step)
