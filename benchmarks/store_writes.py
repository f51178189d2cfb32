"""Bytes that the process writes for each keyframe of a recording, as the kernel counts them.

    python -m benchmarks.store_writes [SYNC_S ...]      2 s and 20 s by default

The results of a replay are handed to the store in the recording's own times, ten times as fast, with all of the
store's times divided by ten: batches, corrections and checkpoints fall as they would on the robot. Counted are the
bytes that go to storage (/proc/self/io, write_bytes: whole pages of the kernel) and those handed to it (wchar).
"""

from __future__ import annotations

import logging
import sqlite3
import sys
import tempfile
import threading
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from robominer_slam import store
from robominer_slam.frame_result import FrameResult
from robominer_slam.replay import replay
from robominer_slam.slam.keyframe import BackendResult
from tests.saved_drives import robust_inputs

FASTER = 10.0


def results() -> list[tuple[float, BackendResult]]:
    """Seconds from the first one, and result, of every keyframe of a recording."""
    found: list[tuple[int, BackendResult]] = []

    def keep(result: BackendResult) -> None:
        found.append((result.keyframe.stamp_ns, result))

    def on_frame(frame: FrameResult) -> None:
        for result in frame.backend_results:
            keep(result)

    replay(robust_inputs(), on_frame, lambda _: None, None, keep)
    return [((stamp - found[0][0]) * 1e-9, result) for stamp, result in found]


def counted() -> tuple[int, int]:
    """Bytes handed to the kernel, and to storage, so far."""
    values = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(values["wchar"]), int(values["write_bytes"])


def measure(drive: list[tuple[float, BackendResult]], sync_s: float) -> str:
    """One line of the table."""
    interval = store.POSES_INTERVAL_S
    store.POSES_INTERVAL_S = max(interval, sync_s) / FASTER
    pace = threading.Event()
    out = Path("out")  # on a disk, as /tmp may not be
    out.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out) as name:
        path = Path(name) / "map.db"
        with store.MapStore(path, sync_s / FASTER, "rm3", "", point_voxel=0.02) as kept:
            handed, stored = counted()
            begin = time.monotonic()
            for at, result in drive:
                pace.wait(max(0.0, begin + at / FASTER - time.monotonic()))
                kept.add(replace(result), 0)
            kept.flush(60.0)
        handed, stored = (after - before for after, before in zip(counted(), (handed, stored), strict=True))
        with closing(sqlite3.connect(path)) as connection:
            payload = connection.execute("SELECT avg(length(points)) FROM keyframes").fetchone()[0]
    store.POSES_INTERVAL_S = interval
    n = len(drive)
    return f"{sync_s:8g}{n:11}{payload:15.0f}{handed / n / 1024:17.1f}{stored / n / 1024:17.1f}"


def main(times: list[float]) -> None:
    logging.disable(logging.CRITICAL)
    drive = results()
    print(f"{drive[-1][0] / len(drive):.2f} s from keyframe to keyframe")
    print(f"{'sync_s':>8}{'keyframes':>11}{'payload, B':>15}{'handed, KiB':>17}{'stored, KiB':>17}")
    for sync_s in times:
        print(measure(drive, sync_s), flush=True)


if __name__ == "__main__":
    main([float(text) for text in sys.argv[1:]] or [2.0, 20.0])
