"""The checkpoints of a training: saved while it goes on, the newest and the best kept, restored whole or not at all."""

import contextlib
import errno
import math
import os
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers

from mdnvo_jax.config import Config
from mdnvo_jax.errors import InputError
from mdnvo_jax.training import checkpoint, checksum, processes
from mdnvo_jax.training.checkpoint import FOLDER
from mdnvo_jax.training.state import SKIPPED, State

# Beside `FOLDER`: steps that could not be read, and for a moment the one that is being replaced.
DAMAGED = "damaged_checkpoints"
_REPLACED = "replaced_checkpoint"
# What a step's folder is called until it is whole.
_UNFINISHED = ".orbax-checkpoint-tmp"
# How often, and for how long at most, it is looked whether such a folder stays away once removed.
_LOOKS, _LOOK_EVERY_S, _REMOVE_WITHIN_S = 5, 0.02, 2.0


class UnsavedError(OSError):
    """A checkpoint could not be written; those before it are whole."""


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
        processes.by_leader(lambda: recover(workdir))
        self._workdir = workdir.absolute()
        self._manager = ocp.CheckpointManager(self._workdir / FOLDER, options=options)

    def save(self, state: State, data_state: Any, config: Config, validation_loss: float = math.inf) -> None:
        """Start to save the training; it goes on in the background.

        A checkpoint of the same step, left by a training that was stopped before it could validate, is replaced.

        Args:
          state: the state after a whole number of steps.
          data_state: the state of the iterator over batches, as JSON values.
          config: the experiment, with the image configuration resolved.
          validation_loss: infinite where this state was not validated, so that it never counts as the best.

        Raises:
          UnsavedError: the last one could not be written, and this one was not begun; or this one could not be begun.
        """
        self.wait()
        step = int(state.step)
        replaces = step in self._manager.all_steps()
        if replaces:
            self._move(step, _REPLACED)
        data = {"iterator": data_state}
        training = _without_model(state)
        checksums = {
            "model": checksum.of_arrays(state.model),
            "training": checksum.of_arrays(training),
            "data": checksum.of_json(data),
        }
        with self._writing():
            self._check_room(state)
            saved = self._manager.save(
                step,
                args=ocp.args.Composite(
                    model=ocp.args.StandardSave(state.model),
                    training=ocp.args.StandardSave(training),
                    data=ocp.args.JsonSave(data),
                    about=ocp.args.JsonSave(checkpoint.about_itself(config, checksums)),
                ),
                metrics={checkpoint.METRIC: validation_loss},
            )
        # Orbax saves nothing, and says nothing, where it knows of a later step.
        assert saved, f"step {step} was not saved: {self.steps()} are there"
        if replaces:
            self.wait()
            processes.by_leader(lambda: recover(self._workdir))

    def steps(self) -> list[int]:
        """Return the steps that have a checkpoint, newest first."""
        self._manager.reload()
        return sorted(self._manager.all_steps(), reverse=True)

    def restore(self, template: State) -> Restored:
        """Return the newest checkpoint that is whole; newer ones are moved to `DAMAGED`, with a warning.

        Args:
          template: a state of the shapes, types and shardings to restore.

        Raises:
          InputError: there is none, or the newest is of a version that this release does not read.
        """
        damaged: dict[int, str] = {}
        for step in self.steps():
            about, wrong = None, ""
            try:
                about = self._check(step)
            except InputError:
                raise
            except checkpoint.DAMAGE as error:
                wrong = checkpoint.first_line(error)
            if not processes.all_agree(not wrong) or about is None:
                damaged[step] = wrong or "another process cannot read it"
                continue
            try:
                restored = self._restore(step, about, template)
            except checkpoint.DAMAGE as error:
                damaged[step] = checkpoint.first_line(error)
                continue
            for number, why in damaged.items():
                # Out of the way: a step is saved once, and this training will come to it again.
                place = self._move(number, DAMAGED)
                if processes.leads():
                    print(
                        f"warning: checkpoint {number} cannot be read and is now {place}; "
                        f"going on from step {step} ({why})",
                        file=sys.stderr,
                    )
            return restored
        raise InputError(
            f"none of the {len(damaged)} checkpoints in {self._manager.directory} can be read "
            f"({'; '.join(f'{step}: {why}' for step, why in damaged.items())}): start again in another --workdir"
        )

    def _check(self, step: int) -> dict[str, Any]:
        """Return what a checkpoint says about itself, after a look at every array of it; raise what is wrong."""
        folder = Path(self._manager.directory) / str(step)
        about = checkpoint.read_about(folder)
        for item in ("model", "training"):
            checksum.check_stored(folder / item, about.get("checksums", {}).get(item))
        return about

    def _restore(self, step: int, about: dict[str, Any], template: State) -> Restored:
        """Return the checkpoint of one step; all processes read it together."""
        training = _without_model(template)
        if about["version"] == 1:
            training["sums"] = {name: leaf for name, leaf in training["sums"].items() if name != SKIPPED}
        found = self._manager.restore(
            step,
            args=ocp.args.Composite(
                model=ocp.args.StandardRestore(template.model),
                training=ocp.args.StandardRestore(training),
                data=ocp.args.JsonRestore(),
            ),
        )
        if about["version"] == 1:
            leaf = template.sums[SKIPPED]
            found.training["sums"][SKIPPED] = jax.device_put(np.zeros(leaf.shape, leaf.dtype), leaf.sharding)
        else:
            checksum.check_json(found.data, about["checksums"]["data"], "data")
        return Restored(State(model=found.model, **found.training), found.data["iterator"], step)

    def _move(self, step: int, name: str) -> Path:
        """Move a step's folder into the folder `name` beside the checkpoints, and return where it is now."""
        place = self._workdir / name / str(step)

        def move() -> None:
            nonlocal place
            place.parent.mkdir(exist_ok=True)
            while place.exists():
                place = place.with_name(f"{place.name}+")
            (self._workdir / FOLDER / str(step)).rename(place)

        processes.by_leader(move)
        self._manager.reload()
        return place

    def wait(self) -> None:
        """Return when everything that was saved is on disk.

        Raises:
          UnsavedError: the last checkpoint could not be written.
        """
        with self._writing():
            self._manager.wait_until_finished()

    def _check_room(self, state: State) -> None:
        """Refuse what the disk has no room for, before orbax tries, and complains in many pages.

        Raises:
          OSError: there is less room than the arrays take.
        """
        needed = sum(leaf.nbytes for leaf in jax.tree.leaves(state))
        free = shutil.disk_usage(self._workdir).free
        if jax.process_count() == 1 and free < needed:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Say in one line what orbax could not write, and remove what it has left of it."""
        try:
            yield
        except (OSError, ValueError) as error:
            if jax.process_count() == 1:
                _remove_unfinished(self._workdir / FOLDER)
            steps = self.steps()
            whole = f"step {steps[0]} is the last whole one" if steps else "there is none yet"
            full = os.strerror(errno.ENOSPC)
            reason = full if full in str(error) else checkpoint.first_line(error)
            raise UnsavedError(f"a checkpoint cannot be written to {self._workdir} ({reason}); {whole}") from error

    def close(self) -> None:
        """Finish what is being written and let go. Whoever wants to know whether it was written waits before."""
        with contextlib.suppress(UnsavedError):
            self.wait()
        self._manager.close()


def recover(workdir: Path) -> None:
    """Bring a training's folder in order that ended while a checkpoint was replaced by another of the same step."""
    for old in (workdir / _REPLACED).glob("*"):
        new = workdir / FOLDER / old.name
        if (new / checkpoint.FINISHED).exists():
            shutil.rmtree(old)
        else:
            old.rename(new)
    if (workdir / _REPLACED).is_dir():
        (workdir / _REPLACED).rmdir()


def _remove_unfinished(folder: Path) -> None:
    """Remove what is left of a checkpoint that could not be written.

    Orbax gives up at the first error and does not wait for its other writes, which may still bring a folder back: it is
    gone when it stays away. What is there after all is removed when the training is opened again.
    """
    deadline, absent = time.monotonic() + _REMOVE_WITHIN_S, 0
    while absent < _LOOKS and time.monotonic() < deadline:
        found = list(folder.glob(f"*{_UNFINISHED}*"))
        for left in found:
            shutil.rmtree(left, ignore_errors=True)
        absent = 0 if found else absent + 1
        time.sleep(_LOOK_EVERY_S)


def any_step(workdir: Path) -> bool:
    """Return whether a training has left a step's folder in `workdir`, be it damaged."""
    recover(workdir)
    folder = workdir / FOLDER
    return folder.is_dir() and any(entry.name.isdigit() for entry in folder.iterdir())


def _without_model(state: State) -> dict[str, Any]:
    """Return the part of a state that only training needs; the model is saved beside it, for prediction to read."""
    return {name: value for name, value in state._asdict().items() if name != "model"}


def _metric(metrics: dict[str, float]) -> float:
    """Return what the best checkpoint is chosen by."""
    return metrics[checkpoint.METRIC]
