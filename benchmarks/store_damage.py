"""Damages databases of maps in every way and starts in each as the daemon does; prints what was saved.

    python -m benchmarks.store_damage [COUNT]       300 databases by default

Each has 100 keyframes, half of them in the log, as after SIGKILL. A start that raises anything is a traceback.
"""

from __future__ import annotations

import logging
import statistics
import sys
import tempfile
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.damaged_databases import KEYFRAMES, KINDS, Start, damage, make_original, start


def main(count: int) -> None:
    logging.disable(logging.CRITICAL)
    starts: dict[str, list[Start]] = {kind: [] for kind in KINDS}
    failed = dict.fromkeys(KINDS, 0)
    slowest = 0.0
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(1) as pool:
        folder = Path(name)
        original = make_original(folder)
        for seed in range(count):
            kind = list(KINDS)[seed % len(KINDS)]
            path = damage(original, folder / str(seed), kind, seed)
            begin = time.monotonic()
            attempt = pool.submit(start, path)
            if (error := attempt.exception()) is None:
                starts[kind].append(attempt.result())
            else:
                failed[kind] += 1
                print(f"seed {seed}, {kind}:", file=sys.stderr)
                traceback.print_exception(error)
            slowest = max(slowest, time.monotonic() - begin)
    print(
        f"{'damage':22}{'starts':>8}{'failed':>8}{'found':>7}{'median':>8}{'worst':>7}{'bridges':>9}{'told lost':>11}"
    )
    for kind, done in starts.items():
        if done:
            kept = [s.keyframes for s in done]
            found, bridges, told = (sum(v) for v in zip(
                *((s.salvage.reason != "", s.salvage.bridges, s.salvage.lost) for s in done), strict=True
            ))  # fmt: skip
            print(
                f"{kind:22}{len(done):8}{failed[kind]:8}{found:7}{statistics.median(kept):8.0f}{min(kept):7}"
                f"{bridges:9}{told:11}"
            )
    print(f"of {KEYFRAMES} keyframes each; {sum(failed.values())} tracebacks; slowest start {slowest:.1f} s")
    sys.exit(1 if any(failed.values()) else 0)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
