"""The machine that the daemon runs on: clock, disk, memory."""

from __future__ import annotations

import ctypes
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from robominer_slam.doctor.finding import Finding

#: What adjtimex(2) answers where nobody keeps the clock.
TIME_ERROR = 5
#: struct timex has 128 bytes on 32 bits and 208 on 64; its first member, `modes`, is 0: nothing is changed.
TIMEX_BYTES = 256
#: A kilometre of gallery is 5 MB; a database needs room for its journal, and the system's own log for itself.
LEAST_DISK_MB, LITTLE_DISK_MB = 50, 500
#: The daemon takes 90 MB, its map grows to half as much again (docs/bounded-map.md).
LEAST_MEMORY_MB = 150


def check_board(store: Path, root: Path = Path("/")) -> Iterator[Finding]:
    """Check the machine.

    Args:
        store: the database of the maps.
        root: of the file system, for /proc.
    """
    yield clock(_clock_state())
    yield disk(store)
    yield memory(root)


def clock(state: int) -> Finding:
    """The clock, by what adjtimex(2) answers."""
    if state == TIME_ERROR:
        text = "nothing keeps this machine's clock: stamps of maps and dates of certificates may be wrong"
        return Finding("clock", "warning", text, "apt-get install chrony, or timedatectl set-ntp true")
    return Finding("clock", "ok", "synchronised")


def _clock_state() -> int:
    libc = ctypes.CDLL(None, use_errno=True)
    return int(libc.adjtimex(ctypes.create_string_buffer(TIMEX_BYTES)))


def disk(store: Path) -> Finding:
    """Room where the maps are kept, and whether they may be written there."""
    folder = store.parent
    while not folder.exists():
        folder = folder.parent
    free_MB = shutil.disk_usage(folder).free // 1_000_000
    text = f"{folder}: {free_MB} MB free"
    mend = f"journalctl --vacuum-size=50M; du -xh {folder} | sort -h | tail"
    if free_MB < LEAST_DISK_MB:
        return Finding("disk", "error", f"{text}: the map cannot be kept for long", mend)
    if free_MB < LITTLE_DISK_MB:
        return Finding("disk", "warning", text, mend)
    # The folder is the service's own user's: who looks may be another.
    if folder == store.parent and not os.access(folder, os.W_OK):
        return Finding("disk", "warning", f"{text}, but you may not write there", f"sudo chown $USER {folder}")
    return Finding("disk", "ok", text)


def memory(root: Path = Path("/")) -> Finding:
    """Memory that a new program can have."""
    lines = (root / "proc/meminfo").read_text(encoding="ascii").splitlines()
    kilobytes = {line.split(":")[0]: int(line.split()[1]) for line in lines if len(line.split()) > 1}
    available_MB = kilobytes["MemAvailable"] // 1024
    text = f"{available_MB} of {kilobytes['MemTotal'] // 1024} MB available"
    if available_MB < LEAST_MEMORY_MB:
        mend = "ps -eo rss,comm --sort=-rss | head: stop what is not needed"
        return Finding("memory", "warning", f"{text}: the daemon with its map may need {LEAST_MEMORY_MB}", mend)
    return Finding("memory", "ok", text)
