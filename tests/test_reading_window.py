"""The window of the last readings is the same however its frames were taken in."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robominer_slam.reading_window import ReadingWindow

LENGTH, WHISKERS, NOISE_MT = 7, 4, 0.5


@given(st.lists(st.integers(1, 12), min_size=1, max_size=6), st.integers(0, 1000))
def test_frames_taken_in_together_make_the_window_of_frames_taken_in_one_by_one(batches, seed):
    rng = np.random.default_rng(seed)
    together, single = ReadingWindow(LENGTH, WHISKERS, NOISE_MT), ReadingWindow(LENGTH, WHISKERS, NOISE_MT)
    fields = []
    for count in batches:
        for _ in range(count):
            fields.append(rng.normal(size=(WHISKERS, 3)))
            frame = (fields[-1], rng.random(WHISKERS), rng.random(WHISKERS) < 0.5, (len(fields), 0.0))
            together.add(*frame)
            single.add(*frame)
            single.take_in()
        together.take_in()
        last = np.array(fields[-LENGTH:]).transpose(0, 2, 1)
        np.testing.assert_array_equal(together.field_mT[-len(last) :], last)
        np.testing.assert_array_equal(together.inclination, single.inclination)
        np.testing.assert_array_equal(together.valid, single.valid)
        assert together.way == single.way == len(last) - 1
        assert together.position == (len(fields), 0.0)
    if len(fields) >= LENGTH:
        expected = (np.abs(np.diff(last, n=2, axis=0)) > 0.6745 * np.sqrt(6.0) * NOISE_MT).sum(axis=1)
        np.testing.assert_array_equal(together.rough, expected)
        np.testing.assert_array_equal(single.rough, expected)
