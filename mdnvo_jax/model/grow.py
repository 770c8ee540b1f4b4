"""A wider network that computes what a trained one does: what was learned is kept, and there is room for more.

New units read all that comes before them, with kernels as they are drawn for a fresh network; what was there reads
nothing of theirs, with kernels of zero. So no output changes, while the gradients of those zeros are not zero: the new
units take part from the first step on. (Net2Net, Chen et al. 2016, copies units instead and parts the copies by noise.)
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mdnvo_jax import leaves
from mdnvo_jax.model.bilstm import GATES
from mdnvo_jax.model.conv import LAYERS


def grow(trained: dict[str, Any], drawn: dict[str, Any]) -> dict[str, Any]:
    """Return the variables of a network as wide as `drawn`, whose outputs are those of `trained`, but for rounding.

    That holds in training too, for batch normalisation treats every channel for itself. As wide, they are `trained`.

    Args:
      trained: of a network, `{"params": ..., "batch_stats": ...}`; what `drawn` has no place for is left out.
      drawn: fresh ones, of `network.initialise`, for a network whose stack and LSTM are as wide or wider, and which is
        like it else. What `trained` lacks, such as the layer for optical flow, is taken from here.

    Raises:
      ValueError: something of `trained` is larger than in `drawn`.
    """
    before, after = _sizes(trained), _sizes(drawn)
    result = leaves.by_name(drawn)
    for name, leaf in leaves.by_name(trained).items():
        if name in result:
            old, new = np.asarray(leaf), np.asarray(result[name])
            parts, room = old.reshape(_runs(name, old.shape, *before)), new.reshape(_runs(name, new.shape, *after))
            if (np.array(parts.shape) > room.shape).any():
                raise ValueError(f"{name} of shape {old.shape} does not fit into one of {new.shape}")
            result[name] = jnp.asarray(_embedded(parts, room).reshape(new.shape))
    return jax.tree.unflatten(jax.tree.structure(drawn), result.values())


def _embedded(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Return `new` with `old` in its first corner, and zero where units of `old`, on the last axis, read others'."""
    result = new.copy()
    result[..., : old.shape[-1]] = 0
    result[tuple(slice(length) for length in old.shape)] = old
    return result


def _sizes(variables: dict[str, Any]) -> tuple[int, int]:
    """Return the channels of the stack's last maps, and the hidden units of a direction of the LSTM."""
    params = variables["params"]
    hidden = params["lstm"]["layer0"]["forward"]["recurrent_kernel"].shape[0]
    return params["stack"][LAYERS[-1].name]["bias"].size, hidden


def _runs(name: str, shape: tuple[int, ...], channels: int, hidden: int) -> tuple[int, ...]:
    """Return the shape of a leaf whose axes hold one kind of unit each: those read before the last, of its own last.

    The LSTM reads the channels of one place of the maps after the other, later layers and the head the hidden units of
    one direction after the other; its own units stand gate by gate.
    """
    match name.split(".")[1:]:
        case ["lstm", "layer0", _, "input_kernel"]:
            return -1, channels, GATES, hidden
        case ["lstm", _, _, "input_kernel"]:
            return -1, hidden, GATES, hidden
        case ["lstm", _, _, "recurrent_kernel"]:
            return hidden, GATES, hidden
        case ["lstm", _, _, "bias"]:
            return GATES, hidden
        case ["head", "kernel"]:
            return -1, hidden, shape[-1]
        case _:
            return shape
