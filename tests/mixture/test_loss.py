"""The loss: how log-likelihoods are reduced, and steps that are masked."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mixture_reference import BATCH, COUPLINGS, device, nll, random_mixture, random_value, reference_log_prob

from mdnvo_jax.mixture import Mixture


def test_reductions(x64: None) -> None:
    mixture, value = device(random_mixture()), random_value()
    log_likelihood = reference_log_prob(mixture, value, "independent")
    np.testing.assert_allclose(nll(mixture, value, reduction="none"), -log_likelihood, rtol=1e-12)
    np.testing.assert_allclose(nll(mixture, value), -log_likelihood.mean(), rtol=1e-12)
    # Equations 6 and 7, as printed.
    windows = -np.log(np.exp(log_likelihood).mean(-1))
    np.testing.assert_allclose(nll(mixture, value, reduction="sequence"), windows.mean(), rtol=1e-12)
    joint = reference_log_prob(mixture, value, "joint")
    np.testing.assert_allclose(nll(mixture, value, coupling="joint"), -joint.mean(), rtol=1e-12)


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.parametrize("reduction", ["mean", "sequence", "none"])
def test_masked_steps_count_for_nothing(reduction: str, coupling: str, x64: None) -> None:
    """Whatever a masked step holds, NaN included, the loss is that of the steps that are left, and so is its slope."""
    mixture, value = random_mixture(), random_value()
    mask = np.array([[True, False, True], [False, False, False]])
    dirty = Mixture(*(np.where(mask.reshape(mask.shape + (1,) * (f.ndim - 2)), f, np.nan) for f in mixture))
    dirty_value = np.where(mask[..., None], value, np.inf)

    def loss(mixture: Mixture, value: jax.Array) -> jax.Array:
        return nll(mixture, value, mask=mask, reduction=reduction, coupling=coupling).sum()

    def loss_of_the_rest(mixture: Mixture, value: jax.Array) -> jax.Array:
        kept = Mixture(*(field[0, ::2] for field in mixture))
        return nll(kept, value[0, ::2], reduction=reduction, coupling=coupling).sum()

    found, found_slope = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))(device(dirty), jnp.asarray(dirty_value))
    expected, slope = jax.jit(jax.value_and_grad(loss_of_the_rest, argnums=(0, 1)))(device(mixture), jnp.asarray(value))
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), found_slope, slope)


@pytest.mark.parametrize("reduction", ["mean", "sequence", "none"])
def test_all_masked_is_zero_with_zero_gradient(reduction: str) -> None:
    mixture = Mixture(*(jnp.full(f.shape, jnp.nan) for f in random_mixture()))

    @jax.jit
    def loss(mixture: Mixture) -> jax.Array:
        mask = jnp.zeros(BATCH, bool)
        return nll(mixture, random_value(), mask=mask, reduction=reduction).sum()

    value, slope = jax.value_and_grad(loss)(mixture)
    assert value == 0
    assert all((field == 0).all() for field in slope)


def test_sequence_of_tiny_likelihoods() -> None:
    """Log-likelihoods near -1e8, whose exponentials are zero in any precision."""
    mixture = Mixture(jnp.zeros((1, 4, 1)), jnp.zeros((1, 4, 1, 1)), jnp.zeros((1, 4, 1, 1)))
    value = jnp.full((1, 4, 1), 1.4142136e4)
    found, slope = jax.jit(jax.value_and_grad(lambda m: nll(m, value, reduction="sequence")))(mixture)
    np.testing.assert_allclose(found, 1e8, rtol=1e-5)
    np.testing.assert_allclose(slope.mean, np.full((1, 4, 1, 1), -1.4142136e4 / 4), rtol=1e-5)
