"""A stacked LSTM, bidirectional or causal, as pure functions on a dictionary of parameters.

The cell is that of `torch.nn.LSTM`, gates in its order i, f, g, o:

    i, f, o = sigmoid(.), g = tanh(.) of W x_t + U h_{t-1} + b
    c_t = f * c_{t-1} + i * g,    h_t = o * tanh(c_t)

torch adds two biases, `bias_ih` and `bias_hh`; only their sum matters, and that is our one `bias`.

Parameters: `{"layer0": {"forward": direction, "backward": direction}, "layer1": ...}` (no "backward" in a causal LSTM),
a direction being `{"input_kernel": [F, 4H], "recurrent_kernel": [H, 4H], "bias": [4H]}`: the transposes of torch's.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mdnvo_jax.model.dropout import drop

GATES = 4

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
        return jax.random.uniform(rng, (fan_in, GATES * hidden), minval=-limit, maxval=limit)

    return {
        "input_kernel": xavier(input_rng, inputs),
        "recurrent_kernel": xavier(recurrent_rng, hidden),
        "bias": jnp.zeros(GATES * hidden),
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
    return bilstm_from_gates(params, input_gates(params, inputs), mask, dropout=dropout, rng=rng)


def input_gates(params: LstmParams, inputs: Array) -> Array:
    """Return what inputs `[..., F]` add to the gates of the first layer, W x + b, `[..., directions * 4H]`.

    It depends on no other step: prediction computes it once for a pair of frames that lies in several windows.
    """
    return _input_gates(params["layer0"], inputs)


def bilstm_from_gates(
    params: LstmParams, gates: Array, mask: Array, *, dropout: float = 0.0, rng: Array | None = None
) -> Array:
    """Return what `bilstm` does, from `input_gates` `[B, T, directions * 4H]` instead of the inputs."""
    outputs = gates
    for layer in range(len(params)):
        directions = params[f"layer{layer}"]
        if layer > 0:
            gates = _input_gates(directions, outputs)
        parts = jnp.split(gates, len(directions), axis=-1)
        layer_outputs = [_lstm(directions["forward"], parts[0], mask, reverse=False)]
        if "backward" in directions:
            layer_outputs.append(_lstm(directions["backward"], parts[1], mask, reverse=True))
        outputs = jnp.concatenate(layer_outputs, axis=-1)
        if rng is not None and dropout > 0:
            outputs = drop(outputs, dropout, jax.random.fold_in(rng, layer))
    return outputs


def _input_gates(directions: dict[str, dict[str, Array]], inputs: Array) -> Array:
    """Return the input products of a layer, forward then backward on the last axis.

    For all steps at once, outside the scan: one large product instead of T small ones.
    """
    products = [
        inputs @ directions[name]["input_kernel"] + directions[name]["bias"]
        for name in ("forward", "backward")
        if name in directions
    ]
    return jnp.concatenate(products, axis=-1)


def _lstm(params: dict[str, Array], gates: Array, mask: Array, *, reverse: bool) -> Array:
    """Return the outputs `[B, T, H]` of one direction of one layer, from its input products `[B, T, 4H]`."""
    outputs = _recurrence(params["recurrent_kernel"], jnp.swapaxes(gates, 0, 1), mask.T, reverse)
    return jnp.swapaxes(outputs, 0, 1)


class _Step(NamedTuple):
    """What the backward pass needs of a step: the state before it, the gates, and tanh of the cell after it."""

    cell: Array
    output: Array
    i: Array
    f: Array
    g: Array
    o: Array
    tanh: Array


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def _recurrence(recurrent_kernel: Array, gates: Array, mask: Array, reverse: bool) -> Array:
    """Return the outputs `[T, B, H]` from input products `[T, B, 4H]` and a mask `[T, B]`.

    Differentiated by hand: JAX would add up the gradient of the recurrent kernel `[H, 4H]` in every step of the scan;
    here the steps' cotangents are kept, and it is one product after the loop.
    """
    return _recurrence_forward(recurrent_kernel, gates, mask, reverse)[0]


def _recurrence_forward(
    recurrent_kernel: Array, gates: Array, mask: Array, reverse: bool
) -> tuple[Array, tuple[Array, Array, _Step]]:
    def step(state: tuple[Array, Array], inputs: tuple[Array, Array]) -> tuple[tuple[Array, Array], Any]:
        cell, output = state
        gates, valid = inputs
        i, f, g, o = jnp.split(gates + output @ recurrent_kernel, GATES, axis=-1)
        i, f, g, o = jax.nn.sigmoid(i), jax.nn.sigmoid(f), jnp.tanh(g), jax.nn.sigmoid(o)
        new_cell = f * cell + i * g
        tanh = jnp.tanh(new_cell)
        new_output = o * tanh
        kept = valid[:, None]
        after = jnp.where(kept, new_cell, cell), jnp.where(kept, new_output, output)
        return after, (jnp.where(kept, new_output, jnp.zeros_like(new_output)), _Step(cell, output, i, f, g, o, tanh))

    zero = jnp.zeros((gates.shape[1], recurrent_kernel.shape[0]), gates.dtype)
    _, (outputs, steps) = jax.lax.scan(step, (zero, zero), (gates, mask), reverse=reverse)
    return outputs, (recurrent_kernel, mask, steps)


def _recurrence_backward(
    reverse: bool, saved: tuple[Array, Array, _Step], cotangents: Array
) -> tuple[Array, Array, None]:
    recurrent_kernel, mask, steps = saved

    def step(cotangent: tuple[Array, Array], inputs: tuple[Array, Array, _Step]) -> tuple[tuple[Array, Array], Array]:
        """Go from the cotangents of the state after a step to those of the state before it and of the gates."""
        d_cell, d_output = cotangent
        d_emitted, valid, (cell, _, i, f, g, o, tanh) = inputs
        d_new_output = d_output + d_emitted
        d_new_cell = d_cell + d_new_output * o * (1 - tanh**2)
        parts = (
            d_new_cell * g * i * (1 - i),
            d_new_cell * cell * f * (1 - f),
            d_new_cell * i * (1 - g**2),
            d_new_output * tanh * o * (1 - o),
        )
        kept = valid[:, None]
        d_gates = jnp.concatenate(parts, axis=-1)
        d_gates = jnp.where(kept, d_gates, jnp.zeros_like(d_gates))
        before = jnp.where(kept, d_new_cell * f, d_cell), jnp.where(kept, d_gates @ recurrent_kernel.T, d_output)
        return before, d_gates

    zero = jnp.zeros_like(steps.cell[0])
    _, d_gates = jax.lax.scan(step, (zero, zero), (cotangents, mask, steps), reverse=not reverse)
    return jnp.einsum("tbh,tbg->hg", steps.output, d_gates), d_gates, None


_recurrence.defvjp(_recurrence_forward, _recurrence_backward)
