"""Processor time and memory of another process, from /proc."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class ProcessUsage:
    """What a process has used so far: processor time (s) and its largest resident memory (MB)."""

    cpu_s: float
    peak_memory_mb: float


def usage_of(pid: int) -> ProcessUsage:
    """Usage of a running process, all its threads.

    Raises:
        OSError: there is no such process.
    """
    # The command's name, in brackets, may hold spaces: fields are counted behind it (proc(5): utime is the 14th).
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    ticks = int(fields[11]) + int(fields[12])
    lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    peak_kb = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
    return ProcessUsage(ticks / os.sysconf("SC_CLK_TCK"), peak_kb / 1024.0)
