"""True loops told from wrong ones: the tests it rests on, made graphs, public ones, and the command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2 as chi2_distribution

from benchmarks.false_loops import agreeing, optimum, pose_graph, position_rmse, scattered
from robominer_slam import geometry as g
from robominer_slam.cli.graph import graph as graph_command
from robominer_slam.slam import loop_consistency as consistency
from robominer_slam.slam.g2o_format import G2oGraph, format_g2o, parse_g2o
from robominer_slam.slam.loop_consistency import Innovations, Loops, innovations, leave_one_out
from robominer_slam.slam.loop_pairs import chain_odometry, clusters, neighbouring_pairs, pair_innovations
from robominer_slam.slam.pose_graph import OptimizationOptions, PoseGraph, PoseGraphError
from robominer_slam.slam.robust_optimizer import optimize_robustly
from tests.pose_graph_problems import MADE_GRAPHS, compose, exp, grid_3d, invert, log, ring


def content_of(graph: PoseGraph) -> G2oGraph:
    i, j = graph.edge_nodes.T
    return G2oGraph(
        dim=graph.dim,
        ids=np.arange(graph.node_count),
        poses=graph.poses,
        i=i,
        j=j,
        measurements=graph.edge_measurements,
        information=graph.edge_information,
    )


def loops_of(graph: PoseGraph) -> tuple[np.ndarray, Loops]:
    edges = np.flatnonzero(np.abs(np.diff(graph.edge_nodes, axis=1)[:, 0]) != 1)
    i, j = graph.edge_nodes[edges].T
    covariance = np.linalg.inv(graph.edge_information[edges])
    return edges, Loops(graph.dim, i, j, graph.edge_measurements[edges], covariance)


MADE = {"ring": content_of(ring()), "grid_3d": content_of(grid_3d())}


class TestRelativeCovariances:
    @pytest.mark.parametrize("make", MADE_GRAPHS.values(), ids=MADE_GRAPHS)
    def test_many_pairs_at_once_are_as_one_by_one(self, make):
        graph = make()
        graph.optimize()
        last = graph.node_count - 1
        pairs = [(0, 7), (7, 0), (3, last), (last, last - 1)] * 20
        together = graph.relative_covariances(pairs)
        one_by_one = [graph.relative_covariance(i, j) for i, j in pairs]
        np.testing.assert_allclose(together, one_by_one, rtol=1e-6, atol=1e-12)

    @pytest.mark.parametrize("make", MADE_GRAPHS.values(), ids=MADE_GRAPHS)
    def test_random_draws_come_close_and_repeat(self, make):
        graph = make()
        graph.optimize()
        pairs = [(0, 7), (3, graph.node_count - 1)]
        drawn = graph.relative_covariances(pairs, samples=3000, seed=1)
        exact = graph.relative_covariances(pairs)
        scale = np.sqrt(np.einsum("kaa,kbb->kab", exact, exact))
        np.testing.assert_allclose(drawn / scale, exact / scale, atol=0.1)
        np.testing.assert_array_equal(drawn, graph.relative_covariances(pairs, samples=3000, seed=1))


class TestInnovations:
    @pytest.mark.parametrize("make", MADE_GRAPHS.values(), ids=MADE_GRAPHS)
    def test_leave_one_out_is_what_leaving_out_gives(self, make):
        graph = make(noise=0.03)
        graph.optimize(OptimizationOptions(relative_tolerance=1e-12))
        poses = graph.poses
        edges, loops = loops_of(graph)
        short = leave_one_out(loops, poses, graph.relative_covariances(np.stack([loops.i, loops.j], -1)))
        for k in range(0, edges.size, 5):
            graph.poses = poses
            graph.set_edge_enabled(int(edges[k]), False)
            graph.optimize(OptimizationOptions(relative_tolerance=1e-12))
            P = graph.relative_covariances([(loops.i[k], loops.j[k])])
            one = np.array([k])
            assert short[k] == pytest.approx(innovations(loops[one], graph.poses, P).squared[0], rel=0.1, abs=0.05)
            graph.set_edge_enabled(int(edges[k]), True)

    @pytest.mark.parametrize("d", [3, 6])
    def test_chance_is_the_share_of_wrong_loops_that_pass(self, d):
        rng = np.random.default_rng(0)
        side, count, gate = 4.0, 2_000_000, 9.0
        root = np.diag(np.linspace(0.3, 0.6, d))
        e = rng.uniform(-side / 2.0, side / 2.0, size=(count, d))
        squared = ((e / np.diag(root)) ** 2).sum(axis=1)
        log_det = 2.0 * np.log(np.diag(root)).sum()
        tests = Innovations(d, squared, np.full(count, log_det))
        one, log_volume = tests[np.array([0])], d * np.log(side)
        inside = squared < gate
        assert one.chance(log_volume, gate)[0] == pytest.approx(inside.mean(), rel=0.1)
        threshold = float(one.best_evidence(log_volume)[0]) - 2.5
        passing = inside & (tests.evidence(log_volume) > threshold)
        assert 0 < passing.sum() < inside.sum()
        assert one.chance(log_volume, gate, threshold)[0] == pytest.approx(passing.mean(), rel=0.15)

    @settings(max_examples=30)
    @given(seed=st.integers(0, 10**6), wrong=st.floats(1e-4, 10.0), d=st.sampled_from([3, 6]))
    def test_the_threshold_lets_as_many_wrong_loops_pass_as_allowed(self, seed, wrong, d):
        rng = np.random.default_rng(seed)
        tests = Innovations(d, rng.chisquare(d, 200), rng.uniform(-4.0 * d, 2.0 * d, 200))
        log_volume, gate = 8.0, 25.0
        threshold = consistency.evidence_threshold(tests, log_volume, gate, wrong)
        assert tests.chance(log_volume, gate, threshold).sum() <= wrong * (1.0 + 1e-9)
        if threshold > 0.0:
            assert tests.chance(log_volume, gate, threshold - 0.01).sum() > wrong
        chosen = consistency.convincing(tests, log_volume, gate, wrong)
        assert (tests.squared[chosen] < gate).all()
        assert (tests.evidence(log_volume)[chosen] > threshold).all()

    def test_covariances_too_large_by_a_factor_are_undone(self):
        tests = Innovations(3, np.array([2.0]), np.array([0.7]))
        scaled = tests.with_covariance_times(0.25)
        assert scaled.squared[0] == pytest.approx(8.0)
        assert scaled.log_det[0] == pytest.approx(0.7 + 3.0 * np.log(0.25))


class TestPairs:
    def chain(self, dim, rng, n=60):
        d = 3 if dim == 2 else 6
        step = np.array([0.5, 0.0, 0.1]) if dim == 2 else np.array([0.5, 0.0, 0.05, 0.02, 0.03, 0.1])
        sigma = 0.02 * np.ones(d)
        truth = [np.zeros(3) if dim == 2 else np.eye(4)]
        odometry = [truth[0]]
        for _ in range(n - 1):
            truth.append(compose(dim, truth[-1], exp(dim, step)))
            odometry.append(compose(dim, odometry[-1], exp(dim, step + sigma * rng.normal(size=d))))
        return np.stack(truth), chain_odometry(dim, np.stack(odometry), np.tile(np.diag(sigma**2), (n - 1, 1, 1)))

    def loops(self, dim, truth, rng, i, j):
        d = 3 if dim == 2 else 6
        Z = compose(dim, compose(dim, invert(dim, truth[i]), truth[j]), exp(dim, 0.03 * rng.normal(size=(i.size, d))))
        return Loops(dim, i, j, Z, np.tile(0.03**2 * np.eye(d), (i.size, 1, 1)))

    @pytest.mark.parametrize("dim", [2, 3])
    def test_true_pairs_have_chi2_errors_and_wrong_ones_fail(self, dim):
        d = 3 if dim == 2 else 6
        squared, wrong = [], []
        for seed in range(150):
            rng = np.random.default_rng(seed)
            truth, odometry = self.chain(dim, rng)
            loops = self.loops(dim, truth, rng, np.array([2, 8]), np.array([49, 45]))
            pairs = np.array([[0, 1]])
            squared.append(pair_innovations(loops, odometry, pairs).squared[0])
            Z = loops.Z.copy()
            Z[1] = compose(dim, Z[1], exp(dim, 3.0 * np.eye(d)[0]))
            moved = Loops(dim, loops.i, loops.j, Z, loops.covariance)
            wrong.append(pair_innovations(moved, odometry, pairs).squared[0])
        assert np.mean(squared) == pytest.approx(d, rel=0.25)
        assert np.quantile(wrong, 0.1) > chi2_distribution.ppf(0.999, d)

    @settings(max_examples=25)
    @given(seed=st.integers(0, 10**6), dim=st.sampled_from([2, 3]), which=st.tuples(st.booleans(), st.booleans()))
    def test_a_loop_says_the_same_in_both_directions(self, seed, dim, which):
        rng = np.random.default_rng(seed)
        truth, odometry = self.chain(dim, rng)
        loops = self.loops(dim, truth, rng, np.array([2, 8]), np.array([49, 45]))
        i, j, Z, covariance = loops.i.copy(), loops.j.copy(), loops.Z.copy(), loops.covariance.copy()
        for k in np.flatnonzero(which):
            i[k], j[k] = j[k], i[k]
            Ad = (g.se2_adjoint if dim == 2 else g.se3_adjoint)(Z[k])
            covariance[k] = Ad @ covariance[k] @ Ad.T
            Z[k] = invert(dim, Z[k])
        turned = pair_innovations(Loops(dim, i, j, Z, covariance), odometry, np.array([[0, 1]]))
        same = pair_innovations(loops, odometry, np.array([[0, 1]]))
        np.testing.assert_allclose(turned.squared, same.squared, rtol=1e-6)
        np.testing.assert_allclose(turned.log_det, same.log_det, rtol=1e-6)

    def test_neighbours_have_both_ends_near_and_stretches_apart(self):
        i = np.array([0, 3, 60, 0, 10])
        j = np.array([50, 55, 2, 30, 16])
        loops = Loops(2, i, j, np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1)))
        pairs = {tuple(sorted(pair)) for pair in neighbouring_pairs(loops, 10).tolist()}
        assert pairs == {(0, 1), (0, 2), (1, 2)}
        short = Loops(2, np.array([0, 5]), np.array([4, 9]), np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)))
        assert neighbouring_pairs(short, 10).size == 0

    def test_clusters_follow_the_pairs(self):
        label = clusters(np.array([[0, 2], [2, 4]]), 6)
        assert label[0] == label[2] == label[4]
        assert len({label[0], label[1], label[3], label[5]}) == 4


class TestOptimizer:
    @pytest.mark.parametrize("name", MADE)
    def test_nothing_is_rejected_where_nothing_is_wrong(self, name):
        graph, plain = pose_graph(MADE[name]), pose_graph(MADE[name])
        plain.optimize()
        result = optimize_robustly(graph)
        assert result.accepted.all()
        assert result.optimization.converged
        assert position_rmse(graph.dim, graph.poses, plain.poses) < 1e-3

    @pytest.mark.parametrize("share", [0.3, 0.6])
    @pytest.mark.parametrize("name", MADE)
    def test_scattered_wrong_loops_are_rejected_and_the_true_ones_kept(self, name, share):
        clean = optimum(MADE[name])
        content, wrong = scattered(MADE[name], clean, share, seed=1)
        graph, plain = pose_graph(content), pose_graph(content)
        plain.optimize(OptimizationOptions(max_iterations=30))
        assert position_rmse(graph.dim, plain.poses, clean) > 0.3, "the wrong loops do no harm"
        result = optimize_robustly(graph)
        np.testing.assert_array_equal(graph.edge_enabled, result.accepted)
        assert (result.accepted & wrong).sum() == 0
        assert (~result.accepted & ~wrong).sum() <= 1
        assert position_rmse(graph.dim, graph.poses, clean) < 0.05
        assert (result.optimization.weights[~result.accepted] == 0.0).all()
        assert result.accepted[result.odometry].all()

    @pytest.mark.parametrize("name", MADE)
    def test_the_poses_of_the_file_do_not_matter(self, name):
        content, _ = scattered(MADE[name], optimum(MADE[name]), 0.4, seed=1)
        one, other = pose_graph(content), pose_graph(content)
        poses = one.poses
        poses[1:] = compose(one.dim, poses[1:], exp(one.dim, np.full(3 if one.dim == 2 else 6, 0.8)))
        other.poses = poses
        np.testing.assert_array_equal(optimize_robustly(one).accepted, optimize_robustly(other).accepted)
        apart = log(one.dim, compose(one.dim, invert(one.dim, one.poses), other.poses))
        np.testing.assert_allclose(apart, 0.0, atol=1e-3)

    def test_nodes_may_be_numbered_in_any_order(self):
        content, _ = scattered(MADE["ring"], optimum(MADE["ring"]), 0.4, seed=2)
        place = np.random.default_rng(0).permutation(content.ids.size)
        node = np.argsort(place)
        shuffled = PoseGraph(2)
        shuffled.add_nodes(content.poses[place])
        shuffled.add_edges(node[content.i], node[content.j], content.measurements, content.information)
        shuffled.fix([int(node[0])])
        straight = pose_graph(content)
        np.testing.assert_array_equal(
            optimize_robustly(shuffled, sequence=place).accepted, optimize_robustly(straight).accepted
        )
        np.testing.assert_allclose(shuffled.poses[node], straight.poses, atol=1e-6)

    def test_of_two_sets_that_exclude_each_other_the_larger_one_stays(self):
        clean = optimum(MADE["ring"])
        content, wrong = agreeing(MADE["ring"], clean, seed=1)
        graph = pose_graph(content)
        result = optimize_robustly(graph)
        np.testing.assert_array_equal(result.accepted, ~wrong)
        assert position_rmse(2, graph.poses, clean) < 1e-3

    def test_a_disabled_edge_stays_out(self):
        graph = ring()
        edge = int(np.flatnonzero(np.array(graph.edge_kinds) == "loop")[3])
        graph.set_edge_enabled(edge, False)
        result = optimize_robustly(graph)
        assert not result.accepted[edge]
        assert result.accepted.sum() == graph.edge_count - 1

    def test_loops_far_better_than_stated_still_expose_a_wrong_one_within_the_stated_noise(self):
        graph = ring(noise=0.002)
        loops = [k for k, kind in enumerate(graph.edge_kinds) if kind == "loop"]
        loose = PoseGraph(2)
        loose.add_nodes(graph.poses)
        i, j = graph.edge_nodes.T
        loose.add_edges(i, j, graph.edge_measurements, 0.01 * graph.edge_information)
        wrong = loose.add_edge(5, 28, [0.9, 0.9, 0.9], 25.0 * np.eye(3))
        result = optimize_robustly(loose)
        assert result.noise < 0.1
        assert result.accepted[loops].all()
        assert not result.accepted[wrong]

    def test_a_new_loop_is_judged_by_the_accepted_ones(self):
        graph = ring()
        optimize_robustly(graph)
        Z = g.se2_compose(g.se2_inverse(graph.poses[4]), graph.poses[31])
        P = graph.relative_covariances([(4, 31)] * 2)
        off = g.se2_compose(Z, [0.5, 0.0, 0.0])
        new = Loops(2, np.full(2, 4), np.full(2, 31), np.stack([Z, off]), np.tile(4e-4 * np.eye(3), (2, 1, 1)))
        good, bad = innovations(new, graph.poses, P).squared
        assert good < 1e-6
        assert bad > chi2_distribution.ppf(0.9999, 3)

    @pytest.mark.parametrize(
        ("change", "arguments", "message"),
        [
            (lambda graph: graph.set_edge_enabled(7, False), {}, "no odometry between nodes"),
            (lambda _: None, {"wrong_loops": 0.0}, "above 0"),
            (lambda _: None, {"sequence": np.zeros(40, int)}, "each place once"),
            (lambda graph: graph.add_edge(1, 9, np.zeros(3), np.diag([1.0, 1.0, 0.0])), {}, "full rank"),
        ],
    )
    def test_what_cannot_be_judged_is_refused_with_the_reason(self, change, arguments, message):
        graph = ring()
        change(graph)
        with pytest.raises(PoseGraphError, match=message):
            optimize_robustly(graph, **arguments)

    def test_a_chain_without_loops_is_only_optimised(self):
        graph = PoseGraph(2)
        graph.add_nodes(np.zeros((3, 3)))
        graph.add_edges([0, 1], [1, 2], [[1.0, 0.0, 0.1]] * 2, [np.eye(3)] * 2)
        assert optimize_robustly(graph).accepted.all()
        np.testing.assert_allclose(graph.poses[1], [1.0, 0.0, 0.1], atol=1e-9)


class TestPublicGraphs:
    @pytest.mark.shared_data
    @pytest.mark.parametrize(
        ("name", "share", "limit"),
        [
            ("intel", 0.5, 0.05),
            ("M3500", 0.1, 0.05),
            ("smallGrid3D", 0.0, 0.1),
            ("smallGrid3D", 0.7, 0.1),
            ("intel", None, 0.05),
            ("smallGrid3D", None, 0.1),
        ],
    )
    def test_the_map_is_that_of_the_true_loops(self, shared_data, name, share, limit):
        clean = parse_g2o((shared_data / "pose_graphs" / f"{name}.g2o").read_text(), name)
        reference = optimum(clean)
        content, wrong = agreeing(clean, reference, 1) if share is None else scattered(clean, reference, share, 0)
        graph = pose_graph(content)
        result = optimize_robustly(graph)
        assert position_rmse(clean.dim, graph.poses, reference) < limit
        assert (result.accepted & wrong).sum() <= 1
        assert (~result.accepted & ~wrong).sum() <= 3


class TestCommand:
    def invoke(self, *arguments: object):
        return CliRunner().invoke(graph_command, [str(argument) for argument in arguments])

    @pytest.mark.parametrize("convention", ["gtsam", "g2o"])
    @pytest.mark.parametrize("name", MADE)
    def test_the_file_keeps_all_nodes_and_only_the_accepted_edges(self, tmp_path, name, convention):
        source, out = tmp_path / "in.g2o", tmp_path / "out.g2o"
        content, wrong = scattered(MADE[name], optimum(MADE[name]), 0.4, seed=3)
        if name == "grid_3d" and convention == "g2o":  # its rotation errors are half angles
            double = np.repeat([1.0, 2.0], 3)
            content = replace(content, information=content.information * double[:, None] * double)
        # Any numbers, backwards: nodes whose numbers follow each other are joined by odometry.
        content = replace(content, ids=100 + 3 * content.ids[::-1])
        source.write_text(format_g2o(content))
        done = self.invoke("optimize", source, "--out", out, "--json", "--robust", "--convention", convention)
        assert done.exit_code == 0, done.output
        figures, written = json.loads(done.stdout), parse_g2o(out.read_text())
        np.testing.assert_array_equal(written.ids, content.ids)
        assert figures["loops"] == figures["accepted_loops"] + figures["rejected_loops"]
        assert written.i.size == figures["edges"] - figures["rejected_loops"]
        assert set(np.flatnonzero(wrong)) <= set(figures["rejected_edges"])
        assert len(figures["rejected"]) == figures["rejected_loops"] <= wrong.sum() + 1
        for edge, pair in zip(figures["rejected_edges"], figures["rejected"], strict=True):
            assert pair == [content.ids[content.i[edge]], content.ids[content.j[edge]]]
        assert pose_graph(written).chi2(convention) == pytest.approx(figures["chi2_after"][convention], rel=1e-9)

    def test_without_the_flag_every_edge_counts(self, tmp_path):
        source, out = tmp_path / "in.g2o", tmp_path / "out.g2o"
        content, _ = scattered(MADE["ring"], optimum(MADE["ring"]), 0.2, seed=4)
        source.write_text(format_g2o(content))
        figures = json.loads(self.invoke("optimize", source, "--out", out, "--json").stdout)
        assert "rejected" not in figures
        assert parse_g2o(out.read_text()).i.size == content.i.size

    def test_people_see_how_many_loops_were_rejected(self, tmp_path):
        source = tmp_path / "in.g2o"
        content, wrong = scattered(MADE["ring"], optimum(MADE["ring"]), 0.3, seed=5)
        source.write_text(format_g2o(content))
        done = self.invoke("optimize", source, "--robust")
        assert done.exit_code == 0
        assert f"{wrong.sum()} of {wrong.sum() + 20} loops rejected" in done.stdout

    def test_a_gap_in_the_odometry_is_a_usage_error(self, tmp_path):
        source = tmp_path / "in.g2o"
        content = MADE["ring"]
        source.write_text("\n".join(k for k in format_g2o(content).splitlines() if not k.startswith("EDGE_SE2 4 5 ")))
        done = self.invoke("optimize", source, "--robust")
        assert done.exit_code == 2
        assert "no odometry between nodes 4 and 5" in done.stderr

    def test_help_says_how(self):
        assert "--robust" in self.invoke("optimize", "--help").stdout
