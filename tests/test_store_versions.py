"""Versions of saved maps: one with every correction that is on the disk, none without; `map versions` tells them."""

from __future__ import annotations

import json
import sqlite3
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from robominer_slam.cli.main import main
from robominer_slam.cli.map import map_group
from robominer_slam.slam.keyframe import GraphEdge
from robominer_slam.store import MapStore
from robominer_slam.store_database import SCHEMA_VERSION, StoreError, open_database, transaction
from robominer_slam.store_reader import load_map, map_versions
from robominer_slam.store_salvage import check_and_salvage
from robominer_slam.store_size import thin
from robominer_slam.store_versions import MapVersion, add_version
from tests.conftest import planar
from tests.test_store import result, rows

LOOP = GraphEdge("loop", 0, 2, planar(0.2, 0, 0), np.eye(6), 1.0)
POSES = np.array([planar(0.1 * i, 0.0, 0.0) for i in range(4)])


def moved(*ways: float) -> np.ndarray:
    """Poses of the first keyframes, each so far to the side."""
    poses = POSES[: len(ways)].copy()
    poses[:, 1, 3] = ways
    return poses


def filled(path: Path, name: str = "", corrections: int = 0) -> Path:
    """A database with one more map of three keyframes and a loop closure, corrected so often."""
    with MapStore(path, 0.1, "rm3", name) as store:
        for k in range(3):
            store.add(result(k), 0)
        store.add(replace(result(2), entered=(), added=[LOOP]), 0)
        assert store.flush(5.0)
        for n in range(corrections):
            store.save_poses(moved(0.0, 0.01, 0.01 * (n + 1)), [0, 1, 2])
    return path


def told(path: Path, wanted: str = "") -> list[tuple[int, int, int, int, float]]:
    """Number, keyframes, closures, moved, by how much."""
    return [
        (v.number, v.keyframes, v.loop_closures, v.moved, round(v.moved_m, 9)) for v in map_versions(path, wanted)[2]
    ]


def test_a_version_comes_with_every_correction_of_stored_poses(tmp_path: Path):
    path, before = filled(tmp_path / "map.db"), time.time_ns()
    with MapStore(path, 0.1, "rm3", "", map_id=1) as store:
        store.save_poses(moved(0.0, 0.02, 0.05), [0, 1, 2])
        store.save_poses(moved(0.0, 0.02, 0.05), [0, 1, 2])
        store.save_poses(moved(0.0, 0.02, 0.0505), [0, 1, 2], [replace(LOOP, weight=0.5)])
        # The fourth is not stored yet, and so moves nothing.
        store.save_poses(moved(0.0, 0.02, 0.06, 0.5), [0, 1, 2, 3])
        store.add(replace(result(3), dropped=[(0, 2)]), 0)
        assert store.flush(5.0)
    # What was added last brings back the poses as they were at first.
    expected = [(1, 3, 1, 2, 0.05), (2, 3, 1, 1, 0.01), (3, 4, 0, 2, 0.06)]
    assert told(path) == expected
    times = [before, *(v.written_unix_ns for v in map_versions(path)[2]), time.time_ns()]
    assert times == sorted(times)


def test_a_map_that_is_gone_on_with_counts_on_and_only_what_moved(tmp_path: Path):
    path = filled(filled(tmp_path / "map.db", "west", 2), "east", 1)
    with MapStore(path, 0.1, "rm3", "", map_id=1) as store:
        store.save_poses(moved(0.0, 0.01, 0.02), [0, 1, 2])  # as they are
        store.save_poses(moved(0.0, 0.01, 0.05), [0, 1, 2])
    assert told(path, "west") == [(1, 3, 1, 2, 0.01), (2, 3, 1, 1, 0.01), (3, 3, 1, 1, 0.03)]
    assert told(path, "east") == [(1, 3, 1, 2, 0.01)]


def test_a_frozen_map_has_no_new_version(tmp_path: Path):
    path = filled(tmp_path / "map.db")
    with MapStore(path, 0.1, "rm3", "", map_id=1, frozen=True) as store:
        store.save_poses(moved(0.0, 0.5, 0.5), [0, 1, 2])
    assert told(path) == []


def test_poses_and_version_are_written_together_or_not_at_all(tmp_path: Path):
    path = filled(tmp_path / "map.db")
    with MapStore(path, 0.1, "rm3", "", map_id=1) as store:
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("CREATE TRIGGER no BEFORE INSERT ON versions BEGIN SELECT raise(ABORT, 'no'); END")
        with pytest.raises(StoreError, match="cannot be stored now"):
            store.save_poses(moved(0.0, 0.0, 0.05), [0, 1, 2])
        np.testing.assert_allclose(load_map(path)[1].poses, POSES[:3], atol=1e-12)
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("DROP TRIGGER no")
        store.save_poses(moved(0.0, 0.0, 0.05), [0, 1, 2])
    np.testing.assert_allclose(load_map(path)[1].poses, moved(0.0, 0.0, 0.05), atol=1e-12)
    assert told(path) == [(1, 3, 1, 1, 0.05)]


def test_the_newest_500_stay_and_of_older_ones_every_tenth(tmp_path: Path):
    path = filled(filled(tmp_path / "map.db", "first", 3), "second")
    with closing(open_database(path)) as connection, transaction(connection):
        for _ in range(620):
            add_version(connection, 2, 1, 1, 0.01)
    assert [v.number for v in map_versions(path, "second")[2]] == [*range(10, 121, 10), *range(121, 621)]
    assert len(told(path, "first")) == 3, "those of other maps stay"


def test_versions_go_with_their_map_and_are_thinned_with_it(tmp_path: Path):
    path = filled(filled(filled(tmp_path / "map.db", "", 2), "named", 23), "current", 2)
    with MapStore(path, 0.1, "rm3", "", map_id=2) as store:
        for k in range(3, 12):
            store.add(result(k), 0)
    with closing(open_database(path)) as connection:
        for _ in range(2):
            with transaction(connection):
                assert thin(connection, 3)
    assert rows(path, "SELECT DISTINCT map_id FROM versions") == [(2,), (3,)]
    newest = rows(path, "SELECT max(number) FROM versions WHERE map_id = 2")[0][0]
    assert newest in (23, 24)
    assert [v.number for v in map_versions(path, "named")[2]] == [10, 20, newest]
    assert len(told(path, "current")) == 2


@pytest.mark.parametrize("version", [1, 2])
def test_an_older_database_is_brought_up_to_date_when_it_is_written(tmp_path: Path, version: int):
    path = filled(tmp_path / "map.db", "old")
    with closing(sqlite3.connect(path)) as connection:
        number = connection.execute("PRAGMA application_id").fetchone()[0]
        connection.executescript("DROP TABLE versions" + ("; DROP TABLE sessions" if version == 1 else ""))
        connection.execute(f"PRAGMA user_version = {version}")
        connection.execute(f"PRAGMA application_id = {0 if version == 1 else number - 1}")
    assert check_and_salvage(path).reason == ""
    assert told(path) == []
    assert rows(path, "PRAGMA user_version") == [(version,)], "who only reads changes nothing"
    with MapStore(path, 0.1, "rm3", "", map_id=1) as store:
        store.save_poses(moved(0.0, 0.02, 0.05), [0, 1, 2])
    assert rows(path, "PRAGMA user_version") == [(3,)] == [(SCHEMA_VERSION,)]
    assert rows(path, "PRAGMA application_id") == [(number,)]
    assert told(path) == [(1, 3, 1, 2, 0.05)]
    assert check_and_salvage(path).reason == ""
    assert len(rows(path, "SELECT * FROM sessions")) == version, "the log of sessions goes on"


def test_versions_are_salvaged_but_none_without_a_map_and_none_that_cannot_be(tmp_path: Path):
    path = filled(filled(tmp_path / "map.db", "west", 30), "east", 2)
    before = [map_versions(path, name)[2] for name in ("west", "east")]
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        for values in ("9, 1, 1, 1, 1, 1, 0.5", "1, 40, 1, 1, 1, 1, 9e300"):  # of no map; farther than any robot goes
            connection.execute(
                f"INSERT INTO versions VALUES ((1 << 32) * {values[0]} + {values.split(',')[1]}, {values})"
            )
        connection.execute("INSERT INTO versions VALUES (77, 1, 50, 1, 1, 1, 1, 0.5)")  # under another's id
    data = path.read_bytes()
    path.write_bytes(bytes(100) + data[100:])
    assert check_and_salvage(path).keyframes == 6
    assert [map_versions(path, name)[2] for name in ("west", "east")] == before
    assert [len(versions) for versions in before] == [30, 2]
    assert rows(path, "SELECT count(*) FROM versions") == [(32,)]
    with MapStore(path, 0.1, "rm3", "", map_id=1) as store:
        store.save_poses(moved(0.0, 0.01, 0.5), [0, 1, 2])
    assert told(path, "west")[-1][:2] == (31, 3)


def test_a_database_that_lost_the_table_is_damaged(tmp_path: Path):
    path = filled(tmp_path / "map.db")
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("ALTER TABLE versions RENAME TO wersions")
    assert "tables are missing: versions" in check_and_salvage(path).reason
    with MapStore(path, 0.1, "rm3", "", map_id=1) as store:
        store.save_poses(moved(0.0, 0.02, 0.05), [0, 1, 2])
    assert len(told(path)) == 1


def test_the_command_tells_the_versions_of_a_map(tmp_path: Path):
    path = filled(filled(tmp_path / "map.db", "west", 2), "east", 1)
    versions: list[MapVersion] = map_versions(path, "west")[2]
    done = CliRunner().invoke(map_group, ["versions", f"{path}:west", "--json"])
    answer = json.loads(done.output)
    assert (answer["id"], answer["name"], done.exit_code) == (1, "west", 0)
    assert answer["versions"][1] == {
        "number": 2,
        "written": str(np.datetime64(versions[1].written_unix_ns, "ns").astype("datetime64[s]")),
        "keyframes": 3,
        "loop_closures": 1,
        "moved": 1,
        "moved_m_max": 0.01,
    }
    table = CliRunner().invoke(map_group, ["versions", str(path)]).output
    assert "map 2 east" in table
    assert answer["versions"][1]["written"][:10] in table
    assert "Example: robominer-slam map versions" in CliRunner().invoke(map_group, ["versions", "--help"]).output


def test_users_mistakes_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    newer = filled(tmp_path / "newer.db")
    with closing(sqlite3.connect(newer)) as connection:
        number = connection.execute("PRAGMA application_id").fetchone()[0]
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
        connection.execute(f"PRAGMA application_id = {number + 1}")
    untouched = newer.read_bytes()
    (tmp_path / "text.db").write_text("not a database, but long enough to be taken for one" * 20)
    mistakes = {
        "nowhere.db": "is not there",
        "text.db": "not a database",
        "newer.db": "schema version 4, this program knows 1 to 3",
        f"{filled(tmp_path / 'map.db').name}:west": "no map is called 'west'",
    }
    for name, said in mistakes.items():
        monkeypatch.setattr(sys, "argv", ["robominer-slam", "map", "versions", str(tmp_path / name)])
        with pytest.raises(SystemExit) as end:
            main()
        line = capsys.readouterr().err
        assert (end.value.code, line.count("\n"), said in line) == (2, 1, True), line
    with pytest.raises(StoreError, match="schema version 4"):
        MapStore(newer, 0.1, "rm3", "")
    assert newer.read_bytes() == untouched
