"""Distribution functions of a mixture: cdf, quantile and interval."""

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from mixture_reference import (
    BATCH,
    DIMENSIONS,
    MIXTURES,
    PROPERTY,
    arrays,
    cdf,
    device,
    interval,
    quantile,
    random_mixture,
    reference_cdf,
    reference_quantile,
)
from scipy import stats

from mdnvo_jax.mixture import Mixture


def test_lower_tail_of_the_cdf_keeps_its_digits(x64: None) -> None:
    mixture = random_mixture()
    value = np.min(mixture.mean - 20 * np.exp(mixture.log_scale), axis=-2)
    np.testing.assert_allclose(cdf(device(mixture), value), reference_cdf(mixture, value), rtol=1e-10, atol=0)


def test_quantile_in_float32_is_accurate_relative_to_sigma() -> None:
    probability = np.linspace(0.001, 0.999, 999, dtype=np.float32)
    standard = Mixture(jnp.zeros(1), jnp.zeros((1, 1)), jnp.zeros((1, 1)))
    found = quantile(standard, probability[:, None])[:, 0]
    np.testing.assert_allclose(found, stats.norm.ppf(probability.astype(np.float64)), rtol=0, atol=1e-6)
    # Components at the same mean, so that the spacing of float32 around the quantile is not what is measured.
    pair = Mixture(np.array([0.5, -0.3]), np.zeros((2, 3)), np.log([[1, 2, 0.3], [1.5, 0.7, 0.3]]))
    for p in (1e-5, 0.2, 0.7):
        p = float(np.float32(p))
        np.testing.assert_allclose(
            quantile(device(pair, "float32"), p), reference_quantile(pair, p), rtol=1e-6, atol=1e-6
        )


def test_quantile_at_and_beyond_the_ends() -> None:
    mixture = device(random_mixture(batch=()))
    points, slope_of = jax.vjp(lambda m: quantile(m, np.array([0, 1, -0.1, 1.1, np.nan])[:, None]), mixture)
    np.testing.assert_array_equal(points, np.array([-np.inf, np.inf, np.nan, np.nan, np.nan])[:, None] * np.ones(3))
    (slope,) = slope_of(jnp.ones_like(points))
    assert all((field == 0).all() for field in slope)
    low, high = interval(mixture, 1.0)
    assert (low == -jnp.inf).all()
    assert (high == jnp.inf).all()


def test_probability_broadcasts_as_documented() -> None:
    mixture = device(random_mixture())
    both = quantile(mixture, jnp.array([0.1, 0.6]).reshape(2, 1, 1, 1))
    assert both.shape == (2, *BATCH, DIMENSIONS)
    by_dimension = quantile(mixture, jnp.array([0.1, 0.6, 0.1]))
    np.testing.assert_allclose(by_dimension[..., 1], both[1, ..., 1], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(by_dimension[..., 2], both[0, ..., 2], rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match="shapes"):
        quantile(mixture, jnp.full(5, 0.5))


def test_cdf_is_never_above_one() -> None:
    """Though weights add up to more in float32, a little, for a good part of these mixtures."""
    rng = np.random.default_rng(0)
    mixture = Mixture(rng.normal(size=(1000, 7)), np.zeros((1000, 7, 1)), np.zeros((1000, 7, 1)))
    assert (cdf(device(mixture, "float32"), jnp.full((1000, 1), 50.0)) == 1).all()


@PROPERTY
@hypothesis.given(MIXTURES, arrays(2), st.floats(0.001, 10))
def test_cdf_is_monotone_and_within_bounds(mixture: Mixture, value: np.ndarray, step: float) -> None:
    here, there = cdf(mixture, value), cdf(mixture, value + np.float32(step))
    assert (here >= 0).all()
    assert (there <= 1).all()
    assert (there >= here - 2e-7).all()


@PROPERTY
@hypothesis.given(MIXTURES, st.floats(1e-4, 1 - 1e-4))
def test_quantile_inverts_cdf(mixture: Mixture, probability: float) -> None:
    with jax.enable_x64(True):
        double = device(mixture, "float64")
        np.testing.assert_allclose(cdf(double, quantile(double, probability)), probability, rtol=1e-11)


def test_interval_holds_its_coverage_with_equal_tails(x64: None) -> None:
    mixture = device(random_mixture())
    low, high = interval(mixture, 0.8)
    np.testing.assert_allclose(cdf(mixture, low), 0.1, rtol=1e-11)
    np.testing.assert_allclose(cdf(mixture, high), 0.9, rtol=1e-11)
