"""Samples of a mixture: of its distribution, and independent."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mixture_reference import (
    BATCH,
    COUPLINGS,
    DIMENSIONS,
    covariance,
    device,
    mean,
    quantile,
    random_mixture,
    sample,
    variance,
)

from mdnvo_jax import mixture as mx
from mdnvo_jax.mixture import Mixture


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_samples_have_the_moments_and_the_distribution(coupling: str) -> None:
    mixture = device(random_mixture(seed=5), "float32")
    count = 40_000
    drawn = jax.jit(lambda m: sample(m, jax.random.key(1), (2, count // 2), coupling=coupling))(mixture)
    assert drawn.shape == (2, count // 2, *BATCH, DIMENSIONS)
    drawn = np.asarray(drawn, np.float64).reshape(count, *BATCH, DIMENSIONS)
    deviation = np.sqrt(variance(mixture))
    # Five standard errors of a mean; a covariance's error is bounded by that of heavier tails.
    np.testing.assert_array_less(np.abs(drawn.mean(0) - mean(mixture)), 5 * deviation / np.sqrt(count))
    for index in np.ndindex(*BATCH):
        found = np.cov(drawn[(slice(None), *index)].T)
        scale = deviation[index][:, None] * deviation[index]
        np.testing.assert_allclose(found / scale, covariance(mixture, coupling=coupling)[index] / scale, atol=0.05)
    point = quantile(mixture, 0.3)
    np.testing.assert_allclose((drawn < point).mean(0), 0.3, atol=5 * np.sqrt(0.3 * 0.7 / count))


def test_samples_do_not_reuse_randomness() -> None:
    mixture = device(random_mixture(seed=5), "float32")
    a, b = (sample(mixture, jax.random.key(seed)) for seed in (0, 1))
    assert (a != b).all()
    # Equal parameters in every batch entry still give different draws.
    same = Mixture(jnp.zeros((4, 1)), jnp.zeros((4, 1, 1)), jnp.zeros((4, 1, 1)))
    assert len(set(sample(same, jax.random.key(0)).ravel().tolist())) == 4


def test_choice_and_noise_are_independent() -> None:
    far = Mixture(jnp.zeros(2), jnp.array([[-100.0], [100.0]]), jnp.zeros((2, 1)))
    drawn = np.asarray(jax.jit(jax.vmap(lambda key: mx.sample(far, key)))(jax.random.split(jax.random.key(0), 4000)))
    side = np.sign(drawn)
    assert abs((side * (drawn - 100 * side)).mean()) < 5 / np.sqrt(4000)
