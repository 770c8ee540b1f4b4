"""Section input: frames a second for training, from PNG and from the cache, and how long a step waits for them."""

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mdnvo_jax import geometry
from mdnvo_jax.benchmark import material, peers
from mdnvo_jax.benchmark.agreement import DisagreementError
from mdnvo_jax.benchmark.outcome import Outcome, Settings, compared
from mdnvo_jax.benchmark.timing import Contender, Untimed, fastest, interleaved, rate, ratio, spread
from mdnvo_jax.config import Config
from mdnvo_jax.data.cache import prepare_cache, read_cache
from mdnvo_jax.data.folder import read_frames
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.data.windows import training_batches
from mdnvo_jax.evaluation.tables import Column, Table
from mdnvo_jax.model.network import build
from mdnvo_jax.training import parallel, step

_ROUNDS = 5
# Batches before the clock starts: until then, threads and workers fill their queues.
_DRAINED = 2
PNG, CACHE, LOADER = "ours, from PNG", "ours, from the cache", "DataLoader, from PNG"


@dataclasses.dataclass(frozen=True)
class _Source:
    """Where training gets its windows.

    Attributes:
      sequence: with poses.
      batches: that are taken in a round.
    """

    sequence: Sequence
    batches: int


def measure(settings: Settings) -> Outcome:
    """Measure the input of training."""
    outcome = Outcome()
    if settings.short:
        config, size, frames, png, cached = (
            material.paper_config(32, 64, 1 / 32, batch=2, window=2),
            (47, 155),
            12,
            1,
            2,
        )
        small = material.small_config(32, 64, 1 / 32, batch=2)
    else:
        config, size, frames, png, cached = material.paper_config(184, 608, 1.0), material.KITTI_SIZE, 120, 4, 60
        small = material.small_config()
    folder = material.write_pngs(material.drawn(frames, 3, size), settings.folder / "input")
    outcome.tables.append(_loading(config, _sources(config, folder, png, cached), folder, settings, outcome))
    outcome.tables.append(_waiting(small, _sources(small, folder, 1, 1), settings, outcome))
    return outcome


def _sources(config: Config, folder: Path, png: int, cached: int) -> dict[str, _Source]:
    """Return the same frames as files and as a cache."""
    found = read_frames(folder, config.image.channels)
    rng = np.random.default_rng(2)
    steps = material.LABELS.mean + material.LABELS.std * rng.normal(size=(found.count - 1, 6))
    poses = np.asarray(geometry.accumulate(geometry.step_to_matrix(steps.astype(np.float64))))
    found = dataclasses.replace(found, name="00", poses=poses)
    cache = _cache(config, folder)
    prepare_cache([found], config.image, cache)
    return {PNG: _Source(found, png), CACHE: _Source(read_cache(cache, config.image)[0], cached)}


def _cache(config: Config, folder: Path) -> Path:
    return folder.parent / f"cache{config.image.width}x{config.image.channels}"


def _loading(config: Config, sources: dict[str, _Source], folder: Path, settings: Settings, outcome: Outcome) -> Table:
    """Return the table of frames a second, with nothing else to do."""
    batch, window = config.training.batch_size, config.data.window
    batches = {name: source.batches for name, source in sources.items()}
    contenders: dict[str, Contender] = {name: _ours(config, source) for name, source in sources.items()}
    if peers.available("torch", outcome):
        from mdnvo_jax.benchmark import torch_input

        paths, labels = list(sources[PNG].sequence.paths), sources[PNG].sequence.steps()
        array = str(_cache(config, folder) / "00.npy")
        kinds = {LOADER: (paths, sources[PNG].batches), "DataLoader, from our cache": (array, sources[CACHE].batches)}
        for name, (frames, count) in kinds.items():
            windows = torch_input.Windows(frames, labels, window, config.image)
            _assert_same_windows(config, sources[PNG].sequence, windows)
            for workers in (0,) if settings.short else (0, 2):
                full = f"{name}, {workers} workers"
                batches[full] = count
                contenders[full] = _peer(torch_input.loader(windows, batch, _DRAINED + count, workers))
    found = interleaved(contenders, settings.rounds(_ROUNDS), warm_up=0, budget_s=60)
    # Of one batch each: from the cache, many are taken in a round.
    found = {name: [value / batches[name] for value in values] for name, values in found.items()}
    outcome.times("input, a batch", found)
    loaders = [name for name in found if name.startswith(LOADER)]
    if loaders:
        loader = fastest(found, loaders)
        outcome.target("input", loader, ratio(found[loader], found[CACHE]))
    frames_in_batch = batch * (window + 1)
    return Table(
        title=f"Input of training: batches of {batch} x {window + 1} frames of {config.image.width}x"
        f"{config.image.height}, from 1241x376 in colour",
        columns=[
            Column("contender", "contender"),
            Column("rate", "frames/s", digits=0),
            Column("ms", "ms a batch", digits=1),
            Column("ratio", "time over ours, from the cache", digits=2),
            Column("n", "rounds"),
        ],
        rows=[{**compared(name, found, CACHE), "rate": rate(found[name], frames_in_batch)} for name in contenders],
        notes=[
            "Nothing else runs meanwhile. Files are in the page cache of the system.",
            f"Ours: {config.data.threads} threads. DataLoader: the same windows, decoded and resized by the same "
            "functions on OpenCV; its windows were asserted to be ours, byte for byte.",
        ],
    )


def _ours(config: Config, source: _Source) -> Contender:
    """Return what takes batches from our iterator."""

    def run() -> Untimed:
        began = time.perf_counter()
        iterator = training_batches([source.sequence], config, seed=0)
        for _ in range(_DRAINED):
            next(iterator)
        start = time.perf_counter()
        for _ in range(source.batches):
            next(iterator)
        stop = time.perf_counter()
        iterator.close()
        return Untimed(start - began + time.perf_counter() - stop)

    return run


def _peer(loader: Any) -> Contender:
    """Return what takes all batches from a loader."""

    def run() -> Untimed:
        began = time.perf_counter()
        iterator = iter(loader)
        for _ in range(_DRAINED):
            next(iterator)
        start = time.perf_counter()
        for _ in iterator:
            pass
        return Untimed(start - began)

    return run


def _assert_same_windows(config: Config, sequence: Sequence, windows: Any) -> None:
    """Assert that every window of a batch of ours is one of the peer's."""
    batches = training_batches([sequence], config, seed=0)
    batch = next(batches)
    batches.close()
    starts = {np.asarray(windows.steps[start], np.float32).tobytes(): start for start in range(len(windows))}
    for images, steps in zip(batch["images"], batch["steps"], strict=True):
        start = starts.get(np.ascontiguousarray(steps[0]).tobytes())
        if start is None or not np.array_equal(windows[start][0].numpy(), images):
            raise DisagreementError("input: a window of ours is not among those of the DataLoader")


def _waiting(config: Config, sources: dict[str, _Source], settings: Settings, outcome: Outcome) -> Table:
    """Return the table of how long the loop of training waits for its next batch."""
    steps = 2 if settings.short else 20
    mesh = parallel.make_mesh(config.training.batch_size, 1)
    network = build(config.image, config.model)
    if settings.short:
        outcome.line("short form: in the loop of training, a stand-in takes the place of the training step")
    function = _stand_in if settings.short else step.bind(step.train_step, network, config)
    take = parallel.compile_step(function, mesh, donate=True)
    state = material.fresh_state(config, mesh)
    waited: dict[str, list[float]] = {}

    def contender(name: str) -> Contender:
        def run() -> Untimed:
            nonlocal state
            began = time.perf_counter()
            batches = _batches(config, sources.get(name))
            state, pending = take(state, parallel.place(next(batches), mesh))
            float(pending["loss"])
            start, waiting = time.perf_counter(), 0.0
            for _ in range(steps):
                asked = time.perf_counter()
                batch = next(batches)
                waiting += time.perf_counter() - asked
                state, metrics = take(state, parallel.place(batch, mesh))
                # As the loop of training does: one step is looked at while the next one runs.
                float(pending["loss"])
                pending = metrics
            float(pending["loss"])
            stop = time.perf_counter()
            waited.setdefault(name, []).append(waiting / (stop - start))
            if hasattr(batches, "close"):
                batches.close()
            return Untimed(start - began + time.perf_counter() - stop)

        return run

    memory = "a batch in memory"
    found = interleaved({name: contender(name) for name in (memory, *sources)}, settings.rounds(_ROUNDS), budget_s=60)
    found = {name: [value / steps for value in values] for name, values in found.items()}
    # The first of each was to warm up.
    shares = {name: values[-len(found[name]) :] for name, values in waited.items()}
    outcome.times("input, a training step", found)
    outcome.times("input, share of a step spent waiting", shares)
    outcome.target("waiting", f"{material.described(config)}, from the cache", spread(shares[CACHE], 100))
    return Table(
        title=f"Waiting for input: the loop of training with configs/kitti_small.py, {material.described(config)}, "
        f"batch {config.training.batch_size}, augmentation on",
        columns=[
            Column("contender", "input"),
            Column("ms", "ms a step", digits=1),
            Column("waiting", "waiting for the next batch, %", digits=2),
            Column("ratio", "step over that from memory", digits=3),
            Column("n", "rounds"),
        ],
        rows=[{**compared(name, found, memory), "waiting": spread(shares[name], 100)} for name in found],
        notes=[
            "Waiting: time in `next(batches)`. A step also takes longer while threads decode on the cores it computes "
            "on: that is in the last ratio.",
        ],
    )


def _stand_in(state: Any, batch: dict[str, jax.Array]) -> Any:
    return state, {"loss": batch["images"].mean()}


def _batches(config: Config, source: _Source | None) -> Iterator[dict[str, np.ndarray]]:
    """Return batches from a source, or the same one for ever."""
    if source is not None:
        return training_batches([source.sequence], config, seed=0)
    batch = material.training_batch(config)
    return iter(lambda: batch, None)
