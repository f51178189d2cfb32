"""Reads recordings: measurements, ground truth, attachments and metadata of an MCAP file."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, TypeVar

from mcap.records import Channel, Schema
from mcap.records import Message as McapMessage

from drivers import ground_truth, measurement_messages
from drivers.counters import Counters
from drivers.ground_truth import GroundTruth, WhiskerTruth
from drivers.mcap_order import ordered_messages
from drivers.mcap_salvage import DAMAGE, Salvage
from drivers.measurement import Measurement
from drivers.recording_contents import TopicSummary, read_contents
from drivers.recording_format import (
    GROUND_TRUTH,
    MEANINGS,
    MESSAGE_ENCODING,
    SENSOR_PERIOD_KEY,
    WHISKER_TRUTH,
    RecordingError,
    resolve_topics,
)
from drivers.ros_messages import MessageError

__all__ = ["RawMessage", "Recording", "RecordingError", "TopicSummary"]

log = logging.getLogger(__name__)

T = TypeVar("T")


class RawMessage(NamedTuple):
    """A message as it stands in the file; `topic` without leading slash."""

    topic: str
    typename: str
    encoding: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


class Recording:
    """A recording to be replayed; iterating gives (log time in ns, measurement), ordered by log time.

    Every iteration opens the file anew, so that several may run one after the other.

    Attributes:
        path: the file.
        sensor_period_ns: time between two sensors of a whisker frame; 0 where the file does not say.
        counters: of the last iteration: `messages` taken; `bad_message`, `not_finite`, `wrong_type` and
            `unknown_topic` dropped; `damaged_chunks` of a damaged file.
    """

    def __init__(self, path: str | Path, topics: Mapping[str, str] | None = None) -> None:
        """Open a file and read what it says about itself.

        Args:
            path: an MCAP file.
            topics: meaning to topic where they differ from `recording_format.MEANINGS`.

        Raises:
            RecordingError: no such file, not an MCAP file, nothing readable in it, or impossible topics.
        """
        self.path = Path(path)
        self.counters = Counters()
        self._meanings = resolve_topics(topics)
        self._wrong_types: set[str] = set()
        self._contents = read_contents(self.path)
        self.sensor_period_ns = _sensor_period_ns(self.path, self.metadata)

    @property
    def complete(self) -> bool:
        """False if the file was cut or has no index: what is there is read, with a warning."""
        return self._contents.indexed

    @property
    def metadata(self) -> dict[str, str]:
        """Entries of the metadata record `robominer_slam`; empty where there is none."""
        return self._contents.metadata

    @property
    def topics(self) -> dict[str, TopicSummary]:
        """What is in the file, by topic without leading slash."""
        return self._contents.topics

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return self._contents.message_count

    @property
    def duration_ns(self) -> int:
        """From the first to the last log time."""
        return self._contents.duration_ns

    def meaning_of(self, topic: str) -> str | None:
        """What a topic is used for here (`recording_format.MEANINGS`), None if it is ignored."""
        return self._meanings.get(topic.strip("/"))

    def __iter__(self) -> Iterator[tuple[int, Measurement]]:
        """(log time, measurement) ordered by log time; what cannot be used is counted.

        Raises:
            RecordingError: the file turns out to be damaged.
        """
        self.counters = Counters()
        for raw in self.raw_messages():
            meaning = self._meaning(raw)
            if meaning is None or meaning in (GROUND_TRUTH, WHISKER_TRUTH):
                continue
            measurement = measurement_messages.decode(
                raw.data,
                raw.typename,
                self.counters,
                screw=MEANINGS[meaning].screw,
                sensor_period_ns=self.sensor_period_ns,
            )
            if measurement is not None:
                yield raw.log_time_ns, measurement

    def ground_truth(self) -> Iterator[tuple[int, GroundTruth]]:
        """(log time, truth) ordered by log time; nothing where the recording has none.

        Raises:
            RecordingError: the file turns out to be damaged.
        """
        yield from self._truths(GROUND_TRUTH, ground_truth.decode)

    def whisker_truth(self) -> Iterator[tuple[int, WhiskerTruth]]:
        """(log time, what the whiskers really did) ordered by log time; nothing where the recording has none.

        Raises:
            RecordingError: the file turns out to be damaged.
        """
        yield from self._truths(WHISKER_TRUTH, ground_truth.decode_whiskers)

    def _truths(self, meaning: str, decode: Callable[[bytes], T]) -> Iterator[tuple[int, T]]:
        wanted = {topic for topic, its in self._meanings.items() if its == meaning}
        (typename,) = MEANINGS[meaning].types
        counters = Counters()
        for raw in self.raw_messages(wanted):
            if raw.typename != typename:
                raise RecordingError(f"{self.path}: {raw.topic} is {raw.typename}, expected {typename}")
            try:
                truth = decode(raw.data)
            except MessageError:
                counters["bad_message"] += 1
                continue
            yield raw.log_time_ns, truth
        if counters:
            log.warning("%s: %s dropped: %s", self.path, meaning.replace("_", " "), counters.line())

    def attachments(self) -> dict[str, bytes]:
        """Name to content; the last of several with the same name."""
        return dict(self._contents.attachments)

    def raw_messages(self, topics: set[str] | None = None) -> Iterator[RawMessage]:
        """Messages as they are, ordered by log time; of some topics only (named without leading slash).

        Raises:
            RecordingError: the file turns out to be damaged.
        """
        try:
            if self.complete:
                yield from self._indexed(topics)
            else:
                yield from self._salvaged(topics)
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot read the recording: {error.strerror}") from error

    def _indexed(self, topics: set[str] | None) -> Iterator[RawMessage]:
        with self.path.open("rb") as file:
            messages = ordered_messages(file, topics)
            while True:
                try:
                    item = next(messages)
                except StopIteration:
                    return
                except DAMAGE as error:
                    raise RecordingError(
                        f"{self.path}: damaged inside ({error}); recover it with `mcap recover`"
                    ) from error
                yield _raw(*item)

    def _salvaged(self, topics: set[str] | None) -> Iterator[RawMessage]:
        """Without an index the order by log time needs the wanted messages in memory at once."""
        salvage = Salvage(self.path)
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        found: list[RawMessage] = []
        for record in salvage.records():
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, McapMessage) and record.channel_id in channels:
                channel = channels[record.channel_id]
                if topics is None or channel.topic.strip("/") in topics:
                    found.append(_raw(schemas.get(channel.schema_id), channel, record))
        if salvage.damaged_chunks:
            self.counters["damaged_chunks"] = salvage.damaged_chunks
        found.sort(key=lambda raw: raw.log_time_ns)
        yield from found

    def _meaning(self, raw: RawMessage) -> str | None:
        meaning = self._meanings.get(raw.topic)
        if meaning is None:
            self.counters["unknown_topic"] += 1
            return None
        expected = MEANINGS[meaning].types
        if raw.typename in expected and raw.encoding == MESSAGE_ENCODING:
            return meaning
        self.counters["wrong_type"] += 1
        if raw.topic not in self._wrong_types:
            self._wrong_types.add(raw.topic)
            log.warning(
                "%s: topic %s is %s (%s), expected %s (cdr); it is not used",
                self.path,
                raw.topic,
                raw.typename or "of no type",
                raw.encoding,
                " or ".join(expected),
            )
        return None


def _raw(schema: Schema | None, channel: Channel, message: McapMessage) -> RawMessage:
    return RawMessage(
        channel.topic.strip("/"),
        schema.name if schema else "",
        channel.message_encoding,
        message.log_time,
        message.publish_time,
        message.data,
    )


def _sensor_period_ns(path: Path, metadata: Mapping[str, str]) -> int:
    text = metadata.get(SENSOR_PERIOD_KEY, "0")
    try:
        period_ns = round(float(text) * 1000.0)
    except (ValueError, OverflowError):
        period_ns = -1
    if period_ns < 0:
        raise RecordingError(f"{path}: metadata {SENSOR_PERIOD_KEY} is {text!r}, expected microseconds, 0 or more")
    return period_ns
