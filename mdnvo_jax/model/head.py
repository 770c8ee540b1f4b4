"""From the raw outputs of the network to a density of the pose step in metres and radians, and DeepVO's loss."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mdnvo_jax import mixture
from mdnvo_jax.config import ModelConfig
from mdnvo_jax.mixture import Mixture

# tx, ty, tz in metres, then the rotation vector rx, ry, rz in radians.
STEP_SIZE = 6
_TRANSLATION = 3


class Labels(NamedTuple):
    """Mean and standard deviation `[6]` of the training steps, in metres and radians: the units of the outputs."""

    mean: Array
    std: Array


def raw_size(model_config: ModelConfig) -> int:
    """Return how many numbers the network gives a step."""
    if model_config.head == "regression":
        return STEP_SIZE
    return mixture.outputs_size(model_config.components, STEP_SIZE)


def mixture_from_outputs(
    outputs: Array,
    labels: Labels,
    model_config: ModelConfig,
    residual_scale: Array | None = None,
) -> Mixture:
    """Return the density of the step, in metres and radians: the one place where standardisation is undone.

    Args:
      outputs: of the network, in standardised units, `[..., D]`.
      labels: the standardisation.
      model_config: tells the head, the number of components and the floors of the standard deviation, which are in
        metres and radians.
      residual_scale: for the head "regression" only, which predicts no scale: the standard deviation `[6]` of its
        residuals, in standardised units. Its density is a single Gaussian.

    Raises:
      ValueError: a head "regression" without `residual_scale`.
    """
    std, mean = jnp.asarray(labels.std, outputs.dtype), jnp.asarray(labels.mean, outputs.dtype)
    floor = scale_floor(model_config, outputs.dtype)
    if model_config.head == "mixture":
        standardised = mixture.from_network(outputs, model_config.components, dimensions=STEP_SIZE, floor=floor / std)
        return mixture.affine(standardised, std, mean)
    if residual_scale is None:
        raise ValueError("head 'regression' predicts no scale: give residual_scale, its residuals' standard deviation")
    scale = jnp.maximum(jnp.asarray(residual_scale, outputs.dtype) * std, floor)
    steps = outputs * std + mean
    return Mixture(
        logits=jnp.zeros((*outputs.shape[:-1], 1), outputs.dtype),
        mean=steps[..., None, :],
        log_scale=jnp.broadcast_to(jnp.log(scale), steps.shape)[..., None, :],
    )


def scale_floor(model_config: ModelConfig, dtype: jnp.dtype) -> Array:
    """Return the least standard deviation `[6]` of a component, in metres and radians."""
    translation, rotation = model_config.translation_floor_m, model_config.rotation_floor_rad
    return jnp.asarray([translation] * _TRANSLATION + [rotation] * _TRANSLATION, dtype)


def regression_loss(outputs: Array, steps: Array, labels: Labels, mask: Array, kappa: float) -> Array:
    """Return DeepVO's loss, equation 6 of Wang et al. 2017: the mean over steps of |p^ - p|^2 + kappa |phi^ - phi|^2.

    Args:
      outputs: of a head "regression", in standardised units, `[B, T, 6]`.
      steps: the labels, in metres and radians, `[B, T, 6]`.
      labels: the standardisation. The loss is in physical units, so that kappa means what it means in DeepVO's paper.
      mask: `[B, T]`, true where a step counts.
      kappa: weight of the rotation, m^2 / rad^2.

    Returns:
      A scalar in m^2; 0 with a gradient of 0 if no step counts.
    """
    if outputs.shape != steps.shape or outputs.shape[-1] != STEP_SIZE:
        raise ValueError(f"outputs {outputs.shape} and steps {steps.shape}: expected both [..., {STEP_SIZE}]")
    error = jnp.square(outputs * labels.std + labels.mean - steps)
    loss = error[..., :_TRANSLATION].sum(-1) + kappa * error[..., _TRANSLATION:].sum(-1)
    return jnp.sum(loss, where=mask) / jnp.maximum(mask.sum(), 1)
