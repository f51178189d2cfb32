"""Saved maps: read back as written, continued with ids that go on, frozen when only followed, refused when absent."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.random_drives import simulated_robot
from drivers.recording_reader import Recording
from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.configuration.model import SlamSection
from robominer_slam.replay import replay
from robominer_slam.replay_session import open_session, split_name
from robominer_slam.slam.keyframe import BackendResult
from robominer_slam.slam.level_map import from_saved
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.store import MapStore
from robominer_slam.store_database import StoreError
from robominer_slam.store_reader import load_map, map_to_start_in
from sim_backend.demo import program
from sim_backend.recorder import record
from tests.saved_drives import LOOP, RECORDING, TURNED, follow, loop_map, robust_inputs, stream
from tests.test_store import in_one_order, result, rows


def content(path: Path) -> list[list[tuple]]:
    """Every row of every table."""
    return [rows(path, f"SELECT rowid, * FROM {table} ORDER BY rowid") for table in ("maps", "keyframes", "edges")]


def write(path: Path, saved: SavedMap, name: str = "") -> None:
    """A map into a new database, through the store."""
    with MapStore(path, 0.2, "rm3", name) as store:
        store.add(
            BackendResult(
                saved.keyframes[-1], np.eye(4), saved.poses, np.zeros((3, 3)), saved.edges, 0, 1,
                saved.keyframes, saved.ids,
            ),
            0,
        )  # fmt: skip


def test_a_map_is_read_back_as_it_was_written(tmp_path):
    path = tmp_path / "map.db"
    with MapStore(path, 0.2, "rm3", "gallery") as store:
        for k in range(5):
            store.add(result(k), 7)
    map_id, saved = load_map(path, "gallery", clock_offset_ns=7)
    assert (map_id, saved.ids, saved.next_id) == (1, (0, 1, 2, 3, 4), 5)
    assert [k.stamp_ns for k in saved.keyframes] == [1000 + k for k in range(5)]
    np.testing.assert_allclose(saved.poses, result(4).poses, atol=1e-12)
    np.testing.assert_allclose(*in_one_order(saved.keyframes[3].points, result(3).keyframe.points), atol=1.1e-3)
    assert [(e.kind, e.i, e.j, e.weight) for e in saved.edges] == [("odometry", i, i + 1, 1.0) for i in range(4)]
    np.testing.assert_allclose(saved.edges[0].information, np.eye(6))


def test_the_newest_map_with_keyframes_is_taken_and_others_by_name_or_id(tmp_path):
    path = tmp_path / "map.db"
    for name, count in (("first", 2), ("second", 3), ("empty", 0)):
        with MapStore(path, 0.1, "rm3", name) as store:
            for k in range(count):
                store.add(result(k), 0)
    assert [load_map(path, wanted)[0] for wanted in ("", "first", "1")] == [2, 1, 1]
    with pytest.raises(StoreError, match=r"no map is called 'third'; there are 'second' \(2\), 'first' \(1\)"):
        load_map(path, "third")
    with pytest.raises(StoreError, match="not there"):
        load_map(tmp_path / "other.db")


def test_poses_corrected_since_and_late_edges_reach_the_disk_by_themselves(tmp_path, monkeypatch):
    """A process that is killed writes nothing at its end: what matters must have been written before."""
    monkeypatch.setattr("robominer_slam.store.POSES_INTERVAL_S", 0.0)
    path = tmp_path / "map.db"
    with MapStore(path, 0.2, "rm3", "") as store:
        store.add(result(1), 0)
        later = result(2)
        loop = replace(later.edges[0], kind="loop", i=0, j=1)
        corrected = later.poses.copy()
        corrected[:, :3, 3] += 0.05
        store.add(replace(later, poses=corrected, edges=[*later.edges, loop]), 0)
        end = time.monotonic() + 2.0
        while True:
            _, saved = load_map(path) if rows(path, "SELECT 1 FROM keyframes") else (0, None)
            if saved is not None and saved.ids == (1, 2) and np.allclose(saved.poses, corrected[1:], atol=1e-9):
                break
            assert time.monotonic() < end, "corrected poses are not on the disk"
            time.sleep(0.02)
    assert rows(path, "SELECT i, j FROM edges WHERE kind = 'loop'") == [(0, 1)]


def test_edges_are_stored_once_also_when_a_map_is_continued(tmp_path):
    path = tmp_path / "map.db"
    with MapStore(path, 0.2, "rm3", "") as store:
        for k in range(3):
            store.add(result(k), 0)
    with MapStore(path, 0.2, "rm3", "", map_id=1) as store:
        for k in range(3, 5):
            store.add(result(k), 0)
    assert rows(path, "SELECT map_id, i, j FROM edges ORDER BY j") == [(1, i, i + 1) for i in range(4)]
    assert rows(path, "SELECT id FROM maps") == [(1,)]


def test_a_lost_keyframe_leaves_a_map_that_still_hangs_together():
    saved = loop_map()
    gone = saved.keyframes[3].id
    kept = [n for n, k in enumerate(saved.keyframes) if k.id != gone]
    edges = [e for e in saved.edges if e.kind == "odometry" and gone not in (e.i, e.j)]
    known = from_saved(SavedMap(tuple(saved.keyframes[n] for n in kept), saved.poses[kept], edges, ""), 0.01)
    assert sorted(known.poses) == [saved.ids[n] for n in kept]
    assert [(e.i, e.j) for e in known.edges][-1] == (gone - 1, gone + 1)


def test_a_second_session_goes_on_in_the_same_map(tmp_path):
    path = tmp_path / "map.db"
    write(path, loop_map(), "gallery")
    before = load_map(path)[1]
    inputs, session = open_session(robust_inputs(), str(path) + ":gallery", "continue", path)
    assert inputs.configuration.slam.start == "continue"
    # Another heading and another way over the same ground.
    drive = stream(
        "thesis", ((0.6, 0.35, 1.0), (0.1, 0.35, 1.0), (0.1, 0.05, 1.0), (0.7, 0.05, 1.0), (0.7, 0.4, 1.0)), 8
    )
    followed = follow(drive, session.known, "continue")
    assert session.store is not None
    with session.store as store:
        store.add(
            BackendResult(
                followed.entered[-1], np.eye(4), followed.map.poses, np.zeros((3, 3)), followed.map.edges, 0, 1,
                tuple(followed.entered[len(before.ids) :]), tuple(followed.map.ids),
            ),
            0,
        )  # fmt: skip
    map_id, after = load_map(path, "gallery")
    assert map_id == 1
    assert after.ids == tuple(range(len(after.ids)))
    assert len(after.ids) > len(before.ids) + 4
    old = before.ids[-1]
    assert any(e.kind == "loop" and e.i <= old < e.j for e in after.edges), "nothing ties the sessions"
    assert {(e.kind, e.i, e.j) for e in before.edges} <= {(e.kind, e.i, e.j) for e in after.edges}
    assert followed.frames[-1].state == "tracking"
    assert followed.errors[-1] < 0.05
    # The map's frame is still that of its first session.
    np.testing.assert_allclose(after.poses[0], before.poses[0], atol=1e-6)


def test_a_frozen_map_is_unchanged_bit_for_bit(tmp_path):
    path = tmp_path / "map.db"
    write(path, loop_map())
    before = content(path)
    _, known = load_map(path)
    drive = stream("thesis", TURNED, 11)
    with MapStore(path, 0.1, "rm3", "", 1, frozen=True) as store:
        followed = follow(drive, known, "localize")
        for frame in followed.frames:
            for one in frame.backend_results:
                store.add(one, 0)
        store.save_poses(followed.map.poses, followed.map.ids, followed.map.edges)
    assert followed.frames[-1].state == "tracking"
    assert followed.errors[-1] < 0.05
    assert content(path) == before
    np.testing.assert_array_equal(followed.map.poses, known.poses)
    assert followed.map.ids == list(known.ids)


def test_the_first_start_with_continue_begins_a_map(tmp_path):
    slam = SlamSection(method="robust", start="continue")
    assert map_to_start_in(slam, tmp_path / "map.db") == (None, None)
    with pytest.raises(StoreError, match="is not there"):
        map_to_start_in(SlamSection(method="robust", start="localize"), tmp_path / "map.db")
    with pytest.raises(StoreError, match="is not there"):
        map_to_start_in(SlamSection(method="robust", start="continue", map="gallery"), tmp_path / "map.db")


def test_a_method_that_cannot_find_its_place_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="cannot find its place"):
        map_to_start_in(SlamSection(method="thesis", start="continue"), tmp_path / "map.db")


def test_options_of_replay_that_do_not_go_together_are_refused(tmp_path):
    path = tmp_path / "map.db"
    write(path, loop_map())
    with pytest.raises(ConfigurationError, match="needs --map"):
        open_session(robust_inputs(), None, "continue", None)
    with pytest.raises(ConfigurationError, match="stays in its database"):
        open_session(robust_inputs(), str(path), "continue", tmp_path / "other.db")
    with pytest.raises(ConfigurationError, match="stays in its database"):
        open_session(robust_inputs(), str(path), "localize", path)
    assert split_name("maps/a.db:west") == (Path("maps/a.db"), "west")
    assert split_name(str(path)) == (path, "")
    connection = sqlite3.connect(path)
    assert connection.execute("SELECT count(*) FROM maps").fetchone() == (1,)
    connection.close()


def test_two_replays_in_a_saved_map_are_the_same_bit_for_bit():
    poses = []
    for _ in range(2):
        inputs = robust_inputs("localize")
        out = []
        replay(_cut(inputs), lambda frame, out=out: out.append(frame.T_map_base), known=loop_map())
        poses.append(np.array(out))
    np.testing.assert_array_equal(poses[0], poses[1])


def _cut(inputs):
    """The first seconds of the recording."""

    class Cut:
        counters = inputs.recording.counters

        def __iter__(self):
            for n, item in enumerate(inputs.recording):
                if n > 1500:
                    return
                yield item

    return replace(inputs, recording=Cut())


def test_replay_saves_a_map_and_finds_its_place_in_it(tmp_path):
    """By the command line: what one replay stores, the next one starts in."""
    config = tmp_path / "robust.toml"
    config.write_text('[robot]\nlayout = "thesis-grid"\n[slam]\nmethod = "robust"\n')
    recording = str(short_recording(tmp_path))

    def run(*more: str, code: int = 0) -> dict:
        done = subprocess.run(
            program("replay", recording, "--config", str(config), "--json", *more),
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
        assert done.returncode == code, done.stderr
        assert "Traceback" not in done.stderr
        return json.loads(done.stdout) if code == 0 else {"error": done.stderr}

    database = str(tmp_path / "map.db")
    made = run("--store", database)
    assert made["tracking_frames"] == made["frames"]
    followed = run("--map", database, "--tum", str(tmp_path / "slam.tum"))
    assert followed["keyframes"] == made["keyframes"]
    assert 0 < followed["tracking_frames"] < followed["frames"]
    continued = run("--map", database + ":1", "--start", "continue", "--store", database)
    assert continued["keyframes"] > made["keyframes"]
    assert load_map(Path(database))[1].ids == tuple(range(continued["keyframes"]))
    assert "no map is called 'west'" in run("--map", database + ":west", code=2)["error"]


def short_recording(folder: Path) -> Path:
    """LOOP twice over, as a recording that carries its calibration."""
    path = folder / "loop.mcap"
    robot = simulated_robot("thesis", np.array(LOOP), 7)
    record(
        robot.events(),
        path,
        array=(8, 8, robot.settings.sensor_period_us),
        attachments=Recording(RECORDING).attachments(),
        whisker_truth=False,
    )
    return path
