"""The loop: epochs of steps, a validation and a checkpoint after each, an orderly stop at any time."""

import contextlib
import dataclasses
import json
import math
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

from mdnvo_jax import config as configuration
from mdnvo_jax import files
from mdnvo_jax.config import Config
from mdnvo_jax.data import checks
from mdnvo_jax.data.load import load_split
from mdnvo_jax.data.windows import batches_per_epoch, training_batches, validation_batches
from mdnvo_jax.errors import InputError
from mdnvo_jax.model.head import Labels
from mdnvo_jax.model.network import Network, build
from mdnvo_jax.training import checkpoint, initial, logs, parallel, processes, step
from mdnvo_jax.training.state import (
    SKIPPED,
    TRAIN_METRICS,
    State,
    initial_state,
    schedule_scale,
    state_template,
)
from mdnvo_jax.training.store import Store, UnsavedError, any_step

# Steps between two rows of TensorBoard.
_LOG_EVERY = 10
# Fields of the training that a run may have otherwise than the one it goes on from.
_MAY_CHANGE = ("epochs", "early_stop_patience", "full_disk")


class NonFiniteError(RuntimeError):
    """The loss or the gradient is infinite or not a number."""


class DiskError(RuntimeError):
    """What belongs to the training cannot be written."""


class Stopped(Exception):  # noqa: N818 - no error
    """A signal ended the training in order, everything is saved; `signal_number` says which."""

    def __init__(self, message: str, signal_number: int) -> None:
        super().__init__(message)
        self.signal_number = signal_number


class StopRequest:
    """Whether a signal asked the training to stop."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None

    @contextlib.contextmanager
    def listening(self) -> Iterator["StopRequest"]:
        """Turn SIGTERM and the first SIGINT into a request; a second SIGINT interrupts at once, as it always does."""
        previous = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

        def request(number: int, _: object) -> None:
            self.signal = signal.Signals(number)
            print(f"{self.signal.name}: saving a checkpoint, then stopping", file=sys.stderr)
            signal.signal(signal.SIGINT, signal.default_int_handler)

        try:
            for number in previous:
                signal.signal(number, request)
            yield self
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


def train(config: Config, workdir: Path, *, resume: bool = False) -> str:
    """Train as `config` says and leave everything in `workdir`.

    Args:
      config: the experiment.
      workdir: gets config.json, environment.json, labels.json, checkpoints/, metrics.csv and tensorboard/.
      resume: go on from the newest checkpoint in `workdir`, bit for bit as if the training had never stopped.

    Returns:
      A summary of one paragraph.

    Raises:
      InputError: the data, the configuration or the state of `workdir` do not allow it.
      NonFiniteError: the training diverged; the last checkpoint is kept.
      DiskError: a checkpoint or a log could not be written, and `training.full_disk` says to stop then.
      Stopped: SIGTERM or SIGINT ended it; a checkpoint of the last step is kept.
    """
    _check_loss(config)
    if not resume:
        initial.check(config)
    processes.by_leader(lambda: _claim(workdir, resume))
    train_set, validation_set, image = load_split(config)
    interval_s = config.data.interval_s or checks.interval_s(train_set)
    config = dataclasses.replace(config, image=image, data=dataclasses.replace(config.data, interval_s=interval_s))
    if resume:
        _check_same(config, workdir)
    mesh = parallel.make_mesh(config.training.batch_size, accumulate=config.training.accumulate)
    share = {"rank": jax.process_index(), "world": jax.process_count()}
    batches = training_batches(train_set, config, seed=config.training.seed, **share)
    steps_per_epoch = config.training.steps_per_epoch or batches_per_epoch(train_set, config)
    network = build(config.image, config.model)
    store = Store(workdir, config.training.keep_latest)
    everywhere = parallel.replicated(mesh)
    if resume:
        restored = store.restore(checkpoint.abstract(state_template(network, config), everywhere))
        state = restored.state
        batches.set_state(restored.data_state)
    else:
        if processes.leads():
            for line in checks.of_labels(train_set):
                print(f"warning: {line}", file=sys.stderr)
        variables, labels = initial.start(network, config, train_set)
        state = jax.device_put(initial_state(variables, config, labels), everywhere)
        processes.by_leader(lambda: _describe(workdir, config, labels))
    run = _Run(config, workdir, network, mesh, store, steps_per_epoch, int(state.step))
    try:
        with processes.together():
            return run.epochs(state, batches, lambda: validation_batches(validation_set, config, **share))
    finally:
        store.close()
        run.logs.close()


def _claim(workdir: Path, resume: bool) -> None:
    """Make `workdir`, or refuse: a training is neither overwritten nor resumed by accident."""
    found = any_step(workdir)
    if found and not resume:
        raise InputError(f"{workdir} holds checkpoints of a training: go on with --resume, or choose another --workdir")
    if resume and not found:
        raise InputError(f"no checkpoint to resume from in {workdir}: start without --resume, or name its --workdir")
    try:
        workdir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {workdir} ({error.strerror}): choose another --workdir") from error


def _check_loss(config: Config) -> None:
    """Refuse choices of the loss and the schedule that contradict each other."""
    training = config.training
    if training.schedule == "cosine" and not training.steps_per_epoch:
        raise InputError("training.schedule cosine needs to know how long it is: set training.steps_per_epoch")
    if training.optimiser == "sgd" and training.weight_decay:
        raise InputError(f"training.weight_decay {training.weight_decay} is for Adam: leave it at 0 with sgd")
    if training.beta and (training.reduction != "mean" or config.model.head != "mixture"):
        raise InputError(
            f"training.beta {training.beta} with training.reduction {training.reduction} and model.head "
            f"{config.model.head}: beta-NLL is defined for reduction mean and head mixture"
        )


def _check_same(config: Config, workdir: Path) -> None:
    """Refuse to resume with another configuration than the training began with, but for what may change."""
    before = dataclasses.asdict(configuration.from_json((workdir / "config.json").read_text()))
    now = dataclasses.asdict(config)
    for name in _MAY_CHANGE:
        before["training"][name] = now["training"][name]
    # Older releases did not look at it.
    before["data"]["interval_s"] = before["data"]["interval_s"] or now["data"]["interval_s"]
    different = [f"{s}.{f}" for s, fields in now.items() for f, value in fields.items() if before[s][f] != value]
    if different:
        raise InputError(
            f"{', '.join(different)} differ from {workdir / 'config.json'}: resume with the same configuration "
            f"(only {', '.join(f'training.{name}' for name in _MAY_CHANGE)} may change), or train in another --workdir"
        )


def _describe(workdir: Path, config: Config, labels: Labels) -> None:
    """Write what the training is: its configuration, its environment, its labels' statistics."""
    files.write_text(workdir / "config.json", configuration.as_json(config))
    files.write_text(workdir / "environment.json", json.dumps(logs.environment(), indent=2) + "\n")
    names = ("tx_m", "ty_m", "tz_m", "rx_rad", "ry_rad", "rz_rad")
    statistics = {key: dict(zip(names, map(float, values), strict=True)) for key, values in labels._asdict().items()}
    files.write_text(workdir / "labels.json", json.dumps(statistics, indent=2) + "\n")


class _Run:
    """What stays the same while a training runs."""

    def __init__(
        self,
        config: Config,
        workdir: Path,
        network: Network,
        mesh: jax.sharding.Mesh,
        store: Store,
        steps_per_epoch: int,
        first_step: int,
    ) -> None:
        self.config, self.workdir, self.mesh, self.store = config, workdir, mesh, store
        self.steps_per_epoch = steps_per_epoch
        self.logs = logs.Logs(workdir, first_step, writes=processes.leads())
        self.first_step = first_step
        self.train_step = parallel.compile_step(step.bind(step.train_step, network, config), mesh, donate=True)
        self.validation_step = parallel.compile_step(
            step.bind(step.validation_step, network, config), mesh, donate=False
        )
        self.end_epoch = jax.jit(lambda state, sums: step.end_epoch(state, sums, config=config))

    def epochs(self, state: State, batches: Any, validation: Any) -> str:
        """Run from where `state` is to the last epoch, or to a signal."""
        started = time.monotonic()
        past = logs.read_rows(self.workdir / logs.CSV, self.first_step)
        losses = [float(row["validation_loss"]) for row in past]
        patience = self.config.training.early_stop_patience
        with StopRequest().listening() as stop:
            for epoch in range(int(state.epoch), self.config.training.epochs):
                if processes.all_agree(_is_stale(losses, patience)):
                    break
                state, stopped = self.steps(state, batches, epoch, stop)
                if stopped:
                    self.keep(state, batches)
                    with self.writing():
                        self.store.wait()
                    # Of several processes, one that was not asked stops with the one that was.
                    number = stop.signal or signal.SIGTERM
                    message = f"stopped by {number.name} after step {int(state.step)}; go on with --resume"
                    raise Stopped(message, number)
                state, row = self.validate(state, validation(), epoch)
                # A row of a step that no checkpoint has is dropped by whoever resumes; the other way round it would
                # be missing for good.
                with self.writing():
                    self.logs.epoch(row)
                self.keep(state, batches, row["validation_loss"])
                losses.append(row["validation_loss"])
                if processes.leads():
                    print(_epoch_line(row), flush=True)
        with self.writing():
            self.store.wait()
        if self.store.steps()[:1] != [int(state.step)]:
            raise DiskError(f"the training is at its end, step {int(state.step)}, which could not be saved")
        steps = int(state.step) - self.first_step
        seconds = time.monotonic() - started
        early = f", {patience} of them without a better one" if int(state.epoch) < self.config.training.epochs else ""
        rate = f"{steps / seconds:.2f} steps/s, validation included" if steps else "nothing was left to do"
        return (
            f"trained {int(state.epoch)} epochs{early}, {steps} steps in this run, in {seconds:.0f} s ({rate}); "
            f"best validation loss {min(losses, default=math.inf):.4f}; everything is in {self.workdir}"
        )

    def steps(self, state: State, batches: Any, epoch: int, stop: StopRequest) -> tuple[State, bool]:
        """Run the rest of an epoch, or to a signal, in whichever process; return whether there was one."""
        start = int(state.step) - epoch * self.steps_per_epoch
        title = f"epoch {epoch + 1}/{self.config.training.epochs}"
        pending: dict[str, jax.Array] | None = None
        stopped = False
        with logs.EpochProgress(title, self.steps_per_epoch, start) as progress:
            for index in range(start, self.steps_per_epoch):
                # Before the step, so that all processes know of it while the step runs, and stop after the same one.
                asked = parallel.anywhere(stop.signal is not None, self.mesh)
                batch = parallel.place(next(batches), self.mesh)
                state, metrics = self.train_step(state, batch)
                # The step before is looked at while this one runs, so that the device never waits for us.
                if pending is not None:
                    self.inspect(pending, epoch * self.steps_per_epoch + index)
                    progress.advance(float(pending["loss"]))
                pending = metrics
                if stopped := bool(asked):
                    break
            if pending is not None:
                self.inspect(pending, int(state.step))
                progress.advance(float(pending["loss"]))
        return state, stopped

    def inspect(self, metrics: dict[str, jax.Array], number: int) -> None:
        """Stop at values that are not finite, or count them; write every few steps' metrics to TensorBoard."""
        bad = [name for name in TRAIN_METRICS if not math.isfinite(metrics[name])]
        limit = self.config.training.skip_nonfinite
        if bad and metrics[SKIPPED] <= limit and limit:
            print(
                f"warning: step {number} is skipped, {', '.join(bad)} not finite: {int(metrics[SKIPPED])} in this "
                f"epoch, training.skip_nonfinite allows {limit}",
                file=sys.stderr,
            )
            return
        if bad:
            raise NonFiniteError(
                f"{', '.join(bad)} not finite at step {number}"
                + (f", after {limit} steps of this epoch were skipped" if limit else "")
                + ": lower training.learning_rate or "
                f"training.gradient_clip; the last good checkpoint in {self.workdir / checkpoint.FOLDER} is kept"
            )
        if number % _LOG_EVERY == 0:
            with self.writing():
                self.logs.scalars(number, {f"step/{name}": float(value) for name, value in metrics.items()})

    def keep(self, state: State, batches: Any, validation_loss: float = math.inf) -> None:
        """Save a checkpoint, in the background."""
        # By itself, so that one that could not be written does not keep this one from being tried.
        with self.writing():
            self.store.wait()
        with self.writing():
            self.store.save(state, batches.get_state(), self.config, validation_loss)

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Stop, or say so and go on, where what is done here cannot be written; as `training.full_disk` says.

        Raises:
          DiskError: it says to stop.
        """
        try:
            yield
        except OSError as error:
            what = str(error) if isinstance(error, UnsavedError) else f"a log cannot be written ({error})"
            if self.config.training.full_disk == "stop":
                raise DiskError(f"{what}: make room and go on with --resume") from error
            print(f"warning: {what}: going on, as training.full_disk says", file=sys.stderr, flush=True)

    def validate(self, state: State, batches: Any, epoch: int) -> tuple[State, dict[str, float]]:
        """Return the state for the next epoch, and this epoch's row of metrics.csv."""
        sums: Any = None
        for batch in batches:
            found = self.validation_step(state.model, parallel.place(batch, self.mesh))
            sums = found if sums is None else jax.tree.map(jax.numpy.add, sums, found)
        skipped = int(state.sums[SKIPPED])
        row = {
            "epoch": epoch + 1,
            "step": int(state.step),
            "learning_rate": self.config.training.learning_rate
            * float(schedule_scale(self.config.training, state.plateau, state.step)),
            **{name: float(state.sums[name]) / max(self.steps_per_epoch - skipped, 1) for name in TRAIN_METRICS},
            SKIPPED: skipped,
            **{name: float(value) for name, value in step.validation_metrics(sums).items()},
        }
        if not math.isfinite(row["validation_loss"]):
            raise NonFiniteError(f"the validation loss is {row['validation_loss']} at step {row['step']}")
        return self.end_epoch(state, sums), row


def _is_stale(losses: list[float], patience: int) -> bool:
    """Return whether none of the last `patience` validation losses is below all those before; never where it is 0."""
    return 0 < patience < len(losses) and min(losses[-patience:]) >= min(losses[:-patience])


def _epoch_line(row: dict[str, float]) -> str:
    """Return the line that is printed after an epoch."""
    return (
        f"epoch {row['epoch']:>3}  step {row['step']:>6}  loss {row['loss']:8.4f}  "
        f"validation {row['validation_loss']:8.4f}  {row['validation_translation_rmse_m']:.4f} m  "
        f"{row['validation_rotation_rmse_deg']:.4f} deg  rate {row['learning_rate']:.2e}"
        + (f"  skipped {row[SKIPPED]}" if row[SKIPPED] else "")
    )
