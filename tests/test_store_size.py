"""The database stays within its bound: the oldest map without a name goes first, the current one never."""

from __future__ import annotations

from pathlib import Path

from robominer_slam.publishing.report_messages import Level
from robominer_slam.status_report import store_diagnostic
from robominer_slam.store import MapStore
from robominer_slam.store_reader import load_map
from tests.damaged_databases import keyframe_result
from tests.test_store import rows


def session(path: Path, name: str, max_mb: float, count: int = 60) -> MapStore:
    with MapStore(path, 0.1, "rm3", name, max_mb=max_mb) as store:
        for k in range(count):
            store.add(keyframe_result(k), 0)
        assert store.flush(10.0)
    return store


def test_the_oldest_without_a_name_goes_first_then_named_ones_are_thinned(tmp_path: Path):
    path = tmp_path / "map.db"
    for name in ("named", "", "", "last"):
        store = session(path, name, 0.3)
    kept = [name for (name,) in rows(path, "SELECT name FROM maps ORDER BY id")]
    assert kept[0] == "named"
    assert kept[-1] == "last"
    assert len(kept) < 4
    store = session(path, "now", 0.18)
    assert [name for (name,) in rows(path, "SELECT name FROM maps ORDER BY id")] == ["named", "last", "now"]
    named = load_map(path, "named")[1]
    assert len(named.keyframes) == 60
    assert 5 <= sum(len(k.points) > 0 for k in named.keyframes) <= 30
    assert len(named.edges) >= 59
    assert all(len(k.points) == 300 for k in load_map(path, "now")[1].keyframes)
    assert not store.too_large


def test_a_map_that_is_too_large_by_itself_is_stored_and_said(tmp_path: Path):
    store = session(tmp_path / "map.db", "", 0.05)
    assert store.too_large
    assert store_diagnostic(store).level is Level.WARN
    assert len(load_map(tmp_path / "map.db")[1].keyframes) == 60
