"""What a checkpoint is: the folder of one step of a training, and how its model is read, whole or not at all.

`store` saves and restores trainings.
"""

import json
import math
import os
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from mdnvo_jax import config as configuration
from mdnvo_jax import files, leaves
from mdnvo_jax.config import Config
from mdnvo_jax.errors import InputError
from mdnvo_jax.model.network import build
from mdnvo_jax.training import checksum
from mdnvo_jax.training.state import Model, State, state_template

# Raised when what is stored, or its meaning, changes. Version 1 has no checksums and does not count skipped steps.
VERSION = 2
_READABLE = (1, VERSION)
FOLDER = "checkpoints"
METRIC = "validation_loss"
# What orbax writes into a step's folder last.
FINISHED = "_CHECKPOINT_METADATA"
# What orbax calls the one file of a JSON item.
_JSON_FILE = "metadata"
# What is raised for a checkpoint that is damaged, incomplete or of another shape depends on where the reader stumbles.
DAMAGE = (Exception,)


def about_itself(config: Config, checksums: dict[str, Any]) -> dict[str, Any]:
    """Return what a checkpoint says about itself, given the checksums of its other items."""
    stored = json.loads(configuration.as_json(config))
    return {"version": VERSION, "config": stored, "checksums": {**checksums, "config": checksum.of_json(stored)}}


def first_line(error: BaseException) -> str:
    """Return the first line of an error, shortened."""
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:160]}"


def abstract(tree: Any, sharding: jax.sharding.Sharding | None = None) -> Any:
    """Return the shapes and types of `tree` as a template for restoring, on `sharding`."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), tree)


def template(config: Config) -> State:
    """Return the template of a training's state on one device."""
    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return abstract(state_template(build(config.image, config.model), config), here)


def steps_in(folder: Path) -> list[int]:
    """Return the steps that have a non-empty folder in the checkpoint folder, newest first."""
    found = [entry for entry in folder.iterdir() if entry.name.isdigit() and (entry / FINISHED).exists()]
    return sorted((int(entry.name) for entry in found), reverse=True)


def locate(path: str | os.PathLike[str]) -> Path:
    """Return the folder of one step: `path` itself, or the best step of the training in `path`.

    Raises:
      InputError: `path` holds no checkpoint.
    """
    path = Path(path).absolute()
    if (path / "model").is_dir():
        return path
    folder = path / FOLDER if (path / FOLDER).is_dir() else path
    steps = steps_in(folder) if folder.is_dir() else []
    if not steps:
        raise InputError(f"no checkpoint in {path}: expected the --workdir of a training, or one step's folder in it")
    return folder / str(min(steps, key=lambda step: (_stored_loss(folder / str(step)), -step)))


def _stored_loss(step_folder: Path) -> float:
    """Return the validation loss that was saved with a step, infinite where there is none."""
    try:
        return float(json.loads((step_folder / "metrics" / "metrics").read_text())[METRIC])
    except (OSError, ValueError, KeyError):
        return math.inf


def read_config(step_folder: Path) -> Config:
    """Return the experiment that a step's checkpoint came from.

    Raises:
      InputError: it is unreadable, or of another version.
    """
    try:
        about = read_about(step_folder)
        return configuration.from_json(json.dumps(about["config"]))
    except InputError:
        raise
    except DAMAGE as error:
        raise InputError(f"the checkpoint {step_folder} is damaged or none of ours ({first_line(error)})") from error


def read_about(step_folder: Path) -> dict[str, Any]:
    """Return what a step's checkpoint says about itself.

    Raises:
      InputError: it is of a version that this release does not read.
      Exception: it is damaged.
    """
    with ocp.Checkpointer(ocp.JsonCheckpointHandler()) as reader:
        about = reader.restore(step_folder / "about")
    version = about["version"]
    if version not in _READABLE:
        newer = isinstance(version, int) and version > VERSION
        raise InputError(
            f"the checkpoint {step_folder} has version {version}, expected {' or '.join(map(str, _READABLE))}: "
            + ("it was written by a newer release of mdnvo_jax; install that one" if newer else "it is none of ours")
        )
    if version > 1:
        checksum.check_json(about["config"], about["checksums"]["config"], "config")
    return about


def write_about(step_folder: Path, config: Config, model: Model) -> None:
    """Put another experiment into a copy of a step's folder, for `read_config`, with the checksums of its model."""
    about = about_itself(config, {"model": checksum.of_arrays(model)})
    files.write_text(step_folder / "about" / _JSON_FILE, json.dumps(about))


def trained(path: str | os.PathLike[str]) -> tuple[Model, Config, Path]:
    """Return the model in a checkpoint as it was trained, the experiment, and the folder of the step.

    Args:
      path: the --workdir of a training, whose best step is taken, or the folder of one step.

    Raises:
      InputError: there is none, or it is damaged.
    """
    folder = locate(path)
    config = read_config(folder)
    return read_model(folder, template(config).model), config, folder


def read_model(step_folder: Path, template: Model) -> Model:
    """Return the model in a step's checkpoint, without the state of the training.

    Raises:
      InputError: it is damaged or its shapes are not those of `template`.
    """
    try:
        checksum.check_stored(step_folder / "model", read_about(step_folder).get("checksums", {}).get("model"))
        # Orbax notices a wrong shape too, but late, and leaves half-done reads behind.
        stored = _shapes(ocp.StandardCheckpointHandler().metadata(step_folder / "model").tree)
        expected = _shapes(template)
        wrong = sorted(name for name in stored.keys() | expected.keys() if stored.get(name) != expected.get(name))
        if wrong:
            raise ValueError(f"{wrong[0]} is {stored.get(wrong[0])}, expected {expected.get(wrong[0])}")
        with ocp.Checkpointer(ocp.StandardCheckpointHandler()) as reader:
            return reader.restore(step_folder / "model", args=ocp.args.StandardRestore(template))
    except InputError:
        raise
    except DAMAGE as error:
        raise InputError(
            f"the checkpoint {step_folder} is damaged or does not fit its own configuration ({first_line(error)})"
        ) from error


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    """Return the shape of every leaf by its name."""
    return {name: tuple(leaf.shape) for name, leaf in leaves.by_name(tree).items()}
