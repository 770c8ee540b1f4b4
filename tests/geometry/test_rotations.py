"""Rotations against scipy, near zero and near pi."""

from types import SimpleNamespace

import numpy as np
import pytest
from geometry_values import AXES, NEAR_PI, VECTORS, numerical_jacobian, steps
from scipy.spatial.transform import Rotation

from mdnvo_jax import geometry as geo


def test_hat_is_the_cross_product(lib: SimpleNamespace) -> None:
    a, b = steps(2)[:, :3]
    np.testing.assert_allclose(lib.hat(a) @ b, np.cross(a, b), rtol=1e-14)


def test_rotations_agree_with_scipy(lib: SimpleNamespace) -> None:
    R = lib.exp_so3(VECTORS)
    np.testing.assert_allclose(R, Rotation.from_rotvec(VECTORS).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(R @ R.swapaxes(-1, -2), np.broadcast_to(np.eye(3), R.shape), atol=2e-15)
    # 1e-160 squared is still a number, 1e-300 squared is not: it may round to zero, no more.
    np.testing.assert_allclose(lib.log_so3(R), VECTORS, rtol=1e-9, atol=1e-15)
    # Small rotations keep all their digits, relative to themselves.
    np.testing.assert_allclose(lib.log_so3(lib.exp_so3(1e-9 * AXES)), 1e-9 * AXES, rtol=1e-14)


@pytest.mark.parametrize("angle", NEAR_PI)
def test_logarithm_near_pi(angle: float, lib: SimpleNamespace) -> None:
    R = lib.exp_so3(angle * AXES)
    vector = lib.log_so3(R)
    np.testing.assert_allclose(np.linalg.norm(vector, axis=-1), angle, rtol=1e-12)
    # Either sign of the axis is right at pi.
    sign = np.sign((vector * AXES).sum(-1, keepdims=True))
    np.testing.assert_allclose(vector * sign, angle * AXES, atol=1e-9)
    if angle < np.pi - 1e-9:
        assert (sign == 1).all()


def test_angles_beyond_pi_come_back_as_the_shorter_way() -> None:
    long = 4.0 * AXES
    np.testing.assert_allclose(geo.log_so3(geo.exp_so3(long)), (4 - 2 * np.pi) * AXES, rtol=1e-12)


def test_quaternions_agree_with_scipy(lib: SimpleNamespace) -> None:
    vectors = np.concatenate([VECTORS, *(angle * AXES for angle in NEAR_PI[:3])])
    R = lib.exp_so3(vectors)
    quaternion = lib.quaternion_from_matrix(R)
    np.testing.assert_allclose(quaternion, Rotation.from_rotvec(vectors).as_quat(canonical=False), atol=2e-15)
    assert (quaternion[..., 3] >= 0).all()
    # Of any length and sign.
    np.testing.assert_allclose(lib.matrix_from_quaternion(quaternion * -3.0), R, atol=4e-15)


def test_nearest_rotation(lib: SimpleNamespace) -> None:
    R = geo.exp_so3(VECTORS)
    # The nearest rotation to R S, S positive definite, is R: the polar decomposition.
    root = np.random.default_rng(0).normal(size=(len(R), 3, 3))
    np.testing.assert_allclose(lib.project_to_so3(R @ (np.eye(3) + root @ root.swapaxes(-1, -2))), R, atol=1e-12)
    reflected = lib.project_to_so3(R * np.array([1.0, 1.0, -0.5]))
    np.testing.assert_allclose(np.linalg.det(reflected), 1, rtol=1e-12)


@pytest.mark.parametrize("angle", [0, 1e-5, 0.5, 0.99, 1.01, 3, 4])
def test_right_jacobian_by_its_definition(angle: float, lib: SimpleNamespace) -> None:
    vector = angle * AXES[3]
    defined = numerical_jacobian(lambda r: geo.log_so3(geo.exp_so3(-vector) @ geo.exp_so3(r)), vector)
    found = lib.right_jacobian_so3(vector)
    np.testing.assert_allclose(found, defined, atol=1e-9)
    np.testing.assert_allclose(lib.right_jacobian_inverse_so3(vector) @ found, np.eye(3), atol=1e-13)
