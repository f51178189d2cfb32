"""Messages in the order of their log times: the same as mcap's own reader gives."""

from __future__ import annotations

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from drivers.mcap_order import ordered_messages
from drivers.mcap_salvage import DAMAGE

TOPICS = ("/imu", "hall", "/screws")


def recording(times: list[tuple[int, int]], *, chunk_size: int = 200, chunked: bool = True) -> io.BytesIO:
    """A file of messages (topic, log time) in the order given."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=chunk_size, compression=CompressionType.NONE, use_chunking=chunked)
    writer.start()
    schema = writer.register_schema("s", "none", b"")
    channels = [writer.register_channel(topic, "none", schema) for topic in TOPICS]
    for k, (topic, time) in enumerate(times):
        writer.add_message(channels[topic], time, k.to_bytes(8, "little"), time, k)
    writer.finish()
    file.seek(0)
    return file


def ours(file: io.BytesIO, topics: set[str] | None = None) -> list[tuple[str, int, int]]:
    file.seek(0)
    return [(channel.topic, m.log_time, m.sequence) for _, channel, m in ordered_messages(file, topics)]


def theirs(file: io.BytesIO, topics: list[str] | None = None) -> list[tuple[str, int, int]]:
    file.seek(0)
    messages = make_reader(file).iter_messages(topics=topics, log_time_order=True)
    return [(channel.topic, m.log_time, m.sequence) for _, channel, m in messages]


arrivals = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 30)), max_size=120)


@given(arrivals, st.sampled_from([1, 150, 400, 100_000]))
def test_interleaved_and_overlapping_chunks_come_in_the_order_of_mcaps_own_reader(times, chunk_size):
    file = recording(times, chunk_size=chunk_size)
    assert ours(file) == theirs(file)
    assert [t for _, t, _ in ours(file)] == sorted(t for _, t in times)


@given(arrivals)
def test_chosen_topics_are_named_with_or_without_slash(times):
    file = recording(times)
    assert ours(file, {"imu", "hall"}) == theirs(file, ["/imu", "hall"])
    assert ours(file, {"nothing"}) == []


def test_a_late_chunk_of_old_messages_is_sorted_in():
    times = [(0, t) for t in range(100, 200)] + [(1, t) for t in range(50, 150)] + [(2, 0)]
    assert ours(recording(times)) == theirs(recording(times))


def test_equal_times_keep_the_order_of_the_file():
    times = [(k % 3, 7) for k in range(50)]
    assert [sequence for _, _, sequence in ours(recording(times))] == list(range(50))


def test_a_file_without_chunks_is_read_too():
    times = [(0, 3), (1, 1), (2, 2)]
    assert [t for _, t, _ in ours(recording(times, chunked=False))] == [1, 2, 3]


def test_only_a_few_chunks_are_read_ahead():
    file = recording([(0, t) for t in range(1000)])
    messages = ordered_messages(file, None)
    next(messages)
    assert file.tell() < len(file.getvalue()) / 4


def test_a_damaged_chunk_is_an_error():
    file = recording([(0, t) for t in range(100)])
    data = bytearray(file.getvalue())
    middle = data.index((50).to_bytes(8, "little") + (50).to_bytes(8, "little"))
    data[middle] ^= 0xFF
    with pytest.raises(DAMAGE):
        ours(io.BytesIO(bytes(data)))
