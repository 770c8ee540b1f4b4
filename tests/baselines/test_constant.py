import jax
import numpy as np

from mdnvo_jax import geometry, mixture
from mdnvo_jax.baselines import constant

MEAN = np.array([0.01, -0.02, 1.1, 0.001, 0.02, -0.003])


def test_poses_compose_the_same_step():
    poses = constant.constant_poses(MEAN, 7)
    assert poses.shape == (8, 4, 4)
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-15)
    step = geometry.step_to_matrix(MEAN)
    np.testing.assert_allclose(poses[7], np.linalg.matrix_power(step, 7), atol=1e-12)


def test_statistics_are_those_of_all_steps_together():
    rng = np.random.default_rng(0)
    steps = [MEAN + 0.01 * rng.standard_normal((count, 6)) for count in (5, 12)]
    paths = [np.asarray(geometry.accumulate(geometry.step_to_matrix(part))) for part in steps]
    mean, std = constant.step_statistics(paths)
    together = np.concatenate(steps)
    np.testing.assert_allclose(mean, together.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(std, together.std(axis=0), atol=1e-12)


def test_density_is_one_gaussian_with_the_given_moments():
    std = np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
    with jax.enable_x64(True):
        density = constant.constant_mixture(MEAN, std, 4)
        assert density.mean.shape == (4, 1, 6)
        np.testing.assert_allclose(mixture.mean(density), np.tile(MEAN, (4, 1)))
        np.testing.assert_allclose(mixture.variance(density), np.tile(std**2, (4, 1)))


def test_a_dimension_that_never_varies_keeps_a_finite_likelihood():
    density = constant.constant_mixture(MEAN, np.zeros(6), 1)
    np.testing.assert_allclose(np.exp(density.log_scale[0, 0]), constant.FLOOR)
    assert np.isfinite(mixture.log_prob(density, MEAN[None])).all()
