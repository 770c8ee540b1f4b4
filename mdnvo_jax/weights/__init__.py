"""The weights that ship with the package. The folder `pretrained` has the form of a step's folder of a training."""

from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from mdnvo_jax.errors import InputError

if TYPE_CHECKING:
    from mdnvo_jax.config import Config

NAME = "pretrained"
# What a configuration calls them.
SHIPPED = "shipped"


def folder() -> Path:
    """Return the folder of the shipped weights.

    Raises:
      InputError: this build of the package has none.
    """
    found = Path(str(resources.files(__name__))) / NAME
    if not (found / "model").is_dir():
        raise InputError("no weights are shipped with this build: give --checkpoint, the --workdir of a training")
    return found


def config() -> "Config":
    """Return the experiment that the shipped weights come from.

    Raises:
      InputError: this build of the package has none.
    """
    from mdnvo_jax.training import checkpoint

    return checkpoint.read_config(folder())
