"""Geometry against scipy's Rotation, matrix exponentials and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from robominer_slam import geometry as g

#: Angles that have broken implementations: zero, tiny, where series meet closed forms, near and at pi.
ANGLES = [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 0.4999, 0.5, 0.5001, 1.0, 2.5, 3.1, np.pi - 1e-7, np.pi - 1e-13]

numbers = st.floats(-10.0, 10.0)
vectors = arrays(np.float64, 3, elements=numbers)
angles = st.one_of(st.sampled_from(ANGLES), st.floats(0.0, np.pi - 1e-9))
directions = arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)).filter(lambda v: np.linalg.norm(v) > 1e-3)


def random_twists(angle: float, count: int = 20, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return np.concatenate([rng.normal(size=(count, 3)) * 3.0, axis * angle], axis=1)


def differences(function, d: int, h: float = 1e-6) -> np.ndarray:
    """Central differences of function(delta) at delta = 0, columns per component."""
    return np.stack([(function(h * row) - function(-h * row)) / (2.0 * h) for row in np.eye(d)], axis=-1)


def twist_matrix(xi: np.ndarray) -> np.ndarray:
    out = np.zeros((4, 4))
    out[:3, :3] = g.hat(xi[3:])
    out[:3, 3] = xi[:3]
    return out


class TestRotations:
    @given(axis=directions, angle=angles)
    def test_exponential_and_logarithm_agree_with_scipy(self, axis, angle):
        w = axis / np.linalg.norm(axis) * angle
        R = g.so3_exp(w)
        np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=1e-14)
        np.testing.assert_allclose(g.so3_log(R), w, atol=1e-12)

    @given(axis=directions)
    def test_logarithm_of_a_half_turn_is_a_half_turn_about_the_same_line(self, axis):
        n = axis / np.linalg.norm(axis)
        R = 2.0 * np.outer(n, n) - np.eye(3)
        w = g.so3_log(R)
        np.testing.assert_allclose(np.linalg.norm(w), np.pi, atol=1e-12)
        np.testing.assert_allclose(g.so3_exp(w), R, atol=1e-12)

    @given(q=arrays(np.float64, 4, elements=numbers).filter(lambda q: np.linalg.norm(q) > 1e-3))
    def test_quaternions_agree_with_scipy_at_any_length(self, q):
        R = g.quaternion_to_matrix(q)
        np.testing.assert_allclose(R, Rotation.from_quat(q).as_matrix(), atol=1e-13)
        back = g.matrix_to_quaternion(R)
        assert back[3] >= 0.0
        np.testing.assert_allclose(back, g.matrix_to_quaternion(R[None])[0], atol=1e-14)
        unit = q / np.linalg.norm(q)
        assert min(np.abs(back - unit).max(), np.abs(back + unit).max()) < 1e-13

    @pytest.mark.parametrize("q", [[0.0, 0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 1.0]])
    def test_a_quaternion_that_is_no_rotation_is_refused(self, q):
        with pytest.raises(ValueError, match="zero or not finite"):
            g.quaternion_to_matrix(q)

    @given(rpy=st.tuples(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1)))
    def test_roll_pitch_yaw_agree_with_scipy(self, rpy):
        R = g.matrix_from_rpy(rpy)
        np.testing.assert_allclose(R, Rotation.from_euler("ZYX", rpy[::-1]).as_matrix(), atol=1e-14)
        np.testing.assert_allclose(g.rpy_of(R), rpy, atol=1e-9)
        np.testing.assert_allclose(g.yaw_of(R), rpy[2], atol=1e-9)

    @pytest.mark.parametrize("angle", ANGLES)
    def test_left_jacobian_is_the_derivative_of_the_exponential(self, angle):
        w = random_twists(angle)[:, 3:]
        R_transposed = np.swapaxes(g.so3_exp(w), -1, -2)
        numeric = differences(lambda d: g.so3_log(g.so3_exp(w + d) @ R_transposed), 3)
        np.testing.assert_allclose(g.so3_left_jacobian(w), numeric, atol=1e-8)
        np.testing.assert_allclose(
            g.so3_left_jacobian(w) @ g.so3_left_jacobian_inverse(w), np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-13
        )


class TestWrapAngle:
    @given(st.floats(-1e4, 1e4))
    def test_stays_in_range_and_keeps_the_direction(self, angle):
        wrapped = float(g.wrap_angle(angle))
        assert -np.pi < wrapped <= np.pi
        np.testing.assert_allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(angle), np.sin(angle)], atol=1e-11)

    @given(st.floats(-np.pi, np.pi, exclude_min=True))
    def test_angles_inside_stay_as_they_are_to_the_bit(self, angle):
        assert float(g.wrap_angle(angle)) == angle

    @pytest.mark.parametrize("turns", [-1.0, 1.0, 3.0, -5.0])
    def test_half_turns_become_pi(self, turns):
        for angle in (turns * np.pi, np.nextafter(turns * np.pi, np.sign(turns) * np.inf)):
            assert abs(float(g.wrap_angle(angle))) == pytest.approx(np.pi, abs=1e-14)
        assert float(g.wrap_angle(turns * np.pi)) == np.pi


class TestMotionsInSpace:
    @given(axis=directions, angle=angles, v=vectors)
    def test_exponential_is_the_matrix_exponential(self, axis, angle, v):
        xi = np.concatenate([v, axis / np.linalg.norm(axis) * angle])
        np.testing.assert_allclose(g.se3_exp(xi), expm(twist_matrix(xi)), atol=1e-12)

    @given(axis=directions, angle=angles, v=vectors)
    def test_logarithm_undoes_the_exponential(self, axis, angle, v):
        xi = np.concatenate([v, axis / np.linalg.norm(axis) * angle])
        np.testing.assert_allclose(g.se3_log(g.se3_exp(xi)), xi, atol=1e-11)

    @given(axis=directions, angle=angles, v=vectors)
    def test_inverse_and_vector7_round_trip(self, axis, angle, v):
        T = g.se3_exp(np.concatenate([v, axis / np.linalg.norm(axis) * angle]))
        np.testing.assert_allclose(g.inverse(T) @ T, np.eye(4), atol=1e-13)
        np.testing.assert_allclose(g.from_vector7(g.to_vector7(T)), T, atol=1e-13)
        np.testing.assert_allclose(g.to_vector7(T)[:3], T[:3, 3])

    def test_pose_matrix_moves_points_as_scipy_does(self):
        rng = np.random.default_rng(1)
        q, t, p = rng.normal(size=(5, 4)), rng.normal(size=(5, 3)), rng.normal(size=(5, 7, 3))
        expected = np.stack([Rotation.from_quat(q[k]).apply(p[k]) + t[k] for k in range(5)])
        np.testing.assert_allclose(g.transform_points(g.pose_matrix(t, q), p), expected, atol=1e-14)
        np.testing.assert_allclose(g.transform_points(g.pose_matrix(t[0], q[0]), p[0]), expected[0], atol=1e-14)

    def test_normalising_makes_a_rotation_again(self):
        T = g.se3_exp(random_twists(1.0))
        T[:, :3, :3] += 1e-7 * np.random.default_rng(2).normal(size=(20, 3, 3))
        R = g.normalise_pose(T)[:, :3, :3]
        np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-15)
        np.testing.assert_allclose(R, T[:, :3, :3], atol=1e-6)

    @pytest.mark.parametrize("angle", ANGLES[:-1])
    def test_right_and_left_jacobians_are_derivatives(self, angle):
        xi = random_twists(angle)
        inverse_T = g.inverse(g.se3_exp(xi))
        right = differences(lambda d: g.se3_log(inverse_T @ g.se3_exp(xi + d)), 6)
        left = differences(lambda d: g.se3_log(g.se3_exp(xi + d) @ inverse_T), 6)
        np.testing.assert_allclose(g.se3_right_jacobian(xi), right, atol=5e-8)
        np.testing.assert_allclose(g.se3_left_jacobian(xi), left, atol=5e-8)

    @pytest.mark.parametrize("angle", ANGLES)
    def test_inverse_jacobians_invert(self, angle):
        xi = random_twists(angle)
        identity = np.broadcast_to(np.eye(6), (20, 6, 6))
        np.testing.assert_allclose(g.se3_right_jacobian(xi) @ g.se3_right_jacobian_inverse(xi), identity, atol=1e-12)
        np.testing.assert_allclose(g.se3_left_jacobian(xi) @ g.se3_left_jacobian_inverse(xi), identity, atol=1e-12)

    def test_adjoint_carries_twists_across_a_pose(self):
        T, xi = g.se3_exp(random_twists(1.3, seed=3)), random_twists(0.7, seed=4)
        carried = (g.se3_adjoint(T) @ xi[..., None])[..., 0]
        np.testing.assert_allclose(T @ g.se3_exp(xi) @ g.inverse(T), g.se3_exp(carried), atol=1e-12)


class TestMotionsInThePlane:
    @given(v=vectors, angle=st.one_of(angles, angles.map(lambda a: -a)))
    def test_agree_with_motions_in_space(self, v, angle):
        xi = np.array([v[0], v[1], angle])
        in_space = g.se3_exp([v[0], v[1], 0.0, 0.0, 0.0, angle])
        np.testing.assert_allclose(g.T_from_xyyaw(g.se2_exp(xi)), in_space, atol=1e-13)
        np.testing.assert_allclose(g.xyyaw_of(in_space), g.se2_exp(xi), atol=1e-13)
        np.testing.assert_allclose(g.se2_log(g.se2_exp(xi)), xi, atol=1e-12)

    @given(a=vectors, b=vectors)
    def test_compose_and_invert_as_matrices_do(self, a, b):
        T = g.T_from_xyyaw(a) @ g.T_from_xyyaw(b)
        np.testing.assert_allclose(g.T_from_xyyaw(g.se2_compose(a, b)), T, atol=1e-13)
        np.testing.assert_allclose(g.T_from_xyyaw(g.se2_inverse(a)), g.inverse(g.T_from_xyyaw(a)), atol=1e-13)

    @pytest.mark.parametrize("angle", ANGLES[:-1])
    def test_jacobians_are_derivatives(self, angle):
        xi = random_twists(0.0)[:, :3]
        xi[:, 2] = angle
        inverse_pose = g.se2_inverse(g.se2_exp(xi))
        numeric = differences(lambda d: g.se2_log(g.se2_compose(inverse_pose, g.se2_exp(xi + d))), 3)
        np.testing.assert_allclose(g.se2_right_jacobian(xi), numeric, atol=5e-8)
        identity = np.broadcast_to(np.eye(3), (20, 3, 3))
        np.testing.assert_allclose(g.se2_right_jacobian(xi) @ g.se2_right_jacobian_inverse(xi), identity, atol=1e-12)

    def test_adjoint_carries_twists_across_a_pose(self):
        rng = np.random.default_rng(5)
        pose, xi = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
        carried = (g.se2_adjoint(pose) @ xi[..., None])[..., 0]
        moved = g.se2_compose(g.se2_compose(pose, g.se2_exp(xi)), g.se2_inverse(pose))
        np.testing.assert_allclose(moved, g.se2_exp(carried), atol=1e-12)


def test_functions_work_on_one_pose_and_on_any_leading_axes():
    xi = random_twists(1.0, count=6).reshape(2, 3, 6)
    T = g.se3_exp(xi)
    assert T.shape == (2, 3, 4, 4)
    for function, argument in [(g.se3_log, T), (g.to_vector7, T), (g.inverse, T), (g.rpy_of, T), (g.se3_adjoint, T),
                               (g.se3_right_jacobian, xi), (g.so3_exp, xi[..., 3:])]:  # fmt: skip
        batched = function(argument)
        np.testing.assert_allclose(batched[1, 2], function(argument[1, 2]), atol=1e-14)
