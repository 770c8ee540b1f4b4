"""Section growth: what our costs are proportional to."""

import dataclasses
import sys
from collections.abc import Callable, Mapping, Sequence

import jax
import numpy as np

from mdnvo_jax import mixture, predictor
from mdnvo_jax.benchmark import child, contest, material
from mdnvo_jax.benchmark.growth import exponent
from mdnvo_jax.benchmark.our_training import OurTraining
from mdnvo_jax.benchmark.outcome import Outcome, Settings
from mdnvo_jax.benchmark.timing import Contender, interleaved, spread
from mdnvo_jax.config import Config
from mdnvo_jax.evaluation.tables import Column, Row, Table
from mdnvo_jax.mixture import Mixture
from mdnvo_jax.predictor import Predictor

_ROUNDS = 7
_MULTIPLIER = 0.25


def measure(settings: Settings) -> Outcome:
    """Measure our costs at several sizes."""
    outcome = Outcome()
    growths: list[tuple[str, Callable[[Settings], dict[float, Contender]]]] = [
        ("predict, frames", _by_frames),
        ("mixture NLL with gradient, components", _by_components),
    ]
    if settings.short:
        outcome.line("short form: growth with pixels, windows and devices is left out, for they compile a lot")
    else:
        growths += [("predict, pixels of a frame", _by_pixels), ("training step, steps of a window", _by_window)]
    rows: list[Row] = []
    for what, contenders in growths:
        by_size = contenders(settings)
        named = {f"{size:g}": contender for size, contender in by_size.items()}
        found = interleaved(named, settings.rounds(_ROUNDS), budget_s=30)
        rows.append(_row(what, found, outcome))
    if not settings.short:
        found = {f"{count:g}": _with_devices(count) for count in (1, 2, 4)}
        rows.append(_row("training step, virtual devices on the same cores", found, outcome))
    columns = [
        Column("what", "cost of"),
        Column("sizes", "sizes"),
        Column("exponent", "exponent ± its standard error", digits=2),
        Column("first", "ms at the first", digits=2),
        Column("last", "ms at the last", digits=2),
        Column("n", "rounds"),
    ]
    notes = [
        "Exponent b of the law time = a * size^b, by least squares on logarithms of the medians: 1 is proportional.",
        f"Network of configs/kitti_small.py; training step: batch 8. Width {_MULTIPLIER:g}.",
        "Virtual devices share the cores of one machine: an exponent of 0 says that splitting a batch costs nothing.",
    ]
    outcome.tables.append(Table("Growth of our costs", columns, rows, notes=notes))
    return outcome


def _row(what: str, found: Mapping[str, Sequence[float]], outcome: Outcome) -> Row:
    outcome.times(f"growth {what}", found)
    sizes, times = list(found), list(found.values())
    return {
        "what": what,
        "sizes": " ".join(sizes),
        "exponent": exponent([float(size) for size in sizes], [float(np.median(values)) for values in times]),
        "first": spread(times[0], 1e3),
        "last": spread(times[-1], 1e3),
        "n": str(len(times[0])),
    }


def _config(settings: Settings, height: int = 80, width: int = 256) -> Config:
    if settings.short:
        return material.small_config(height // 2, width // 4, 1 / 32, batch=2)
    return material.small_config(height, width, _MULTIPLIER)


def _prediction(model: Predictor, count: int) -> Contender:
    image = model.config.image
    sequence = material.in_memory(material.drawn(64, image.channels, (image.height, image.width)))
    frames = np.stack([sequence.read(index % 64) for index in range(count)])

    return contest.offline(model, frames)


def _load(config: Config) -> Predictor:
    return predictor.from_model(material.untrained_model(config), config, source="benchmark")


def _by_frames(settings: Settings) -> dict[float, Contender]:
    """Return predictions of more and more frames."""
    model = _load(_config(settings))
    return {count: _prediction(model, count) for count in ((9, 17, 33) if settings.short else (65, 129, 257, 513))}


def _by_pixels(settings: Settings) -> dict[float, Contender]:
    """Return predictions at larger and larger frames of one shape."""
    sizes = ((64, 192), (96, 288), (128, 384), (192, 576))
    models = {height * width: _load(_config(settings, height, width)) for height, width in sizes}
    return {pixels: _prediction(model, 65) for pixels, model in models.items()}


def _by_window(settings: Settings) -> dict[float, Contender]:
    """Return training steps on longer and longer windows."""
    return {steps: _training(_config(settings), steps, 1) for steps in (3, 6, 12, 24)}


def _training(config: Config, steps: int, devices: int) -> Contender:
    """Return what takes a training step on windows of `steps` steps."""
    config = dataclasses.replace(config, data=dataclasses.replace(config.data, window=steps))
    ours = OurTraining(config, devices)
    return ours.contender(ours.compiled(config))


def _by_components(settings: Settings) -> dict[float, Contender]:
    """Return the loss for more and more Gaussians."""
    count = 200 if settings.short else 20_000

    def contender(components: int) -> Contender:
        rng = np.random.default_rng(components)
        shape = (count, components, 6)
        given = Mixture(*(jax.numpy.asarray(rng.normal(size=s), "float32") for s in (shape[:2], shape, shape)))
        value = jax.numpy.asarray(rng.normal(size=(count, 6)), "float32")
        run = jax.jit(jax.value_and_grad(lambda m: mixture.nll(m, value)))
        return lambda: run(given)

    return {components: contender(components) for components in ((2, 4) if settings.short else (2, 4, 8, 16, 32))}


def _with_devices(count: int) -> list[float]:
    """Return the seconds of training steps split over virtual devices, measured in a process that has so many."""
    environment = child.virtual_devices(count)
    printed = child.run(["-m", "mdnvo_jax.benchmark.sections.growth", str(count)], environment)
    return [float(word) for word in printed.split()]


def _print_steps(devices: int) -> None:
    """Print the seconds of a few training steps on `devices` devices."""
    contender = _training(material.small_config(), 6, devices)
    print(*interleaved({"step": contender}, _ROUNDS)["step"])


if __name__ == "__main__":
    _print_steps(int(sys.argv[1]))
