"""One frame in, one step out: causal prediction in constant memory, as a pure function of an explicit state."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mdnvo_jax import mixture
from mdnvo_jax.config import Config
from mdnvo_jax.mixture import Mixture
from mdnvo_jax.model import fold
from mdnvo_jax.model.convolution import Products
from mdnvo_jax.model.fold import Folded
from mdnvo_jax.model.head import Labels


class StreamState(NamedTuple):
    """What is remembered between frames.

    Attributes:
      image: the last frame as the network reads it, `[H, W, C]` float32.
      usable: whether it was readable.
      seen: whether there was one at all.
      gates: of the last pairs of frames, oldest first, `[window, S G]`: what the LSTM's first layer makes of their
        features.
      mask: which of them are real, `[window]`.
      mean: the last estimated step, `[6]`, held where a frame is unusable.
      variance: of that estimate, `[6]`.
    """

    image: jax.Array
    usable: jax.Array
    seen: jax.Array
    gates: jax.Array
    mask: jax.Array
    mean: jax.Array
    variance: jax.Array


class StreamStep(NamedTuple):
    """The estimate of one step.

    Attributes:
      mean: `[6]`, metres and radians.
      covariance: `[6, 6]` of that vector.
      mixture: the whole density, logits `[M]`, mean and log_scale `[M, 6]`.
      held: whether a frame was unusable, so that the step repeats the one before, less surely.
      valid: false for the first frame, which has no predecessor.
    """

    mean: jax.Array
    covariance: jax.Array
    mixture: Mixture
    held: jax.Array
    valid: jax.Array


def held_step(mean: jax.Array, variance: jax.Array, labels: Labels, components: int) -> Mixture:
    """Return the density of a step that no pair of frames shows: the last mean, as far off as steps vary.

    Args:
      mean: the last estimated step, `[6]`.
      variance: of that estimate, `[6]`; the variance of the labels, how far a step can be from the one before, is
        added to it.
      labels: of the training.
      components: of the mixture.
    """
    log_scale = jnp.log(jnp.asarray(variance) + jnp.asarray(labels.std) ** 2) / 2
    shape = (components, 6)
    return Mixture(
        jnp.zeros(components), jnp.broadcast_to(jnp.asarray(mean), shape), jnp.broadcast_to(log_scale, shape)
    )


class Stream(NamedTuple):
    """What runs a stream; pure functions, which can be jitted and vmapped over cameras.

    Attributes:
      start: (model) -> the state before the first frame.
      step: (model, state, image, usable) -> (state, step): what a frame `[H, W, C]` uint8 adds; `usable` false says
        that it could not be read.
      pair: (state, image) -> (frame, pair): the first part of a step, the image as the network reads it and the pair
        that it makes with the last, `[S, H, W, 2C]` by side, see `fold.sides`.
      advance: (model, state, frame, usable, features) -> (state, step): the last part, after the convolutions have
        made features `[S, F]` of the pair.
    """

    start: Callable[[Folded], StreamState]
    step: Callable[[Folded, StreamState, Any, Any], tuple[StreamState, StreamStep]]
    pair: Callable[[StreamState, Any], tuple[jax.Array, jax.Array]]
    advance: Callable[[Folded, StreamState, Any, Any, Any], tuple[StreamState, StreamStep]]


def stream(config: Config, window: int, sigma_scale: jax.Array | None = None, products: Products = "float32") -> Stream:
    """Return the functions that run a stream.

    Every frame pair goes through the convolutions once; the LSTM runs over the last `window` pairs, so that a step
    depends on no frame that is older.

    Args:
      config: the experiment the model comes from.
      window: pairs remembered; the length the network was trained with is the natural choice.
      sigma_scale: factors `[6]` that every sigma is multiplied by, if any.
      products: of the convolutions, see `convolution`.
    """
    shape = (config.image.height, config.image.width, config.image.channels)

    def start(model: Folded) -> StreamState:
        return StreamState(
            image=jnp.zeros(shape, jnp.float32),
            usable=jnp.array(False),
            seen=jnp.array(False),
            gates=jnp.zeros((window, fold.gates_size(model, config.model)), jnp.float32),
            mask=jnp.zeros(window, bool),
            mean=jnp.asarray(model.labels.mean),
            variance=jnp.zeros(6),
        )

    def pair(state: StreamState, image: jax.Array) -> tuple[jax.Array, jax.Array]:
        frame = fold.normalised_frames(jnp.asarray(image), config.image)
        return frame, fold.sides(jnp.concatenate([state.image, frame], axis=-1)[None], config.image, config.model)

    def advance(
        model: Folded, state: StreamState, frame: jax.Array, usable: jax.Array, features: jax.Array
    ) -> tuple[StreamState, StreamStep]:
        pair_usable = state.seen & state.usable & usable
        gates = jnp.concatenate([state.gates[1:], fold.pair_gates(model, jnp.reshape(features, (1, -1)))])
        mask = jnp.concatenate([state.mask[1:], pair_usable[None]])
        windows = fold.window_densities(model, gates[None], mask[None], config.model, sigma_scale)
        seen_step = jax.tree.map(lambda leaf: leaf[0, -1], windows)
        held = held_step(state.mean, state.variance, model.labels, seen_step.logits.shape[-1])
        density = jax.tree.map(lambda seen, other: jnp.where(pair_usable, seen, other), seen_step, held)
        mean = mixture.mean(density)
        following = StreamState(
            image=jnp.where(usable, frame, state.image),
            usable=jnp.asarray(usable),
            seen=jnp.array(True),
            gates=gates,
            mask=mask,
            mean=jnp.where(pair_usable, mean, state.mean),
            variance=jnp.where(pair_usable, mixture.variance(density), state.variance),
        )
        covariance = mixture.covariance(density, coupling=config.model.coupling)
        return following, StreamStep(mean, covariance, density, state.seen & ~pair_usable, state.seen)

    def step(model: Folded, state: StreamState, image: jax.Array, usable: jax.Array) -> tuple[StreamState, StreamStep]:
        frame, stacked = pair(state, image)
        return advance(model, state, frame, usable, fold.folded_stack(model.stack, stacked, products))

    return Stream(start, step, pair, advance)
