"""Tables of calibration."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mdnvo_jax.evaluation import bootstrap
from mdnvo_jax.evaluation.calibration import (
    RANKED,
    REPORTED,
    SIGMA_LEVELS,
    Calibration,
    Estimated,
    Reported,
    StepScores,
    calibrate,
    join,
    score,
)
from mdnvo_jax.evaluation.tables import Column, Row, Table, Value
from mdnvo_jax.mixture import Coupling, Mixture
from mdnvo_jax.odometry import COMPONENTS

_SIGMA_OF: dict[Reported, str] = {"mixture": "whole mixture", "strongest": "strongest component"}
# What nominal coverage is, in percent; a Gaussian's 1, 2 and 3 sigma.
NOMINAL = tuple(100 * level for level in SIGMA_LEVELS)
CONTEXT = ("split", "alignment", "delta", "frames")
_ABOUT = (
    Column("name", "estimate"),
    Column("sigma", "sigma of"),
    Column("split", "split"),
    Column("alignment", "alignment"),
    Column("delta", "delta"),
    Column("frames", "frames"),
)


@dataclass(frozen=True)
class CalibrationRow:
    """The calibration of one method on one split.

    Attributes:
      name: of the method.
      split: what it was judged on.
      reported: what sigma is.
      covered: frames that the method gave, of `total`.
      total: frames of the split.
      found: the statistics.
    """

    name: str
    split: str
    reported: Reported
    covered: int
    total: int
    found: Calibration


def calibration_rows(
    name: str,
    split: str,
    steps: Sequence[tuple[Mixture, np.ndarray]],
    *,
    coupling: Coupling,
    frames: tuple[int, int],
    block: int,
) -> tuple[list[CalibrationRow], list[StepScores]]:
    """Calibrate the densities of one or several sequences, for the whole mixture and for its strongest component.

    Args:
      name: of the method.
      split: what it is judged on.
      steps: of each sequence, densities and true steps `[n, 6]`.
      coupling: of the densities.
      frames: covered, and in total.
      block: frames in a bootstrap block.

    Returns:
      Rows, and the scores they come from; a density of one component has one of each.
    """
    single = all(mixture.logits.shape[-1] == 1 for mixture, _ in steps)
    rows, scores = [], []
    for reported in REPORTED[: 1 if single else 2]:
        parts = [score(mixture, truth, coupling=coupling, reported=reported) for mixture, truth in steps]
        draws = bootstrap.draw([len(part.nll) for part in parts], block=block)
        scores.append(join(parts))
        rows.append(CalibrationRow(name, split, reported, *frames, calibrate(scores[-1], draws)))
    return rows, scores


def calibration_table(rows: Sequence[CalibrationRow], notes: Sequence[str] = ()) -> Table:
    """Return one row a method: what concerns the whole 6-vector."""
    columns = (
        *_ABOUT,
        Column("nll", "NLL mean (nats) [95 %]", 3, "low"),
        Column("nees", "NEES mean (6 is right) [95 %]", 2, 6.0),
        Column("inside", "in 3 sigma, mean of six (99.73 %)", 2, NOMINAL[2]),
        Column("spearman_t", "Spearman trans.", 3, "high"),
        Column("spearman_r", "Spearman rot.", 3, "high"),
        Column("own_t", "of its own draws, trans.", 3),
        Column("own_r", "of its own draws, rot.", 3),
        Column("ause_t", "AUSE trans.", 3, "low"),
        Column("ause_r", "AUSE rot.", 3, "low"),
    )
    translation, rotation = RANKED.index("translation"), RANKED.index("rotation")
    body: list[Row] = [
        {
            **_about(row),
            "nll": _value(row.found.nll),
            "nees": _value(row.found.nees),
            "inside": Value(100 * float(row.found.coverage.value[2].mean())),
            "spearman_t": _value(row.found.spearman, translation),
            "spearman_r": _value(row.found.spearman, rotation),
            "own_t": _value(row.found.own_spearman, translation),
            "own_r": _value(row.found.own_spearman, rotation),
            "ause_t": _value(row.found.ause, translation),
            "ause_r": _value(row.found.ause, rotation),
        }
        for row in rows
    ]
    notes = (
        *notes,
        "NLL in metres and radians. Intervals, coverage and NLL are those of the density's CDF, no Gaussian stands in.",
        "Spearman: rank correlation of sigma with the absolute error; '-' where sigma never varies. "
        "AUSE: area under the sparsification error, 0 is the ranking by the errors themselves.",
        "Of its own draws: Spearman of errors drawn from the densities themselves, with the interval of 95 % of draws. "
        "Where the measured one is as high, sigma ranks as well as the little or much that it varies allows.",
    )
    return Table("Calibration of the predicted steps", columns, body, CONTEXT, group="split", notes=notes)


def component_table(rows: Sequence[CalibrationRow], notes: Sequence[str] = ()) -> Table:
    """Return a row a method and component."""
    columns = (
        *_ABOUT,
        Column("component", "component"),
        *(
            Column(f"inside_{sigmas}", f"in {sigmas} sigma ({nominal:.2f} %) [95 %]", 1, round(nominal, 1))
            for sigmas, nominal in enumerate(NOMINAL, start=1)
        ),
        Column("crps", "CRPS mean (mm, mrad)", 3, "low"),
        Column("spearman", "Spearman", 3, "high"),
        Column("ause", "AUSE", 3, "low"),
    )
    body: list[Row] = []
    for row in rows:
        for k, component in enumerate(COMPONENTS):
            inside = {
                f"inside_{level + 1}": _value(row.found.coverage, (level, k), factor=100)
                for level in range(len(NOMINAL))
            }
            ranks = {"spearman": _value(row.found.spearman, k), "ause": _value(row.found.ause, k)}
            crps = Value(1e3 * float(row.found.crps.value[k]))
            group = f"{row.split} {component}"
            body.append({**_about(row), "component": component, **inside, "crps": crps, **ranks, "group": group})
    return Table("Calibration by component", columns, body, CONTEXT, group="group", notes=notes)


def calibration_data(row: CalibrationRow) -> dict[str, Any]:
    """Return everything known about one row, for JSON."""
    found = row.found
    levels = ("1 sigma", "2 sigma", "3 sigma")
    return {
        **_about(row),
        "steps": found.steps,
        "coverage": {level: _named(found.coverage, COMPONENTS, i) for i, level in enumerate(levels)},
        "nll": _value(found.nll),
        "crps": _named(found.crps, COMPONENTS),
        "nees": _value(found.nees),
        "spearman": _named(found.spearman, RANKED),
        "own_spearman": _named(found.own_spearman, RANKED),
        "ause": _named(found.ause, RANKED),
    }


def _about(row: CalibrationRow) -> dict[str, str]:
    """Return what a row says about itself."""
    return {
        "name": row.name,
        "sigma": _SIGMA_OF[row.reported],
        "split": row.split,
        "alignment": "none",
        "delta": "1 frame",
        "frames": f"{row.covered} of {row.total}",
    }


def _named(found: Estimated, names: Sequence[str], *index: int) -> dict[str, Value]:
    """Return the last axis of a statistic by name."""
    return {name: _value(found, (*index, k)) for k, name in enumerate(names)}


def _value(found: Estimated, index: int | tuple[int, ...] = (), *, factor: float = 1) -> Value:
    """Return one number of a statistic, with its interval."""
    parts = (np.asarray(part)[index] for part in (found.value, found.low, found.high))
    return Value(*(factor * float(part) for part in parts))
