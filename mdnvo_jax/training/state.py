"""Everything a training carries from one step to the next, as one pytree."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from optax.contrib import ReduceLROnPlateauState, reduce_on_plateau

from mdnvo_jax.config import Config, TrainingConfig
from mdnvo_jax.model.head import Labels
from mdnvo_jax.model.network import Network, initialise, template


class Model(NamedTuple):
    """What prediction needs of a training.

    Attributes:
      params: parameters of the network.
      batch_stats: running statistics of its batch normalisation.
      labels: mean and standard deviation of the training split's steps, `[6]` each, in metres and radians.
      residual_scale: root mean square of the standardised validation residuals, `[6]`: the spread that a regression
        head, which predicts none, is given. One until the first validation.
    """

    params: Any
    batch_stats: Any
    labels: Labels
    residual_scale: jax.Array


class State(NamedTuple):
    """The state of a training.

    Attributes:
      model: see `Model`.
      optimiser: optax state.
      plateau: state of the learning rate schedule.
      rng: key that every step folds its number into.
      step: steps taken.
      epoch: epochs finished, validation included.
      sums: running sums of the metrics over the epoch, so that a resumed epoch reports the means of all of it; and
        under `SKIPPED` how many of its steps were skipped, whose metrics are not in the sums.
    """

    model: Model
    optimiser: optax.OptState
    plateau: ReduceLROnPlateauState
    rng: jax.Array
    step: jax.Array
    epoch: jax.Array
    sums: dict[str, jax.Array]


# Metrics of a train step, in the order in which they are written.
TRAIN_METRICS = (
    "loss",
    "gradient_norm",
    "update_norm",
    "parameter_norm",
    *(f"sigma_translation_m_q{percent}" for percent in (10, 50, 90)),
    *(f"sigma_rotation_rad_q{percent}" for percent in (10, 50, 90)),
)
# Steps of an epoch, so far, that changed nothing, because a number in them was not finite.
SKIPPED = "skipped"


def make_optimiser(config: TrainingConfig) -> optax.GradientTransformation:
    """Return Adam, AdamW or SGD with clipping by the global norm; the schedule's scale is applied by the step."""
    rate, betas = config.learning_rate, {"b1": config.beta1, "b2": config.beta2}
    if config.optimiser == "sgd":
        update = optax.sgd(rate)
    elif config.weight_decay:
        update = optax.adamw(rate, weight_decay=config.weight_decay, **betas)
    else:
        # Not the same with a decay of 0: its state has another structure.
        update = optax.adam(rate, **betas)
    return optax.chain(optax.clip_by_global_norm(config.gradient_clip), update) if config.gradient_clip else update


def make_plateau(config: TrainingConfig) -> optax.GradientTransformationExtraArgs:
    """Return a schedule that behaves as `torch.optim.lr_scheduler.ReduceLROnPlateau(threshold_mode="abs")`.

    PyTorch lowers the rate when the epochs without improvement exceed the patience, optax when they reach it. The
    threshold is absolute: optax's relative test asks for the wrong thing below zero, where a NLL often is.
    """
    return reduce_on_plateau(
        factor=config.plateau_factor, patience=config.plateau_patience + 1, rtol=0.0, atol=config.plateau_threshold
    )


def schedule_scale(config: TrainingConfig, plateau: ReduceLROnPlateauState, step: jax.Array) -> jax.Array:
    """Return what the learning rate is multiplied by at `step`: the plateau's factor, or half a cosine from 1 to 0."""
    if config.schedule == "plateau":
        return plateau.scale
    return optax.cosine_decay_schedule(1.0, config.epochs * config.steps_per_epoch)(step)


def initial_variables(network: Network, config: Config) -> Any:
    """Return the network's variables before training; a function of the config's seed alone."""
    rng = jax.random.fold_in(jax.random.PRNGKey(config.training.seed), 0)
    return initialise(network, rng, config.image, config.data.window)


def initial_state(variables: Any, config: Config, labels: Labels) -> State:
    """Return the state before the first step.

    Args:
      variables: of the network, params and batch_stats.
      config: the experiment.
      labels: mean and standard deviation of the training split's steps.
    """
    model = Model(
        params=variables["params"],
        batch_stats=variables["batch_stats"],
        labels=Labels(*(jnp.asarray(value, jnp.float32) for value in labels)),
        residual_scale=jnp.ones(6, jnp.float32),
    )
    return State(
        model=model,
        optimiser=make_optimiser(config.training).init(model.params),
        plateau=make_plateau(config.training).init(model.params),
        rng=jax.random.fold_in(jax.random.PRNGKey(config.training.seed), 1),
        step=jnp.zeros((), jnp.int32),
        epoch=jnp.zeros((), jnp.int32),
        # A zero of its own each: the step donates the state, and a buffer can be donated once.
        sums={name: jnp.zeros((), jnp.float32) for name in (*TRAIN_METRICS, SKIPPED)},
    )


def state_template(network: Network, config: Config) -> State:
    """Return the shapes and types of a state, without computing one."""
    variables = template(network, config.image, config.data.window)
    return jax.eval_shape(lambda given: initial_state(given, config, Labels(jnp.zeros(6), jnp.ones(6))), variables)
