"""Mixtures made of mixtures: in other units, widened, with noise, pooled."""

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from mixture_reference import (
    BATCH,
    COUPLINGS,
    DIMENSIONS,
    MIXTURES,
    PROPERTY,
    add_noise,
    affine,
    arrays,
    cdf,
    covariance,
    crps,
    device,
    log_prob,
    mean,
    pool,
    quantile,
    random_mixture,
    random_value,
    reference_mean,
    variance,
    widen,
)
from scipy import stats

from mdnvo_jax import mixture as mx
from mdnvo_jax.mixture import Mixture


@PROPERTY
@hypothesis.given(MIXTURES, arrays(2), hnp.arrays(np.float32, 2, elements=st.floats(0.0625, 16, width=32)), arrays(2))
def test_affine_changes_units(mixture: Mixture, value: np.ndarray, scale: np.ndarray, shift: np.ndarray) -> None:
    with jax.enable_x64(True):
        original = device(mixture, "float64")
        scale, shift, value = (array.astype(np.float64) for array in (scale, shift, value))
        moved, moved_value = affine(original, scale, shift), value * scale + shift
        close = {"rtol": 1e-9, "atol": 1e-9}
        for coupling in COUPLINGS:
            found = log_prob(moved, moved_value, coupling=coupling)
            expected = log_prob(original, value, coupling=coupling) - np.log(scale).sum()
            np.testing.assert_allclose(found, expected, **close)
        np.testing.assert_allclose(mean(moved), mean(original) * scale + shift, **close)
        np.testing.assert_allclose(variance(moved), variance(original) * scale**2, **close)
        np.testing.assert_allclose(cdf(moved, moved_value), cdf(original, value), **close)
        np.testing.assert_allclose(crps(moved, moved_value), crps(original, value) * scale, **close)
        np.testing.assert_allclose(quantile(moved, 0.2), quantile(original, 0.2) * scale + shift, **close)


def test_widening_multiplies_the_deviation_about_the_mean(x64: None) -> None:
    """By hand: weights 1/4 and 3/4 at -1 and 1 with sigma 1 and 2 have mean 1/2 and variance 3.25 + 0.75 = 4."""
    two = Mixture(np.log([0.25, 0.75]), np.array([[-1.0], [1.0]]), np.log([[1.0], [2.0]]))
    found = widen(two, np.array([3.0]))
    np.testing.assert_allclose(mean(found), [0.5], rtol=1e-12)
    np.testing.assert_allclose(variance(found), [36.0], rtol=1e-12)
    np.testing.assert_array_equal(found.logits, two.logits)
    np.testing.assert_allclose(found.mean, [[0.5 - 4.5], [0.5 + 1.5]], rtol=1e-12)
    np.testing.assert_allclose(np.exp(found.log_scale), [[3.0], [6.0]], rtol=1e-12)


def test_noise_adds_its_variance_to_every_component(x64: None) -> None:
    """By hand: 3, 4 make 5, and 12, 5 make 13; the density is the integral of the product of the two."""
    two = Mixture(np.log([0.25, 0.75]), np.array([[-1.0, 0.0], [1.0, 2.0]]), np.log([[3.0, 12.0], [3.0, 12.0]]))
    sigma, value = np.array([4.0, 5.0]), np.array([0.5, -3.0])
    found = add_noise(two, sigma)
    np.testing.assert_allclose(np.exp(found.log_scale), [[5.0, 13.0]] * 2, rtol=1e-12)
    np.testing.assert_array_equal(found.mean, two.mean)
    np.testing.assert_array_equal(found.logits, two.logits)
    noise = np.linspace(-10, 10, 401) * sigma[:, None]
    weight = np.exp(-((noise / sigma[:, None]) ** 2) / 2) * 0.05 / np.sqrt(2 * np.pi)
    grid = value - np.stack(np.meshgrid(*noise, indexing="ij"), -1)
    for coupling in COUPLINGS:
        density = np.exp(jax.vmap(jax.vmap(lambda y, c=coupling: mx.log_prob(two, y, coupling=c)))(grid))
        expected = np.einsum("i,j,ij->", *weight, density)
        np.testing.assert_allclose(np.exp(log_prob(found, value, coupling=coupling)), expected, rtol=1e-9)


def test_no_noise_changes_no_bit_and_any_has_finite_gradients() -> None:
    mixture = device(random_mixture(), "float32")
    nothing = jnp.zeros(DIMENSIONS)
    for before, after in zip(mixture, add_noise(mixture, nothing), strict=True):
        np.testing.assert_array_equal(after, before)

    def total(log_scale: jax.Array, sigma: jax.Array) -> jax.Array:
        return mx.add_noise(mixture._replace(log_scale=log_scale), sigma).log_scale.sum()

    for sigma in (nothing, jnp.full(DIMENSIONS, 1e-30), jnp.full(DIMENSIONS, 1e30), jnp.array([0.0, 1.0, 0.0])):
        by_log_scale, by_sigma = jax.grad(total, argnums=(0, 1))(mixture.log_scale, sigma)
        assert np.isfinite(by_log_scale).all() and np.isfinite(by_sigma).all()
    by_log_scale, by_sigma = jax.grad(total, argnums=(0, 1))(mixture.log_scale, nothing)
    np.testing.assert_array_equal(by_log_scale, 1)
    np.testing.assert_array_equal(by_sigma, 0)


def test_widening_is_by_dimension_and_keeps_the_shape(x64: None) -> None:
    mixture, value, factor = random_mixture(), random_value(), np.array([0.25, 1.0, 8.0])
    original, found = device(mixture), widen(device(mixture), factor)
    centre = reference_mean(mixture)
    moved_value = centre + factor * (value - centre)
    np.testing.assert_allclose(mean(found), centre, rtol=1e-12)
    for coupling in COUPLINGS:
        scaled = covariance(original, coupling=coupling) * np.outer(factor, factor)
        np.testing.assert_allclose(covariance(found, coupling=coupling), scaled, rtol=1e-10, atol=1e-10)
        # The density of what is wider is lower by the Jacobian.
        expected = log_prob(original, value, coupling=coupling) - np.log(factor).sum()
        np.testing.assert_allclose(log_prob(found, moved_value, coupling=coupling), expected, rtol=1e-10)
    np.testing.assert_allclose(cdf(found, moved_value), cdf(original, value), rtol=1e-10)


def test_a_pool_has_the_mean_of_the_densities(x64: None) -> None:
    """By hand, then whatever the numbers of components: 0 and 2 with sigma 1 have mean 1 and variance 1 + 1 = 2."""
    one = Mixture(np.array([7.0]), np.array([[0.0]]), np.array([[0.0]]))
    both = pool([one, one._replace(logits=np.array([-3.0]), mean=np.array([[2.0]]))])
    np.testing.assert_allclose(mean(both), [1.0], rtol=1e-12)
    np.testing.assert_allclose(variance(both), [2.0], rtol=1e-12)

    parts, value = [random_mixture(seed, components=seed + 1) for seed in range(3)], random_value()
    found = pool(parts)
    assert found.logits.shape == (*BATCH, 1 + 2 + 3)
    densities = np.exp([log_prob(device(part), value, coupling="joint") for part in parts])
    np.testing.assert_allclose(np.exp(log_prob(found, value, coupling="joint")), densities.mean(0), rtol=1e-12)
    for function in (mean, lambda part: cdf(part, value)):
        np.testing.assert_allclose(function(found), np.mean([function(part) for part in parts], axis=0), rtol=1e-12)
    spread = np.var([mean(part) for part in parts], axis=0)
    np.testing.assert_allclose(variance(found), np.mean([variance(part) for part in parts], 0) + spread, rtol=1e-12)
    np.testing.assert_allclose(log_prob(pool(parts[2:]), value), log_prob(parts[2], value), rtol=1e-12)


def test_a_pool_of_extremes_is_finite_and_so_are_its_gradients() -> None:
    def total(logits: jax.Array) -> jax.Array:
        parts = [Mixture(row, jnp.array([[0.0], [1e4]]), jnp.array([[-9.0], [9.0]])) for row in logits]
        return mx.log_prob(mx.pool(parts), jnp.array([3.0]))

    logits = jnp.array([[0.0, -jnp.inf], [1e4, -1e4], [-1e30, 1e30]])
    value, gradient = jax.value_and_grad(total)(logits)
    assert np.isfinite(value) and np.isfinite(gradient).all()
    # The last part is all in its second component, which alone reaches 3; it is a third of the whole.
    expected = stats.norm.logpdf(3, 1e4, np.exp(9)) - np.log(3)
    np.testing.assert_allclose(value, expected, rtol=1e-5)
