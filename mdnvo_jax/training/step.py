"""One step of training and one of validation, as pure functions of the state and a batch."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from mdnvo_jax import mixture
from mdnvo_jax.config import Config
from mdnvo_jax.model.head import Labels, mixture_from_outputs, regression_loss
from mdnvo_jax.model.network import Network
from mdnvo_jax.training.state import TRAIN_METRICS, Model, State, make_optimiser, make_plateau

Batch = dict[str, jax.Array]
Metrics = dict[str, jax.Array]


def objective(
    outputs: jax.Array, batch: Batch, labels: Labels, config: Config, reduction: mixture.Reduction
) -> jax.Array:
    """Return the loss of the network's outputs `[B, T, D]`: a NLL in metres and radians, or DeepVO's squared error."""
    steps, mask = batch["steps"], batch["mask"]
    if config.model.head == "regression":
        return regression_loss(outputs, steps, labels, mask, config.training.kappa)
    predicted = mixture_from_outputs(outputs, labels, config.model)
    return mixture.nll(predicted, steps, mask=mask, coupling=config.model.coupling, reduction=reduction)


def train_step(state: State, batch: Batch, *, network: Network, config: Config) -> tuple[State, Metrics]:
    """Take one step of Adam on one batch.

    Args:
      state: the state so far.
      batch: `images` `[B, T+1, H, W, C]` uint8, `steps` `[B, T, 6]`, `mask` `[B, T]`.
      network: the network.
      config: the experiment.

    Returns:
      The next state, and the metrics `TRAIN_METRICS` of this step, each a scalar.
    """
    model = state.model

    def loss_of(params: Any) -> tuple[jax.Array, tuple[jax.Array, Any]]:
        outputs, updated = network.apply(
            {"params": params, "batch_stats": model.batch_stats},
            batch["images"],
            batch["mask"],
            train=True,
            rngs={"dropout": jax.random.fold_in(state.rng, state.step)},
            mutable=["batch_stats"],
        )
        loss = objective(outputs, batch, model.labels, config, config.training.reduction)
        return loss, (outputs, updated["batch_stats"])

    (loss, (outputs, batch_stats)), gradient = jax.value_and_grad(loss_of, has_aux=True)(model.params)
    update, optimiser = make_optimiser(config.training).update(gradient, state.optimiser, model.params)
    update = optax.tree.scale(state.plateau.scale, update)
    params = optax.apply_updates(model.params, update)
    norms = [optax.tree.norm(tree) for tree in (gradient, update, params)]
    predicted = mixture_from_outputs(outputs, model.labels, config.model, model.residual_scale)
    metrics = dict(zip(TRAIN_METRICS, [loss, *norms, *_sigma_quantiles(predicted, batch["mask"])], strict=True))
    next_state = state._replace(
        model=model._replace(params=params, batch_stats=batch_stats),
        optimiser=optimiser,
        step=state.step + 1,
        sums=jax.tree.map(jnp.add, state.sums, metrics),
    )
    return next_state, metrics


def _sigma_quantiles(predicted: mixture.Mixture, mask: jax.Array) -> list[jax.Array]:
    """Return the 10, 50 and 90 % quantiles over the batch of the total sigma of translation, then of rotation."""
    variance = jnp.where(mask[..., None], mixture.variance(predicted), jnp.nan)
    sigmas = jnp.sqrt(jnp.stack([variance[..., :3].sum(-1), variance[..., 3:].sum(-1)]))
    return list(jnp.nanquantile(sigmas.reshape(2, -1), jnp.array([0.1, 0.5, 0.9]), axis=1).T.reshape(-1))


def validation_step(model: Model, batch: Batch, *, network: Network, config: Config) -> Metrics:
    """Return sums over the valid steps of one batch; `validation_metrics` makes means of them.

    `loss`: NLL, or DeepVO's loss; `count`: valid steps; `squares` `[6]`: squared residuals of the mean estimate.
    """
    variables = {"params": model.params, "batch_stats": model.batch_stats}
    outputs = network.apply(variables, batch["images"], batch["mask"], train=False)
    count = jnp.sum(batch["mask"])
    predicted = mixture_from_outputs(outputs, model.labels, config.model, model.residual_scale)
    residual = jnp.where(batch["mask"][..., None], mixture.mean(predicted) - batch["steps"], 0.0)
    return {
        "loss": objective(outputs, batch, model.labels, config, "mean") * count,
        "count": count,
        "squares": jnp.sum(residual**2, axis=(0, 1)),
    }


def validation_metrics(sums: Metrics) -> Metrics:
    """Return the mean loss and the root mean square errors in metres and degrees a step, from sums over batches."""
    mean_squares = sums["squares"] / sums["count"]
    return {
        "validation_loss": sums["loss"] / sums["count"],
        "validation_translation_rmse_m": jnp.sqrt(jnp.sum(mean_squares[:3])),
        "validation_rotation_rmse_deg": jnp.rad2deg(jnp.sqrt(jnp.sum(mean_squares[3:]))),
    }


def end_epoch(state: State, sums: Metrics, *, config: Config) -> State:
    """Return the state for the next epoch: plateau told of the validation loss, residual scale renewed, sums zero."""
    value = validation_metrics(sums)["validation_loss"]
    _, plateau = make_plateau(config.training).update({}, state.plateau, value=value)
    residual_scale = jnp.sqrt(sums["squares"] / sums["count"]) / state.model.labels.std
    return state._replace(
        model=state.model._replace(residual_scale=residual_scale),
        plateau=plateau,
        epoch=state.epoch + 1,
        sums=jax.tree.map(jnp.zeros_like, state.sums),
    )


def bind(function: Callable[..., Any], network: Network, config: Config) -> Callable[..., Any]:
    """Return `function` of state and batch alone."""
    return functools.partial(function, network=network, config=config)
