"""Writes recordings: MCAP with ROS 2 messages, chunked and compressed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from mcap.writer import CompressionType, Writer

from drivers import ground_truth, measurement_messages
from drivers.ground_truth import GroundTruth, WhiskerTruth
from drivers.measurement import HallFrame, Measurement
from drivers.recording_format import (
    GROUND_TRUTH,
    MEANINGS,
    MESSAGE_ENCODING,
    METADATA_NAME,
    PROFILE,
    SCHEMA_ENCODING,
    SENSOR_PERIOD_KEY,
    WHISKER_TRUTH,
    ForeignFormat,
    RecordingError,
)
from drivers.ros_messages import Message, schema_text, serialize

log = logging.getLogger(__name__)

#: What a power cut may lose: about three seconds of the whole robot's sensors.
CHUNK_BYTES = 256 * 1024
_COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}


class RecordingWriter:
    """A recording being written; use it with `with`.

    Attributes:
        path: the file.
        counts: messages written so far, by topic.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        sensor_period_us: float | None = None,
        attachments: Mapping[str, bytes] | None = None,
        metadata: Mapping[str, str] | None = None,
        compression: str = "zstd",
        chunk_bytes: int = CHUNK_BYTES,
    ) -> None:
        """Create the file and write what is known from the start.

        Args:
            path: file to create; one that exists is overwritten.
            sensor_period_us: time between two sensors of a whisker frame; None takes it from the first frame.
            attachments: layout, calibration, configuration: name to content.
            metadata: further entries of the metadata record `robominer_slam`.
            compression: zstd, lz4 or none.
            chunk_bytes: size of a chunk before compression.

        Raises:
            RecordingError: the file cannot be created.
        """
        self.path = Path(path)
        self.counts: dict[str, int] = {}
        self._sensor_period_us = sensor_period_us
        self._metadata = dict(metadata or {})
        self._metadata_written = False
        self._period_warned = False
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._closed = False
        try:
            self._file = self.path.open("wb")
        except OSError as error:
            raise RecordingError(f"{path}: cannot create the recording: {error.strerror}") from error
        self._writer = Writer(self._file, chunk_size=chunk_bytes, compression=_COMPRESSIONS[compression])
        try:
            self._writer.start(profile=PROFILE, library="robominer-slam")
            for name, data in (attachments or {}).items():
                self.attach(name, data)
            if sensor_period_us is not None:
                self._write_metadata()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def attach(self, name: str, data: bytes, media_type: str = "application/octet-stream", time_ns: int = 0) -> None:
        """Add an attachment.

        Raises:
            RecordingError: the file cannot be written.
        """
        try:
            self._writer.add_attachment(
                create_time=time_ns, log_time=time_ns, name=name, media_type=media_type, data=data
            )
        except OSError as error:
            raise self._failed(error) from error

    def write(
        self,
        topic: str,
        typename: str,
        message: Message | bytes,
        log_time_ns: int,
        publish_time_ns: int | None = None,
    ) -> None:
        """Write a message, given as an object or as CDR bytes.

        Args:
            topic: name of the topic.
            typename: ROS type, such as `sensor_msgs/msg/Imu`.
            message: what `ros_messages.new` made, or its CDR bytes.
            log_time_ns: replay goes by this time.
            publish_time_ns: by default the log time.

        Raises:
            RecordingError: the file cannot be written.
            MessageError: unknown type, or a message that does not fit it.
        """
        data = message if isinstance(message, bytes) else serialize(message, typename)
        self._add(topic, self._channel(topic, typename), data, log_time_ns, publish_time_ns)

    def write_foreign(
        self, topic: str, form: ForeignFormat, data: bytes, log_time_ns: int, publish_time_ns: int | None = None
    ) -> None:
        """Write a message that is none of ROS's, with words on its format in the channel's metadata.

        Raises:
            RecordingError: the file cannot be written.
        """
        self._add(topic, self._foreign_channel(topic, form), data, log_time_ns, publish_time_ns)

    def _add(self, topic: str, channel: int, data: bytes, log_time_ns: int, publish_time_ns: int | None) -> None:
        sequence = self.counts.get(topic, 0)
        try:
            self._writer.add_message(
                channel_id=channel,
                log_time=log_time_ns,
                data=data,
                publish_time=log_time_ns if publish_time_ns is None else publish_time_ns,
                sequence=sequence,
            )
        except OSError as error:
            raise self._failed(error) from error
        self.counts[topic] = sequence + 1

    def write_measurement(self, measurement: Measurement, log_time_ns: int | None = None) -> None:
        """Write a measurement on its default topic; the log time is its stamp where none is given."""
        if isinstance(measurement, HallFrame):
            self._check_period(measurement.sensor_period_ns / 1000.0)
        log_time = measurement.stamp_ns if log_time_ns is None else log_time_ns
        for topic, typename, data in measurement_messages.encode(measurement):
            self.write(topic, typename, data, log_time, measurement.stamp_ns)

    def write_ground_truth(self, truth: GroundTruth, log_time_ns: int | None = None) -> None:
        """Write where the robot really is; the log time is the stamp where none is given."""
        log_time = truth.stamp_ns if log_time_ns is None else log_time_ns
        self.write(GROUND_TRUTH, ground_truth.TYPENAME, ground_truth.encode(truth), log_time, truth.stamp_ns)

    def write_whisker_truth(self, truth: WhiskerTruth, log_time_ns: int | None = None) -> None:
        """Write what the whiskers really did; the log time is the stamp where none is given."""
        topic, log_time = MEANINGS[WHISKER_TRUTH].topic, truth.stamp_ns if log_time_ns is None else log_time_ns
        self.write(topic, ground_truth.WHISKERS_TYPENAME, ground_truth.encode_whiskers(truth), log_time, truth.stamp_ns)

    def flush(self) -> None:
        """Hand every chunk that is complete to the system, so that what kills this program leaves them.

        Raises:
            RecordingError: the file cannot be written.
        """
        try:
            self._file.flush()
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Write the rest and the index, and close the file; again is harmless."""
        if self._closed:
            return
        self._closed = True
        try:
            if not self._metadata_written and (self._metadata or self._sensor_period_us is not None):
                self._write_metadata()
            # mcap leaves this method without annotations.
            finish: Callable[[], None] = self._writer.finish
            finish()
            self._file.close()
        except OSError as error:
            raise self._failed(error) from error
        finally:
            # What could not be flushed fails again here; the first failure is the one to report.
            with suppress(OSError):
                self._file.close()

    def _failed(self, error: OSError) -> RecordingError:
        return RecordingError(f"{self.path}: cannot write the recording: {error.strerror}")

    def _check_period(self, period_us: float) -> None:
        """Early in the file, so that a recording that is cut later still has it."""
        if self._sensor_period_us is None:
            self._sensor_period_us = period_us
            self._write_metadata()
        elif period_us != self._sensor_period_us and not self._period_warned:
            self._period_warned = True
            log.warning(
                "%s: a whisker frame has a sensor period of %g us, the recording's is %g us; it keeps the latter",
                self.path,
                period_us,
                self._sensor_period_us,
            )

    def _write_metadata(self) -> None:
        entries = dict(self._metadata)
        if self._sensor_period_us is not None:
            entries[SENSOR_PERIOD_KEY] = f"{self._sensor_period_us:.10g}"
        try:
            self._writer.add_metadata(METADATA_NAME, entries)
        except OSError as error:
            raise self._failed(error) from error
        self._metadata_written = True

    def _channel(self, topic: str, typename: str) -> int:
        channel = self._channels.get((topic, typename))
        if channel is None:
            schema = self._schemas.get(typename)
            if schema is None:
                schema = self._writer.register_schema(
                    name=typename, encoding=SCHEMA_ENCODING, data=schema_text(typename).encode()
                )
                self._schemas[typename] = schema
            channel = self._writer.register_channel(topic=topic, message_encoding=MESSAGE_ENCODING, schema_id=schema)
            self._channels[topic, typename] = channel
        return channel

    def _foreign_channel(self, topic: str, form: ForeignFormat) -> int:
        channel = self._channels.get((topic, form.name))
        if channel is None:
            # With a name, but no definition: readers stumble over definitions in a language that they do not know.
            schema = self._writer.register_schema(name=form.name, encoding="", data=b"")
            channel = self._writer.register_channel(
                topic=topic,
                message_encoding=form.encoding,
                schema_id=schema,
                metadata={"format": form.description},
            )
            self._channels[topic, form.name] = channel
        return channel
