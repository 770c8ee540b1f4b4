"""Checkpoints: saved while training goes on, the newest and the best kept, read back whole or not at all."""

import json
import math
import os
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers

from mdnvo_jax import config as configuration
from mdnvo_jax import files
from mdnvo_jax.config import Config
from mdnvo_jax.errors import InputError
from mdnvo_jax.model.network import build
from mdnvo_jax.training.state import Model, State, state_template

# Raised when what is stored, or its meaning, changes.
VERSION = 1
FOLDER = "checkpoints"
_METRIC = "validation_loss"
# What orbax calls the one file of a JSON item.
_JSON_FILE = "metadata"
# What orbax raises for a checkpoint that is damaged, incomplete or of another shape.
_DAMAGE = (ValueError, KeyError, OSError, TypeError)


class Restored(NamedTuple):
    """A training as a checkpoint holds it."""

    state: State
    data_state: Any
    step: int


class Store:
    """The checkpoints of one training, in `workdir/checkpoints`."""

    def __init__(self, workdir: Path, keep_latest: int) -> None:
        policies = [
            checkpoint_managers.LatestN(keep_latest),
            checkpoint_managers.BestN(get_metric_fn=_metric, reverse=True, n=1, keep_checkpoints_without_metrics=False),
        ]
        options = ocp.CheckpointManagerOptions(
            preservation_policy=checkpoint_managers.AnyPreservationPolicy(policies),
            # Without these two, metrics are not written and the best step is unknown after a restart.
            best_fn=_metric,
            best_mode="min",
            cleanup_tmp_directories=True,
        )
        self._manager = ocp.CheckpointManager((workdir / FOLDER).absolute(), options=options)

    def save(self, state: State, data_state: Any, config: Config, validation_loss: float = math.inf) -> None:
        """Start to save the training; it goes on in the background.

        Args:
          state: the state after a whole number of steps.
          data_state: the state of the iterator over batches, as JSON values.
          config: the experiment, with the image configuration resolved.
          validation_loss: infinite where this state was not validated, so that it never counts as the best.
        """
        self._manager.save(
            int(state.step),
            args=ocp.args.Composite(
                model=ocp.args.StandardSave(state.model),
                training=ocp.args.StandardSave(_without_model(state)),
                data=ocp.args.JsonSave({"iterator": data_state}),
                about=ocp.args.JsonSave(_about(config)),
            ),
            metrics={_METRIC: validation_loss},
        )

    def steps(self) -> list[int]:
        """Return the steps that have a checkpoint, newest first."""
        return sorted(self._manager.all_steps(read=True), reverse=True)

    def restore(self, template: State) -> Restored:
        """Return the newest checkpoint that can be read.

        Args:
          template: a state of the shapes, types and shardings to restore.

        Raises:
          InputError: there is none.
        """
        for step in self.steps():
            try:
                found = self._manager.restore(
                    step,
                    args=ocp.args.Composite(
                        model=ocp.args.StandardRestore(template.model),
                        training=ocp.args.StandardRestore(_without_model(template)),
                        data=ocp.args.JsonRestore(),
                    ),
                )
            except _DAMAGE as error:
                print(
                    f"warning: checkpoint {step} cannot be read, trying an older one ({_first(error)})", file=sys.stderr
                )
                continue
            state = State(model=found.model, **found.training)
            return Restored(state, found.data["iterator"], step)
        raise InputError(f"no readable checkpoint in {self._manager.directory}: start again without --resume")

    def wait(self) -> None:
        """Return when everything that was saved is on disk."""
        self._manager.wait_until_finished()

    def close(self) -> None:
        """Finish what is being written and let go."""
        self._manager.close()


def _about(config: Config) -> dict[str, Any]:
    """Return what a checkpoint says about itself."""
    return {"version": VERSION, "config": json.loads(configuration.as_json(config))}


def _without_model(state: State) -> dict[str, Any]:
    """Return the part of a state that only training needs; the model is saved beside it, for prediction to read."""
    return {name: value for name, value in state._asdict().items() if name != "model"}


def _metric(metrics: dict[str, float]) -> float:
    """Return what the best checkpoint is chosen by."""
    return metrics[_METRIC]


def _first(error: BaseException) -> str:
    """Return the first line of an error, shortened."""
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:120]}"


def abstract(tree: Any, sharding: jax.sharding.Sharding | None = None) -> Any:
    """Return the shapes and types of `tree` as a template for restoring, on `sharding`."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), tree)


def steps_in(folder: Path) -> list[int]:
    """Return the steps that have a non-empty folder in the checkpoint folder, newest first."""
    found = [entry for entry in folder.iterdir() if entry.name.isdigit() and (entry / "_CHECKPOINT_METADATA").exists()]
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
        return float(json.loads((step_folder / "metrics" / "metrics").read_text())[_METRIC])
    except (OSError, ValueError, KeyError):
        return math.inf


def read_config(step_folder: Path) -> Config:
    """Return the experiment that a step's checkpoint came from.

    Raises:
      InputError: it is unreadable, or of another version.
    """
    with ocp.Checkpointer(ocp.JsonCheckpointHandler()) as reader:
        try:
            about = reader.restore(step_folder / "about")
        except _DAMAGE as error:
            raise InputError(f"the checkpoint {step_folder} is damaged or none of ours ({_first(error)})") from error
    if about["version"] != VERSION:
        raise InputError(
            f"the checkpoint {step_folder} has version {about['version']}, expected {VERSION}: "
            "use the release of mdnvo_jax that wrote it"
        )
    return configuration.from_json(json.dumps(about["config"]))


def write_about(step_folder: Path, config: Config) -> None:
    """Put another experiment into a copy of a step's folder, for `read_config`."""
    files.write_text(step_folder / "about" / _JSON_FILE, json.dumps(_about(config)))


def trained(path: str | os.PathLike[str]) -> tuple[Model, Config, Path]:
    """Return the model in a checkpoint as it was trained, the experiment, and the folder of the step.

    Args:
      path: the --workdir of a training, whose best step is taken, or the folder of one step.

    Raises:
      InputError: there is none, or it is damaged.
    """
    folder = locate(path)
    config = read_config(folder)
    template = state_template(build(config.image, config.model), config).model
    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return read_model(folder, abstract(template, here)), config, folder


def read_model(step_folder: Path, template: Model) -> Model:
    """Return the model in a step's checkpoint, without the state of the training.

    Raises:
      InputError: it is damaged or its shapes are not those of `template`.
    """
    try:
        # Orbax notices a wrong shape too, but late, and leaves half-done reads behind.
        stored = _shapes(ocp.StandardCheckpointHandler().metadata(step_folder / "model").tree)
        expected = _shapes(template)
        wrong = sorted(name for name in stored.keys() | expected.keys() if stored.get(name) != expected.get(name))
        if wrong:
            raise ValueError(f"{wrong[0]} is {stored.get(wrong[0])}, expected {expected.get(wrong[0])}")
        with ocp.Checkpointer(ocp.StandardCheckpointHandler()) as reader:
            return reader.restore(step_folder / "model", args=ocp.args.StandardRestore(template))
    except _DAMAGE as error:
        raise InputError(
            f"the checkpoint {step_folder} is damaged or does not fit its own configuration ({_first(error)})"
        ) from error


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    """Return the shape of every leaf by its path."""
    leaves = jax.tree.leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): tuple(leaf.shape) for path, leaf in leaves}
