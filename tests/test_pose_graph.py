"""Pose graph: Jacobians against finite differences, minima and covariances against GTSAM, robust kernels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from robominer_slam import geometry as g
from robominer_slam.slam import pose_graph_residuals as residuals
from robominer_slam.slam.dense_system import DenseSystem
from robominer_slam.slam.g2o_format import parse_g2o
from robominer_slam.slam.linear_system import solution
from robominer_slam.slam.pose_graph import PoseGraph, PoseGraphError
from robominer_slam.slam.pose_graph_optimizer import (
    Kernels,
    OptimizationOptions,
    edge_costs,
    minimise,
    normal_equations,
)
from robominer_slam.slam.pose_graph_residuals import EdgeArrays
from robominer_slam.slam.pose_graph_system import normal_system
from robominer_slam.slam.robust_kernels import KERNEL_NAMES, kernel_code, robust_cost_and_weight
from robominer_slam.slam.sparse_system import SparseSystem
from tests.pose_graph_problems import (
    MADE_GRAPHS,
    PUBLIC_OPTIMA,
    ROTATION_FIRST,
    compose,
    exp,
    grid_3d,
    gtsam_optimum,
    import_gtsam,
    invert,
    log,
    random_information,
    ring,
)


class TestJacobians:
    @pytest.mark.parametrize("dim", [2, 3])
    @pytest.mark.parametrize("convention", ["gtsam", "g2o"])
    @pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-3, 0.3, 1.0])
    def test_error_slopes_are_derivatives(self, dim, convention, scale):
        rng = np.random.default_rng(0)
        d = 3 if dim == 2 else 6
        E = exp(dim, scale * rng.normal(size=(30, d)))
        e = residuals.error_vectors(dim, E, convention)
        analytic = residuals.error_slopes(dim, E, e, convention)
        h = 1e-6
        numeric = np.stack(
            [
                residuals.error_vectors(dim, compose(dim, E, exp(dim, h * row)), convention)
                - residuals.error_vectors(dim, compose(dim, E, exp(dim, -h * row)), convention)
                for row in np.eye(d)
            ],
            axis=-1,
        ) / (2.0 * h)
        np.testing.assert_allclose(analytic, numeric, atol=1e-7)

    @pytest.mark.parametrize("make", MADE_GRAPHS.values(), ids=MADE_GRAPHS)
    @pytest.mark.parametrize("convention", ["gtsam", "g2o"])
    def test_gradient_of_the_whole_graph_is_the_derivative_of_half_its_cost(self, make, convention):
        graph = make()
        dim, poses, n = graph.dim, graph.poses, graph.node_count
        d = 3 if dim == 2 else 6
        Z_inverse = invert(dim, graph.edge_measurements)
        edges = EdgeArrays(dim, *graph.edge_nodes.T, Z_inverse, graph.edge_information)
        m = graph.edge_count
        kernels = Kernels(np.full(m, kernel_code("cauchy"), np.int8), np.full(m, 2.0))
        fixed = np.arange(n) == 0
        system = normal_system(edges.i, edges.j, fixed, d)
        pivot = residuals.positions(dim, poses).mean(axis=0)
        costs = edge_costs(edges, kernels, poses, convention)
        gradient, _ = normal_equations(edges, costs, poses, pivot, system, convention)
        h = 1e-6
        for place in (0, n // 2, n - 2):
            for component in range(d):
                steps = np.zeros((n, d))
                steps[system.free_nodes[place], component] = h
                up = edge_costs(edges, kernels, residuals.perturbed(dim, poses, steps, pivot), convention).cost
                down = edge_costs(edges, kernels, residuals.perturbed(dim, poses, -steps, pivot), convention).cost
                numeric = (up - down) / (4.0 * h)
                assert gradient[place, component] == pytest.approx(numeric, rel=1e-5, abs=1e-6 * np.abs(gradient).max())

    @pytest.mark.parametrize("System", [DenseSystem, SparseSystem])
    @pytest.mark.parametrize("dim", [2, 3])
    def test_assembled_matrix_is_the_sum_over_edges_made_one_by_one(self, dim, System):
        graph = MADE_GRAPHS["ring" if dim == 2 else "grid_3d"]()
        d, n, m = (3 if dim == 2 else 6), graph.node_count, graph.edge_count
        i, j = graph.edge_nodes.T
        fixed = np.zeros(n, dtype=bool)
        fixed[[0, 7]] = True
        system = System(i, j, fixed, d)
        blocks = random_information(np.random.default_rng(1), m, d)
        H = np.zeros((n, d, n, d))
        for k in range(m):
            H[i[k], :, i[k]] += blocks[k]
            H[j[k], :, j[k]] += blocks[k]
            H[i[k], :, j[k]] -= blocks[k]
            H[j[k], :, i[k]] -= blocks[k]
        size = system.free_nodes.size * d
        H = H[system.free_nodes][:, :, system.free_nodes].reshape(size, size)
        right = np.random.default_rng(2).normal(size=(system.free_nodes.size, d))
        x = solution(system.factorise(blocks), right)
        np.testing.assert_allclose(x.ravel(), np.linalg.solve(H, right.ravel()), rtol=1e-9, atol=1e-12)


class TestDenseAndSparse:
    @pytest.mark.parametrize("make", MADE_GRAPHS.values(), ids=MADE_GRAPHS)
    @pytest.mark.parametrize(
        ("convention", "kernel", "held"), [("gtsam", None, [0]), ("g2o", "huber", [0, 5]), ("gtsam", "cauchy", [3, 9])]
    )
    def test_both_find_the_same_poses_in_the_same_steps(self, make, convention, kernel, held):
        graph = make()
        edges = EdgeArrays(
            graph.dim, *graph.edge_nodes.T, invert(graph.dim, graph.edge_measurements), graph.edge_information
        )
        kernels = Kernels(np.full(graph.edge_count, kernel_code(kernel), np.int8), np.full(graph.edge_count, 2.0))
        fixed = np.zeros(graph.node_count, dtype=bool)
        fixed[held] = True
        options = OptimizationOptions(convention=convention, relative_tolerance=1e-10)
        dense, sparse = (
            minimise(edges, kernels, graph.poses, System(edges.i, edges.j, fixed, 3 if graph.dim == 2 else 6), options)
            for System in (DenseSystem, SparseSystem)
        )
        assert np.abs(sparse.poses - graph.poses).max() > 0.1, "the start is so near that the test shows nothing"
        assert dense.converged
        assert dense.iterations == sparse.iterations
        np.testing.assert_allclose(dense.poses, sparse.poses, atol=1e-9)
        np.testing.assert_allclose(dense.after.weights, sparse.after.weights, atol=1e-9)


class TestAgainstGtsam:
    @pytest.mark.parametrize("make", MADE_GRAPHS.values(), ids=MADE_GRAPHS)
    def test_reaches_the_same_minimum(self, make):
        graph = make()
        poses, chi2, _ = gtsam_optimum(graph)
        before = graph.chi2()
        result = graph.optimize(OptimizationOptions(relative_tolerance=1e-12))
        assert result.converged
        assert result.chi2_before == pytest.approx(before)
        assert result.chi2_before > 1.5 * chi2, "the start is so near that the test shows nothing"
        assert result.chi2_after == pytest.approx(chi2, rel=1e-9)
        assert graph.chi2() == pytest.approx(chi2, rel=1e-9)
        apart = log(graph.dim, compose(graph.dim, invert(graph.dim, poses), graph.poses))
        np.testing.assert_allclose(apart, 0.0, atol=1e-5)

    @pytest.mark.parametrize("make", MADE_GRAPHS.values(), ids=MADE_GRAPHS)
    def test_default_tolerance_is_good_to_a_millionth(self, make):
        graph = make(seed=3)
        _, chi2, _ = gtsam_optimum(graph)
        assert graph.optimize().chi2_after == pytest.approx(chi2, rel=1e-6)

    @pytest.mark.parametrize("make", MADE_GRAPHS.values(), ids=MADE_GRAPHS)
    def test_marginal_and_joint_covariances(self, make):
        gtsam = import_gtsam()
        graph = make()
        _, _, (factors, optimum) = gtsam_optimum(graph)
        graph.optimize(OptimizationOptions(relative_tolerance=1e-13))
        last = graph.node_count - 1
        marginals = gtsam.Marginals(factors, optimum)
        order = slice(None) if graph.dim == 2 else np.ix_(ROTATION_FIRST, ROTATION_FIRST)
        ours = graph.marginal_covariance([last, 0, 5])
        scale = np.abs(ours[0]).max()
        np.testing.assert_allclose(ours[0], marginals.marginalCovariance(last)[order], atol=1e-5 * scale)
        np.testing.assert_allclose(ours[2], marginals.marginalCovariance(5)[order], atol=1e-5 * scale)
        np.testing.assert_array_equal(ours[1], 0.0)

    @pytest.mark.shared_data
    @pytest.mark.parametrize("convention", ["gtsam", "g2o"])
    @pytest.mark.parametrize("name", PUBLIC_OPTIMA)
    def test_public_data_sets(self, shared_data, name, convention):
        content = parse_g2o((shared_data / "pose_graphs" / name).read_text(), name)
        graph = PoseGraph(content.dim)
        graph.add_nodes(content.poses)
        graph.add_edges(content.i, content.j, content.measurements, content.information)
        result = graph.optimize(OptimizationOptions(convention=convention))
        optimum = PUBLIC_OPTIMA[name][0 if convention == "gtsam" else 1]
        assert result.converged
        assert result.chi2_after == pytest.approx(optimum, rel=1e-6)
        assert graph.chi2(convention) == pytest.approx(result.chi2_after, rel=1e-9)


class TestRobustKernels:
    @pytest.mark.parametrize("name", KERNEL_NAMES)
    @pytest.mark.parametrize("width", [0.5, 3.0])
    def test_cost_is_the_integral_of_the_weight(self, name, width):
        codes, widths = np.array([kernel_code(name)], np.int8), np.array([width])

        def at(s):
            cost, weight = robust_cost_and_weight(np.array([s]), codes, widths)
            return cost[0], weight[0]

        assert at(0.0) == (0.0, 1.0)
        for s in (0.5 * width**2, width**2, 4.0 * width**2, 50.0):
            integral = quad(lambda x: at(x)[1], 0.0, s, points=[min(s, width**2)])[0]
            assert at(s)[0] == pytest.approx(integral, rel=1e-8)
            assert 0.0 < at(s)[1] <= 1.0

    @pytest.mark.parametrize("kernel", ["cauchy", "dcs", "geman-mcclure"])
    def test_a_false_loop_is_outvoted(self, kernel):
        clean = ring()
        clean.optimize()
        robust, plain = ring(), ring()
        false = [
            graph.add_edge(3, 13, np.zeros(3), 2500.0 * np.eye(3), kind="loop", kernel=name, kernel_width=1.0)
            for graph, name in ((robust, kernel), (plain, None))
        ]
        result = robust.optimize()
        plain.optimize()
        apart = np.abs(robust.poses[:, :2] - clean.poses[:, :2]).max()
        assert apart < 0.02
        assert np.abs(plain.poses[:, :2] - clean.poses[:, :2]).max() > 0.5, "the false loop does no harm"
        assert result.converged
        assert result.weights[false[0]] < 0.01
        np.testing.assert_array_equal(result.weights[: false[0]], 1.0)
        assert result.cost_after < result.chi2_after

    def test_a_true_loop_keeps_its_weight(self):
        graph = ring()
        edge = graph.add_edge(2, 22, np.zeros(3), 400.0 * np.eye(3), kind="loop", kernel="dcs", kernel_width=2.0)
        assert graph.optimize().weights[edge] > 0.9

    def test_an_unknown_kernel_is_refused_with_the_choice(self):
        with pytest.raises(PoseGraphError, match="'tukey' is not known; expected one of none, huber"):
            ring().add_edge(0, 1, np.zeros(3), np.eye(3), kernel="tukey")


class TestGraph:
    def test_a_disabled_edge_counts_for_nothing_and_can_come_back(self):
        graph, without = ring(), ring()
        edge = graph.add_edge(3, 13, np.zeros(3), 2500.0 * np.eye(3), kind="loop")
        graph.set_edge_enabled(edge, False)
        result = graph.optimize()
        without.optimize()
        np.testing.assert_allclose(graph.poses, without.poses, atol=1e-9)
        assert result.weights[edge] == 0.0
        assert graph.chi2() == pytest.approx(without.chi2())
        graph.set_edge_enabled([edge], True)
        assert graph.optimize().chi2_after > 10.0 * without.chi2()

    @pytest.mark.parametrize("make", MADE_GRAPHS.values(), ids=MADE_GRAPHS)
    def test_the_first_pose_stays_to_the_bit(self, make):
        graph = make()
        first = graph.poses[0].copy()
        graph.optimize()
        np.testing.assert_array_equal(graph.poses[0], first)

    def test_nodes_fixed_on_purpose_stay_and_pull_the_others(self):
        graph = ring()
        poses = graph.poses
        poses[39, :2] += 1.0
        graph.poses = poses
        graph.fix([0, 39])
        graph.optimize()
        np.testing.assert_array_equal(graph.poses[[0, 39]], poses[[0, 39]])
        np.testing.assert_array_equal(graph.marginal_covariance([39])[0], 0.0)

    def test_the_minimum_does_not_depend_on_where_the_map_lies(self):
        near, far = ring(), ring()
        away = np.array([4.0e5, -6.0e5, 2.0])
        far.poses = g.se2_compose(away, far.poses)
        assert far.optimize().chi2_after == pytest.approx(near.optimize().chi2_after, rel=1e-6)
        np.testing.assert_allclose(g.se2_compose(g.se2_inverse(away), far.poses)[:, :2], near.poses[:, :2], atol=1e-5)

    def test_growing_gives_the_same_minimum_as_all_at_once(self):
        whole = ring()
        growing = PoseGraph(2)
        growing.add_node(whole.poses[0])
        measurements, ends = whole.edge_measurements, whole.edge_nodes
        for m in range(whole.edge_count):
            i, j = ends[m]
            if j == growing.node_count:
                growing.add_node(g.se2_compose(growing.poses[i], measurements[m]))
            growing.add_edge(i, j, measurements[m], whole.edge_information[m])
            growing.optimize()
        whole.optimize(OptimizationOptions(relative_tolerance=1e-12))
        growing.optimize(OptimizationOptions(relative_tolerance=1e-12))
        np.testing.assert_allclose(growing.poses, whole.poses, atol=1e-6)

    def test_the_same_graph_gives_the_same_poses_to_the_bit(self):
        one, two = grid_3d(), grid_3d()
        one.optimize()
        two.optimize()
        np.testing.assert_array_equal(one.poses, two.poses)

    def test_a_single_node_or_perfect_edges_need_no_iteration(self):
        graph = PoseGraph(3)
        graph.add_node(np.eye(4))
        assert graph.optimize().converged
        np.testing.assert_array_equal(graph.marginal_covariance([0]), np.zeros((1, 6, 6)))
        Z = g.se3_exp([0.3, -0.2, 0.1, 0.5, 0.4, -0.3])
        graph.add_node(Z)
        graph.add_edge(0, 1, Z, np.eye(6))
        result = graph.optimize()
        assert (result.converged, result.iterations) == (True, 0)

    def test_relative_covariance_of_a_chain_is_that_of_its_edge(self):
        graph = PoseGraph(3)
        Z = g.se3_exp([0.3, -0.2, 0.1, 0.5, 0.4, -0.3])
        information = random_information(np.random.default_rng(0), 3, 6)
        pose = np.eye(4)
        graph.add_node(pose)
        for k in range(3):
            pose = pose @ Z
            graph.add_node(pose)
            graph.add_edge(k, k + 1, Z, information[k])
        np.testing.assert_allclose(graph.relative_covariance(1, 2), np.linalg.inv(information[1]), atol=1e-12)

    def test_what_was_put_in_comes_out(self):
        graph = ring()
        assert graph.edge_kinds[:19] == ("odometry",) * 19
        assert graph.edge_kinds[-1] == "loop"
        k = int(graph.add_edges([1, 2], [5, 6], np.array([[1.0, 2.0, 3.0], [4.0, 5.0, -1.0]]), [np.eye(3)] * 2)[1])
        np.testing.assert_array_equal(graph.edge_nodes[k], [2, 6])
        np.testing.assert_allclose(graph.edge_measurements[k], [4.0, 5.0, -1.0], atol=1e-14)
        assert graph.edge_enabled.all()

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda graph: graph.add_edge(0, 99, np.zeros(3), np.eye(3)), "joins nodes 0 and 99"),
            (lambda graph: graph.add_edge(4, 4, np.zeros(3), np.eye(3)), "two different ones"),
            (lambda graph: graph.add_edge(0, 1, np.zeros(6), np.eye(3)), "shape"),
            (lambda graph: graph.add_edge(0, 1, np.full(3, np.nan), np.eye(3)), "not a finite pose"),
            (lambda graph: graph.add_edge(0, 1, np.zeros(3), -np.eye(3)), "not symmetric and positive"),
            (lambda graph: graph.add_edge(0, 1, np.zeros(3), np.triu(np.ones((3, 3)))), "not symmetric and positive"),
            (lambda graph: graph.add_edge(0, 1, np.zeros(3), np.eye(3), kernel="dcs", kernel_width=0.0), "width"),
            (lambda graph: graph.fix([]), "cannot fix"),
            (lambda graph: graph.fix([40]), "cannot fix"),
            (lambda graph: (graph.add_node(np.zeros(3)), graph.optimize()), "node 40 is not joined"),
            (
                lambda graph: (graph.set_edge_enabled(0, False), graph.fix([1]), graph.optimize()),
                "node 0 is not joined",
            ),
        ],
    )
    def test_what_cannot_be_is_refused_with_the_reason(self, change, message):
        graph = ring(per_turn=40, turns=1)
        with pytest.raises(PoseGraphError, match=message):
            change(graph)

    def test_a_mirror_is_no_rotation(self):
        with pytest.raises(PoseGraphError, match="proper rotation"):
            PoseGraph(3).add_node(np.diag([1.0, 1.0, -1.0, 1.0]))

    def test_information_of_too_low_rank_is_an_error_and_no_pose(self):
        graph = PoseGraph(2)
        graph.add_nodes(np.zeros((2, 3)))
        graph.add_edge(0, 1, np.array([1.0, 0.0, 0.0]), np.diag([1.0, 0.0, 0.0]))
        with pytest.raises(PoseGraphError, match="full rank"):
            graph.optimize()

    def test_iterations_are_bounded(self):
        result = grid_3d().optimize(OptimizationOptions(max_iterations=2))
        assert (result.iterations, result.converged) == (2, False)

    @pytest.mark.parametrize(
        "wrong", [{"convention": "ceres"}, {"max_iterations": 0}, {"relative_tolerance": -1.0}], ids=str
    )
    def test_impossible_options_are_refused(self, wrong):
        with pytest.raises(ValueError, match="expected"):
            OptimizationOptions(**wrong)
