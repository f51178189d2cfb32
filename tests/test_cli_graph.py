"""`robominer-slam graph optimize` as a user calls it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from robominer_slam.cli.graph import graph
from robominer_slam.slam.g2o_format import G2oGraph, format_g2o, parse_g2o
from robominer_slam.slam.pose_graph import PoseGraph
from tests.pose_graph_problems import PUBLIC_OPTIMA, grid_3d, ring


def as_text(pose_graph: PoseGraph) -> str:
    i, j = pose_graph.edge_nodes.T
    return format_g2o(
        G2oGraph(
            dim=pose_graph.dim,
            ids=np.arange(pose_graph.node_count),
            poses=pose_graph.poses,
            i=i,
            j=j,
            measurements=pose_graph.edge_measurements,
            information=pose_graph.edge_information,
        )
    )


def invoke(*arguments: object):
    return CliRunner().invoke(graph, [str(argument) for argument in arguments])


@pytest.mark.parametrize("make", [ring, grid_3d])
@pytest.mark.parametrize("convention", ["gtsam", "g2o"])
def test_json_has_chi2_in_both_conventions_and_the_file_has_the_poses(tmp_path, make, convention):
    source, out = tmp_path / "in.g2o", tmp_path / "out.g2o"
    source.write_text(as_text(make()))
    done = invoke("optimize", source, "--out", out, "--json", "--convention", convention)
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    assert figures["convention"] == convention
    assert figures["converged"] is True
    assert figures["iterations"] >= 1
    assert figures["seconds"] > 0.0
    content = parse_g2o(out.read_text())
    again = PoseGraph(content.dim)
    again.add_nodes(content.poses)
    again.add_edges(content.i, content.j, content.measurements, content.information)
    before = make()
    for name in ("gtsam", "g2o"):
        assert figures["chi2_before"][name] == pytest.approx(before.chi2(name), rel=1e-9)
        assert figures["chi2_after"][name] == pytest.approx(again.chi2(name), rel=1e-9)
    other = "g2o" if convention == "gtsam" else "gtsam"
    less = json.loads(invoke("optimize", source, "--json", "--convention", other).stdout)["chi2_after"][convention]
    assert figures["chi2_after"][convention] <= less * (1.0 + 1e-9)


def test_people_get_a_table(tmp_path):
    source = tmp_path / "in.g2o"
    source.write_text(as_text(ring()))
    done = invoke("optimize", source)
    assert done.exit_code == 0
    assert "40 poses, 59 edges, 2D" in done.stdout
    assert "iterations" in done.stdout


def test_fix_lines_hold_other_nodes_than_the_first(tmp_path):
    source, out = tmp_path / "in.g2o", tmp_path / "out.g2o"
    text = as_text(ring())
    source.write_text(text + "FIX 20\n")
    assert invoke("optimize", source, "--out", out).exit_code == 0
    before, after = parse_g2o(text), parse_g2o(out.read_text())
    np.testing.assert_array_equal(after.poses[20], before.poses[20])
    assert np.abs(after.poses[0] - before.poses[0]).max() > 1e-3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("VERTEX_SE2 0 0 0 0\nLANDMARK 1 2\n", "in.g2o, line 2: tag 'LANDMARK' is not known"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 0 0 0\n", "in.g2o: node 1 is not joined to a fixed node"),
        (
            "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 0 0 0\nEDGE_SE2 0 1 0 0 0 -1 0 0 1 0 1\n",
            "in.g2o: information matrix 0 of those given is not symmetric and positive",
        ),
        ("", "in.g2o: no node"),
    ],
)
def test_a_file_that_cannot_be_used_is_one_clear_line_and_exit_code_2(tmp_path, text, message):
    source = tmp_path / "in.g2o"
    source.write_text(text)
    done = invoke("optimize", source, "--json")
    assert done.exit_code == 2
    assert message in done.stderr
    assert done.stdout == ""


def test_a_binary_file_a_missing_file_and_a_missing_folder_are_usage_errors(tmp_path):
    source = tmp_path / "in.g2o"
    assert invoke("optimize", source).exit_code == 2
    source.write_bytes(b"\xff\xfe\x00")
    done = invoke("optimize", source)
    assert done.exit_code == 2
    assert "not a text file" in done.stderr
    source.write_text(as_text(ring()))
    done = invoke("optimize", source, "--out", tmp_path / "nowhere" / "out.g2o")
    assert done.exit_code == 2
    assert "cannot be written" in done.stderr


def test_a_search_that_is_cut_short_says_so_with_exit_code_1(tmp_path):
    source = tmp_path / "in.g2o"
    source.write_text(as_text(grid_3d()))
    done = invoke("optimize", source, "--json", "--max-iterations", 1)
    assert done.exit_code == 1
    assert "not converged after 1 iterations" in done.stderr
    assert json.loads(done.stdout)["converged"] is False


def test_help_has_an_example():
    assert "Example: robominer-slam graph optimize" in invoke("optimize", "--help").stdout


@pytest.mark.shared_data
@pytest.mark.parametrize("convention", ["gtsam", "g2o"])
def test_public_graph_reaches_its_published_optimum(shared_data, tmp_path, convention):
    out = tmp_path / "out.g2o"
    done = invoke(
        "optimize", shared_data / "pose_graphs" / "intel.g2o", "--out", out, "--json", "--convention", convention
    )
    assert done.exit_code == 0
    expected = PUBLIC_OPTIMA["intel.g2o"][0 if convention == "gtsam" else 1]
    assert json.loads(done.stdout)["chi2_after"][convention] == pytest.approx(expected, rel=1e-6)
    assert parse_g2o(out.read_text()).ids.size == 1728
