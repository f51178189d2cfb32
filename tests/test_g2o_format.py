"""g2o's text format: what is read, what is written, and what is said about broken files."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from robominer_slam import geometry as g
from robominer_slam.slam.g2o_format import G2oFormatError, G2oGraph, format_g2o, parse_g2o

PLANE = """\
# a triangle
VERTEX_SE2 10 0 0 0
VERTEX_SE2 7 1.5 -2 0.25

VERTEX_SE2 30 1 1 3
FIX 7
EDGE_SE2 10 7 1.5 -2 0.25 1 2 3 4 5 6
EDGE_SE2 7 30 0.5 0.25 -1 10 0 0 10 0 20   # the second side
"""
SPACE = """\
VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 2 3 0 0 1 1
EDGE_SE3:QUAT 0 1 1 2 3 0.5 0.5 0.5 0.5 {information}
""".format(information=" ".join(str(k) for k in range(1, 22)))

finite = st.floats(-1e6, 1e6)


def test_reads_a_graph_in_the_plane():
    graph = parse_g2o(PLANE)
    assert graph.dim == 2
    np.testing.assert_array_equal(graph.ids, [10, 7, 30])
    np.testing.assert_array_equal(graph.poses[1], [1.5, -2.0, 0.25])
    np.testing.assert_array_equal(graph.i, [0, 1])
    np.testing.assert_array_equal(graph.j, [1, 2])
    np.testing.assert_array_equal(graph.information[0], [[1, 2, 3], [2, 4, 5], [3, 5, 6]])
    np.testing.assert_array_equal(graph.measurements[1], [0.5, 0.25, -1.0])
    assert graph.fixed == (1,)


def test_reads_a_graph_in_space_and_normalises_its_quaternions():
    graph = parse_g2o(SPACE)
    assert graph.dim == 3
    np.testing.assert_allclose(g.yaw_of(graph.poses[1]), np.pi / 2.0)
    np.testing.assert_array_equal(graph.poses[1, :3, 3], [1.0, 2.0, 3.0])
    Omega = graph.information[0]
    np.testing.assert_array_equal(Omega, Omega.T)
    np.testing.assert_array_equal(Omega[0], [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(np.diag(Omega), [1, 7, 12, 16, 19, 21])


@given(
    poses=arrays(np.float64, (3, 3), elements=finite),
    measurements=arrays(np.float64, (2, 3), elements=finite),
    triangle=arrays(np.float64, (2, 3, 3), elements=finite),
)
def test_what_is_written_in_the_plane_is_read_back_to_the_bit(poses, measurements, triangle):
    information = triangle + np.swapaxes(triangle, 1, 2)
    graph = G2oGraph(2, np.array([5, 1, 9]), poses, np.array([0, 1]), np.array([1, 2]), measurements, information, (2,))
    back = parse_g2o(format_g2o(graph))
    for name in ("ids", "poses", "i", "j", "measurements", "information"):
        np.testing.assert_array_equal(getattr(back, name), getattr(graph, name))
    assert back.fixed == (2,)


def test_what_is_written_in_space_is_read_back_to_rounding():
    rng = np.random.default_rng(0)
    poses = g.se3_exp(rng.normal(size=(50, 6)) * 3.0)
    A = rng.normal(size=(49, 6, 6))
    graph = G2oGraph(3, np.arange(50), poses, np.arange(49), np.arange(1, 50), poses[1:], A + np.swapaxes(A, 1, 2))
    back = parse_g2o(format_g2o(graph))
    np.testing.assert_allclose(back.poses, graph.poses, atol=1e-14)
    np.testing.assert_allclose(back.measurements, graph.measurements, atol=1e-14)
    np.testing.assert_array_equal(back.information, graph.information)
    assert back.fixed == ()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("VERTEX_SE2 0 0 0 0\nVERTEX_XY 1 0 0\n", r"map\.g2o, line 2: tag 'VERTEX_XY' is not known; expected one of"),
        ("VERTEX_SE2 0 0 0\n", r"map\.g2o, line 1: VERTEX_SE2 has 3 fields; expected 4"),
        ("VERTEX_SE2 0 0 0 left\n", r"map\.g2o, line 1: VERTEX_SE2: could not convert .*'left'"),
        ("VERTEX_SE2 0 0 0 nan\n", r"map\.g2o, line 1: VERTEX_SE2: a number is not finite"),
        ("VERTEX_SE2 a 0 0 0\n", r"map\.g2o, line 1: VERTEX_SE2: node number 'a' is not an integer"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 0 0 0\n", r"map\.g2o, line 2: node 0 stands here for the second time"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 0 0 0\nVERTEX_SE2 0 0 0 0\n", r"line 3: node 0 .* second time"),
        (PLANE + "EDGE_SE2 10 8 0 0 0 1 0 0 1 0 1\n", r"map\.g2o, line 9: EDGE_SE2: node 8 has no VERTEX line"),
        (PLANE + "EDGE_SE2 10 10 0 0 0 1 0 0 1 0 1\n", r"map\.g2o, line 9: the edge joins node 10 with itself"),
        (PLANE + "EDGE_SE2 10 7 0 0 0 1 0 0 1 0\n", r"map\.g2o, line 9: EDGE_SE2 has 10 fields; expected 11"),
        (PLANE + "FIX 11\n", r"map\.g2o, line 9: FIX: node 11 has no VERTEX line"),
        (PLANE + SPACE, r"map\.g2o, line 9: VERTEX_SE3:QUAT in a graph that began with VERTEX_SE2"),
        ("VERTEX_SE3:QUAT 4 0 0 0 0 0 0 0\n", r"map\.g2o, line 1: .*the quaternion is zero"),
        ("# nothing\n", r"map\.g2o: no node"),
        ("", r"map\.g2o: no node"),
    ],
)
def test_a_broken_file_is_told_by_line(text, message):
    with pytest.raises(G2oFormatError, match=message):
        parse_g2o(text, "map.g2o")


def test_a_graph_without_edges_is_a_graph():
    graph = parse_g2o("VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1\n")
    assert graph.information.shape == (0, 6, 6)
    assert graph.measurements.shape == (0, 4, 4)
    assert parse_g2o(format_g2o(graph)).ids.tolist() == [3]


@pytest.mark.shared_data
def test_public_files_survive_a_round_trip(shared_data):
    for name in ("MIT.g2o", "smallGrid3D.g2o"):
        graph = parse_g2o((shared_data / "pose_graphs" / name).read_text(), name)
        back = parse_g2o(format_g2o(graph), name)
        np.testing.assert_allclose(back.poses, graph.poses, atol=1e-13)
        np.testing.assert_array_equal(back.information, graph.information)
        np.testing.assert_array_equal(back.i, graph.i)
