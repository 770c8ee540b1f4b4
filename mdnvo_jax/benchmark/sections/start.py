"""Section start: seconds from the shell's prompt to help, to an import, to a first prediction."""

import functools

from mdnvo_jax.benchmark import child, material, peers
from mdnvo_jax.benchmark.outcome import Outcome, Settings, compared
from mdnvo_jax.benchmark.timing import Contender, interleaved, spread
from mdnvo_jax.evaluation.tables import Column, Table

_ROUNDS = 9
# A prediction takes seconds.
_PREDICTIONS = 3
_FRAMES = 8
PYTHON = "python -c pass"
COLD = f"predict {_FRAMES} frames, nothing compiled"
WARM = f"predict {_FRAMES} frames, compiled before"


def measure(settings: Settings) -> Outcome:
    """Measure how long processes take to start."""
    outcome = Outcome()
    commands = ("predict",) if settings.short else ("predict", "train", "evaluate", "synthesize")
    contenders: dict[str, Contender] = {PYTHON: lambda: child.run(["-c", "pass"])}
    for name in commands:
        contenders[f"{name} --help"] = functools.partial(child.run, ["-m", f"mdnvo_jax.{name}", "--help"])
    contenders["import mdnvo_jax.mixture"] = lambda: child.run(["-c", "import mdnvo_jax.mixture"])
    if not settings.short and peers.available("torch", outcome):
        contenders["import torch"] = lambda: child.run(["-c", "import torch"])
    found = interleaved(contenders, settings.rounds(_ROUNDS), warm_up=0 if settings.short else 1)
    predictions = interleaved(_predictions(settings), 1 if settings.short else _PREDICTIONS, warm_up=0)
    if settings.short:
        outcome.line("short form: other commands and the start with compiled programs are left out")
    outcome.times("start", {**found, **predictions})
    for name in commands:
        outcome.target("help", f"{name} --help", spread(found[f"{name} --help"]))
    columns = [Column("contender", "process"), Column("s", "s", digits=2), Column("n", "rounds")]
    rows = [
        {**compared(name, times, name), "s": spread(times[name])} for times in (found, predictions) for name in times
    ]
    notes = [
        "Wall time of a process. Predictions: configs/kitti_small.py from PNG, files and pictures written; compiled "
        "before: with the persistent compilation cache of an earlier process.",
    ]
    outcome.tables.append(Table("From the start of a process", columns, rows, notes=notes))
    return outcome


def _predictions(settings: Settings) -> dict[str, Contender]:
    """Return what predicts a few frames from the command line."""
    config = material.small_config(32, 64, 1 / 32) if settings.short else material.small_config()
    size = (94, 310) if settings.short else material.KITTI_SIZE
    checkpoint = material.write_checkpoint(material.untrained_model(config), config, settings.folder / "start")
    images = material.write_pngs(material.drawn(_FRAMES, config.image.channels, size), settings.folder / "eight")
    store, output = settings.folder / "compiled", settings.folder / "prediction"
    arguments = ["-m", "mdnvo_jax.predict", str(images), "--checkpoint", str(checkpoint), "--output", str(output)]

    def predict(kept: bool) -> None:
        options = {"XDG_CACHE_HOME": str(store), "JAX_ENABLE_COMPILATION_CACHE": str(kept).lower()}
        child.run([*arguments, "--force"], options)

    if settings.short:
        return {COLD: lambda: predict(False)}
    predict(True)
    return {COLD: lambda: predict(False), WARM: lambda: predict(True)}
