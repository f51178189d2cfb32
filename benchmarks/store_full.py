"""Runs the store on a disk that is full, again and again, and looks whether anything stored is lost.

    mount -t tmpfs -o size=1m none DISK; python -m benchmarks.store_full DISK [ROUNDS]      100 rounds by default

DISK is a small file system that nobody else uses. In each round it is filled but for a random rest before the start or
after it; every third database is damaged before; every fourth daemon ends while the disk is still full.
"""

from __future__ import annotations

import logging
import shutil
import sys
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from robominer_slam.configuration.model import Configuration, SlamSection
from robominer_slam.service import map_to_start_with
from robominer_slam.store import MapStore
from robominer_slam.store_reader import load_map
from robominer_slam.store_salvage import check_and_salvage
from tests.damaged_databases import KINDS, keyframe_result

BEFORE, MEANWHILE = 40, 40


def fill(disk: Path, rest: int) -> Path:
    """Leave so many bytes."""
    filler = disk / "filler"
    filler.write_bytes(bytes(max(0, shutil.disk_usage(disk).free - rest)))
    return filler


def until_written(store: MapStore) -> None:
    end = time.monotonic() + 20.0
    while store.fault or not store.flush(1.0):
        if time.monotonic() > end:
            raise TimeoutError(store.fault)
        time.sleep(0.02)


def round_of(disk: Path, seed: int) -> tuple[bool, bool, int]:
    """Whether the disk was full, whether the database was damaged, and keyframes that are lost."""
    rng = np.random.default_rng(seed)
    path = disk / "map.db"
    with MapStore(path, 0.1, "rm3", "gallery", point_voxel=0.02) as store:
        for k in range(BEFORE):
            store.add(keyframe_result(k), 0)
        until_written(store)
    if seed % 3 == 0:
        KINDS["blocks zeroed"](path, rng)
    early, rest = bool(rng.integers(2)), int(rng.integers(0, 80_000))
    filler = fill(disk, rest) if early else None
    salvage = check_and_salvage(path)
    if salvage.reason and seed % 3:
        raise ValueError(f"sound, and taken for damaged: {salvage}")
    configuration = Configuration(slam=SlamSection(method="robust", start="continue"))
    map_id, known = map_to_start_with(configuration, path, salvage)
    expected = set() if known is None else set(known.ids)
    with MapStore(path, 0.1, "rm3", "", map_id, salvage=salvage, point_voxel=0.02) as store:
        filler = filler or fill(disk, rest)
        for k in range(BEFORE, BEFORE + MEANWHILE):
            store.add(keyframe_result(k), 0)
        store.flush(5.0)
        full = store.fault != ""
        if seed % 4:
            filler.unlink()
            until_written(store)
            expected |= set(range(BEFORE, BEFORE + MEANWHILE))
        elif not full:
            expected |= set(range(BEFORE, BEFORE + MEANWHILE))
    filler.unlink(missing_ok=True)
    if not expected:
        return full, bool(salvage.reason), 0
    again = check_and_salvage(path)
    if again.reason and not salvage.postponed:
        raise ValueError(f"damaged by the full disk: {again}")
    return full, bool(salvage.reason), len(expected - set(load_map(path)[1].ids))


def main(disk: Path, rounds: int) -> None:
    logging.disable(logging.CRITICAL)
    done: list[tuple[bool, bool, int]] = []
    failed = 0
    with ThreadPoolExecutor(1) as pool:
        for seed in range(rounds):
            attempt = pool.submit(round_of, disk, seed)
            if (error := attempt.exception()) is None:
                done.append(attempt.result())
            else:
                failed += 1
                print(f"seed {seed}:", file=sys.stderr)
                traceback.print_exception(error)
            for file in disk.iterdir():
                file.unlink()
    full, damaged, lost = (sum(column) for column in zip(*done, strict=True))
    print(f"{rounds} rounds, {full} with a full disk, {damaged} damaged before; {failed} failed; {lost} keyframes lost")
    sys.exit(1 if failed or lost else 0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 100)
