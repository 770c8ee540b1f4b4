"""A stacked LSTM, bidirectional or causal, as pure functions on a dictionary of parameters.

The cell is that of `torch.nn.LSTM`, gates in its order i, f, g, o:

    i, f, o = sigmoid(.), g = tanh(.) of W x_t + U h_{t-1} + b
    c_t = f * c_{t-1} + i * g,    h_t = o * tanh(c_t)

torch adds two biases, `bias_ih` and `bias_hh`; only their sum matters, and that is our one `bias`.

Parameters: `{"layer0": {"forward": direction, "backward": direction}, "layer1": ...}` (no "backward" in a causal LSTM),
a direction being `{"input_kernel": [F, 4H], "recurrent_kernel": [H, 4H], "bias": [4H]}`: the transposes of torch's.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

_GATES = 4

LstmParams = dict[str, dict[str, dict[str, Any]]]


def init_lstm(rng: Array, features: int, hidden: int, layers: int, *, bidirectional: bool = True) -> LstmParams:
    """Return fresh parameters.

    Kernels are Xavier uniform gate by gate: limit sqrt(6 / (inputs + hidden)). Biases are zero, that of the forget
    gate included: the paper says Xavier and no more.

    Args:
      rng: a PRNG key.
      features: size F of an input step.
      hidden: units H of a direction.
      layers: number of layers; those after the first read the outputs of the one before.
      bidirectional: whether every layer also runs backwards in time.
    """
    directions = ("forward", "backward") if bidirectional else ("forward",)
    params: LstmParams = {}
    for layer in range(layers):
        inputs = features if layer == 0 else hidden * len(directions)
        params[f"layer{layer}"] = {
            direction: _init_direction(jax.random.fold_in(rng, 2 * layer + index), inputs, hidden)
            for index, direction in enumerate(directions)
        }
    return params


def _init_direction(rng: Array, inputs: int, hidden: int) -> dict[str, Array]:
    """Return the parameters of one direction of one layer."""
    input_rng, recurrent_rng = jax.random.split(rng)

    def xavier(rng: Array, fan_in: int) -> Array:
        limit = (6 / (fan_in + hidden)) ** 0.5
        return jax.random.uniform(rng, (fan_in, _GATES * hidden), minval=-limit, maxval=limit)

    return {
        "input_kernel": xavier(input_rng, inputs),
        "recurrent_kernel": xavier(recurrent_rng, hidden),
        "bias": jnp.zeros(_GATES * hidden),
    }


def bilstm(params: LstmParams, inputs: Array, mask: Array, *, dropout: float = 0.0, rng: Array | None = None) -> Array:
    """Run the stacked LSTM over windows, from a zero initial state.

    A masked step leaves the state as it was, wherever it stands: the backward direction therefore starts at the last
    valid step of a padded window with a zero state, and a hole in the middle (a bad frame) is bridged. What stands in
    masked steps never reaches the outputs of valid ones, unless it is not finite.

    Args:
      params: of `init_lstm`; layers and directions are those that are there.
      inputs: `[B, T, F]`.
      mask: `[B, T]`, true where a step counts.
      dropout: share of a layer's outputs that is zeroed, after every layer, where an `rng` is given.
      rng: a PRNG key for dropout; None (prediction) drops nothing.

    Returns:
      The outputs of the last layer, forward then backward on the last axis: `[B, T, 2 * H]`, or `[B, T, H]` if causal.
      Zero in masked steps.
    """
    for layer in range(len(params)):
        directions = params[f"layer{layer}"]
        outputs = [_lstm(directions["forward"], inputs, mask, reverse=False)]
        if "backward" in directions:
            outputs.append(_lstm(directions["backward"], inputs, mask, reverse=True))
        inputs = jnp.concatenate(outputs, axis=-1)
        if rng is not None and dropout > 0:
            kept = jax.random.bernoulli(jax.random.fold_in(rng, layer), 1 - dropout, inputs.shape)
            inputs = jnp.where(kept, inputs / (1 - dropout), jnp.zeros_like(inputs))
    return inputs


def _lstm(params: dict[str, Array], inputs: Array, mask: Array, *, reverse: bool) -> Array:
    """Return the outputs `[B, T, H]` of one direction of one layer."""
    recurrent_kernel = params["recurrent_kernel"]
    batch, hidden = inputs.shape[0], recurrent_kernel.shape[0]
    # All steps at once, outside the scan: one large product instead of T small ones.
    projected = jnp.einsum("btf,fg->tbg", inputs, params["input_kernel"]) + params["bias"]

    def step(carry: tuple[Array, Array], step_inputs: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        cell, output = carry
        gates, valid = step_inputs
        i, f, g, o = jnp.split(gates + output @ recurrent_kernel, _GATES, axis=-1)
        new_cell = jax.nn.sigmoid(f) * cell + jax.nn.sigmoid(i) * jnp.tanh(g)
        new_output = jax.nn.sigmoid(o) * jnp.tanh(new_cell)
        kept = valid[:, None]
        carry = jnp.where(kept, new_cell, cell), jnp.where(kept, new_output, output)
        return carry, jnp.where(kept, new_output, jnp.zeros_like(new_output))

    zero = jnp.zeros((batch, hidden), projected.dtype)
    _, outputs = jax.lax.scan(step, (zero, zero), (projected, mask.T), reverse=reverse)
    return jnp.swapaxes(outputs, 0, 1)
