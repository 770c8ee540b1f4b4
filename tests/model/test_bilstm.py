import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from mdnvo_jax.model.bilstm import bilstm, init_lstm

FEATURES, HIDDEN, STEPS = 5, 3, 6

run = jax.jit(bilstm)
run_dropping = jax.jit(bilstm, static_argnames="dropout")


def random_params(layers=2, bidirectional=True, seed=0):
    params = init_lstm(jax.random.key(seed), FEATURES, HIDDEN, layers, bidirectional=bidirectional)
    # Lively: no bias of zero, gates that saturate now and then.
    leaves, tree = jax.tree.flatten(params)
    rng = np.random.default_rng(seed)
    return jax.tree.unflatten(tree, [rng.normal(size=leaf.shape).astype(np.float32) for leaf in leaves])


def naive(params, inputs, mask):
    """One step, one window, one layer at a time, in float64; masked steps are cut out of the window."""
    outputs = np.zeros((*mask.shape, HIDDEN * len(params["layer0"])))
    for window, valid in enumerate(mask):
        x = inputs[window][valid].astype(np.float64)
        for layer in range(len(params)):
            columns = []
            for direction, order in (("forward", 1), ("backward", -1)):
                if direction not in params[f"layer{layer}"]:
                    continue
                p = params[f"layer{layer}"][direction]
                c, h, hs = np.zeros(HIDDEN), np.zeros(HIDDEN), []
                for step in x[::order]:
                    i, f, g, o = np.split(step @ p["input_kernel"] + h @ p["recurrent_kernel"] + p["bias"], 4)
                    c = c / (1 + np.exp(-f)) + np.tanh(g) / (1 + np.exp(-i))
                    h = np.tanh(c) / (1 + np.exp(-o))
                    hs.append(h)
                columns.append(np.array(hs).reshape(-1, HIDDEN)[::order])
            x = np.concatenate(columns, -1)
        outputs[window][valid] = x
    return outputs


# Also windows with holes, and windows without a step.
@given(st.lists(st.lists(st.booleans(), min_size=STEPS, max_size=STEPS), min_size=2, max_size=2), st.booleans())
@settings(max_examples=25, deadline=None)
def test_is_the_definition_with_masked_steps_cut_out(mask, bidirectional):
    mask = np.array(mask)
    inputs = np.random.default_rng(1).normal(size=(2, STEPS, FEATURES)).astype(np.float32)
    params = random_params(bidirectional=bidirectional)
    found = run(params, inputs, mask)
    np.testing.assert_allclose(found, naive(params, inputs, mask), rtol=1e-5, atol=1e-6)
    assert (np.asarray(found)[~mask] == 0).all()


def ours(weights, kind):
    """Our parameters from those of `torch.nn.LSTM`."""
    directions = {"forward": ""} | ({"backward": "_reverse"} if kind == "both" else {})
    return {
        f"layer{layer}": {
            direction: {
                "input_kernel": weights[f"{kind}_weight_ih_l{layer}{suffix}"].T,
                "recurrent_kernel": weights[f"{kind}_weight_hh_l{layer}{suffix}"].T,
                "bias": weights[f"{kind}_bias_ih_l{layer}{suffix}"] + weights[f"{kind}_bias_hh_l{layer}{suffix}"],
            }
            for direction, suffix in directions.items()
        }
        for layer in range(2)
    }


# In float64 the only difference left is that the recorded figures are float32; float32 adds its own rounding.
@pytest.mark.parametrize(("wide", "tolerance"), [(True, 2e-7), (False, 1e-5)])
@pytest.mark.parametrize("kind", ["both", "causal"])
def test_agrees_with_torch(golden, assert_close, kind, wide, tolerance):
    dtype = np.float64 if wide else np.float32
    with np.load(golden / "torch_lstm.npz") as recorded, jax.enable_x64(wide):
        recorded = {name: jnp.asarray(array, dtype) for name, array in recorded.items()}
        inputs = recorded["inputs"]
        mask = jnp.arange(inputs.shape[1]) < recorded["lengths"][:, None]

        def loss(params, inputs):
            outputs = bilstm(params, inputs, mask)
            return jnp.sum(outputs * recorded[f"{kind}_cotangent"]), outputs

        (by_params, by_inputs), outputs = jax.jit(jax.grad(loss, argnums=(0, 1), has_aux=True))(
            ours(recorded, kind), inputs
        )
        assert outputs.dtype == dtype
        assert_close(outputs, recorded[f"{kind}_outputs"], tolerance)
        assert_close(by_inputs, recorded[f"{kind}_grad_inputs"], tolerance)
        expected = ours({name.replace("grad_", ""): array for name, array in recorded.items() if "grad_" in name}, kind)
        for layer, directions in expected.items():
            for direction, arrays in directions.items():
                # The two biases of torch have the same gradient, which is ours.
                arrays["bias"] = arrays["bias"] / 2
                for name, array in arrays.items():
                    assert_close(by_params[layer][direction][name], array, tolerance)


@pytest.mark.parametrize("bidirectional", [True, False])
def test_gradients_are_those_of_finite_differences(bidirectional):
    """The backward pass is written by hand; holes, padding and an empty window included."""
    mask = np.array([[1, 1, 1, 1, 1, 1], [1, 1, 0, 1, 0, 0], [0, 0, 0, 0, 0, 0]], bool)
    with jax.enable_x64(True):
        params = jax.tree.map(np.float64, random_params(layers=2, bidirectional=bidirectional))
        inputs = np.random.default_rng(2).normal(size=(3, STEPS, FEATURES))
        check_grads(
            jax.jit(lambda params, inputs: bilstm(params, inputs, mask)), (params, inputs), 1, ["rev"], rtol=1e-6
        )


def test_padding_changes_nothing():
    rng = np.random.default_rng(0)
    params, inputs = random_params(), rng.normal(size=(2, STEPS, FEATURES)).astype(np.float32)
    mask = np.arange(STEPS) < np.array([[4], [2]])
    padded = np.where(mask[..., None], inputs, 1e6).astype(np.float32)
    expected = run(params, inputs, mask)
    np.testing.assert_array_equal(run(params, padded, mask), expected)
    longer = np.concatenate([padded, padded], 1), np.concatenate([mask, np.zeros_like(mask)], 1)
    np.testing.assert_allclose(run(params, *longer)[:, :STEPS], expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("bidirectional", [False, True])
def test_only_a_bidirectional_lstm_looks_ahead(bidirectional):
    params = random_params(bidirectional=bidirectional)
    inputs = np.random.default_rng(0).normal(size=(1, STEPS, FEATURES)).astype(np.float32)
    mask = np.ones((1, STEPS), bool)
    before, after = run(params, inputs, mask), run(params, inputs + (np.arange(STEPS) >= 4)[:, None], mask)
    changed = (np.asarray(before) != np.asarray(after)).any(-1)[0]
    assert changed.tolist() == ([True] * STEPS if bidirectional else [False] * 4 + [True] * 2)


def test_initialisation_is_xavier_gate_by_gate():
    features, hidden = 200, 100
    params = jax.jit(functools.partial(init_lstm, features=features, hidden=hidden, layers=2))(jax.random.key(0))
    assert list(params) == ["layer0", "layer1"]
    kernels = []
    for layer, inputs in (("layer0", features), ("layer1", 2 * hidden)):
        assert list(params[layer]) == ["backward", "forward"]
        for direction in params[layer].values():
            assert (np.asarray(direction["bias"]) == 0).all()
            for name, fan_in in (("input_kernel", inputs), ("recurrent_kernel", hidden)):
                kernel = np.asarray(direction[name])
                assert kernel.shape == (fan_in, 4 * hidden)
                assert kernel.var() == pytest.approx(2 / (fan_in + hidden), rel=0.03)
                assert np.abs(kernel).max() <= np.sqrt(6 / (fan_in + hidden))
                kernels.append(kernel.ravel())
    # No two alike: every layer and direction has its own random numbers.
    correlations = np.corrcoef([kernel[:40_000] for kernel in kernels])
    assert np.abs(correlations - np.eye(len(kernels))).max() < 0.05
    assert list(init_lstm(jax.random.key(0), 2, 2, 1, bidirectional=False)["layer0"]) == ["forward"]


def test_dropout_follows_every_layer_and_needs_a_key():
    inputs = np.random.default_rng(0).normal(size=(64, STEPS, FEATURES)).astype(np.float32)
    mask, params = np.ones((64, STEPS), bool), random_params(layers=1)
    plain = np.asarray(run(params, inputs, mask))
    np.testing.assert_array_equal(run_dropping(params, inputs, mask, dropout=0.2), plain)
    dropped = np.asarray(run_dropping(params, inputs, mask, dropout=0.2, rng=jax.random.key(0)))
    kept = dropped != 0
    np.testing.assert_allclose(dropped[kept], plain[kept] / 0.8, rtol=1e-5)
    assert abs((~kept).mean() - 0.2) < 4 * np.sqrt(0.16 / kept.size)

    # With everything after the first layer dropped, the second sees zeros: its outputs are those of its biases.
    params = random_params(layers=2)
    outputs = run_dropping(params, inputs, mask, dropout=1 - 1e-7, rng=jax.random.key(0))
    assert np.count_nonzero(outputs) < 0.01 * outputs.size


@pytest.mark.parametrize("scale", [0.0, 1e4])
def test_gradients_are_finite_and_zero_where_masked(scale):
    rng = np.random.default_rng(0)
    params, inputs = random_params(), (scale * rng.normal(size=(2, STEPS, FEATURES))).astype(np.float32)
    mask = np.array([[True, False, True, True, False, False], [False] * STEPS])
    gradient = jax.jit(jax.grad(lambda params, x: bilstm(params, x, mask).sum(), argnums=(0, 1)))(params, inputs)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert (np.asarray(gradient[1])[~mask] == 0).all()
