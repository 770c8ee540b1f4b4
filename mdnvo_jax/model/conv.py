"""The convolution stack: nine layers as in FlowNetS and DeepVO, each with BatchNorm, LeakyReLU and dropout."""

from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from mdnvo_jax.model.convolution import Products, convolve
from mdnvo_jax.model.dropout import drop


class Layer(NamedTuple):
    """One convolution: a square kernel of `kernel` pixels, `stride`, and its output `channels` at full width."""

    name: str
    kernel: int
    stride: int
    channels: int

    @property
    def padding(self) -> int:
        """Rows and columns of zeros on every side. Explicit: SAME would pad a strided 7x7 by 2 and 3, FlowNet by 3."""
        return (self.kernel - 1) // 2


# FlowNetS (Dosovitskiy et al. 2015) up to conv6, which are the nine layers of DeepVO and of the MDN-VO paper.
LAYERS = (
    Layer("conv1", 7, 2, 64),
    Layer("conv2", 5, 2, 128),
    Layer("conv3", 5, 2, 256),
    Layer("conv3_1", 3, 1, 256),
    Layer("conv4", 3, 2, 512),
    Layer("conv4_1", 3, 1, 512),
    Layer("conv5", 3, 2, 512),
    Layer("conv5_1", 3, 1, 512),
    Layer("conv6", 3, 2, 1024),
)

# The layers up to the one that optical flow is read off while training: the last at this stride in each direction.
FLOW_LAYERS = LAYERS[:4]
FLOW_STRIDE = 8

# FlowNet's LeakyReLU; flax's own default is 0.01.
LEAKY_SLOPE = 0.1
# torch's default.
BATCH_NORM_EPSILON = 1e-5


def layer_channels(layer: Layer, multiplier: float) -> int:
    """Return the output channels of `layer` in a stack whose widths are scaled by `multiplier`; at least 1."""
    return max(1, round(layer.channels * multiplier))


def map_size(height: int, width: int, layers: Sequence[Layer] = LAYERS) -> tuple[int, int]:
    """Return rows and columns of the maps after `layers` for images of `height` x `width` pixels."""
    for layer in layers:
        height = (height + 2 * layer.padding - layer.kernel) // layer.stride + 1
        width = (width + 2 * layer.padding - layer.kernel) // layer.stride + 1
    return height, width


class Moments(NamedTuple):
    """Mean and biased variance by channel `[C]` over the `pixels` that were not masked."""

    mean: Array
    variance: Array
    pixels: Array


def batch_moments(x: Array, mask: Array, axis_name: str | None = None) -> Moments:
    """Return the moments of maps `x` `[N, H, W, C]` over those with a true `mask` `[N]`; zeros where there are none.

    They are those of the maps of all devices along the axis `axis_name` of a `jax.pmap`, where one is named.
    """

    def total(values: Array) -> Array:
        return values if axis_name is None else jax.lax.psum(values, axis_name)

    x = x.astype(jnp.promote_types(x.dtype, jnp.float32))
    where = mask[:, None, None, None]
    pixels = total(mask.sum() * (x.shape[1] * x.shape[2]))
    divisor = jnp.maximum(pixels, 1).astype(x.dtype)
    mean = total(jnp.sum(x, axis=(0, 1, 2), where=where)) / divisor
    # Two passes: the mean of squares minus the square of the mean loses digits where the mean is large.
    variance = total(jnp.sum(jnp.square(x - mean), axis=(0, 1, 2), where=where)) / divisor
    return Moments(mean, variance, pixels)


class ConvBlock(nn.Module):
    """Convolution without bias, BatchNorm, LeakyReLU, dropout.

    The BatchNorm is that of torch: the batch is normalised with its biased variance, while the running variance takes
    the unbiased one. (`flax.linen.BatchNorm` keeps the biased one, and its statistics are NaN for a batch whose maps
    are all masked; here such a batch is normalised with the running statistics, and leaves them alone.)

    Parameters are kernel `[k, k, C, D]`, scale `[D]` and bias `[D]`; batch statistics are mean `[D]` and var `[D]`. All
    of them, and what is computed between two convolutions, are float32; the maps come and go in their own type.
    """

    layer: Layer
    channels: int
    dropout: float
    products: Products = "float32"
    momentum: float = 0.9
    axis_name: str | None = None

    @nn.compact
    def __call__(self, x: Array, mask: Array, train: bool) -> Array:
        """Return `[N, h, w, channels]` for maps `[N, H, W, C]`; `mask` `[N]` marks those that count in statistics."""
        size = self.layer.kernel
        kernel = self.param("kernel", nn.initializers.glorot_uniform(), (size, size, x.shape[-1], self.channels))
        scale = self.param("scale", nn.initializers.ones, (self.channels,))
        bias = self.param("bias", nn.initializers.zeros, (self.channels,))
        running_mean = self.variable("batch_stats", "mean", jnp.zeros, (self.channels,))
        running_variance = self.variable("batch_stats", "var", jnp.ones, (self.channels,))

        kind = x.dtype
        x = convolve(x, kernel, self.layer.stride, self.layer.padding, self.products)
        mean, variance = running_mean.value, running_variance.value
        if train:
            batch = batch_moments(x, mask, self.axis_name)
            filled = batch.pixels > 0
            unbiased = batch.variance * (batch.pixels / jnp.maximum(batch.pixels - 1, 1))
            running_mean.value = jnp.where(filled, self._blend(mean, batch.mean), mean)
            running_variance.value = jnp.where(filled, self._blend(variance, unbiased), variance)
            mean = jnp.where(filled, batch.mean, mean)
            variance = jnp.where(filled, batch.variance, variance)
        x = (x - mean) * (scale * jax.lax.rsqrt(variance + BATCH_NORM_EPSILON)) + bias
        x = nn.leaky_relu(x, LEAKY_SLOPE)
        x = drop(x, self.dropout, self.make_rng("dropout")) if train and self.dropout else x
        return x.astype(kind)

    def _blend(self, running: Array, batch: Array) -> Array:
        """Return the running statistic after one more batch."""
        return (self.momentum * running + (1 - self.momentum) * batch).astype(running.dtype)


class ConvStack(nn.Module):
    """The nine blocks of `LAYERS`, with channels scaled by `multiplier` and dropout of rate `dropout` after each.

    Attributes:
      multiplier: of the channels.
      dropout: its rate.
      products: see `convolution`.
      momentum: of the running statistics.
      activations: type of the maps while training.
      rematerialise: whether the backward pass computes the maps again.
      axis_name: of the `jax.pmap` whose devices share the batch, if it is one.
    """

    multiplier: float
    dropout: float
    products: Products = "float32"
    momentum: float = 0.9
    activations: str = "float32"
    rematerialise: bool = False
    axis_name: str | None = None

    def __call__(self, pairs: Array, mask: Array, *, train: bool) -> Array:
        """Return the last of `maps`: `[N, h, w, D]` with h, w of `map_size` and D = 1024 * multiplier."""
        return self.maps(pairs, mask, train=train)[-1]

    @nn.compact
    def maps(self, pairs: Array, mask: Array, *, train: bool) -> tuple[Array, ...]:
        """Return the maps of frame pairs after each layer.

        Args:
          pairs: two frames stacked on channels, normalised, `[N, H, W, 2 * C]`.
          mask: `[N]`, false for pairs that are padding: they do not enter the batch statistics.
          train: whether to drop units, normalise with the batch and update the collection "batch_stats".

        Returns:
          Nine times `[N, h, w, D]`, float32.
        """
        block_type = nn.remat(ConvBlock, static_argnums=(3,)) if self.rematerialise and train else ConvBlock
        x = pairs.astype(jnp.bfloat16) if train and self.activations == "bfloat16" else pairs
        maps = []
        for layer in LAYERS:
            channels = layer_channels(layer, self.multiplier)
            shared = (self.products, self.momentum, self.axis_name)
            x = block_type(layer, channels, self.dropout, *shared, name=layer.name)(x, mask, train)
            maps.append(x)
        return tuple(x.astype(pairs.dtype) for x in maps)
