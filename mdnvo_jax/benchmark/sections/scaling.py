"""Section scaling: a training step shared between processes or devices: what that costs, and that its losses agree."""

import argparse
import dataclasses
import json
import os
import sys
import time
from typing import Any, NamedTuple

import jax
import numpy as np

from mdnvo_jax.benchmark import child, material
from mdnvo_jax.benchmark.machine import usable_cores
from mdnvo_jax.benchmark.outcome import Outcome, Settings
from mdnvo_jax.benchmark.timing import rate, spread
from mdnvo_jax.config import Config
from mdnvo_jax.evaluation.tables import Column, Row, Table, Value
from mdnvo_jax.model.network import build
from mdnvo_jax.training import parallel, processes, step

# Steps whose losses are compared, and steps that are timed after as many that are not.
_COMPARED, _FIRST, _TIMED, _WARM_UP = 100, 10, 30, 3
# Optimisers and rates that losses are compared at: the faster a network learns, the faster rounding grows.
_COMPARED_AT = (("sgd", 1e-4), ("sgd", 1e-3), ("adam", 3e-5), ("adam", 1e-4))
_LOST_AFTER_S = 60


class Arrangement(NamedTuple):
    """Who shares a step.

    Attributes:
      processes: that take part; each has one core of its own, in turn, where there are several.
      devices: of each process, virtual ones.
      cores: that a single process may use.
      batch: windows in the global batch.
    """

    processes: int = 1
    devices: int = 1
    cores: int = 1
    batch: int = 8

    def used(self) -> int:
        """Return how many cores of this machine take part."""
        return min(usable_cores(), max(self.processes, self.cores))


_ALONE = Arrangement()


def measure(settings: Settings) -> Outcome:
    """Compare the losses of several processes with those of one, and time weak and strong scaling."""
    outcome = Outcome()
    if settings.short:
        outcome.line("short form: one process alone, for every other one compiles for seconds")
    else:
        outcome.tables.append(_agreement(outcome))
    outcome.tables.append(_costs(settings, outcome))
    return outcome


def _agreement(outcome: Outcome) -> Table:
    """Return how far the losses of a training are from those of one process with the same batches."""
    rows: list[Row] = []
    for optimiser, learning_rate in _COMPARED_AT:
        at = {"optimiser": optimiser, "learning_rate": learning_rate}
        expected = np.array(_run(_ALONE, _COMPARED, compared_at=at)["losses"])
        for shared in (Arrangement(devices=4), Arrangement(processes=2), Arrangement(processes=4)):
            away = np.abs(np.array(_run(shared, _COMPARED, compared_at=at)["losses"]) / expected - 1)
            outcome.agreement[f"loss, {optimiser} at {learning_rate:g}, {_named(shared)}"] = float(away.max())
            rows.append(
                {
                    "optimiser": f"{optimiser}, rate {learning_rate:g}",
                    "who": _named(shared),
                    "losses": f"{expected[0]:.3f} to {expected[-1]:.3f}",
                    "first": f"{away[:_FIRST].max():.1e}",
                    "all": f"{away.max():.1e}",
                }
            )
    columns = [
        Column("optimiser", "optimiser"),
        Column("who", "shared by"),
        Column("losses", "losses of one process"),
        Column("first", f"largest relative difference, first {_FIRST} steps"),
        Column("all", f"all {_COMPARED}"),
    ]
    config = _config(8, short=False, compared_at={})
    notes = [
        f"{material.described(config)}, global batch 8 x window {config.data.window}, float32, dropout on, the same "
        "batches for all; sums over a batch are taken in another order, and training makes more of that step by step."
    ]
    return Table("Losses of processes and devices against those of one", columns, rows, notes=notes)


def _costs(settings: Settings, outcome: Outcome) -> Table:
    """Return what a step takes by who shares it, the global batch kept (strong) or grown with them (weak)."""
    cores = usable_cores()
    arrangements = {
        "one process": _ALONE,
        "one process, all cores": Arrangement(cores=cores),
        "strong": Arrangement(processes=2),
        "strong, virtual devices": Arrangement(devices=2, cores=cores),
        "weak": Arrangement(processes=2, batch=16),
        "strong, twice as many as cores": Arrangement(processes=2 * cores),
        "weak, twice as many as cores": Arrangement(processes=2 * cores, batch=16 * cores),
    }
    if settings.short:
        arrangements = {"one process": _ALONE}
    steps = _WARM_UP + settings.rounds(_TIMED)
    rows: list[Row] = []
    alone = 0.0
    for what, shared in arrangements.items():
        seconds = _run(shared, steps, short=settings.short)["seconds"][_WARM_UP:]
        outcome.times("scaling", {f"{what}: {_named(shared)}, batch {shared.batch}": seconds})
        windows = rate(seconds, shared.batch)
        alone = alone or windows.value
        rows.append(
            {
                "what": what,
                "who": _named(shared),
                "batch": str(shared.batch),
                "ms": spread(seconds, 1e3),
                "windows": windows,
                "efficiency": Value(windows.value / alone / shared.used()),
                "n": str(len(seconds)),
            }
        )
    columns = [
        Column("what", "scaling"),
        Column("who", "shared by"),
        Column("batch", "global batch"),
        Column("ms", "ms a step", 1),
        Column("windows", "windows/s", 2),
        Column("efficiency", "windows/s a core, over the first row's", 2),
        Column("n", "steps"),
    ]
    config = _config(8, short=settings.short, compared_at=None)
    notes = [
        f"{material.described(config)}, window {config.data.window}, Adam. Processes are kept on a core each, in turn, "
        "and meet over loopback (gloo); input is not part of a step."
    ]
    return Table("Weak and strong scaling of a training step", columns, rows, notes=notes)


def _named(shared: Arrangement) -> str:
    if shared.devices > 1:
        return f"{shared.devices} virtual devices"
    return f"{shared.processes} process{'es' if shared.processes > 1 else ''}, {shared.used()} cores"


def _run(
    shared: Arrangement, steps: int, *, short: bool = False, compared_at: dict[str, Any] | None = None
) -> dict[str, list[float]]:
    """Return losses and seconds of the steps of a training, as process 0 of those that share it saw them.

    Args:
      shared: who shares it.
      steps: how many.
      short: of a toy.
      compared_at: fields of the training where losses are compared, which is done on a smaller network.
    """
    asked = {
        **shared._asdict(),
        "address": processes.loopback(),
        "steps": steps,
        "short": short,
        "compared_at": compared_at,
    }
    workers = [
        child.start(["-m", __name__, json.dumps({**asked, "process": number})], child.virtual_devices(shared.devices))
        for number in range(shared.processes)
    ]
    try:
        told = [child.printed(worker) for worker in workers]
    finally:
        for worker in workers:
            worker.kill()
    found: dict[str, list[float]] = json.loads(told[0].splitlines()[-1])
    return found


def _config(batch: int, *, short: bool, compared_at: dict[str, Any] | None) -> Config:
    """Return what is trained: a toy, a small network where losses are compared, else that of configs/kitti_small.py."""
    if short:
        return material.small_config(32, 64, 1 / 32, batch=batch)
    if compared_at is None:
        return material.small_config(batch=batch)
    config = material.small_config(32, 64, 1 / 16, batch=batch)
    return dataclasses.replace(config, training=dataclasses.replace(config.training, **compared_at))


def _work(asked: dict[str, Any]) -> dict[str, list[float]]:
    """Take part in a training as one of its processes, and return its losses and seconds."""
    shared = Arrangement(**{name: asked[name] for name in Arrangement._fields})
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        several = shared.processes > 1
        os.sched_setaffinity(0, [cores[asked["process"] % len(cores)]] if several else cores[: shared.cores])
    together = {"coordinator": asked["address"], "processes": shared.processes, "process": asked["process"]}
    if shared.processes == 1:
        together = dict.fromkeys(together)
    processes.join(argparse.Namespace(**together, cluster=False, lost_after=_LOST_AFTER_S))
    config = _config(shared.batch, short=asked["short"], compared_at=asked["compared_at"])
    mesh = parallel.make_mesh(shared.batch)
    state = material.fresh_state(config, mesh)
    take = parallel.compile_step(
        step.bind(step.train_step, build(config.image, config.model), config), mesh, donate=True
    )
    losses, seconds = [], []
    rows = shared.batch // shared.processes
    mine = slice(asked["process"] * rows, (asked["process"] + 1) * rows)
    for number in range(asked["steps"]):
        batch = material.moving_batch(config, number)
        placed = parallel.place({name: values[mine] for name, values in batch.items()}, mesh)
        began = time.perf_counter()
        state, metrics = jax.block_until_ready(take(state, placed))
        seconds.append(time.perf_counter() - began)
        losses.append(float(metrics["loss"]))
    return {"losses": losses, "seconds": seconds}


if __name__ == "__main__":
    print(json.dumps(_work(json.loads(sys.argv[1]))))
