"""Runs a recording until it is told to stop, with a line of progress on stderr."""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import asdict, dataclass
from typing import Protocol

from drivers.recording_writer import RecordingWriter

STEP_S = 0.2
TEND_S = 1.0
#: Where stderr is no terminal, lines are not overwritten: fewer of them.
LOG_INTERVAL_S = 10.0


class Recorder(Protocol):
    """Writes what comes from somewhere."""

    @property
    def dropped(self) -> int:
        """How much came too fast."""
        ...

    def step(self, timeout_s: float) -> None:
        """Write what has come."""
        ...

    def tend(self) -> None:
        """What is to be done once a second."""
        ...

    def finish(self) -> None:
        """Write the rest."""
        ...


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """What a recording has become: file, seconds, size, messages by topic, and what came too fast for the disk."""

    file: str
    seconds: float
    bytes: int
    counts: dict[str, int]
    dropped: int

    @property
    def messages(self) -> int:
        """All of them."""
        return sum(self.counts.values())

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return {**asdict(self), "messages": self.messages}


def record(
    recorder: Recorder, writer: RecordingWriter, stop: threading.Event, max_time_s: float | None = None
) -> RecordingSummary:
    """Record until `stop` is set, or for so long; the file is finished then.

    Raises:
        RecordingError: the file cannot be written.
    """
    begin = time.monotonic()
    end = float("inf") if max_time_s is None else begin + max_time_s
    progress = _Progress(begin)
    tend_s = begin
    try:
        while not stop.is_set() and (now := time.monotonic()) < end:
            recorder.step(min(STEP_S, end - now))
            if time.monotonic() >= tend_s:
                tend_s = time.monotonic() + TEND_S
                recorder.tend()
                progress.show(writer)
        recorder.finish()
    finally:
        progress.end()
        writer.close()
    seconds = round(time.monotonic() - begin, 3)
    return RecordingSummary(str(writer.path), seconds, _size(writer), dict(writer.counts), recorder.dropped)


class _Progress:
    def __init__(self, begin: float) -> None:
        self._begin = begin
        self._terminal = sys.stderr.isatty()
        self._due_s = begin + (0.0 if self._terminal else LOG_INTERVAL_S)
        self._shown = False

    def show(self, writer: RecordingWriter) -> None:
        now = time.monotonic()
        if now < self._due_s:
            return
        self._due_s = now + (0.0 if self._terminal else LOG_INTERVAL_S)
        text = (
            f"{now - self._begin:.0f} s: {sum(writer.counts.values())} messages on {len(writer.counts)} topics, "
            f"{_size(writer) / 1e6:.2f} MB (Ctrl-C ends)"
        )
        print(f"\r{text}\x1b[K" if self._terminal else text, end="" if self._terminal else "\n", file=sys.stderr)
        sys.stderr.flush()
        self._shown = True

    def end(self) -> None:
        if self._terminal and self._shown:
            print(file=sys.stderr)


def _size(writer: RecordingWriter) -> int:
    try:
        return writer.path.stat().st_size
    except OSError:
        return 0
