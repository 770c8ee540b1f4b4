"""What a training starts from: drawn by its seed, with FlowNet's stack where asked for, or what another one reached."""

import dataclasses
import sys
from collections.abc import Sequence as Many
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from mdnvo_jax import weights
from mdnvo_jax.config import Config
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.data.windows import label_statistics
from mdnvo_jax.errors import InputError
from mdnvo_jax.model.flownet import load_stack
from mdnvo_jax.model.grow import grow
from mdnvo_jax.model.head import Labels
from mdnvo_jax.model.network import Network
from mdnvo_jax.training import checkpoint
from mdnvo_jax.training.state import initial_variables

# Fields of the model that weights do not depend on: how it is trained, how products are computed, how it predicts.
_FREE = (
    "conv_dropout",
    "batch_norm_momentum",
    "lstm_dropout",
    "mirrored",
    "flow_weight",
    "products",
    "activations",
    "rematerialise",
)
# What may be larger than it was.
_GROWING = ("width", "lstm_hidden")


def check(config: Config) -> None:
    """Refuse initial weights that do not fit the configuration, before any data is read.

    Raises:
      InputError: there are none; or frames or network differ from those they were trained with; or FlowNet's stack is
        asked for as well.
    """
    if not config.training.initial_weights:
        return
    if config.training.initial_stack:
        raise InputError(
            "training.initial_weights and training.initial_stack are both given: the first has a stack of its own; "
            "leave one out"
        )
    theirs = checkpoint.read_config(_folder(config))
    differing = [
        f"{section}.{field.name} is {mine!r}, trained with {their!r}"
        for section in ("image", "model")
        for field in dataclasses.fields(getattr(config, section))
        for mine, their in [(getattr(getattr(whole, section), field.name) for whole in (config, theirs))]
        if mine != their and field.name not in _FREE and not (field.name in _GROWING and mine > their)
    ]
    if differing:
        growing = " and ".join(f"model.{name}" for name in _GROWING)
        raise InputError(
            f"training.initial_weights {config.training.initial_weights} does not fit: {'; '.join(differing)}: "
            f"set these fields as they were ({growing} may be larger)"
        )


def start(network: Network, config: Config, sequences: Many[Sequence]) -> tuple[dict[str, Any], Labels]:
    """Return the variables to start from, and the statistics that labels are standardised with.

    Initial weights bring the statistics of their own labels, since they are the units of their outputs. Where the
    network is wider than theirs they are grown into it, and its outputs are theirs. Of layers that serve training alone
    (the one for optical flow), those they lack are drawn and those that are not wanted left out.

    Args:
      network: of the configuration.
      config: the experiment, which `check` has passed.
      sequences: of the training split.

    Raises:
      InputError: what the configuration starts from is unreadable.
    """
    variables = initial_variables(network, config)
    if config.training.initial_weights:
        model, _, _ = checkpoint.trained(_folder(config))
        return grow({"params": model.params, "batch_stats": model.batch_stats}, variables), model.labels
    if config.training.initial_stack:
        if config.image.normalisation != "flownet":
            print(
                f"warning: image.normalisation is {config.image.normalisation!r}: FlowNet's weights were trained on "
                "frames normalised by 'flownet'",
                file=sys.stderr,
            )
        variables = load_stack(config.training.initial_stack, variables)
    return variables, Labels(*map(jnp.asarray, label_statistics(sequences, config.data)))


def _folder(config: Config) -> Path:
    """Return the folder of the step that the configuration starts from."""
    given = config.training.initial_weights
    return weights.folder() if given == weights.SHIPPED else checkpoint.locate(given)
