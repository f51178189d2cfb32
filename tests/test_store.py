"""The store: what was added is on the disk, whatever comes."""

from __future__ import annotations

import sqlite3
import time
import zlib
from dataclasses import replace

import numpy as np
import pytest

from robominer_slam import __version__, geometry
from robominer_slam.packed_points import pack_points, unpack_points
from robominer_slam.slam.keyframe import BackendResult, GraphEdge, Keyframe, Merge
from robominer_slam.store import MapStore
from robominer_slam.store_database import StoreError, open_database
from robominer_slam.store_reader import load_map
from robominer_slam.store_salvage import Salvage, check_and_salvage
from tests.conftest import planar


def result(k: int) -> BackendResult:
    poses = np.array([planar(0.1 * i, 0.0, 0.0) for i in range(k + 1)])
    edges = [GraphEdge("odometry", i, i + 1, planar(0.1, 0, 0), np.eye(6), 1.0) for i in range(k)]
    points = np.random.default_rng(k).uniform(-0.4, 0.4, (300, 3))
    keyframe = Keyframe(k, 1000 + k, poses[k], points, 0.1 * k)
    return BackendResult(keyframe, np.eye(4), poses, np.zeros((3, 3)), edges, 0, k + 1)


def rows(path, query: str) -> list[tuple]:
    connection = sqlite3.connect(path)
    try:
        return connection.execute(query).fetchall()
    finally:
        connection.close()


def test_keyframes_and_edges_are_stored_with_their_poses(tmp_path):
    path = tmp_path / "sub" / "map.db"
    with MapStore(path, 0.2, "rm3", "first") as store:
        for k in range(5):
            store.add(result(k), 7)
        assert store.flush(5.0)
        store.save_poses(np.array([planar(0, 1.0 * i, 0) for i in range(5)]))
        store.rename("gallery")
    assert rows(path, "SELECT name, robot FROM maps") == [("gallery", "rm3")]
    stored = rows(path, "SELECT id, stamp_unix_ns, T_map_base, points FROM keyframes ORDER BY id")
    assert [(row[0], row[1]) for row in stored] == [(k, 1007 + k) for k in range(5)]
    np.testing.assert_allclose(np.frombuffer(stored[3][2]), geometry.to_vector7(planar(0, 3.0, 0)))
    np.testing.assert_allclose(*in_one_order(unpack_points(stored[3][3]), result(3).keyframe.points), atol=1.1e-3)
    assert rows(path, "SELECT kind, i, j FROM edges ORDER BY j") == [("odometry", i, i + 1) for i in range(4)]


def test_a_keyframe_is_on_the_disk_within_the_promised_time(tmp_path):
    path = tmp_path / "map.db"
    with MapStore(path, 1.0, "rm3", "") as store:
        store.add(result(0), 0)
        end = time.monotonic() + 1.0
        while not rows(path, "SELECT id FROM keyframes"):
            assert time.monotonic() < end, "not on the disk after sync_s"


def test_every_session_is_logged_with_what_it_found(tmp_path):
    path = tmp_path / "map.db"
    with MapStore(path, 0.1, "rm3", "") as store:
        store.add(result(0), 0)
    with MapStore(path, 0.1, "rm3", "", map_id=1, salvage=Salvage("torn", "map.db.broken")):
        pass
    with MapStore(path, 0.1, "rm3", "", map_id=1, frozen=True):
        pass
    (first, second) = rows(path, "SELECT map_id, program, found FROM sessions ORDER BY id")
    assert first == (1, __version__, "sound")
    assert second[2].startswith("damaged (torn), moved aside to map.db.broken")


def test_each_run_is_a_map_of_its_own(tmp_path):
    for _ in range(2):
        with MapStore(tmp_path / "map.db", 0.1, "rm3", "") as store:
            store.add(result(0), 0)
    assert rows(tmp_path / "map.db", "SELECT map_id, id FROM keyframes") == [(1, 0), (2, 0)]


def test_what_leaves_the_graph_leaves_the_store_and_its_touches_move(tmp_path):
    """Keyframe 2 is merged into 1 and a bridge replaces its edges; keyframe 3 keeps no touches."""
    path = tmp_path / "map.db"
    last = result(4)
    bridge = GraphEdge("odometry", 1, 3, planar(0.2, 0, 0), np.eye(6), 1.0)
    change = replace(
        last, added=[bridge, last.edges[-1]], removed=[2], bare=[3], merged=[Merge(2, 1, planar(0.1, 0, 0), 0.02)],
        poses=np.delete(last.poses, 2, axis=0), ids=(0, 1, 3, 4),
    )  # fmt: skip
    with MapStore(path, 0.1, "rm3", "") as store:
        for k in range(4):
            store.add(result(k), 0)
        store.add(change, 0)
        assert store.flush(5.0)
        store.save_poses(np.array([planar(0, 1.0 * i, 0) for i in (0, 1, 3, 4)]), [0, 1, 3, 4])
    assert sorted(rows(path, "SELECT i, j FROM edges")) == [(0, 1), (1, 3), (3, 4)]
    stored = {row[0]: row[1:] for row in rows(path, "SELECT id, points, T_map_base FROM keyframes")}
    assert sorted(stored) == [0, 1, 3, 4]
    both = np.concatenate([result(1).keyframe.points, result(2).keyframe.points + np.array([0.1, 0.0, 0.0])])
    np.testing.assert_allclose(*in_one_order(unpack_points(stored[1][0]), both), atol=2.1e-3)
    assert len(unpack_points(stored[3][0])) == 0
    np.testing.assert_allclose(np.frombuffer(stored[4][1]), geometry.to_vector7(planar(0, 4.0, 0)))


def test_a_closure_that_waited_for_its_partner_is_stored_too(tmp_path):
    late = GraphEdge("loop", 0, 2, planar(0.2, 0, 0), np.eye(6), 1.0)
    with MapStore(tmp_path / "map.db", 0.1, "rm3", "") as store:
        for k in range(3):
            store.add(result(k), 0)
        store.add(replace(result(3), added=[late, result(3).edges[-1]]), 0)
    assert (0, 2) in rows(tmp_path / "map.db", "SELECT i, j FROM edges WHERE kind = 'loop'")


def test_a_newer_database_is_refused_and_left_alone(tmp_path):
    path = tmp_path / "map.db"
    open_database(path).close()
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(StoreError, match="schema version 99"):
        open_database(path)
    assert rows(path, "PRAGMA user_version") == [(99,)]


def test_what_is_no_database_is_refused_with_one_line(tmp_path):
    path = tmp_path / "map.db"
    path.write_bytes(b"this is not a database, it is a letter" * 100)
    with pytest.raises(StoreError, match="not a database") as error:
        open_database(path)
    assert "\n" not in str(error.value)
    with pytest.raises(StoreError, match="writable folder"):
        open_database(path / "below" / "map.db")


def test_a_locked_database_is_reported_and_nothing_is_lost(tmp_path):
    path = tmp_path / "map.db"
    with MapStore(path, 0.1, "rm3", "") as store:
        store._connection.execute("PRAGMA busy_timeout = 10")
        other = sqlite3.connect(path, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        store.add(result(0), 0)
        end = time.monotonic() + 5
        while not store.fault and time.monotonic() < end:
            store.flush(0.1)
        assert "locked" in store.fault
        other.execute("ROLLBACK")
        other.close()
        store.add(result(1), 0)
        assert store.flush(5.0)
        assert store.fault == ""
    assert rows(path, "SELECT id FROM keyframes") == [(0,), (1,)]


def test_points_survive_packing_to_a_millimetre():
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    np.testing.assert_allclose(*in_one_order(unpack_points(pack_points(points)), points), atol=1.01e-3)
    assert unpack_points(pack_points(np.zeros((0, 3)))).shape == (0, 3)


def test_touches_of_one_cell_are_stored_as_one():
    points = np.array([[0.001, 0.001, -0.19], [0.009, 0.011, -0.194], [0.5, 0.001, -0.19]])
    expected = [[0.005, 0.006, -0.192], [0.5, 0.001, -0.19]]
    np.testing.assert_allclose(*in_one_order(unpack_points(pack_points(points, 0.02)), np.array(expected)), atol=2e-3)


def test_a_database_of_version_1_is_brought_up_to_date_and_its_touches_are_read(tmp_path):
    path = tmp_path / "map.db"
    with MapStore(path, 0.1, "rm3", "old") as store:
        store.add(result(0), 0)
    old = np.rint(result(0).keyframe.points * 1000).astype("<i2")
    connection = sqlite3.connect(path)
    connection.execute("UPDATE keyframes SET points = ?", (zlib.compress(old.tobytes()),))
    connection.execute("DROP TABLE sessions")
    connection.execute("DROP TABLE versions")
    connection.execute("PRAGMA user_version = 1")
    connection.execute("PRAGMA application_id = 0")
    connection.commit()
    connection.close()
    assert check_and_salvage(path).reason == ""
    open_database(path).close()
    assert rows(path, "PRAGMA user_version") == [(3,)]
    assert rows(path, "SELECT * FROM sessions") == rows(path, "SELECT * FROM versions") == []
    np.testing.assert_allclose(load_map(path)[1].keyframes[0].points, old / 1000)


def in_one_order(*clouds: np.ndarray) -> list[np.ndarray]:
    """Clouds in one order: the nearest point of the last one for each of the others' points, then the last one."""
    last = clouds[-1]
    ordered = [c[np.linalg.norm(c[None] - last[:, None], axis=2).argmin(axis=1)] for c in clouds[:-1]]
    assert all(len(c) == len(last) for c in clouds)
    return [*ordered, last]
