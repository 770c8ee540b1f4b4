"""The mixture density at its extremes: value and gradient of everything, in float32."""

from collections.abc import Iterable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mixture_reference import (
    BATCH,
    COMPONENTS,
    COUPLINGS,
    GOOD,
    GOOD_VALUE,
    PUBLIC,
    REFERENCES,
    device,
    everything,
    log_prob,
    mode,
    random_mixture,
    random_value,
    several,
)

from mdnvo_jax import mixture as mx
from mdnvo_jax.mixture import Mixture

# Six cases, one a row.
EXTREMES = Mixture(
    logits=np.array(
        [[0, 1e4, -1e4], [0, -np.inf, -np.inf], [0, -np.inf, 1], [0, 0, 0], [-1e4, 0, 0], [0, 0, -np.inf]], np.float32
    ),
    mean=np.array(
        [
            [[0, 0], [1, 1], [2, 2]],
            # The two of weight zero are where the value is.
            [[0, 0], [1e4, 1e4], [1e4, 1e4]],
            [[-1e4, 1e4], [0, 0], [1e4, -1e4]],
            # Far apart and equally likely: quantiles fall into the gaps.
            [[-1e4, -1e4], [0, 0], [1e4, 1e4]],
            # At the floor of the scale, 1e4 sigma from the value.
            [[0, 0], [0, 0], [1e-8, 0]],
            [[-1e4, 1e4], [1e4, -1e4], [0, 0]],
        ],
        np.float32,
    ),
    log_scale=np.log(np.array([1, 1, 1, 1, 1e-8, 1], np.float32))[:, None, None] * np.ones((1, 3, 2), np.float32),
)
EXTREME_VALUES = np.array([[1e4, -1e4], [1e4, 1e4], [0, 0], [1e4, -1e4], [1e-4, -1e-4], [0, 1e4]], np.float32)


# M = 1 has less to go wrong: only what treats components against each other.
@pytest.mark.parametrize(
    ("components", "names"),
    [(3, tuple(PUBLIC)), (1, ("nll sequence", "covariance joint", "strongest", "mode", "quantile", "sample", "crps"))],
    ids=["3", "1"],
)
def test_extremes_have_finite_values_and_gradients(components: int, names: tuple[str, ...]) -> None:
    logits, centre, log_scale = (field[:, :components] for field in EXTREMES)
    log_scale = np.broadcast_to(log_scale, centre.shape)
    mixture = Mixture(*(field.reshape(*BATCH, *field.shape[1:]) for field in (logits, centre, log_scale)))
    value = EXTREME_VALUES.reshape(*BATCH, 2)

    def total(names: Iterable[str], *arguments: object) -> tuple[jax.Array, dict[str, object]]:
        outputs = several(names)(*arguments)
        return sum(leaf.sum() for leaf in jax.tree.leaves(outputs)), outputs

    def slope(names: Iterable[str]) -> tuple[object, dict[str, object]]:
        return jax.jit(jax.grad(partial(total, names), argnums=(0, 1), has_aux=True))(mixture, value)

    slopes, outputs = slope(names)
    for name, output in outputs.items():
        assert is_finite(output), name
    # What is not finite in one gradient is not in their sum; only then is it worth the time to ask which.
    assert is_finite(slopes), [name for name in names if not is_finite(slope([name])[0])]


def is_finite(tree: object) -> bool:
    return all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))


def test_slope_of_a_quantile_between_spikes_is_finite() -> None:
    """Scales below the spacing of float32 at the means: the density at the nearest number may be zero."""
    rng = np.random.default_rng(0)
    spikes = Mixture(rng.normal(size=(200, 2)), rng.uniform(50, 150, (200, 2, 1)), np.log(np.full((200, 2, 1), 1e-7)))
    probability = np.array([0.1, 0.3, 0.5, 0.7, 0.9])[:, None, None]
    slope = jax.jit(jax.grad(lambda m: mx.quantile(m, probability).sum()))(device(spikes, "float32"))
    assert is_finite(slope)


def test_a_component_of_weight_zero_is_as_good_as_absent() -> None:
    mixture, value = random_mixture(), random_value()
    never = device(mixture._replace(logits=np.where(np.arange(COMPONENTS) == 1, -np.inf, mixture.logits)))
    without = Mixture(*(np.delete(field, 1, axis=len(BATCH)) for field in mixture))
    found = everything(never, jnp.asarray(value))
    for name, reference in REFERENCES.items():
        np.testing.assert_allclose(found[name], reference(without, value), rtol=2e-5, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(found["mode"], mode(device(without)), rtol=1e-5, atol=1e-5)
    slope = jax.jit(jax.grad(lambda m: sum(mx.nll(m, value, coupling=coupling) for coupling in COUPLINGS)))(never)
    assert (slope.logits[..., 1] == 0).all()
    assert (slope.mean[..., 1, :] == 0).all()


def test_slope_beyond_the_largest_square_is_finite() -> None:
    """1e25 sigma from a component: the square of the residual is infinite, the weight of the component zero."""
    mixture = Mixture(jnp.zeros(2), jnp.array([[0.0, 0.0], [1e25, 0.0]]), jnp.zeros((2, 2)))
    value = jnp.array([0.5, 0.0])
    found = jax.jit(jax.grad(lambda m, y: mx.nll(m, y, coupling="joint"), argnums=(0, 1)))(mixture, value)
    np.testing.assert_allclose(found[0].mean, [[-0.5, 0], [0, 0]])
    np.testing.assert_allclose(found[0].log_scale, [[0.75, 1], [0, 0]])
    np.testing.assert_allclose(found[1], [0.5, 0])


@pytest.mark.parametrize("compiled", [True, False], ids=["jit", "eager"])
def test_an_infinite_residual_has_density_zero(compiled: bool) -> None:
    density = partial(mx.log_prob, coupling="joint")
    density = jax.jit(density) if compiled else density
    far = GOOD_VALUE.at[0, 0, 0].set(jnp.inf).at[1, 2, 1].set(-jnp.inf)
    expected = np.asarray(log_prob(GOOD, GOOD_VALUE, coupling="joint")).copy()
    expected[0, 0] = expected[1, 2] = -np.inf
    np.testing.assert_allclose(density(GOOD, far), expected, rtol=1e-6)
