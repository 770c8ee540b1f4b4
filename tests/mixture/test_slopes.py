"""Slopes of the mixture density against finite differences and against its definition."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mixture_reference import (
    DIMENSIONS,
    GOOD,
    GOOD_VALUE,
    device,
    everything,
    log_prob,
    quantile,
    random_mixture,
    random_value,
    several,
)

from mdnvo_jax import mixture as mx
from mdnvo_jax.mixture import Mixture


def test_gradients_against_finite_differences(x64: None) -> None:
    """Along a random direction, where it is not just arithmetic; reverse mode is the transpose of what is tested."""
    function = several(("nll sequence", "covariance joint", "mode", "cdf", "quantile", "crps"))
    mixture, value = device(random_mixture()), jnp.asarray(random_value())
    direction = (device(random_mixture(8)), jnp.asarray(random_value(9)))
    _, slopes = jax.jit(lambda *point: jax.jvp(function, point, direction))(mixture, value)
    step = 1e-5

    def moved(step: float) -> dict[str, object]:
        return everything(*jax.tree.map(lambda x, d: x + step * d, (mixture, value), direction))

    ahead, behind = moved(step), moved(-step)
    for name in slopes:
        leaves = map(jax.tree.leaves, (slopes[name], ahead[name], behind[name]))
        for slope, up, down in zip(*leaves, strict=True):
            np.testing.assert_allclose(slope, (up - down) / (2 * step), rtol=1e-6, atol=1e-6, err_msg=name)


def plain_joint(mixture: Mixture, value: jax.Array) -> jax.Array:
    """The definition, differentiated by JAX alone."""
    squares = ((value[..., None, :] - mixture.mean) / jnp.exp(mixture.log_scale)) ** 2
    log_normal = -0.5 * (squares + np.log(2 * np.pi)) - mixture.log_scale
    return jax.nn.logsumexp(jax.nn.log_softmax(mixture.logits) + log_normal.sum(-1), axis=-1)


def test_slopes_of_the_joint_density_are_those_of_its_definition(x64: None) -> None:
    """In both modes, once and twice, under vmap."""
    mixture, value = device(random_mixture()), jnp.asarray(random_value())
    direction = (device(random_mixture(8)), jnp.asarray(random_value(9)))

    def slopes(density: Callable) -> list[jax.Array]:
        def total(*point: object) -> jax.Array:
            return jnp.sin(density(*point)).sum()

        reverse = jax.grad(total, argnums=(0, 1))
        forward_of_reverse = jax.jvp(reverse, (mixture, value), direction)
        mapped = jax.vmap(jax.vmap(jax.grad(density, argnums=(0, 1))))(mixture, value)
        return jax.tree.leaves((jax.jvp(density, (mixture, value), direction), forward_of_reverse, mapped))

    found = jax.jit(lambda: slopes(partial(mx.log_prob, coupling="joint")))()
    for ours, exact in zip(found, jax.jit(lambda: slopes(plain_joint))(), strict=True):
        np.testing.assert_allclose(ours, exact, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("platform", ["cpu", "cuda", "tpu"])
def test_only_a_processor_adds_up_dimensions_by_a_product(platform: str) -> None:
    """A TPU would round it, or make NaN of an infinite term; nor is there a product in the gradient."""
    loss = jax.jit(jax.value_and_grad(partial(mx.nll, coupling="joint"), argnums=(0, 1)))
    lowered = loss.trace(GOOD, GOOD_VALUE).lower(lowering_platforms=(platform,))
    assert ("dot_general" in lowered.as_text()) == (platform == "cpu")


def test_slope_of_the_quantile_is_one_over_the_density(x64: None) -> None:
    mixture = device(random_mixture(batch=(), components=3))
    for probability in (0.01, 0.8):
        point, slope = jax.jvp(lambda p: quantile(mixture, p), (probability,), (1.0,))
        marginals = Mixture(jnp.zeros((DIMENSIONS, 3)) + mixture.logits, *(f.T[..., None] for f in mixture[1:]))
        np.testing.assert_allclose(slope, jnp.exp(-log_prob(marginals, point[:, None])), rtol=1e-9)
