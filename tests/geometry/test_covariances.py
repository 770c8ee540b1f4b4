"""Covariances of steps and poses against Monte Carlo and their definitions."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from geometry_values import ad, numerical_jacobian, steps

from mdnvo_jax import geometry as geo


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


def test_errors_that_neighbours_share_by_their_definition(lib: SimpleNamespace) -> None:
    """All pairs of different steps: J_k D_k R^|k - l| D_l^T J_l^T, J_k what step k does to the pose."""
    rng = np.random.default_rng(12)
    T_steps = geo.step_to_matrix(steps(6, seed=13, size=0.5))
    directions, r = rng.normal(size=(6, 6, 3)), np.array([0.0, 0.6, 1.0])
    poses = geo.accumulate(T_steps)
    found = lib.serial_covariance(T_steps, directions, r)
    for pose in range(7):
        columns = [geo.adjoint(geo.inverse(poses[pose]) @ poses[k + 1]) @ directions[k] for k in range(pose)]
        pairs = [(k, other) for k in range(pose) for other in range(pose) if k != other]
        expected = sum((columns[k] * r ** abs(k - other) @ columns[other].T for k, other in pairs), np.zeros((6, 6)))
        np.testing.assert_allclose(found[pose], expected, atol=1e-9)
    # Batches of paths, and no step at all.
    both = lib.serial_covariance(np.stack([T_steps, T_steps]), np.stack([directions, 2 * directions]), r)
    np.testing.assert_allclose(both[1], 4 * both[0], rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(lib.serial_covariance(T_steps[:0], directions[:0], r), np.zeros((1, 6, 6)))


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
