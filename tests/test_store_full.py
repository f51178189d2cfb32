"""The disk takes nothing more: the robot maps on in memory, says so, and stores all of it when there is room."""

from __future__ import annotations

import resource
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from robominer_slam.publishing.report_messages import Level
from robominer_slam.status_report import store_diagnostic
from robominer_slam.store import MapStore
from robominer_slam.store_database import StoreError
from robominer_slam.store_reader import load_map
from robominer_slam.store_salvage import check_and_salvage
from tests.damaged_databases import KEYFRAMES, damage, keyframe_result, make_original


@contextmanager
def no_room(size: int) -> Iterator[None]:
    """No file may grow beyond so many bytes, as if the disk were full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def until(what: Callable[[], object], limit_s: float = 10.0) -> None:
    end = time.monotonic() + limit_s
    while not what():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.01)


def test_a_disk_that_fills_up_loses_nothing_and_is_written_to_when_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("robominer_slam.store.RETRY_S", 0.05)
    path = tmp_path / "map.db"
    with MapStore(path, 0.1, "rm3", "") as store:
        for k in range(10):
            store.add(keyframe_result(k), 0)
        assert store.flush(5.0)
        with no_room(Path(f"{path}-wal").stat().st_size):
            for k in range(10, 20):
                store.add(keyframe_result(k), 0)
            until(lambda: store.fault and not store.waiting)
            assert not store.flush(1.0)
            said = store_diagnostic(store)
            assert said.level is Level.ERROR
            assert said.message.startswith("not stored, mapping in memory: ")
            assert int(said.values["waiting"]) >= 1
            with pytest.raises(StoreError, match="cannot be stored now"):
                store.save_poses(keyframe_result(9).poses * 1.01)
            store.new_map("rm3", "second")
            store.add(keyframe_result(0), 0)
            assert load_map(path, "1")[1].ids == tuple(range(10))
        until(lambda: not store.fault and store.flush(0.1))  # without another keyframe
        assert store.dropped == 0
    assert load_map(path, "1")[1].ids == tuple(range(20))
    assert load_map(path, "second")[1].ids == (0,)


def test_a_daemon_that_starts_on_a_full_disk_maps_in_memory_until_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("robominer_slam.store.RETRY_S", 0.05)
    path = tmp_path / "map.db"
    with no_room(0):
        store = MapStore(path, 0.1, "rm3", "")
        store.__enter__()
        store.add(keyframe_result(0), 0)
        until(lambda: store.unwritten == 1)
        assert (store.map_id, store_diagnostic(store).level) == (0, Level.ERROR)
    until(lambda: not store.fault)
    store.__exit__()
    assert load_map(path)[1].ids == (0,)
    with closing(sqlite3.connect(path)) as connection:
        assert connection.execute("SELECT map_id FROM sessions").fetchall() == [(1,)]


def test_a_sound_database_with_a_log_is_read_on_a_full_disk_and_left_as_it_is(tmp_path: Path):
    """As after SIGKILL and a power cut: no index of the log, and no room for one."""
    path = make_original(tmp_path / "original")
    Path(f"{path}-shm").unlink()
    files = [path, Path(f"{path}-wal")]
    before = [file.read_bytes() for file in files]
    with no_room(0):
        assert check_and_salvage(path).reason == ""
        assert len(load_map(path)[1].keyframes) == KEYFRAMES
    assert [file.read_bytes() for file in files] == before
    assert check_and_salvage(path).reason == ""


def test_what_is_damaged_on_a_full_disk_is_salvaged_when_there_is_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("robominer_slam.store.RETRY_S", 0.05)
    path = damage(make_original(tmp_path / "original"), tmp_path / "damaged", "blocks zeroed", 1)
    before = path.read_bytes()
    with no_room(8192):
        salvage = check_and_salvage(path)
        assert salvage.postponed
        assert path.read_bytes() == before
        store = MapStore(path, 0.1, "rm3", "new", salvage=salvage)
        store.__enter__()
        store.add(keyframe_result(0), 0)
        until(lambda: store.unwritten == 1)
    until(lambda: not store.fault)
    store.__exit__()
    assert store.salvage.keyframes > KEYFRAMES // 2
    assert len(load_map(path, "gallery")[1].ids) == store.salvage.keyframes
    assert load_map(path, "new")[1].ids == (0,)
