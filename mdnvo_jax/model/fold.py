"""The network as prediction runs it: BatchNorm folded into the convolutions, each half a pure function of arrays.

In evaluation a block of the stack is `leaky((conv(x, K) - mean) a + bias)` with `a = scale / sqrt(var + epsilon)`: a
convolution with the kernel `K a` and the bias `bias - mean a`. Three passes over every map are spared.

A network that looks at every pair mirrored as well (`ModelConfig.mirrored`) has two sides: the stack sees each pair and
its mirror image after it, and features and gates of a pair are those of both, one behind the other.

Of the LSTM, the product of the features with the first layer's kernels depends on one pair of frames alone. It is taken
apart (`pair_gates`), so that a pair which lies in several windows goes through it once, as through the convolutions.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mdnvo_jax import mixture
from mdnvo_jax.config import ImageConfig, ModelConfig
from mdnvo_jax.geometry import mirror_step
from mdnvo_jax.mixture import Mixture
from mdnvo_jax.model.bilstm import LstmParams, bilstm_from_gates, input_gates
from mdnvo_jax.model.conv import BATCH_NORM_EPSILON, LAYERS, LEAKY_SLOPE
from mdnvo_jax.model.convolution import Products, convolve
from mdnvo_jax.model.head import Labels, mixture_from_outputs
from mdnvo_jax.model.normalise import normalise


class FoldedLayer(NamedTuple):
    """A convolution with a bias: kernel `[k, k, C, D]`, bias `[D]`."""

    kernel: Array | np.ndarray
    bias: Array | np.ndarray


class Folded(NamedTuple):
    """A trained network without what only training needs.

    Attributes:
      stack: the convolutions, one for each of `conv.LAYERS`.
      lstm: parameters of `bilstm`.
      head: kernel `[2H, D]` and bias `[D]` of the last dense layer.
      labels: mean and standard deviation of the training steps, `[6]` each, in metres and radians.
      residual_scale: see `head.mixture_from_outputs`, `[6]`.
    """

    stack: tuple[FoldedLayer, ...]
    lstm: LstmParams
    head: dict[str, Array]
    labels: Labels
    residual_scale: Array


def fold_stack(params: Mapping[str, Any], batch_stats: Mapping[str, Any]) -> tuple[FoldedLayer, ...]:
    """Return the stack with its BatchNorm folded, as float32 of numpy; computed in float64.

    Args:
      params: of the stack, by layer: kernel `[k, k, C, D]`, scale `[D]`, bias `[D]`.
      batch_stats: of the stack, by layer: mean `[D]`, var `[D]`.
    """
    return tuple(_fold_layer(params[layer.name], batch_stats[layer.name]) for layer in LAYERS)


def _fold_layer(params: Mapping[str, Any], batch_stats: Mapping[str, Any]) -> FoldedLayer:
    kernel, scale, bias = (np.asarray(params[name], np.float64) for name in ("kernel", "scale", "bias"))
    mean, variance = (np.asarray(batch_stats[name], np.float64) for name in ("mean", "var"))
    factor = scale / np.sqrt(variance + BATCH_NORM_EPSILON)
    return FoldedLayer((kernel * factor).astype(np.float32), (bias - mean * factor).astype(np.float32))


def normalised_frames(frames: Array, image_config: ImageConfig) -> Array:
    """Return frames `[..., H, W, C]` uint8 as the network reads them.

    Raises:
      ValueError: they are of another size than the configuration says, or see `normalise`.
    """
    expected = (image_config.height, image_config.width, image_config.channels)
    if frames.shape[-3:] != expected:
        raise ValueError(f"found frames of shape {frames.shape[-3:]}, expected {expected} as in the image config")
    return normalise(frames, image_config.normalisation)


def stacked_pairs(frames: Array, image_config: ImageConfig) -> Array:
    """Return consecutive frames `[N+1, H, W, C]` uint8 as normalised pairs `[N, H, W, 2C]`."""
    normalised = normalised_frames(frames, image_config)
    return jnp.concatenate([normalised[:-1], normalised[1:]], axis=-1)


def sides(pairs: Array, image_config: ImageConfig, model_config: ModelConfig) -> Array:
    """Return what the stack sees of normalised pairs `[N, H, W, 2C]`: them, or `[2N, H, W, 2C]`, each with its mirror.

    The mirror image is what the left-right mirrored world would show to the same camera: column u is column 2 cx - u,
    between columns interpolated, beyond the edge the edge. Of an unknown camera, cx is the middle.
    """
    if not model_config.mirrored:
        return pairs
    width = pairs.shape[2]
    known = image_config.camera if image_config.rectify else ()
    centre = known[2] if known else (width - 1) / 2
    source = np.clip(2 * centre - np.arange(width), 0, width - 1)
    weights = np.maximum(1 - np.abs(source[:, None] - np.arange(width)), 0).astype(np.float32)
    # For a camera that looks through the middle, or the middle between two columns, all weights are 0 or 1: a copy.
    mirrored = jnp.einsum("uw,nhwc->nhuc", weights, pairs, precision=jax.lax.Precision.HIGHEST)
    return jnp.stack([pairs, mirrored], axis=1).reshape(-1, *pairs.shape[1:])


def folded_stack(stack: Sequence[FoldedLayer], pairs: Array, products: Products = "float32") -> Array:
    """Return the features `[N, F]` of normalised pairs `[N, H, W, 2C]`; for `products` see `convolution`."""
    maps = pairs
    for layer, (kernel, bias) in zip(LAYERS, stack, strict=True):
        maps = convolve(maps, jnp.asarray(kernel), layer.stride, layer.padding, products) + bias
        maps = jnp.maximum(maps, LEAKY_SLOPE * maps)
    return maps.reshape(maps.shape[0], -1)


def pair_features(
    model: Folded, frames: Array, image_config: ImageConfig, model_config: ModelConfig, products: Products = "float32"
) -> Array:
    """Return the features `[N, S F]` of the pairs of consecutive frames `[N+1, H, W, C]` uint8, of S sides each."""
    seen = sides(stacked_pairs(frames, image_config), image_config, model_config)
    return folded_stack(model.stack, seen, products).reshape(frames.shape[0] - 1, -1)


def pair_gates(model: Folded, features: Array) -> Array:
    """Return what features `[..., S F]` add to the gates of the LSTM's first layer, `[..., S G]`."""
    size = model.lstm["layer0"]["forward"]["input_kernel"].shape[0]
    gates = input_gates(model.lstm, features.reshape(*features.shape[:-1], -1, size))
    return gates.reshape(*features.shape[:-1], -1)


def gates_size(model: Folded, model_config: ModelConfig) -> int:
    """Return the size S G of what `pair_gates` gives."""
    return (1 + model_config.mirrored) * sum(layer["bias"].shape[0] for layer in model.lstm["layer0"].values())


def window_densities(
    model: Folded, gates: Array, mask: Array, model_config: ModelConfig, sigma_scale: Array | None = None
) -> Mixture:
    """Return the density of every step of windows, in metres and radians.

    Args:
      model: of `fold_stack` and the rest of a training.
      gates: of `pair_gates`, `[B, T, S G]`.
      mask: `[B, T]`, false for steps that do not count.
      model_config: of the network.
      sigma_scale: factors `[6]` that every sigma is multiplied by, fitted on validation data (see `recalibration`); a
        sigma may then fall below the floor.
    """
    if model_config.mirrored:
        gates, mask = jnp.concatenate(jnp.split(gates, 2, axis=-1)), jnp.concatenate([mask, mask])
    outputs = bilstm_from_gates(model.lstm, gates, mask) @ model.head["kernel"] + model.head["bias"]
    density = mixture_from_outputs(outputs, model.labels, model_config, model.residual_scale)
    if model_config.mirrored:
        straight, mirrored = (Mixture(*parts) for parts in zip(*(jnp.split(leaf, 2) for leaf in density), strict=True))
        density = mixture.pool([straight, mirrored._replace(mean=mirror_step(mirrored.mean))])
    return density if sigma_scale is None else mixture.widen(density, sigma_scale)
