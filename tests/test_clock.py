"""The device clock: drift, wrap-around, jumps and slow answers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.clock import WRAP_US, DeviceClock


def drive(clock: DeviceClock, *, seconds: int, drift: float = 0.0, start_us: int = 0, seed: int = 0) -> float:
    """Round trips once a second with trips of 0.3 to 3 ms, one in five slow; returns the final mapping error, s."""
    rng = np.random.default_rng(seed)
    for i in range(seconds):
        sent = 10.0 + i
        out, back = rng.uniform(0.0001, 0.0003, 2)
        if i % 5 == 4:
            back += 0.4
        device = start_us + (sent + out) * (1.0 + drift) * 1e6
        clock.add_round_trip(round(sent * 1e9), round((sent + out + back) * 1e9), int(device) % WRAP_US)
    now = 10.0 + seconds
    mapped = clock.to_host_ns(int(start_us + now * (1.0 + drift) * 1e6) % WRAP_US)
    return abs(mapped * 1e-9 - now)


def test_offset_is_right_within_the_trips_asymmetry():
    assert drive(DeviceClock(), seconds=3) < 2e-4


def test_drift_of_100_ppm_is_found():
    clock = DeviceClock()
    assert drive(clock, seconds=40, drift=100e-6) < 2e-4
    assert clock.drift == pytest.approx(-100e-6, abs=15e-6)


def test_time_goes_on_across_the_wrap():
    assert drive(DeviceClock(), seconds=30, start_us=WRAP_US - 20_000_000) < 2e-4


def test_a_jump_starts_the_mapping_anew():
    clock = DeviceClock()
    drive(clock, seconds=10)
    clock.add_round_trip(30_000_000_000, 30_000_400_000, 5_000_000)
    assert clock.jumps == 1
    assert clock.to_host_ns(5_000_000) == pytest.approx(30_000_200_000, abs=1000)


def test_before_the_first_round_trip_there_is_no_time():
    with pytest.raises(RuntimeError, match="not synchronised"):
        DeviceClock().to_host_ns(5)


def test_measurement_older_than_the_last_trip_maps_backwards():
    clock = DeviceClock()
    clock.add_round_trip(1_000_000_000, 1_000_000_000, 7_000_000)
    assert clock.to_host_ns(6_960_000) == 960_000_000


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 30_000), st.integers(0, 30_000)), min_size=1, max_size=20))
def test_the_mapping_is_within_the_bound_that_it_states_however_slow_and_lopsided_the_trips(delays_us):
    clock = DeviceClock()
    for index, (there_us, back_us) in enumerate(delays_us):
        sent_ns = index * 25_000_000
        clock.add_round_trip(sent_ns, sent_ns + (there_us + back_us) * 1000, 1_000_000 + sent_ns // 1000 + there_us)
    if clock.jumps == 0:
        assert abs(clock.to_host_ns(1_000_000)) <= clock.uncertainty_ns + 2000


def test_one_quick_trip_outweighs_many_slow_ones():
    clock = DeviceClock()
    for index in range(20):
        sent_ns = index * 25_000_000
        there_us, back_us = (50, 50) if index == 7 else (8000, 100)
        clock.add_round_trip(sent_ns, sent_ns + (there_us + back_us) * 1000, sent_ns // 1000 + there_us)
    assert abs(clock.to_host_ns(0)) < 50_000
    assert clock.uncertainty_ns < 100_000
