"""A network that grew answers as it did before, and learns with all of itself."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_model import CONFIG, FRAMES, trained_variables

from mdnvo_jax.config import Config
from mdnvo_jax.model.grow import grow
from mdnvo_jax.model.network import Network, build
from mdnvo_jax.training.state import initial_variables

WINDOWS = jnp.asarray(np.stack([FRAMES[:5], FRAMES[10:15], FRAMES[20:25]]))
MASK = jnp.array([[True] * 4, [True] * 4, [True, True, False, False]])


@pytest.fixture(scope="module")
def small() -> dict:
    return trained_variables()


def like(**model: object) -> Config:
    return dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, conv_dropout=0.0, **model))


def drawn(config: Config) -> tuple[Network, dict]:
    network = build(config.image, config.model)
    return network, initial_variables(network, config)


@pytest.mark.parametrize("sizes", [{"width": 3 / 32}, {"lstm_hidden": 13}, {"width": 1 / 8, "lstm_hidden": 11}])
def test_outputs_are_what_they_were(small: dict, sizes: dict) -> None:
    network, fresh = drawn(like(**sizes))
    grown = grow(small, fresh)
    assert jax.tree.map(jnp.shape, grown) == jax.tree.map(jnp.shape, fresh)
    before = build(CONFIG.image, like().model).apply(small, WINDOWS, MASK)
    # Far from what a network of that size gives without having learned anything.
    assert np.abs(network.apply(fresh, WINDOWS, MASK) - before).max() > 0.1
    np.testing.assert_allclose(network.apply(grown, WINDOWS, MASK), before, atol=1e-5)


def test_outputs_in_training_are_what_they_were_as_well(small: dict) -> None:
    network, fresh = drawn(like(width=1 / 8, lstm_hidden=11, lstm_dropout=0.0))

    def train(network: Network, variables: dict) -> tuple:
        return network.apply(variables, WINDOWS, MASK, train=True, mutable=["batch_stats"])

    after, statistics = train(network, grow(small, fresh))
    before, known = train(build(CONFIG.image, like(lstm_dropout=0.0).model), small)
    np.testing.assert_allclose(after, before, atol=1e-4)
    layer = known["batch_stats"]["stack"]["conv6"]["mean"]
    np.testing.assert_allclose(
        statistics["batch_stats"]["stack"]["conv6"]["mean"][: layer.size], layer, rtol=1e-5, atol=1e-6
    )


def test_a_causal_lstm_grows_as_well() -> None:
    network, variables = drawn(like(bidirectional=False))
    wider, fresh = drawn(like(bidirectional=False, width=1 / 8, lstm_hidden=11))
    before = network.apply(variables, WINDOWS, MASK)
    np.testing.assert_allclose(wider.apply(grow(variables, fresh), WINDOWS, MASK), before, atol=1e-5)


def test_new_units_learn_from_the_first_step_on(small: dict) -> None:
    """Kernels of zero have gradients, and after one step along them, so have the kernels of new units."""
    network, fresh = drawn(like(width=1 / 8, lstm_hidden=11))
    grown = grow(small, fresh)

    @jax.jit
    def gradient(params: dict) -> dict:
        def loss(given: dict) -> jax.Array:
            return jnp.square(network.apply({**grown, "params": given}, WINDOWS, MASK)).sum()

        return jax.grad(loss)(params)

    channels = {"conv1": 4, "conv2": 8, "conv4_1": 32, "conv6": 64}
    params = grown["params"]
    first = gradient(params)
    assert not any(np.any(first["stack"][name]["kernel"][..., size:]) for name, size in channels.items())
    assert np.abs(first["stack"]["conv2"]["kernel"][:, :, 4:, :8]).min() > 0
    assert np.abs(first["lstm"]["layer0"]["forward"]["input_kernel"].reshape(-1, 128, 4, 11)[:, 64:, :, :8]).max() > 0
    assert np.abs(first["head"]["kernel"].reshape(2, 11, -1)[:, 8:]).min() > 0
    second = gradient(jax.tree.map(lambda value, slope: value - 1e-3 * slope, params, first))
    for name, size in channels.items():
        assert np.abs(second["stack"][name]["kernel"][..., size:]).max() > 0, name


def test_as_wide_it_is_the_same_network_to_the_bit(small: dict) -> None:
    _, fresh = drawn(CONFIG)
    jax.tree.map(np.testing.assert_array_equal, grow(small, fresh), small)


def test_no_network_shrinks(small: dict) -> None:
    for sizes in ({"width": 1 / 32}, {"lstm_hidden": 7}):
        with pytest.raises(ValueError, match="does not fit into one of"):
            grow(small, drawn(like(**sizes))[1])
