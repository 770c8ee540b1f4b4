"""Rigid motions against scipy, against each other, at zero and at pi, and covariances against Monte Carlo."""

import functools
import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from mdnvo_jax import geometry as geo

# Rotation vectors where formulas change branch, lose digits, or divide zero by zero.
AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 2, 3], [3, -2, 1], [-1, -1, -1], [1, 1, -5]], np.float64)
AXES /= np.linalg.norm(AXES, axis=-1, keepdims=True)
ANGLES = np.array([0, 1e-300, 1e-160, 1e-12, 1e-6, 1e-3, 0.1, 0.199, 0.201, 0.999, 1.001, 2, 3, np.pi - 1e-3])
NEAR_PI = np.pi - np.array([1e-6, 1e-8, 1e-12, 0])
VECTORS = (ANGLES[:, None, None] * AXES).reshape(-1, 3)


@pytest.fixture
def x64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@functools.cache
def compiled(name: str) -> Callable[..., np.ndarray]:
    function = jax.jit(getattr(geo, name), static_argnames=["order"] if name == "propagate_covariance" else [])
    return lambda *arguments, **options: np.asarray(function(*arguments, **options))


@pytest.fixture(params=["numpy", "jax"])
def lib(request: pytest.FixtureRequest, x64: None) -> object:
    """The module as numpy arrays find it, then as JAX compiles it, both in float64."""
    if request.param == "numpy":
        return geo
    names = [name for name, member in vars(geo).items() if inspect.isfunction(member) and not name.startswith("_")]
    return SimpleNamespace(**{name: compiled(name) for name in names})


def steps(count: int, seed: int = 0, size: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 6)) * size


def ad(xi: np.ndarray) -> np.ndarray:
    phi, rho = geo.hat(xi[3:]), geo.hat(xi[:3])
    return np.block([[phi, rho], [np.zeros((3, 3)), phi]])


# Rotations.


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


def numerical_jacobian(function: Callable, at: np.ndarray, step: float = 1e-5) -> np.ndarray:
    columns = [(function(at + step * e) - function(at - step * e)) / (2 * step) for e in np.eye(at.shape[-1])]
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("angle", [0, 1e-5, 0.5, 0.99, 1.01, 3, 4])
def test_right_jacobian_by_its_definition(angle: float, lib: SimpleNamespace) -> None:
    vector = angle * AXES[3]
    defined = numerical_jacobian(lambda r: geo.log_so3(geo.exp_so3(-vector) @ geo.exp_so3(r)), vector)
    found = lib.right_jacobian_so3(vector)
    np.testing.assert_allclose(found, defined, atol=1e-9)
    np.testing.assert_allclose(lib.right_jacobian_inverse_so3(vector) @ found, np.eye(3), atol=1e-13)


# Gradients: exact, at zero too.


def is_finite(tree: object) -> bool:
    return all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("angle", [0, 1e-160, 1e-9, 1e-4, 0.2, 0.9999999, 1.0000001, 3.0])
def test_gradient_of_the_exponential_is_exact(angle: float, x64: None) -> None:
    """d/dr_i exp(r) = exp(r) hat(J_r(r) e_i), with J_r from scipy's matrix exponential, not from our series."""
    vector = angle * AXES[3]
    found = jax.jit(jax.jacfwd(geo.exp_so3))(jnp.asarray(vector))
    generator = np.asarray(geo.hat(vector))
    # J_r(r) = integral of exp(-s hat(r)) over s in [0, 1]: a block of a larger matrix exponential (Van Loan).
    right = expm(np.block([[-generator, np.eye(3)], [np.zeros((3, 6))]]))[:3, 3:]
    expected = np.einsum("ab,ibc->aci", expm(generator), geo.hat(right.T))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("angle", [0, 1e-160, 1e-9, 1e-4, 0.199, 0.201, 1.5, 3.0])
def test_gradient_of_the_logarithm_is_exact(angle: float, x64: None) -> None:
    """log(exp(r)) is r, so its Jacobian is the identity, through both functions' branches."""
    vector = jnp.asarray(angle * AXES[4])
    round_trip = jax.jit(jax.jacrev(lambda r: geo.log_so3(geo.exp_so3(r))))
    np.testing.assert_allclose(round_trip(vector), np.eye(3), atol=1e-11)


def test_gradients_are_finite_everywhere() -> None:
    """In float32, at zero, at pi, in between, of everything that is differentiable."""
    angles = np.array([0, 1e-30, 1e-10, 1e-4, 0.2, 1, 3.1415925, np.pi])
    rotations = (angles[:, None, None] * AXES).reshape(-1, 3)
    vectors = jnp.asarray(np.concatenate([np.ones_like(rotations), rotations], axis=-1), jnp.float32)

    def everything(step: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        T, rotation = geo.step_to_matrix(step), step[..., 3:]
        covariances = jnp.broadcast_to(jnp.eye(6) * 1e-3, (4, 6, 6))
        outputs = {
            "matrix_to_step": geo.matrix_to_step(T),
            "quaternion": geo.matrix_from_quaternion(geo.quaternion_from_matrix(T[..., :3, :3])),
            "exp_se3": geo.exp_se3(step),
            "log_se3": geo.log_se3(T),
            "adjoint": geo.adjoint(geo.inverse(T)),
            "reverse": geo.reverse_step(step),
            "jacobian": geo.right_jacobian_so3(rotation),
            "accumulate": geo.accumulate(T[-4:]),
            "covariance": geo.propagate_covariance(T[:4], covariances, order=2),
        }
        return sum(leaf.sum() for leaf in outputs.values()), outputs

    slope, outputs = jax.jit(jax.grad(everything, has_aux=True))(vectors)
    for name, output in outputs.items():
        assert is_finite(output), name
    assert is_finite(slope)


def test_gradient_at_pi_of_the_logarithm() -> None:
    """Of half turns given as matrices, whose quaternions have w = 0."""
    half_turns = 2 * AXES[:, :, None] * AXES[:, None, :] - np.eye(3)
    slopes = jax.jit(jax.vmap(jax.jacrev(geo.log_so3)))(jnp.asarray(half_turns, jnp.float32))
    assert is_finite(slopes)


# Motions.


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


# Paths.


def test_accumulate_multiplies_from_the_right(lib: SimpleNamespace) -> None:
    T, first = geo.step_to_matrix(steps(3)), geo.step_to_matrix(steps(1, seed=1)[0])
    poses = lib.accumulate(T, first)
    expected = [first, first @ T[0], first @ T[0] @ T[1], first @ T[0] @ T[1] @ T[2]]
    np.testing.assert_allclose(poses, expected, atol=1e-13)
    np.testing.assert_allclose(lib.relative_steps(poses), T, atol=1e-13)
    np.testing.assert_array_equal(lib.accumulate(T)[0], np.eye(4))
    assert lib.accumulate(T[:0]).shape == (1, 4, 4)


def test_batches_of_paths(lib: SimpleNamespace) -> None:
    T = geo.step_to_matrix(steps(10)).reshape(2, 5, 4, 4)
    covariance = np.broadcast_to(np.diag([1.0, 2, 3, 4, 5, 6]) * 1e-2, (2, 5, 6, 6))
    poses = lib.accumulate(T)
    assert poses.shape == (2, 6, 4, 4)
    np.testing.assert_allclose(poses[1], geo.accumulate(T[1]), atol=1e-12)
    for order in (1, 2):
        spread = lib.propagate_covariance(T, covariance, order=order)
        assert spread.shape == (2, 6, 6, 6)
        np.testing.assert_allclose(
            spread[1], geo.propagate_covariance(T[1], covariance[1], order=order), rtol=1e-9, atol=1e-12
        )


@pytest.mark.parametrize("name", [f"{number:02d}" for number in range(11)])
def test_labels_give_the_poses_of_kitti_back(name: str, data_root: Path) -> None:
    lines = np.loadtxt(data_root / "trajectories" / "ground_truth" / f"{name}.txt")
    poses = np.tile(np.eye(4), (len(lines), 1, 1))
    poses[:, :3] = lines.reshape(-1, 3, 4)
    poses[:, :3, :3] = geo.project_to_so3(poses[:, :3, :3])
    # The files carry 7 digits.
    np.testing.assert_allclose(poses[:, :3].reshape(-1, 12), lines, atol=2e-6)
    labels = geo.matrix_to_step(geo.relative_steps(poses))
    back = geo.accumulate(geo.step_to_matrix(labels), poses[0])
    np.testing.assert_allclose(back[:, :3, 3], poses[:, :3, 3], rtol=0, atol=1e-6)
    np.testing.assert_allclose(back[:, :3, :3], poses[:, :3, :3], rtol=0, atol=1e-9)


# Covariances.


def spread_of(T: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Covariance about `mean` of right perturbations of poses `[S, 4, 4]`."""
    xi = geo.log_se3(geo.inverse(mean) @ T)
    return xi.T @ xi / len(xi)


def random_covariance(rng: np.random.Generator, scale: np.ndarray) -> np.ndarray:
    root = rng.normal(size=(6, 9)) / 3
    return (root @ root.T) * scale[:, None] * scale


def test_covariance_of_a_step_becomes_that_of_its_perturbation(lib: SimpleNamespace) -> None:
    rng = np.random.default_rng(0)
    step = np.array([0.1, -0.05, 1.2, 0.3, -0.9, 0.2])
    covariance = random_covariance(rng, np.full(6, 1e-3))
    drawn = rng.multivariate_normal(step, covariance, size=40_000)
    expected = spread_of(geo.step_to_matrix(drawn), geo.step_to_matrix(step))
    found = lib.step_covariance_to_perturbation(step, covariance)
    np.testing.assert_allclose(found, expected, atol=0.03 * np.abs(expected).max())
    # And exactly, by the derivative it stands for.
    T_inverse = geo.inverse(geo.step_to_matrix(step))
    moved = numerical_jacobian(lambda y: geo.log_se3(T_inverse @ geo.step_to_matrix(y)), step)
    np.testing.assert_allclose(found, moved @ covariance @ moved.T, atol=1e-8 * np.abs(expected).max())


def monte_carlo(
    count: int, deviation: np.ndarray, samples: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean steps of a curve, step covariances, covariance of the start, and the covariance found at the end."""
    rng = np.random.default_rng(seed)
    T_steps = geo.step_to_matrix(np.tile([0.0, 0.05, 1.0, 0.02, 0.25, -0.01], (count, 1)))
    covariances = np.stack([random_covariance(rng, deviation) for _ in range(count)])
    initial = random_covariance(rng, deviation)
    T = geo.exp_se3(rng.multivariate_normal(np.zeros(6), initial, size=samples))
    for step, covariance in zip(T_steps, covariances, strict=True):
        T = T @ step @ geo.exp_se3(rng.multivariate_normal(np.zeros(6), covariance, size=samples))
    return T_steps, covariances, initial, spread_of(T, geo.accumulate(T_steps)[-1])


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    """Of covariances, in units of the expected standard deviations."""
    deviation = np.sqrt(np.diag(expected))
    return float(np.abs((found - expected) / deviation[:, None] / deviation).max())


def test_small_noise_agrees_with_monte_carlo(lib: SimpleNamespace) -> None:
    deviation = np.array([0.02, 0.03, 0.05, 0.004, 0.01, 0.006])
    T_steps, covariances, initial, expected = monte_carlo(6, deviation, samples=40_000)
    for order in (1, 2):
        found = lib.propagate_covariance(T_steps, covariances, order=order, initial=initial)
        np.testing.assert_array_equal(found[0], (initial + initial.T) / 2)
        # Five standard errors of a sampled variance.
        assert relative_error(found[-1], expected) < 5 * np.sqrt(2 / 40_000)


def test_second_order_is_closer_at_large_rotation_noise(lib: SimpleNamespace) -> None:
    deviation = np.array([0.05, 0.05, 0.05, 0.15, 0.2, 0.1])
    T_steps, covariances, initial, expected = monte_carlo(8, deviation, samples=60_000)
    first, second = (
        lib.propagate_covariance(T_steps, covariances, order=order, initial=initial)[-1] for order in (1, 2)
    )
    assert relative_error(second, expected) < 0.5 * relative_error(first, expected)


def test_fourth_order_terms_are_the_expectation_of_the_series() -> None:
    """For two steps, E[xi xi^T] of the Baker-Campbell-Hausdorff series, by exact Gaussian quadrature of its terms."""
    rng = np.random.default_rng(1)
    a, b = (random_covariance(rng, np.full(6, scale)) for scale in (0.3, 0.2))
    still = np.eye(4)[None]
    found = geo.propagate_covariance(still, b[None], order=2, initial=a)[1]
    # Fourth moments of Gaussians are reproduced by summing over pairs of columns of square roots.
    roots_a, roots_b = np.linalg.cholesky(a).T, np.linalg.cholesky(b).T
    expected = a + b
    for x in roots_a:
        expected = expected + ad(x) @ b @ ad(x).T / 4
        double = ad(x) @ ad(x) @ b / 12
        expected = expected + double + double.T
    for y in roots_b:
        double = ad(y) @ ad(y) @ a / 12
        expected = expected + double + double.T
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)


def test_scan_and_loop_agree_on_a_long_path() -> None:
    """Float32 on the device against float64 numpy, over a kilometre."""
    T = geo.step_to_matrix(np.tile([0.0, 0.0, 1.0, 0.0, 0.01, 0.0], (1000, 1)))
    covariances = np.tile(np.diag([1e-4, 1e-4, 1e-2, 1e-7, 1e-6, 1e-7]), (1000, 1, 1))
    poses = jax.jit(geo.accumulate)(jnp.asarray(T))
    np.testing.assert_allclose(poses, geo.accumulate(T), atol=2e-3)
    for order in (1, 2):
        found = jax.jit(geo.propagate_covariance, static_argnames="order")(T, jnp.asarray(covariances), order=order)
        assert found.dtype == jnp.float32
        expected = geo.propagate_covariance(T, covariances, order=order)
        scale = np.sqrt(np.diagonal(expected[-1]))
        np.testing.assert_allclose(found[-1] / np.outer(scale, scale), expected[-1] / np.outer(scale, scale), atol=1e-3)


def test_an_error_of_scale_lengthens_the_way_from_the_first_pose(lib: SimpleNamespace) -> None:
    poses = geo.accumulate(geo.step_to_matrix(steps(7, seed=4)), geo.step_to_matrix(steps(1, seed=5)[0]))
    scaled = poses.copy()
    error = -0.3
    scaled[:, :3, 3] = poses[0, :3, 3] + (1 + error) * (poses[:, :3, 3] - poses[0, :3, 3])
    # Right perturbations, exact however large the error is.
    xi = geo.log_se3(geo.compose(geo.inverse(poses), scaled))
    found = lib.scale_covariance(poses, 0.3)
    np.testing.assert_allclose(found, xi[:, :, None] * xi[:, None, :], atol=1e-12)
    assert not np.any(found[0])
    # Batches of paths, and no error at all.
    np.testing.assert_allclose(lib.scale_covariance(np.stack([poses, poses[::-1]]), 0.3)[0], found, atol=1e-12)
    np.testing.assert_array_equal(lib.scale_covariance(poses, 0.0), np.zeros((8, 6, 6)))


def test_errors_that_steps_share_by_their_definition(lib: SimpleNamespace) -> None:
    rng = np.random.default_rng(8)
    T_steps = geo.step_to_matrix(steps(6, seed=9, size=0.5))
    directions = rng.normal(size=(6, 6, 3))
    first = geo.step_to_matrix(steps(1, seed=10)[0])
    poses = geo.accumulate(T_steps, first)

    def moved(e: np.ndarray) -> np.ndarray:
        # Every step by the same e, each in its own direction.
        return geo.accumulate(T_steps @ geo.exp_se3(directions @ e), first)

    for pose in range(7):
        T_inverse = geo.inverse(poses[pose])
        jacobian = numerical_jacobian(lambda e, T=T_inverse, j=pose: geo.log_se3(T @ moved(e)[j]), np.zeros(3))
        np.testing.assert_allclose(
            lib.shared_covariance(poses, directions)[pose], jacobian @ jacobian.T, rtol=1e-6, atol=1e-6
        )
    # Batches of paths.
    both = lib.shared_covariance(np.stack([poses, poses]), np.stack([directions, 2 * directions]))
    np.testing.assert_allclose(both[1], 4 * both[0], rtol=1e-12, atol=1e-12)


def test_an_error_of_scale_is_one_that_steps_share(lib: SimpleNamespace) -> None:
    vectors = steps(8, seed=11)
    poses = geo.accumulate(geo.step_to_matrix(vectors))
    shift = geo.step_jacobian(vectors)[..., :3] @ vectors[:, :3, None]
    np.testing.assert_allclose(lib.shared_covariance(poses, 0.1 * shift), lib.scale_covariance(poses, 0.1), atol=1e-12)


def test_independent_errors_and_one_of_scale_add_up(lib: SimpleNamespace) -> None:
    """As a filter has it that carries the error of the scale along as a seventh state."""
    rng = np.random.default_rng(3)
    T_steps = geo.step_to_matrix(steps(9, seed=6, size=0.4))
    covariances = np.stack([random_covariance(rng, np.full(6, 0.01)) for _ in range(9)])
    sigma = 0.07
    state = np.zeros((7, 7))
    state[6, 6] = sigma**2
    for T, covariance in zip(T_steps, covariances, strict=True):
        carry = np.eye(7)
        carry[:6, :6] = geo.adjoint(geo.inverse(T))
        carry[:3, 6] = T[:3, :3].T @ T[:3, 3]
        state = carry @ state @ carry.T
        state[:6, :6] += covariance
    found = lib.propagate_covariance(T_steps, covariances) + lib.scale_covariance(geo.accumulate(T_steps), sigma)
    np.testing.assert_allclose(found[-1], state[:6, :6], atol=1e-12)


# Namespaces and mistakes.


def test_numpy_in_numpy_out_and_the_rest_in_jax() -> None:
    single = np.ones(6, np.float32)
    assert isinstance(geo.step_to_matrix(single), np.ndarray)
    assert geo.step_to_matrix(single).dtype == np.float64
    assert geo.step_to_matrix(jnp.asarray(single)).dtype == jnp.float32
    assert geo.step_to_matrix(jnp.asarray(single, jnp.bfloat16)).dtype == jnp.float32
    mixed = geo.compose(np.eye(4), jnp.eye(4))
    assert isinstance(mixed, jax.Array)
    given = geo.step_to_matrix(steps(3))
    before = given.copy()
    geo.accumulate(given)
    np.testing.assert_array_equal(given, before)


def test_vmap_equals_the_batch() -> None:
    step = jnp.asarray(steps(4))
    mapped = jax.jit(jax.vmap(lambda s: geo.log_se3(geo.step_to_matrix(s))))(step)
    np.testing.assert_allclose(mapped, geo.log_se3(geo.step_to_matrix(steps(4))), atol=1e-5)


T2, C2 = np.tile(np.eye(4), (2, 1, 1)), np.tile(np.eye(6), (2, 1, 1))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: geo.step_to_matrix(np.ones(7)), r"\(7,\); expected \[\.\.\., 6\]"),
        (lambda: geo.exp_so3(np.float64(1)), r"\(\); expected \[\.\.\., 3\]"),
        (lambda: geo.matrix_to_step(np.eye(3)), r"\(3, 3\); expected \[\.\.\., 4, 4\]"),
        (lambda: geo.accumulate(np.eye(4)), r"\(4, 4\); expected \[\.\.\., N, 4, 4\]"),
        (lambda: geo.accumulate(T2, np.eye(3)), r"\(3, 3\); expected \[\.\.\., 4, 4\]"),
        (lambda: geo.propagate_covariance(T2, C2[:1]), "expected one a step"),
        (lambda: geo.propagate_covariance(T2, C2, order=3), "order is 3; expected 1 or 2"),
        (lambda: geo.step_covariance_to_perturbation(np.ones(6), np.ones(6)), r"expected \[\.\.\., 6, 6\]"),
    ],
)
def test_mistakes_are_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
