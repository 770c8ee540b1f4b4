"""The goals that this project set itself, and whether a run reached them."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from mdnvo_jax.evaluation.tables import Column, Row, Table, Value


class Target(NamedTuple):
    """A goal: `least` is to be reached, `aim` is hoped for; less is better where `low`."""

    what: str
    least: float
    aim: float
    unit: str = ""
    low: bool = False


_CACHING = "PyTorch with the same caching"
TARGETS = {
    "train float32": Target("train step, float32, vs PyTorch float32", 0.85, 1.0),
    "train mixed": Target("train step, mixed, vs PyTorch float32", 1.4, 2.0),
    "predict deepvo": Target("predict from decoded frames, our JAX float32 vs DeepVO-style PyTorch float32", 5, 6),
    "predict float32": Target(f"predict, our JAX float32 vs {_CACHING}, float32", 0.9, 1.1),
    "predict best": Target(f"predict, our best backend vs {_CACHING}, float32", 4, 7),
    "predict best bf16": Target(f"predict, our best backend vs {_CACHING}, bf16", 1.1, 2),
    "lstm": Target("BiLSTM with gradient vs torch.nn.LSTM", 1.2, 1.5),
    "mixture": Target("mixture NLL, value and gradient, vs the faster of the two peers", 2, 3),
    "input": Target("input from the cache vs DataLoader", 5, 20),
    "memory": Target("memory, 5,000 frames over 500", 1.05, 1.0, low=True),
    "waiting": Target("train: waiting for input", 5, 1, " %", low=True),
    "help": Target("--help", 1, 0.3, " s", low=True),
    "live": Target("quarter-width model at 256x80, live from KITTI PNG on disk", 30, 100, " frames/s"),
}

Measured = Mapping[str, Sequence[tuple[str, Value]]]


def table(measured: Measured, *, short: bool) -> Table:
    """Return the table of all targets; one that was not measured says so, and none is left out."""
    rows: list[Row] = []
    for key, target in TARGETS.items():
        bound = "or less" if target.low else ""
        goal = {
            "what": target.what,
            "least": f"{target.least:g}{target.unit} {bound}".strip(),
            "aim": f"{target.aim:g}{target.unit}",
        }
        if not measured.get(key):
            rows.append({**goal, "where": "", "met": "not measured in this run"})
        for where, value in measured.get(key, ()):
            met = "not judged at toy sizes" if short else verdict(target, value.value)
            rows.append({**goal, "where": where, "measured": value, "met": met})
    return Table(
        title="Targets: the project's own goals, set before anything was measured",
        columns=[
            Column("what", "what"),
            Column("where", "at"),
            Column("least", "at least"),
            Column("aim", "aim"),
            Column("measured", "measured", digits=2),
            Column("met", "met"),
        ],
        rows=rows,
    )


def verdict(target: Target, value: float) -> str:
    """Return whether `value` reaches a target."""
    sign = -1 if target.low else 1
    if sign * value >= sign * target.aim:
        return "yes, aim reached"
    return "yes" if sign * value >= sign * target.least else "NO"
