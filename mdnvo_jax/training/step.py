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
from mdnvo_jax.training.state import (
    SKIPPED,
    TRAIN_METRICS,
    Model,
    State,
    make_optimiser,
    make_plateau,
    schedule_scale,
)

# Pixels of the map of optical flow: longer flow is cut to this, and the loss is round below that.
_LARGEST_FLOW = 8.0
_FLOW_ROUNDING = 0.01

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


def training_objective(
    outputs: jax.Array, flow: jax.Array | None, batch: Batch, labels: Labels, config: Config
) -> jax.Array:
    """Return what a training step lowers: `objective`, or its beta-NLL, and the loss on optical flow."""
    training = config.training
    if training.beta and config.model.head == "mixture":
        predicted = mixture_from_outputs(outputs, labels, config.model)
        loss = beta_nll(predicted, batch["steps"], batch["mask"], labels, config.model.coupling, training.beta)
    else:
        loss = objective(outputs, batch, labels, config, training.reduction)
    return loss if flow is None else loss + config.model.flow_weight * flow_loss(flow, batch["flow"])


def beta_nll(
    predicted: mixture.Mixture,
    steps: jax.Array,
    mask: jax.Array,
    labels: Labels,
    coupling: mixture.Coupling,
    beta: float,
) -> jax.Array:
    """Return the beta-NLL, a mean over steps: each NLL times sigma^(2 beta), which has no gradient.

    Sigma is that of the whole mixture over the deviation of the labels. For coupling "independent" each dimension's
    NLL has its own weight; the NLL of a step of coupling "joint" has the geometric mean of the six. (Seitzer et al.
    2022, equation 4, is this for one Gaussian.)

    Args:
      predicted: of each step, `[B, T, M, 6]`, m and rad.
      steps: `[B, T, 6]`.
      mask: `[B, T]`, true where a step counts.
      labels: whose deviation is the unit of sigma.
      coupling: of the mixture.
      beta: 0 is the NLL; at 1 the gradient of a mean is that of the squared error.
    """
    weight = (mixture.variance(predicted) / labels.std**2) ** beta
    if coupling == "joint":
        weight = jnp.exp(jnp.mean(jnp.log(weight), axis=-1))
        losses = mixture.nll(predicted, steps, mask=mask, coupling=coupling, reduction="none")
    else:
        # Each dimension as a mixture over one: `[B, T, 6, M, 1]`.
        alone = mixture.Mixture(
            logits=jnp.broadcast_to(predicted.logits[..., None, :], (*steps.shape, predicted.logits.shape[-1])),
            mean=jnp.swapaxes(predicted.mean, -1, -2)[..., None],
            log_scale=jnp.swapaxes(predicted.log_scale, -1, -2)[..., None],
        )
        counts = jnp.broadcast_to(mask[..., None], steps.shape)
        losses = mixture.nll(alone, steps[..., None], mask=counts, coupling="independent", reduction="none")
    return jnp.sum(jax.lax.stop_gradient(weight) * losses) / jnp.maximum(mask.sum(), 1)


def flow_loss(predicted: jax.Array, flow: jax.Array) -> jax.Array:
    """Return the mean length of the error of optical flow, in pixels of its map, where the flow is known.

    Args:
      predicted: `[..., 2]`.
      flow: the same, NaN where it is not known.
    """
    known = jnp.isfinite(flow).all(-1)
    # A flow of many pixels is that of the bonnet's edge: it shall not outweigh the rest.
    error = predicted - jnp.where(known[..., None], jnp.clip(flow, -_LARGEST_FLOW, _LARGEST_FLOW), predicted)
    length = jnp.sqrt(jnp.sum(error**2, -1) + _FLOW_ROUNDING**2)
    return jnp.sum(length, where=known) / jnp.maximum(known.sum(), 1)


def train_step(
    state: State, batch: Batch, *, network: Network, config: Config, axis_name: str | None = None
) -> tuple[State, Metrics]:
    """Take one step of the optimiser on one batch.

    With `training.skip_nonfinite`, a step with a metric that is infinite or not a number changes nothing but two
    counts, of steps and of skipped ones: the next step has another batch, another dropout and the rate of its number.

    Args:
      state: the state so far.
      batch: `images` `[B, T+1, H, W, C]` uint8, `steps` `[B, T, 6]`, `mask` `[B, T]`.
      network: the network.
      config: the experiment.
      axis_name: of the axis of a `jax.pmap` of this function over equal parts of a batch, whose `network` was built
        with the same name. Not for a batch that is split by its sharding.

    Returns:
      The next state, and the metrics `TRAIN_METRICS` of this step, each a scalar; `SKIPPED` counts the steps skipped
      in this epoch.
    """
    model = state.model

    def loss_of(params: Any, batch_stats: Any, part: Batch, rng: jax.Array) -> tuple[jax.Array, tuple[jax.Array, Any]]:
        (outputs, flow), updated = network.apply(
            {"params": params, "batch_stats": batch_stats},
            part["images"],
            part["mask"],
            train=True,
            rngs={"dropout": rng},
            mutable=["batch_stats"],
            method="with_flow",
        )
        loss = training_objective(outputs, flow, part, model.labels, config)
        return loss, (outputs, updated["batch_stats"])

    derive = jax.value_and_grad(loss_of, has_aux=True)
    rng = jax.random.fold_in(state.rng, state.step)
    if config.training.accumulate == 1:
        (loss, (outputs, batch_stats)), gradient = derive(model.params, model.batch_stats, batch, rng)
    else:
        batch = _parts(batch, config.training.accumulate)

        def add(carry: tuple[Any, Any], item: tuple[Batch, jax.Array]) -> tuple[Any, tuple[jax.Array, jax.Array]]:
            part, number = item
            (loss, (outputs, stats)), gradient = derive(model.params, carry[1], part, jax.random.fold_in(rng, number))
            return (jax.tree.map(jnp.add, carry[0], gradient), stats), (loss, outputs)

        nothing = jax.tree.map(jnp.zeros_like, model.params)
        numbers = jnp.arange(config.training.accumulate)
        (total, batch_stats), (losses, outputs) = jax.lax.scan(add, (nothing, model.batch_stats), (batch, numbers))
        loss, gradient = losses.mean(), optax.tree.scale(1 / config.training.accumulate, total)
    if axis_name is not None:
        loss, gradient = jax.lax.pmean((loss, gradient), axis_name)
    update, optimiser = make_optimiser(config.training).update(gradient, state.optimiser, model.params)
    update = optax.tree.scale(schedule_scale(config.training, state.plateau, state.step), update)
    params = optax.apply_updates(model.params, update)
    norms = [optax.tree.norm(tree) for tree in (gradient, update, params)]
    predicted = mixture_from_outputs(outputs, model.labels, config.model, model.residual_scale)
    metrics = dict(zip(TRAIN_METRICS, [loss, *norms, *_sigma_quantiles(predicted, batch["mask"])], strict=True))
    sums = {name: state.sums[name] + value for name, value in metrics.items()}
    next_state = state._replace(
        model=model._replace(params=params, batch_stats=batch_stats),
        optimiser=optimiser,
        sums={**sums, SKIPPED: state.sums[SKIPPED]},
    )
    if config.training.skip_nonfinite:
        finite = jnp.isfinite(jnp.stack(list(metrics.values()))).all()
        next_state = jax.tree.map(lambda new, old: jnp.where(finite, new, old), next_state, state)
        next_state.sums[SKIPPED] += ~finite
    return next_state._replace(step=state.step + 1), {**metrics, SKIPPED: next_state.sums[SKIPPED]}


def _parts(batch: Batch, count: int) -> Batch:
    """Return a batch as `count` parts on a new first axis, each of every `count`-th row: all devices share in each."""
    return {name: jnp.moveaxis(rows.reshape(-1, count, *rows.shape[1:]), 1, 0) for name, rows in batch.items()}


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
