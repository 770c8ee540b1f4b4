"""The mixture density, and whatever is computed of one, against scipy and against its own definitions."""

from collections.abc import Callable

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from mixture_reference import (
    COUPLINGS,
    MIXTURES,
    PROPERTY,
    REFERENCES,
    arrays,
    cdf,
    covariance,
    crps,
    device,
    everything,
    interval,
    log_prob,
    mean,
    mode,
    random_mixture,
    random_value,
    variance,
)
from scipy import stats

from mdnvo_jax.mixture import Mixture


def test_agrees_with_scipy_in_float64(x64: None) -> None:
    mixture, value = random_mixture(), random_value()
    found = everything(device(mixture), jnp.asarray(value))
    assert all(leaf.dtype == jnp.float64 for leaf in jax.tree.leaves(found))
    for name, reference in REFERENCES.items():
        # A covariance may come out near zero by cancellation, hence a little absolute slack beside the relative.
        np.testing.assert_allclose(found[name], reference(mixture, value), rtol=1e-10, atol=1e-12, err_msg=name)


def test_agrees_with_scipy_in_float32() -> None:
    # The reference is of the rounded parameters: rounding them is the caller's doing.
    mixture = Mixture(*(field.astype(np.float32).astype(np.float64) for field in random_mixture()))
    value = random_value().astype(np.float32).astype(np.float64)
    found = everything(device(mixture), jnp.asarray(value))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(found))
    for name, reference in REFERENCES.items():
        np.testing.assert_allclose(found[name], reference(mixture, value), rtol=1e-5, atol=2e-6, err_msg=name)


def test_one_component_is_a_gaussian(x64: None) -> None:
    mixture = device(Mixture(np.array([3.0]), np.array([[1.0, -2.0]]), np.log([[0.5, 2.0]])))
    assert log_prob(mixture, [1.5, 0.0]) == pytest.approx(
        stats.norm.logpdf(1.5, 1, 0.5) + stats.norm.logpdf(0, -2, 2), rel=1e-12
    )
    np.testing.assert_allclose(mean(mixture), [1, -2])
    np.testing.assert_allclose(mode(mixture), [1, -2])
    np.testing.assert_allclose(variance(mixture), [0.25, 4])
    low, high = interval(mixture, 0.9973)
    half = stats.norm.isf((1 - 0.9973) / 2)
    np.testing.assert_allclose(low, [1 - 0.5 * half, -2 - 2 * half], rtol=1e-12)
    np.testing.assert_allclose(high, [1 + 0.5 * half, -2 + 2 * half], rtol=1e-12)
    # Gneiting and Raftery (2007), equation 21: sigma (z (2 Phi(z) - 1) + 2 phi(z) - 1 / sqrt(pi)).
    z = 0.7
    expected = 2 * (z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - 1 / np.sqrt(np.pi))
    assert crps(mixture, [1.0, -2.0 + 2.0 * z])[1] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("function", [log_prob, covariance, mode], ids=lambda f: f.__name__)
def test_couplings_agree_with_one_component(function: Callable, x64: None) -> None:
    mixture = device(random_mixture(components=1))
    arguments = (random_value(),) if function is log_prob else ()
    independent, joint = (function(mixture, *arguments, coupling=coupling) for coupling in COUPLINGS)
    np.testing.assert_allclose(independent, joint, rtol=1e-12)


def test_couplings_share_marginals_and_differ_together(x64: None) -> None:
    """Two components on a diagonal: joint puts no mass on the other diagonal, independent as much as on this one."""
    mixture = device(Mixture(np.zeros(2), np.array([[-5.0, -5.0], [5.0, 5.0]]), np.zeros((2, 2))))
    on, off = jnp.array([5.0, 5.0]), jnp.array([5.0, -5.0])
    np.testing.assert_allclose(log_prob(mixture, on), log_prob(mixture, off), rtol=1e-12)
    assert log_prob(mixture, on, coupling="joint") > log_prob(mixture, off, coupling="joint") + 40
    assert covariance(mixture)[0, 1] == 0
    np.testing.assert_allclose(covariance(mixture, coupling="joint"), [[26, 25], [25, 26]], rtol=1e-12)


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_density_integrates_to_one(coupling: str, x64: None) -> None:
    rng = np.random.default_rng(3)
    mixture = device(Mixture(rng.normal(size=3), rng.normal(size=(3, 2)), rng.uniform(-1, 0, size=(3, 2))))
    axis = np.linspace(-9, 9, 400)
    points = jnp.stack(jnp.meshgrid(axis, axis), axis=-1)
    density = jnp.exp(jax.vmap(jax.vmap(lambda y: log_prob(mixture, y, coupling=coupling)))(points))
    assert float(density.sum()) * (axis[1] - axis[0]) ** 2 == pytest.approx(1, abs=1e-9)


@PROPERTY
@hypothesis.given(MIXTURES, arrays(2), st.permutations(range(3)))
def test_order_of_components_does_not_matter(mixture: Mixture, value: np.ndarray, order: list[int]) -> None:
    permuted = Mixture(*(field[order] for field in mixture))
    for function in (log_prob, lambda m, y: log_prob(m, y, coupling="joint"), crps, cdf):
        np.testing.assert_allclose(function(mixture, value), function(permuted, value), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(mean(mixture), mean(permuted), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(variance(mixture), variance(permuted), rtol=1e-5)
