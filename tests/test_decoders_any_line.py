"""What holds for every decoder: any fragmentation, any noise, a bounded buffer, and it finds its way back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.device_streams import LINES, damaged, decoded, mutate

every_line = pytest.mark.parametrize("name", LINES)
#: The longest that any decoder may keep: framed's bound is 32 KiB, the others' a few frames.
BUFFER_BOUND = 33_000


@every_line
def test_every_two_way_split_gives_the_same(name):
    line = LINES[name]
    stream = b"".join(line.packets(3, 1))
    whole = decoded(line.decoder(), [stream])
    assert len(whole) == 3
    step = 1 if len(stream) < 1200 else 7
    for cut in range(1, len(stream), step):
        assert decoded(line.decoder(), [stream[:cut], stream[cut:]]) == whole


@every_line
def test_every_fixed_chunk_size_gives_the_same_also_on_a_damaged_line(name):
    line = LINES[name]
    packets = line.packets(20, 2)
    # Every third packet is hit.
    stream = damaged(b"".join(packets), 0.3 / len(packets[0]), np.random.default_rng(3))
    once = line.decoder()
    whole = decoded(once, [stream])
    assert len(whole) > 4
    for size in (*range(1, 20), 61, 64, 100, 127, 256, 385, 386, 387, 1000):
        decoder = line.decoder()
        assert decoded(decoder, [stream[at : at + size] for at in range(0, len(stream), size)]) == whole
        assert decoder.counters == once.counters


@every_line
@settings(max_examples=15)
@given(data=st.data())
def test_after_noise_a_decoder_finds_its_way_back(name, data):
    line = LINES[name]
    noise = data.draw(st.binary(max_size=600))
    size = len(line.packets(1, 0)[0])
    # A rest of the noise may look like a packet's head and swallow what comes: 261 bytes at most.
    spared = 8 if "rm3-compressed" in name else max(2, -(-300 // size))
    good = line.packets(spared + 8, data.draw(st.integers(0, 50)))
    readings = decoded(line.decoder(), [noise + b"\0", *good])
    expected = decoded(line.decoder(), good)
    assert [one[2:] for one in readings[-8:]] == [one[2:] for one in expected[-8:]]


@every_line
def test_a_million_bytes_of_noise_and_damage_raise_nothing_and_fill_nothing(name):
    line, rng = LINES[name], np.random.default_rng(7)
    decoder, peak, fed = line.decoder(), 0, 0
    good = b"".join(line.packets(40, 5))
    while fed < 1_000_000:
        piece = rng.bytes(4000) if fed % 3 == 0 else mutate(good, rng)
        for at in range(0, len(piece), 1499):
            decoder.feed(piece[at : at + 1499])
            peak = max(peak, len(decoder._buffer))
        fed += len(piece)
    assert peak < BUFFER_BOUND
    # Still at work.
    assert len(decoded(decoder, [b"\0" * 300, *line.packets(20, 6)])) >= 8


def test_framed_never_accepts_a_wrong_frame_with_one_byte_in_a_thousand_damaged():
    line, rng = LINES["framed"], np.random.default_rng(11)
    packets = line.packets(2000, 8)
    good = set(decoded(line.decoder(), packets))
    stream = damaged(b"".join(packets), 0.001, rng)
    readings = decoded(line.decoder(), [stream])
    assert len(readings) > 1000
    assert set(readings) <= good
