"""Rigid motions: steps, exponential, adjoint and inverse, mirrored, reversed, and as a group."""

from types import SimpleNamespace

import hypothesis
import numpy as np
from geometry_values import ad, steps
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from mdnvo_jax import geometry as geo


def test_step_is_a_translation_column_and_a_rotation_vector(lib: SimpleNamespace) -> None:
    step = steps(5)
    T = lib.step_to_matrix(step)
    np.testing.assert_allclose(T[:, :3, 3], step[:, :3], rtol=1e-14)
    np.testing.assert_allclose(T[:, :3, :3], Rotation.from_rotvec(step[:, 3:]).as_matrix(), atol=1e-14)
    np.testing.assert_array_equal(T[:, 3], [[0, 0, 0, 1]] * 5)
    np.testing.assert_allclose(lib.matrix_to_step(T), step, rtol=1e-12)


def test_exponential_of_se3_agrees_with_the_matrix_exponential(lib: SimpleNamespace) -> None:
    small = np.concatenate([np.ones((3, 3)), np.array([[0, 0, 0], [1e-160, 0, 0], [0, 1e-7, 0]])], axis=-1)
    xi = np.concatenate([steps(6), small])
    T = lib.exp_se3(xi)
    generator = np.zeros((len(xi), 4, 4))
    generator[:, :3, :3], generator[:, :3, 3] = geo.hat(xi[:, 3:]), xi[:, :3]
    np.testing.assert_allclose(T, expm(generator), atol=1e-14)
    np.testing.assert_allclose(lib.log_se3(T), xi, rtol=1e-11, atol=1e-15)


def test_adjoint_moves_a_perturbation_to_the_left(lib: SimpleNamespace) -> None:
    T, xi = geo.exp_se3(steps(1)[0]), steps(1, seed=1)[0]
    left = lib.exp_se3(lib.adjoint(T) @ xi)
    np.testing.assert_allclose(left, T @ geo.exp_se3(xi) @ geo.inverse(T), atol=1e-13)
    np.testing.assert_allclose(lib.adjoint(lib.exp_se3(xi)), expm(ad(xi)), atol=1e-13)


def test_inverse_and_compose(lib: SimpleNamespace) -> None:
    T = lib.step_to_matrix(steps(4))
    np.testing.assert_allclose(lib.inverse(T), np.linalg.inv(T), atol=1e-14)
    np.testing.assert_allclose(lib.compose(T[0], T[1]), T[0] @ T[1], rtol=1e-14)


def camera_film(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """What each camera sees: directions of world points `[P, 3]` in its axes, `[N, P, 3]`."""
    seen = np.einsum("nji,npj->npi", poses[:, :3, :3], points[None] - poses[:, None, :3, 3])
    return seen / np.linalg.norm(seen, axis=-1, keepdims=True)


def test_mirrored_step_explains_the_mirrored_film() -> None:
    """The mirrored film, x to -x in every image, is the film of a mirrored world: its steps must reproduce it."""
    step = steps(5, size=0.3)
    points = np.random.default_rng(3).normal(size=(20, 3)) * 5
    film = camera_film(geo.accumulate(geo.step_to_matrix(step)), points)
    mirrored = camera_film(geo.accumulate(geo.step_to_matrix(geo.mirror_step(step))), points * [-1, 1, 1])
    np.testing.assert_allclose(mirrored, film * [-1, 1, 1], atol=1e-12)
    S = np.diag([-1.0, 1, 1, 1])
    np.testing.assert_allclose(geo.step_to_matrix(geo.mirror_step(step)), S @ geo.step_to_matrix(step) @ S, atol=1e-14)
    np.testing.assert_array_equal(geo.mirror_step(geo.mirror_step(step)), step)


def test_reversed_step_is_the_inverse(lib: SimpleNamespace) -> None:
    step = steps(5)
    T = lib.step_to_matrix(lib.reverse_step(step))
    np.testing.assert_allclose(T, np.linalg.inv(geo.step_to_matrix(step)), atol=1e-13)
    poses = geo.accumulate(geo.step_to_matrix(step))
    backwards = geo.matrix_to_step(geo.relative_steps(poses[::-1]))
    np.testing.assert_allclose(geo.reverse_step(step)[::-1], backwards, rtol=1e-10)


COORDINATES = hnp.arrays(np.float64, 6, elements=st.floats(-1.5, 1.5))


@hypothesis.settings(max_examples=100, deadline=None, derandomize=True)
@hypothesis.given(COORDINATES, COORDINATES, COORDINATES)
def test_motions_are_a_group(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    A, B, C = (geo.step_to_matrix(step) for step in (a, b, c))
    np.testing.assert_allclose(geo.compose(geo.compose(A, B), C), geo.compose(A, geo.compose(B, C)), atol=1e-13)
    np.testing.assert_allclose(geo.inverse(geo.compose(A, B)), geo.compose(geo.inverse(B), geo.inverse(A)), atol=1e-13)
    np.testing.assert_allclose(geo.adjoint(geo.compose(A, B)), geo.adjoint(A) @ geo.adjoint(B), atol=1e-12)
    np.testing.assert_allclose(geo.exp_se3(geo.log_se3(A)), A, atol=1e-13)
    # The mirror of a composition is the composition of mirrors.
    mirrored = geo.compose(*(geo.step_to_matrix(geo.mirror_step(step)) for step in (a, b)))
    together = geo.mirror_step(geo.matrix_to_step(geo.compose(A, B)))
    np.testing.assert_allclose(mirrored, geo.step_to_matrix(together), atol=1e-13)
