"""Measurements of several ports come out in the order of their stamps."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drivers.measurement import HallFrame, ImuSample
from robominer_slam.reorder import ReorderBuffer

MS = 1_000_000


def imu(ms: int) -> ImuSample:
    return ImuSample(ms * MS, np.zeros(3), np.zeros(3))


def frame(ms: int) -> HallFrame:
    return HallFrame(ms * MS, np.zeros((1, 1, 3)), np.ones((1, 1), dtype=bool))


def stamps(due) -> list[int]:
    return [m.stamp_ns // MS for _, m in due]


def test_a_frame_releases_what_is_not_newer_than_it():
    buffer = ReorderBuffer(500 * MS)
    for ms in (10, 30, 20, 50):
        assert buffer.add("imu", imu(ms)) == []
    assert stamps(buffer.add("whiskers", frame(40))) == [10, 20, 30, 40]
    assert stamps(buffer.flush()) == [50]


def test_without_frames_the_window_bounds_the_wait():
    buffer = ReorderBuffer(500 * MS)
    for ms in range(0, 500, 100):
        assert buffer.add("imu", imu(ms)) == []
    assert stamps(buffer.add("imu", imu(620))) == [0, 100]


def test_late_measurements_are_counted_and_very_late_ones_dropped():
    buffer = ReorderBuffer(500 * MS)
    buffer.add("whiskers", frame(1000))
    assert buffer.add("imu", imu(950)) == []
    assert stamps(buffer.add("whiskers", frame(1040))) == [950, 1040]
    assert buffer.add("imu", imu(800)) == []
    assert (buffer.late, buffer.dropped) == (2, 1)


@given(st.lists(st.integers(0, 400), max_size=60))
def test_nothing_within_the_window_is_lost_and_order_holds(times):
    buffer = ReorderBuffer(500 * MS)
    out = []
    for ms in times:
        out += buffer.add("imu", imu(ms))
    out += buffer.flush()
    assert stamps(out) == sorted(times)
