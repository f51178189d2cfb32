"""Log records to systemd's journal with their level and fields, by its native protocol: one datagram an entry.

See https://systemd.io/JOURNAL_NATIVE_PROTOCOL. Written out for the reason given in `notify.py`.
"""

from __future__ import annotations

import logging
import os
import struct
import sys
from collections.abc import Mapping
from logging.handlers import DatagramHandler

SOCKET = "/run/systemd/journal/socket"
#: syslog's levels by those of `logging`.
PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (0, 7))
#: Fields of our own that a record may carry (`extra=`); `journalctl DEVICE=imu` finds them.
FIELDS = ("device", "state")


def stderr_is_journal(environment: Mapping[str, str] = os.environ) -> bool:
    """Whether what is written to stderr lands in the journal: systemd names the stream by device and inode."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return environment.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def priority(level: int) -> int:
    """The level of syslog for a level of `logging`."""
    return next(number for least, number in PRIORITIES if level >= least)


class JournalHandler(DatagramHandler):
    """Sends to the journal; an entry that its socket does not take goes to stderr, each line with `<N>` before it."""

    def __init__(self, address: str = SOCKET) -> None:
        super().__init__(address, None)

    def makePickle(self, record: logging.LogRecord) -> bytes:  # the base class's name for what it sends
        """The record as a datagram."""
        return entry(record, self.format(record))

    def handleError(self, record: logging.LogRecord) -> None:
        """Called by the base class in its handling of an error."""
        if not isinstance(sys.exception(), OSError):
            super().handleError(record)
            return
        sys.stderr.write("".join(f"<{priority(record.levelno)}>{line}\n" for line in self.format(record).splitlines()))
        sys.stderr.flush()


def entry(record: logging.LogRecord, text: str) -> bytes:
    """A record as a datagram."""
    fields = {
        "MESSAGE": text,
        "PRIORITY": str(priority(record.levelno)),
        "SYSLOG_IDENTIFIER": "robominer-slam",
        "LOGGER": record.name,
        "CODE_FILE": record.pathname,
        "CODE_LINE": str(record.lineno),
        "CODE_FUNC": record.funcName or "",
        "THREAD_NAME": record.threadName or "",
    }
    fields |= {name.upper(): str(value) for name in FIELDS if (value := getattr(record, name, None)) is not None}
    return b"".join(_field(name, value.encode(errors="replace")) for name, value in fields.items())


def _field(name: str, value: bytes) -> bytes:
    # A value with a line break goes with its length before it.
    if b"\n" in value:
        return name.encode() + b"\n" + struct.pack("<Q", len(value)) + value + b"\n"
    return name.encode() + b"=" + value + b"\n"
