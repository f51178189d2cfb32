"""Memory of a program that runs under qemu-user: `guest_memory.py PID`, its own pages in MB, without the emulator's.

The program was started with QEMU_GUEST_BASE as below: pages of [base, base + 4 GiB) are its own.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

GUEST_BASE = 0x400000000
RANGE = re.compile(r"([0-9a-f]+)-[0-9a-f]+ ")


def resident_kB(smaps: str) -> int:
    """Resident memory of the guest by the text of /proc/PID/smaps."""
    total, own = 0, False
    for line in smaps.splitlines():
        found = RANGE.match(line)
        if found is not None:
            own = GUEST_BASE <= int(found[1], 16) < GUEST_BASE + (1 << 32)
        elif own and line.startswith("Rss:"):
            total += int(line.split()[1])
    return total


if __name__ == "__main__":
    print(f"{resident_kB(Path(f'/proc/{sys.argv[1]}/smaps').read_text(encoding='ascii')) / 1024:.1f}")
