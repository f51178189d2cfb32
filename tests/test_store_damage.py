"""Whatever happened to the database: the daemon starts, keeps what can be read, and says what it found."""

from __future__ import annotations

import logging
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from robominer_slam.store import MapStore
from robominer_slam.store_database import StoreError, open_database
from robominer_slam.store_reader import load_map
from robominer_slam.store_salvage import check_and_salvage
from tests.damaged_databases import ENDS, KEYFRAMES, KINDS, Start, damage, keyframe_result, make_original, start

#: Fewest keyframes that are left of 100, by kind; half of them are in the log.
LEAST = {
    "truncated": 40, "bits flipped": 85, "blocks zeroed": 60, "blocks of noise": 60, "header damaged": 95,
    "log cut": 50, "log removed": 50, "log's bits flipped": 90, "log's header damaged": 100, "database emptied": 40,
    "database removed": 40, "no database": 0,
}  # fmt: skip


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_original(tmp_path_factory.mktemp("original"))


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_database_never_keeps_the_daemon_from_starting(kind: str, original: Path, tmp_path: Path):
    for seed in range(3):
        found: Start = start(damage(original, tmp_path / str(seed), kind, seed))
        assert found.keyframes >= LEAST[kind], str(found.salvage)
        if found.salvage.reason:
            aside = tmp_path / str(seed) / found.salvage.aside
            assert aside.exists() or kind == "database removed"
            assert f"{found.salvage.keyframes} keyframes" in str(found.salvage)


def test_an_undamaged_database_is_left_alone(original: Path, tmp_path: Path):
    path = tmp_path / "map.db"
    for end in ENDS:
        Path(f"{path}{end}").write_bytes(Path(f"{original}{end}").read_bytes())
    before = path.read_bytes()
    assert check_and_salvage(path).reason == ""
    assert path.read_bytes() == before
    assert len(load_map(path)[1].keyframes) == KEYFRAMES


def test_what_is_salvaged_equals_what_was_stored_and_hangs_together(original: Path, tmp_path: Path):
    _, whole = load_map(original)
    for seed in range(20):
        path = damage(original, tmp_path / str(seed), "blocks of noise", seed)
        salvage = check_and_salvage(path)
        if salvage.bridges:
            break
    assert salvage.bridges > 0, "one of the seeds is to tear the graph"
    _, left = load_map(path)
    places = {k: n for n, k in enumerate(whole.ids)}
    for k, pose in zip(left.keyframes, left.poses, strict=True):
        n = places[k.id]
        np.testing.assert_array_equal(pose, whole.poses[n])
        if len(k.points):
            np.testing.assert_array_equal(k.points, whole.keyframes[n].points)
    reached, edges = {left.ids[0]}, [(e.i, e.j) for e in left.edges]
    for _ in left.ids:
        reached |= {b for a, b in [*edges, *((j, i) for i, j in edges)] if a in reached}
    assert reached == set(left.ids)


def test_a_newer_database_is_refused_untouched_but_a_damaged_number_is_not(tmp_path: Path):
    path = tmp_path / "map.db"
    open_database(path).close()
    with closing(sqlite3.connect(path)) as connection:
        number = connection.execute("PRAGMA application_id").fetchone()[0]
        connection.execute("PRAGMA user_version = 99")
        connection.execute(f"PRAGMA application_id = {number + 98}")
    before = path.read_bytes()
    with pytest.raises(StoreError, match="schema version 99"):
        check_and_salvage(path)
    assert path.read_bytes() == before
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(f"PRAGMA application_id = {number}")
    assert "schema version" in check_and_salvage(path).reason


def test_a_place_that_cannot_be_written_is_the_users_mistake(tmp_path: Path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "file" / "map.db", tmp_path / "folder"):
        with pytest.raises(StoreError) as error:
            start(path)
        assert "\n" not in str(error.value)


def test_a_start_that_was_interrupted_while_salvaging_is_finished(original: Path, tmp_path: Path):
    """The broken file was moved aside, the power went, and the new one had not its name yet."""
    path = damage(original, tmp_path / "a", "blocks zeroed", 1)
    kept = check_and_salvage(path).keyframes
    path.rename(path.with_name("map.db.salvaged"))
    assert check_and_salvage(path).reason == ""
    assert len(load_map(path)[1].keyframes) == kept > 0


def test_a_database_that_was_only_begun_is_made_anew(tmp_path: Path):
    """Killed while its tables were made."""
    path = tmp_path / "map.db"
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE maps (id INTEGER PRIMARY KEY)")
    assert check_and_salvage(path).reason
    with MapStore(path, 0.1, "rm3", "") as store:
        store.add(keyframe_result(0), 0)
        assert store.flush(5.0)


def test_the_log_tells_what_was_salvaged(original: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    path = damage(original, tmp_path / "a", "truncated", 3)
    with caplog.at_level(logging.ERROR):
        salvage = check_and_salvage(path)
    assert str(salvage) in caplog.text
    assert f"salvaged: 1 maps, {salvage.keyframes} keyframes" in caplog.text
