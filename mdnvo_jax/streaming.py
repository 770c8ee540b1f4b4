"""One frame in, one step out: causal prediction in constant memory, as a pure function of an explicit state."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mdnvo_jax import mixture
from mdnvo_jax.config import Config
from mdnvo_jax.mixture import Mixture
from mdnvo_jax.model.head import Labels, mixture_from_outputs
from mdnvo_jax.model.network import Network
from mdnvo_jax.training.state import Model


class StreamState(NamedTuple):
    """What is remembered between frames.

    Attributes:
      image: the last frame, `[H, W, C]` uint8.
      usable: whether it was readable.
      seen: whether there was one at all.
      features: of the last pairs of frames, oldest first, `[window, F]`.
      mask: which of them are real, `[window]`.
      mean: the last estimated step, `[6]`, held where a frame is unusable.
      variance: of that estimate, `[6]`.
    """

    image: jax.Array
    usable: jax.Array
    seen: jax.Array
    features: jax.Array
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


def stream(
    network: Network, config: Config, window: int, sigma_scale: jax.Array | None = None
) -> tuple[
    Callable[[Model], StreamState], Callable[[Model, StreamState, jax.Array, jax.Array], tuple[StreamState, StreamStep]]
]:
    """Return `start(model) -> state` and `step(model, state, image, usable) -> (state, step)`.

    Both are pure and can be jitted and vmapped over cameras. Every frame pair goes through the convolutions once; the
    LSTM runs over the last `window` pairs, so that a step depends on no frame that is older.

    Args:
      network: from `build`.
      config: the experiment the model comes from.
      window: pairs remembered; the length the network was trained with is the natural choice.
      sigma_scale: factors `[6]` that every sigma is multiplied by, if any.
    """
    shape = (config.image.height, config.image.width, config.image.channels)

    def pair_features(model: Model, first: jax.Array, second: jax.Array) -> jax.Array:
        variables = {"params": model.params, "batch_stats": model.batch_stats}
        return network.apply(variables, first[None], second[None], method="pair_features")[0]

    def start(model: Model) -> StreamState:
        frame = jax.ShapeDtypeStruct(shape, jnp.uint8)
        features = jax.eval_shape(pair_features, model, frame, frame)
        return StreamState(
            image=jnp.zeros(shape, jnp.uint8),
            usable=jnp.array(False),
            seen=jnp.array(False),
            features=jnp.zeros((window, *features.shape), features.dtype),
            mask=jnp.zeros(window, bool),
            mean=jnp.asarray(model.labels.mean),
            variance=jnp.zeros(6),
        )

    def step(model: Model, state: StreamState, image: jax.Array, usable: jax.Array) -> tuple[StreamState, StreamStep]:
        pair_usable = state.seen & state.usable & usable
        features = jnp.concatenate([state.features[1:], pair_features(model, state.image, image)[None]])
        mask = jnp.concatenate([state.mask[1:], pair_usable[None]])
        variables = {"params": model.params, "batch_stats": model.batch_stats}
        outputs = network.apply(variables, features[None], mask[None], method="outputs_from_features")[0, -1]
        seen_step = mixture_from_outputs(outputs, model.labels, config.model, model.residual_scale, sigma_scale)
        held = held_step(state.mean, state.variance, model.labels, seen_step.logits.shape[-1])
        density = jax.tree.map(lambda seen, other: jnp.where(pair_usable, seen, other), seen_step, held)
        mean = mixture.mean(density)
        following = StreamState(
            image=jnp.where(usable, image, state.image),
            usable=usable,
            seen=jnp.array(True),
            features=features,
            mask=mask,
            mean=jnp.where(pair_usable, mean, state.mean),
            variance=jnp.where(pair_usable, mixture.variance(density), state.variance),
        )
        covariance = mixture.covariance(density, coupling=config.model.coupling)
        return following, StreamStep(mean, covariance, density, state.seen & ~pair_usable, state.seen)

    return start, step
