"""What an MCAP file says about itself: from its index, or from a pass over the file where it has none."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.records import Message as McapMessage

from drivers.mcap_salvage import DAMAGE, Salvage
from drivers.recording_format import METADATA_NAME, RecordingError

log = logging.getLogger(__name__)

MAGIC = b"\x89MCAP0\r\n"


@dataclass(slots=True)
class TopicSummary:
    """Message type and number of messages of a topic."""

    typename: str
    count: int


@dataclass(slots=True)
class RecordingContents:
    """A file's own account of itself.

    Attributes:
        indexed: True if the file has its end with an index that covers its messages.
        metadata: entries of the metadata record `robominer_slam`.
        attachments: name to content; the last of several with the same name.
        topics: by topic without leading slash.
        message_count: messages of all topics.
        duration_ns: from the first to the last log time.
    """

    indexed: bool = False
    metadata: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    topics: dict[str, TopicSummary] = field(default_factory=dict)
    message_count: int = 0
    duration_ns: int = 0

    def add_topic(self, channel: Channel, schema: Schema | None, count: int) -> None:
        """Take a channel; several channels of one topic are one topic."""
        topic = channel.topic.strip("/")
        known = self.topics.setdefault(topic, TopicSummary(schema.name if schema else "", 0))
        known.count += count

    def add_metadata(self, metadata: Metadata) -> None:
        """Take a metadata record if it is ours."""
        if metadata.name == METADATA_NAME:
            self.metadata.update(metadata.metadata)


def read_contents(path: Path) -> RecordingContents:
    """The file's account of itself; a cut or damaged file is read through, with a warning.

    Raises:
        RecordingError: no such file, not an MCAP file, or no message can be read from it.
    """
    try:
        with path.open("rb") as file:
            start = file.read(len(MAGIC))
        if start != MAGIC:
            raise RecordingError(f"{path}: not a recording; expected an MCAP file")
        return _from_index(path) or _from_pass(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot read the recording: {error.strerror}") from error


def _from_index(path: Path) -> RecordingContents | None:
    contents = RecordingContents(indexed=True)
    with path.open("rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        try:
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                return None
            for metadata in reader.iter_metadata():
                contents.add_metadata(metadata)
            contents.attachments = {item.name: item.data for item in reader.iter_attachments()}
        # OSError: seeking to where a file without an end should have its footer.
        except (*DAMAGE, OSError):
            return None
    statistics = summary.statistics
    if statistics.message_count and not summary.chunk_indexes:
        # Messages outside chunks are in no index.
        return None
    for channel in summary.channels.values():
        count = statistics.channel_message_counts.get(channel.id, 0)
        contents.add_topic(channel, summary.schemas.get(channel.schema_id), count)
    contents.message_count = statistics.message_count
    contents.duration_ns = statistics.message_end_time - statistics.message_start_time
    return contents


def _from_pass(path: Path) -> RecordingContents:
    contents = RecordingContents()
    salvage = Salvage(path)
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    counts: dict[int, int] = {}
    first: int | None = None
    last = 0
    for record in salvage.records():
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, McapMessage):
            counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
            first = record.log_time if first is None else min(first, record.log_time)
            last = max(last, record.log_time)
        elif isinstance(record, Metadata):
            contents.add_metadata(record)
        elif isinstance(record, Attachment):
            contents.attachments[record.name] = record.data
    if first is None:
        raise RecordingError(f"{path}: cut or damaged, and no message can be read from it")
    for channel in channels.values():
        contents.add_topic(channel, schemas.get(channel.schema_id), counts.get(channel.id, 0))
    contents.message_count = sum(counts.values())
    contents.duration_ns = last - first
    log.warning(
        "%s: the recording is %s; %d messages over %.1f s could be read, %d damaged chunks were left out",
        path,
        "cut before its end" if salvage.cut else "without a usable index",
        contents.message_count,
        contents.duration_ns / 1e9,
        salvage.damaged_chunks,
    )
    return contents
