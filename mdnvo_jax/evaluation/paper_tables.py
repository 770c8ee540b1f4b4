"""The paper's two tables: with what was measured here, and as published."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mdnvo_jax.evaluation import trajectory
from mdnvo_jax.evaluation.compare import CONSTANT
from mdnvo_jax.evaluation.scoring import PathScore
from mdnvo_jax.evaluation.tables import Cell, Column, Row, Table, Value

METHODS = ("ORB-SLAM", "DeepVO", "MDN-VO")
_ALIGNED = {"ORB-SLAM": "ORB-SLAM (Sim(3)-aligned)"}
_TITLES = {"kitti": "Table I, KITTI test split", "nuscenes": "Table II, nuScenes test split"}
_ABOUT = "RPE of the translation in m, delta 1 frame"
_MEAN = "mean"
# RMSE, max, mean and std of the translation's RPE in m, by row, for each of METHODS; None where the paper prints "-".
_Four = tuple[float, float, float, float]
PUBLISHED: dict[str, dict[str, tuple[_Four | None, _Four, _Four]]] = {
    "kitti": {
        "03": ((0.03, 0.20, 0.03, 0.02), (0.08, 0.23, 0.08, 0.04), (0.12, 0.41, 0.11, 0.06)),
        "05": ((0.25, 0.67, 0.20, 0.15), (0.24, 0.57, 0.21, 0.12), (0.16, 0.36, 0.15, 0.08)),
        "06": ((0.34, 0.65, 0.30, 0.17), (0.16, 0.31, 0.14, 0.08), (0.20, 0.45, 0.18, 0.09)),
        "07": ((0.17, 0.35, 0.13, 0.09), (0.14, 0.35, 0.12, 0.07), (0.08, 0.51, 0.07, 0.05)),
        "10": ((0.30, 0.95, 0.23, 0.20), (0.21, 0.47, 0.19, 0.08), (0.14, 0.32, 0.13, 0.06)),
        _MEAN: ((0.22, 0.56, 0.18, 0.13), (0.17, 0.39, 0.15, 0.08), (0.14, 0.41, 0.13, 0.07)),
    },
    "nuscenes": {
        "daylight": ((0.40, 3.28, 0.12, 0.38), (0.09, 0.54, 0.06, 0.07), (0.07, 0.53, 0.04, 0.05)),
        "rain": ((0.76, 10.19, 0.14, 0.74), (0.07, 0.39, 0.05, 0.05), (0.06, 0.43, 0.04, 0.05)),
        "night": (None, (0.12, 0.74, 0.09, 0.09), (0.11, 0.73, 0.07, 0.08)),
    },
}


@dataclass(frozen=True)
class Line:
    """A row of the table.

    Attributes:
      name: of the sequence or condition.
      drives: how many it is made of.
      frames: of those.
      scores: by method, of those drives that it has a trajectory of.
    """

    name: str
    drives: int
    frames: int
    scores: Mapping[str, PathScore]


def own_table(dataset: str, lines: Sequence[Line], notes: Sequence[str]) -> Table:
    """Return the paper's table with what was measured, the best of each row bold.

    With a row of means over several sequences for KITTI: of the methods that have all of them.
    """
    figures = {
        (line.name, name): _four(trajectory.statistics(score.relative.translation_m))
        for line in lines
        for name, score in line.scores.items()
    }
    every = (*METHODS, CONSTANT)
    partly = [name for name in every if any(name in x.scores and x.scores[name].covered < x.frames for x in lines)]
    counted = dataset == "nuscenes"
    columns = [
        Column("row", "condition" if counted else "sequence"),
        *([Column("drives", "scenes")] if counted else []),
        Column("frames", "frames"),
    ]
    for name in every:
        columns += _columns(name, _ALIGNED.get(name, f"{name} (no alignment)"), 3, name in partly)
    rows: list[Row] = []
    for line in lines:
        row: dict[str, Cell] = {"row": line.name, "drives": str(line.drives), "frames": str(line.frames)}
        for name, score in line.scores.items():
            row |= _cells(name, figures[line.name, name])
            row[f"{name} frames"] = f"{score.covered} of {line.frames}"
        rows.append(row)
    said = list(notes)
    if not counted and len(lines) > 1:
        row = {"row": _MEAN, "frames": str(sum(line.frames for line in lines))}
        for name in every:
            found = [figures[line.name, name] for line in lines if (line.name, name) in figures]
            if len(found) == len(lines):
                first, second, third, fourth = np.mean(found, axis=0)
                row |= _cells(name, (first, second, third, fourth))
        rows.append(row)
        said.append("mean: of the figures above it, as in the paper; of the methods that have every sequence")
    if partly:
        said.append(f"{', '.join(partly)}: errors are those of the frames that it has")
    said.append("RPE by evo. Bold: best of the row. Intervals are in the table of details (table.md, report.html).")
    title = f"{_TITLES[dataset]}: {_ABOUT}"
    return Table(title, columns, rows, notes=said)


def published_table(dataset: str) -> Table:
    """Return the paper's table as it was published."""
    columns = [Column("row", "condition" if dataset == "nuscenes" else "sequence")]
    for name in METHODS:
        columns += _columns(name, name, 2, False)
    rows: list[Row] = []
    for name, figures in PUBLISHED[dataset].items():
        row: dict[str, Cell] = {"row": name}
        for method, four in zip(METHODS, figures, strict=True):
            row |= {} if four is None else _cells(method, four)
        rows.append(row)
    note = "Kaygusuz, Mendez, Bowden, 2021. ORB-SLAM aligned with scale; the whole split, whatever is on disk here."
    return Table(f"{_TITLES[dataset]}, as published: {_ABOUT}", columns, rows, notes=[note])


def _columns(name: str, over: str, digits: int, partly: bool) -> list[Column]:
    """Return the columns of one method."""
    return [
        *([Column(f"{name} frames", "frames", over=over)] if partly else []),
        Column(f"{name} rmse", "RMSE", digits, "low", over),
        Column(f"{name} max", "max", digits, "low", over),
        Column(f"{name} mean", "mean ± std", digits, "low", over),
    ]


def _cells(name: str, figures: _Four) -> dict[str, Cell]:
    """Return the cells of one method in a row."""
    rmse, greatest, mean, std = figures
    return {
        f"{name} rmse": Value(rmse),
        f"{name} max": Value(greatest),
        f"{name} mean": Value(mean, spread=std),
    }


def _four(found: trajectory.Statistics) -> _Four:
    return found.rmse, found.max, found.mean, found.std
