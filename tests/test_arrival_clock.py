"""Time from arrivals alone: stalls with bursts, drift, losses, restarts."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.arrival_clock import DEVICE_TIME, SAMPLES, ArrivalClock, Counting
from drivers.device_time import RVC_INDEX

BASE_NS = 10**12
STALL_NS = 600_000_000
MS = 1_000_000


def errors(
    clock: ArrivalClock,
    period_ns: int,
    samples: int,
    *,
    sent: str = "nothing",
    drift: float = 0.0,
    lost: frozenset[int] = frozenset(),
    stalls: tuple[int, ...] = (),
    late_from: int | None = None,
    restart: int | None = None,
) -> np.ndarray:
    """Errors of the stamps, ms, by sample; NaN where lost or not synchronised. Delays are exponential, 1 ms mean.

    A stall begins at a sample; what falls into it comes after it, 0.1 ms apart.
    """
    rng = np.random.default_rng(5)
    found = np.full(samples, np.nan)
    before = 0
    for k in range(samples):
        true_ns = BASE_NS + k * period_ns + (int(0.37 * period_ns) if late_from is not None and k >= late_from else 0)
        if k in lost:
            continue
        arrival_ns = true_ns + int(rng.exponential(1.0) * MS)
        for stall in stalls:
            end = BASE_NS + stall * period_ns + STALL_NS
            if k >= stall and true_ns < end:
                arrival_ns = end
        before = arrival_ns = max(arrival_ns, before + MS // 10)
        since = k - (restart if restart is not None and k >= restart else 0)
        counts = {"nothing": None, "index": since % 256, "time": round(since * period_ns * (1 + drift) / 1000) + 77}
        stamp = clock.add(arrival_ns, counts[sent])
        assert stamp <= arrival_ns
        if clock.synchronised:
            found[k] = (stamp - true_ns) / MS
    return found


KINDS = [
    (DEVICE_TIME, "time", 10 * MS),
    (RVC_INDEX, "index", 10 * MS),
    (RVC_INDEX, "index", 10_001_000),
    (SAMPLES, "nothing", 40 * MS),
    (SAMPLES, "nothing", 47_300_000),
    (SAMPLES, "nothing", 200 * MS),
]
kinds = pytest.mark.parametrize(("counting", "sent", "period_ns"), KINDS)


@kinds
def test_a_stall_of_600_ms_and_its_burst_change_no_stamp_by_2_ms(counting: Counting, sent, period_ns):
    samples = 40_000 * MS // period_ns
    stalls = (samples // 4, samples // 2, samples // 2 + 2 * STALL_NS // period_ns)
    found = errors(ArrivalClock(counting), period_ns, samples, sent=sent, stalls=stalls)
    assert np.nanmax(np.abs(found[samples // 8 :])) < 2.0
    assert np.isfinite(found[samples // 8 :]).all()


@kinds
def test_stamps_come_within_a_second_and_are_good_from_the_start(counting, sent, period_ns):
    found = errors(ArrivalClock(counting), period_ns, 3_000 * MS // period_ns, sent=sent)
    assert np.isfinite(found[max(10, 1_000 * MS // period_ns) :]).all()
    assert np.nanmax(np.abs(found)) < 2.0


def test_a_clock_that_drifts_by_100_ppm_is_followed_for_minutes():
    clock = ArrivalClock(DEVICE_TIME)
    found = errors(clock, 10 * MS, 20_000, sent="time", drift=100e-6)
    assert clock.drift == pytest.approx(100e-6, abs=5e-6)
    assert np.nanmax(np.abs(found[1000:])) < 0.5
    assert clock.jumps == 0


@pytest.mark.parametrize(("counting", "sent"), [(RVC_INDEX, "index"), (DEVICE_TIME, "time")])
def test_losses_that_the_device_counts_cost_nothing(counting, sent):
    lost = frozenset({900, *range(1500, 1520), *range(2000, 2700)})
    found = errors(ArrivalClock(counting), 10 * MS, 4000, sent=sent, lost=lost)
    assert np.nanmax(np.abs(found[300:])) < 2.0


def test_losses_that_nobody_counts_are_found_at_the_second_sample_after():
    clock = ArrivalClock(SAMPLES)
    lost = frozenset({300, 500, 501, 502})
    found = errors(clock, 40 * MS, 800, lost=lost)
    found[:50] = 0.0
    wrong = np.flatnonzero(np.abs(found) > 2.0)
    assert wrong.tolist() == [301, 503]
    # That one sample is stamped as if it had been delayed, never as if it were newer than it is.
    np.testing.assert_allclose(found[wrong], [-40.0, -120.0], atol=1.0)
    assert clock.inferred_losses == 4


def test_a_device_that_pauses_is_followed_within_two_seconds():
    clock = ArrivalClock(SAMPLES)
    found = errors(clock, 40 * MS, 900, late_from=500)
    assert np.nanmax(np.abs(found[550:])) < 3.0
    assert clock.jumps == 1


@pytest.mark.parametrize(("counting", "sent"), [(RVC_INDEX, "index"), (DEVICE_TIME, "time")])
def test_a_restart_begins_anew(counting, sent):
    clock = ArrivalClock(counting)
    found = errors(clock, 10 * MS, 3000, sent=sent, restart=1000)
    assert clock.jumps == 1
    assert np.nanmax(np.abs(found[1030:])) < 2.0
    # Only the line's own delay at first: nothing is stamped with the former count.
    assert np.nanmin(found) > -2.0


def test_opened_anew_it_says_nothing_until_it_knows():
    clock = ArrivalClock(SAMPLES)
    errors(clock, 40 * MS, 100)
    clock.reset()
    assert not clock.synchronised
