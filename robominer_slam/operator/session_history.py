"""The session so far, for scrubbing back: in memory of fixed size, the last minutes at 10 Hz, all of it evenly."""

from __future__ import annotations

import numpy as np

from robominer_slam.operator.live_frame import LiveFrame
from robominer_slam.publishing.telemetry import STATES

#: An hour at 10 Hz; when it is full, frames older than the last minutes are thinned.
CAPACITY = 36_000
#: Share of the capacity, the newest frames, that is never thinned.
_RECENT = 0.15
#: Share that is to be in use after thinning.
_ROOM = 0.75
INTERVAL_NS = 100_000_000
_UNKNOWN = len(STATES)


class SessionHistory:
    """Frames by time; the caller holds a lock.

    Args:
        capacity: how many frames are kept.
        interval_ns: frames closer than this to the last one kept are not kept.
    """

    def __init__(self, capacity: int = CAPACITY, interval_ns: int = INTERVAL_NS) -> None:
        self._capacity, self._interval_ns = capacity, interval_ns
        self._count = 0
        self._spacing_ns = interval_ns
        self._stamp = np.zeros(capacity, dtype=np.int64)
        self._pose = np.zeros((capacity, 7))
        self._covariance = np.zeros((capacity, 4), dtype=np.float32)
        self._state = np.zeros(capacity, dtype=np.uint8)
        self._angles = np.zeros((capacity, 2, 0), dtype=np.float16)

    def __len__(self) -> int:
        return self._count

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Stamps of the first and last frame; None while there is none."""
        if not self._count:
            return None
        return int(self._stamp[0]), int(self._stamp[self._count - 1])

    def add(self, frame: LiveFrame) -> None:
        """Keep a frame, if it is later than the last one by the interval."""
        if self._count and frame.stamp_ns - int(self._stamp[self._count - 1]) < self._interval_ns:
            return
        if self._count == self._capacity:
            self._thin()
        whiskers = len(frame.inclination)
        if whiskers != self._angles.shape[2] and whiskers:
            # The array became known: what was kept before has no whiskers.
            self._angles = np.full((self._capacity, 2, whiskers), np.nan, dtype=np.float16)
        k = self._count
        self._stamp[k], self._pose[k], self._covariance[k] = frame.stamp_ns, frame.pose, frame.covariance
        self._state[k] = STATES.index(frame.state) if frame.state in STATES else _UNKNOWN
        if whiskers:
            self._angles[k, 0], self._angles[k, 1] = frame.inclination, frame.azimuth
        self._count += 1

    def at(self, stamp_ns: int) -> LiveFrame | None:
        """The last frame at or before a time, else the first; None while there is none."""
        if not self._count:
            return None
        k = max(0, int(np.searchsorted(self._stamp[: self._count], stamp_ns, side="right")) - 1)
        state = int(self._state[k])
        return LiveFrame(
            int(self._stamp[k]),
            self._pose[k].copy(),
            self._covariance[k].astype(np.float64),
            STATES[state] if state < _UNKNOWN else "",
            self._angles[k, 0].astype(np.float64),
            self._angles[k, 1].astype(np.float64),
        )

    def poses(self) -> list[tuple[int, np.ndarray[tuple[int, ...], np.dtype[np.float64]]]]:
        """Stamps (UNIX ns) and poses (7,) of all frames kept."""
        return [(int(self._stamp[k]), self._pose[k].copy()) for k in range(self._count)]

    def trail(self, points: int, since_ns: int = 0) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        """Places driven through, evenly thinned: time (s after the first frame), x, y, z; shape (m, 4), m <= points.

        Args:
            points: how many at most.
            since_ns: only those from this time on.
        """
        first = int(np.searchsorted(self._stamp[: self._count], since_ns))
        kept = np.unique(np.linspace(first, self._count - 1, min(points, self._count - first)).astype(np.intp))
        seconds = (self._stamp[kept] - self._stamp[0]) * 1e-9
        return np.column_stack([seconds, self._pose[kept, :3]])

    def whisker(self, index: int, end_ns: int, seconds: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        """One whisker's last seconds before a time: s before it (negative), inclination, azimuth (rad); (m, 3)."""
        stamps = self._stamp[: self._count]
        first = int(np.searchsorted(stamps, end_ns - int(seconds * 1e9)))
        last = int(np.searchsorted(stamps, end_ns, side="right"))
        if index >= self._angles.shape[2]:
            return np.zeros((0, 3))
        angles = self._angles[first:last, :, index].astype(np.float64)
        return np.column_stack([(stamps[first:last] - end_ns) * 1e-9, angles])

    def _thin(self) -> None:
        """Older frames are kept farther apart, all of them alike: the spacing grows until there is room again."""
        recent = self._count - int(_RECENT * self._capacity)
        while True:
            kept, at = [], 0
            while at < recent:
                kept.append(at)
                at = int(np.searchsorted(self._stamp[:recent], self._stamp[at] + self._spacing_ns))
            if len(kept) + self._count - recent <= _ROOM * self._capacity:
                break
            self._spacing_ns *= 2
        chosen = np.concatenate([np.array(kept, dtype=np.intp), np.arange(recent, self._count)])
        self._count = len(chosen)
        for values in (self._stamp, self._pose, self._covariance, self._state, self._angles):
            values[: self._count] = values[chosen]
