"""Saved maps in other programs' formats, each read back by a program that is not ours; `map` as a user runs it."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import gtsam
import numpy as np
import pytest
import tifffile
import trimesh
import yaml
from click.testing import CliRunner
from evo.tools import file_interface
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from pypcd4 import PointCloud

from robominer_slam import geometry
from robominer_slam.cli.map import map_group
from robominer_slam.map_files import octomap, point_files
from robominer_slam.map_files.formats import cloud
from robominer_slam.mapping.height_grid import height_grid, occupancy
from robominer_slam.slam.keyframe import BackendResult, GraphEdge, Keyframe
from robominer_slam.store import MapStore
from robominer_slam.store_reader import load_map

STAMP = 1_700_000_000_000_000_000
CELL = 0.02


def stored(path: Path, name: str = "gallery", shift: float = 0.0) -> None:
    """A map of three keyframes with a loop, through the store."""
    rng = np.random.default_rng(3)
    poses = geometry.T_from_xyyaw(np.array([[0.0, 0.0, 0.0], [0.5, 0.1, 0.3], [0.1 + shift, 0.6, 2.0]]))
    poses[:, 2, 3] = [0.0, 0.01, -0.02]
    keyframes = []
    for k in range(3):
        points = rng.uniform(-0.25, 0.25, (400, 3)) * [1.0, 1.0, 0.3] - [0.0, 0.0, 0.15]
        keyframes.append(Keyframe(k, STAMP + k * 2 * 10**9, poses[k], points, 0.5 * k))
    between = [(0, 1, "odometry", 1.0), (1, 2, "odometry", 1.0), (0, 2, "loop", 0.8)]
    edges = tuple(
        GraphEdge(kind, i, j, geometry.inverse(poses[i]) @ poses[j], np.diag([100.0, 90, 80, 70, 60, 50]), weight)
        for i, j, kind, weight in between
    )
    with MapStore(path, 0.05, "rm3", name, None, False) as store:
        for n in range(1, 4):
            known = tuple(edge for edge in edges if max(edge.i, edge.j) < n)
            store.add(BackendResult(keyframes[n - 1], np.eye(4), poses[:n], np.eye(3), known, 0, n), 0)
        assert store.flush(10.0)
        store.save_poses(poses, [0, 1, 2], edges)


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "map.db"
    stored(path)
    stored(path, "again", shift=0.1)
    return path


def run(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(map_group, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output
    return result.output


def exported(database: Path, ending: str, *options: object) -> Path:
    out = database.parent / f"gallery{ending}"
    run("export", f"{database}:gallery", out, *options)
    return out


def test_points_come_back_from_ply_and_pcd(database: Path) -> None:
    expected = cloud(load_map(database, "gallery")[1])
    assert len(expected) > 1000
    found = trimesh.load(exported(database, ".ply")).vertices
    np.testing.assert_allclose(found, expected, atol=1e-6)
    found = PointCloud.from_path(exported(database, ".pcd")).numpy(("x", "y", "z"))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def octomap_cells(path: Path) -> np.ndarray:
    """Centres of occupied cells as OctoMap's own program reads them, shape (n, 3)."""
    if shutil.which("bt2vrml") is None and not os.environ.get("ROBOMINER_SLAM_CI"):
        pytest.skip("octomap-tools is not installed: apt-get install octomap-tools")
    subprocess.run(["bt2vrml", str(path)], check=True, capture_output=True, timeout=60)
    text = Path(f"{path}.wrl").read_text()
    found = re.findall(r"translation (\S+) (\S+) (\S+)", text)
    return np.array(found, dtype=np.float64).reshape(-1, 3)


def test_octomaps_own_program_reads_the_cells(database: Path) -> None:
    points = cloud(load_map(database, "gallery")[1])
    expected = np.unique(np.floor(points / 0.03).astype(int), axis=0)
    found = octomap_cells(exported(database, ".bt", "--octree-cell", 0.03))
    cells = np.unique(np.rint(found / 0.03 - 0.5).astype(int), axis=0)
    np.testing.assert_array_equal(cells, expected)


@settings(max_examples=5, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-3200, 3200)] * 3), min_size=1, max_size=40))
def test_any_cells_come_back_from_an_octomap(places: list[tuple[float, float, float]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cells.bt"
        path.write_bytes(octomap.binary_tree(np.array(places), 0.1))
        found = octomap_cells(path)
    expected = np.unique(np.floor(np.array(places) / 0.1).astype(int), axis=0)
    np.testing.assert_array_equal(np.unique(np.rint(found / 0.1 - 0.5).astype(int), axis=0), expected)


def test_places_out_of_an_octrees_reach_are_told(database: Path) -> None:
    with pytest.raises(octomap.OctomapSizeError, match="farther than 32"):
        octomap.binary_tree(np.array([[0.0, 40.0, 0.0]]), 0.001)
    assert octomap.binary_tree(np.zeros((0, 3)), 0.1).endswith(b"size 0\nres 0.1\ndata\n")


def test_a_geotiff_lies_where_the_map_has_it(database: Path) -> None:
    grid = height_grid(cloud(load_map(database, "gallery")[1]), CELL)
    with tifffile.TiffFile(exported(database, ".tif")) as file:
        tags, heights = file.geotiff_metadata, file.asarray()
    assert tags["ModelPixelScale"] == [CELL, CELL, 0.0]
    np.testing.assert_allclose(tags["ModelTiepoint"][3:5], [grid.origin[0], grid.origin[1] + CELL * len(grid.height)])
    found = np.where(heights == -9999.0, np.nan, heights)[::-1]
    np.testing.assert_allclose(found, grid.height, atol=1e-5)


def test_the_picture_is_one(database: Path) -> None:
    with Image.open(exported(database, ".png")) as image:
        assert image.size == (1200, 900)
        assert len(image.convert("RGB").getcolors(1 << 20)) > 100


def test_ros_reads_the_grid(database: Path) -> None:
    out = exported(database, ".yaml", "--cell", 0.05)
    described = yaml.safe_load(out.read_text())
    grid = height_grid(cloud(load_map(database, "gallery")[1]), 0.05)
    assert described["resolution"] == 0.05
    assert described["origin"] == pytest.approx([*grid.origin, 0.0])
    # As map_server reads it: p = (255 - grey) / 255 against the two thresholds.
    with Image.open(out.parent / described["image"]) as image:
        p = (255 - np.asarray(image)[::-1].astype(float)) / 255
    cells = np.select([p > described["occupied_thresh"], p < described["free_thresh"]], [100, 0], -1)
    np.testing.assert_array_equal(cells, occupancy(grid, 0.04))
    assert set(np.unique(cells)) == {-1, 0, 100}


def test_trajectory_and_graph_come_back(database: Path) -> None:
    saved = load_map(database, "gallery")[1]
    trajectory = file_interface.read_tum_trajectory_file(exported(database, ".tum"))
    np.testing.assert_allclose(trajectory.poses_se3, saved.poses, atol=1e-8)
    np.testing.assert_allclose(trajectory.timestamps, [STAMP * 1e-9 + 2 * k for k in range(3)])
    graph, values = gtsam.readG2o(str(exported(database, ".g2o")), True)
    assert (graph.size(), values.size()) == (3, 3)
    for key, T in enumerate(saved.poses):
        np.testing.assert_allclose(values.atPose3(key).matrix(), T, atol=1e-9)


def test_info_and_diff_tell_what_is_there(database: Path) -> None:
    told = json.loads(run("info", database, "--json"))
    assert [(entry["name"], entry["keyframes"], entry["loop_closures"]) for entry in told["maps"]] == [
        ("gallery", 3, 1),
        ("again", 3, 1),
    ]
    assert "gallery" in run("info", database)
    figures = json.loads(run("diff", f"{database}:gallery", f"{database}:again", "--json"))
    assert (figures["keyframes_common"], figures["keyframes_only_second"]) == (3, 0)
    assert figures["moved_m_max"] == pytest.approx(0.1, abs=1e-6)
    assert figures["cells_only_first"] > 0
    assert json.loads(run("diff", database, database, "--json"))["height_m_rms"] == 0.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("export", "{db}:gallery", "map.xyz"), "expected an ending of .ply"),
        (("export", "{db}:gallery", "map.tif", "--cell", "0"), "expected 0.001 to 10 m"),
        (("export", "{db}:gallery", "/nowhere/map.ply"), "cannot be written"),
    ],
)
def test_mistakes_are_told_in_one_line(database: Path, arguments: tuple[str, ...], said: str) -> None:
    output = run(*(text.format(db=database) for text in arguments), code=2)
    assert said in output


def test_a_map_without_touches_is_a_file_too() -> None:
    assert point_files.ply(np.zeros((0, 3))).endswith(b"end_header\n")
    head, _, data = point_files.pcd(np.zeros((0, 3))).partition(b"DATA binary\n")
    assert (b"POINTS 0" in head, data) == (True, b"")
