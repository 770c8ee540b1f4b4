"""Section options: what the options that save memory save, and what they cost."""

import dataclasses
from typing import Any

from mdnvo_jax.benchmark import material
from mdnvo_jax.benchmark.our_training import OurTraining
from mdnvo_jax.benchmark.outcome import Outcome, Settings, compared
from mdnvo_jax.benchmark.timing import RATIO, interleaved
from mdnvo_jax.config import Config
from mdnvo_jax.evaluation.tables import Column, Row, Table, Value

_ROUNDS = 7
_BUDGET_S = 120.0
_PLAIN = "none"
# By name: fields of `ModelConfig`, fields of `TrainingConfig`.
_OPTIONS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    _PLAIN: ({}, {}),
    "model.activations bfloat16": ({"activations": "bfloat16"}, {}),
    "model.rematerialise": ({"rematerialise": True}, {}),
    "training.accumulate 2": ({}, {"accumulate": 2}),
    "training.accumulate 4": ({}, {"accumulate": 4}),
    "rematerialise, accumulate 4": ({"rematerialise": True}, {"accumulate": 4}),
}


def measure(settings: Settings) -> Outcome:
    """Measure memory and time of a training step."""
    outcome = Outcome()
    config = material.small_config(32, 64, 1 / 32, batch=4) if settings.short else material.paper_config(96, 320, 0.25)
    ours, steps, held = OurTraining(config), {}, {}
    if settings.short:
        outcome.line("short form: a step without options alone, for each of them compiles for seconds")
    for name in [_PLAIN] if settings.short else _OPTIONS:
        compiled = ours.compiled(_with(config, name))
        steps[name], held[name] = ours.contender(compiled), compiled.memory_analysis().temp_size_in_bytes
    found = interleaved(steps, settings.rounds(_ROUNDS), budget_s=_BUDGET_S)
    outcome.times(f"options {material.described(config)}", found)
    rows: list[Row] = [
        {
            **compared(name, found, _PLAIN),
            "held": Value(held[name] / 1e6),
            "share": Value(held[name] / held[_PLAIN]),
        }
        for name in found
    ]
    columns = [
        Column("contender", "option"),
        Column("held", "held between forward and backward, MB", 0),
        Column("share", "of that without", 2),
        Column("ms", "ms a step", 1),
        Column("ratio", "time over that without", 2),
        Column("n", "rounds"),
    ]
    notes = [
        f"{material.described(config)}, batch {config.training.batch_size} x window {config.data.window}. Held: the "
        "temporary memory that XLA plans for the compiled step, beside parameters, optimiser and batch. " + RATIO
    ]
    outcome.tables.append(Table("Options of a training step", columns, rows, notes=notes))
    return outcome


def _with(config: Config, name: str) -> Config:
    """Return `config` with the fields of an option."""
    model, training = _OPTIONS[name]
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, **model),
        training=dataclasses.replace(config.training, **training),
    )
