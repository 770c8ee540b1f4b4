"""Sigmas, and errors that steps share, fitted on the validation split of a training: what `evaluate recalibrate` does.

No sequence can be named: the split is that of the checkpoint's own configuration, so that no test data gets in.
"""

import argparse
import dataclasses
import functools
import shlex
import sys
from collections.abc import Sequence as Many
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mdnvo_jax import mixture, recalibration
from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation.calibration import SIGMA_LEVELS, StepScores, fit_sigma_scale, is_inside, score
from mdnvo_jax.evaluation.calibration_tables import NOMINAL
from mdnvo_jax.evaluation.model import track
from mdnvo_jax.evaluation.shared_errors import fit_correlations, fit_scale_sigma, scale_error
from mdnvo_jax.evaluation.tables import Column, Row, Table, Value
from mdnvo_jax.mixture import Coupling, Mixture, widen
from mdnvo_jax.odometry import COMPONENTS
from mdnvo_jax.recalibration import SigmaScale

if TYPE_CHECKING:
    from mdnvo_jax.config import Config
    from mdnvo_jax.data.sequence import Sequence

# Fewer steps determine a factor to no better than 7 %: that of a Gaussian is known to 1 / sqrt(2 n).
_FEW_STEPS = 100
# Fewer drives determine what steps are wrong by together to no better than 16 %, for the same reason.
_FEW_DRIVES = 20
# Drives that the table's title names.
_NAMED = 8


def run(options: argparse.Namespace) -> tuple[Table, Path]:
    """Fit as the options of `evaluate recalibrate` say, write the factors, and return what to print and their file.

    Raises:
      InputError: the checkpoint has factors already and `--force` is not given, or it or its data is unusable.
    """
    from mdnvo_jax import predictor
    from mdnvo_jax.training import checkpoint

    path = checkpoint.locate(options.checkpoint) / recalibration.FILE
    if path.exists() and not options.force:
        raise InputError(f"{path} is there already: fit again with --force")
    model = predictor.load(options.checkpoint, recalibrated=False)
    predictions, names = [], []
    for sequence in validation_sequences(model.config, root=options.root, cache=options.cache):
        if sequence.count < 2:
            continue
        bar = functools.partial(track, name=sequence.name)
        densities = predictor.predict(model, sequence, mode=options.mode, progress=bar).mixture
        predictions.append((densities, sequence.steps()))
        names.append(sequence.name)
    about = {
        "split": "validation split of the training",
        "dataset": model.config.data.dataset,
        "sequences": names,
        "mode": options.mode,
    }
    found, table = fit(predictions, model.config.model.coupling, about, widen_only=options.widen_only)
    written = recalibration.write(
        model.source, found, checkpoint=Path(model.source).name, command=shlex.join(sys.orig_argv)
    )
    return table, written


def validation_sequences(config: "Config", *, root: str | None, cache: str | None) -> list["Sequence"]:
    """Return the validation split of a training, at the stride it validated at.

    Args:
      config: of the training.
      root: of its data set, where that is not what it was in the training.
      cache: the same of its cache.
    """
    from mdnvo_jax.data import load

    data = config.data
    if root or cache:
        data = dataclasses.replace(data, root=root or data.root, cache=cache or "")
    _, validation, _ = load.load_split(dataclasses.replace(config, data=data))
    return [_strided(sequence, data.strides[0]) for sequence in validation]


def fit(
    predictions: Many[tuple[Mixture, np.ndarray]],
    coupling: Coupling,
    fitted_on: dict[str, Any],
    *,
    widen_only: bool = False,
) -> tuple[SigmaScale, Table]:
    """Fit factors and errors that steps share on several sequences, and tabulate what the factors do to them.

    The factors are those of `calibration.fit_sigma_scale`, over all steps. What the steps of a drive are wrong by
    together is then judged by the sigmas that they have with the factors, first as an error of scale, and as
    correlated errors what is left; see `shared_errors`.

    Args:
      predictions: of each sequence, densities `[n, M, 6]` and true steps `[n, 6]`.
      coupling: of the densities.
      fitted_on: what the predictions are of, to be kept, beside the error of scale of each and the factors as fitted.
      widen_only: leave sigmas as they are that these predictions show to be too wide. Elsewhere than on drives like
        those of the training errors are larger, and what is rather too wide at home is about right there.

    Raises:
      InputError: there is no step.
    """
    if not predictions:
        raise InputError("the validation split has no step: there is nothing to fit on")
    leaves: list[Any] = [np.concatenate(parts) for parts in zip(*(density for density, _ in predictions), strict=True)]
    density = Mixture(*leaves)
    truth = np.concatenate([steps for _, steps in predictions])
    fitted = fit_sigma_scale(density, truth)
    scale = np.maximum(fitted, 1) if widen_only else fitted
    before = score(density, truth, coupling=coupling)
    after = score(widen(density, scale), truth, coupling=coupling)
    together = _errors_together(predictions, coupling, scale)
    products, squares = together.neighbours.sum(axis=0), together.squares.sum(axis=0)
    # Drives of one step have no neighbours.
    neighbours = np.divide(products, squares, out=np.zeros_like(products), where=squares > 0)
    correlation, serial_correlation = fit_correlations(together.rest, together.steps, neighbours)
    found = SigmaScale(
        scale=scale,
        steps=len(truth),
        nll_before=float(before.nll.mean()),
        nll_after=float(after.nll.mean()),
        fitted_on=fitted_on | {"scale_errors": together.scale.tolist(), "fitted_scale": fitted.tolist()},
        scale_sigma=fit_scale_sigma(together.scale, together.variance),
        correlation=correlation,
        serial_correlation=serial_correlation,
        drives=len(predictions),
    )
    return found, _table(found, before, after)


class _Together(NamedTuple):
    """What the steps of each of D drives are wrong by together.

    Attributes:
      scale: error of scale, `[D]`.
      variance: of that, `[D]`.
      rest: mean of the standardised errors that are left without it, `[D, 6]`.
      steps: in each drive, `[D]`.
      neighbours: sum of the products of those errors of neighbouring steps, `[D, 6]`.
      squares: sum of the mean squares of the same steps, `[D, 6]`.
    """

    scale: np.ndarray
    variance: np.ndarray
    rest: np.ndarray
    steps: np.ndarray
    neighbours: np.ndarray
    squares: np.ndarray


def _errors_together(predictions: Many[tuple[Mixture, np.ndarray]], coupling: Coupling, scale: np.ndarray) -> _Together:
    """Measure sequences, with sigmas that `scale` is applied to."""
    rows = []
    for density, truth in predictions:
        widened = widen(density, scale)
        mean = np.asarray(mixture.mean(widened), np.float64)
        covariance = np.asarray(mixture.covariance(widened, coupling=coupling), np.float64)
        error, variance = scale_error(mean, covariance, truth)
        without = np.concatenate([(1 + error) * mean[:, :3], mean[:, 3:]], axis=1)
        standardised = (truth - without) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        products = (standardised[1:] * standardised[:-1]).sum(axis=0)
        squares = (standardised[1:] ** 2 + standardised[:-1] ** 2).sum(axis=0) / 2
        rows.append((error, variance, standardised.mean(axis=0), len(truth), products, squares))
    return _Together(*(np.array(column) for column in zip(*rows, strict=True)))


def _table(found: SigmaScale, before: StepScores, after: StepScores) -> Table:
    """Return a row a component: its factor, and the share of truths inside intervals before and after."""
    columns = [Column("component", "component"), Column("factor", "sigma times", 3)]
    columns.append(Column("correlation", "correlation of any two steps", 3))
    columns.append(Column("serial_correlation", "and of neighbours beyond that", 3))
    for level, nominal in enumerate(NOMINAL):
        columns += [
            Column(f"{when}_{level}", f"in {level + 1} sigma, {when} ({nominal:.2f} %)", 1)
            for when in ("before", "after")
        ]
    shares = {
        f"{when}_{level}": 100 * is_inside(scores.pit, probability).mean(axis=0)
        for when, scores in (("before", before), ("after", after))
        for level, probability in enumerate(SIGMA_LEVELS)
    }
    rows: list[Row] = [
        {
            "component": name,
            "factor": Value(float(found.scale[k])),
            "correlation": Value(float(found.correlation[k])),
            "serial_correlation": Value(float(found.serial_correlation[k])),
            **{key: Value(float(values[k])) for key, values in shares.items()},
        }
        for k, name in enumerate(COMPONENTS)
    ]
    notes = [f"NLL of these steps: {found.nll_before:.3f} before, {found.nll_after:.3f} after (nats a step, m and rad)"]
    narrower = [
        f"{name} {factor:.3f}"
        for name, factor, applied in zip(COMPONENTS, found.fitted_on["fitted_scale"], found.scale, strict=True)
        if factor < applied
    ]
    if narrower:
        notes.append(f"too wide for these steps, and left so: {', '.join(narrower)} would be their factors")
    if found.steps < _FEW_STEPS:
        notes.append(f"{found.steps} steps are few: a factor is known to some {100 / np.sqrt(2 * found.steps):.0f} %")
    notes.append(
        f"error of scale that a drive's steps share: {100 * found.scale_sigma:.1f} % (1 sigma, about zero), by maximum "
        f"likelihood over {found.drives} drives"
    )
    if 0 < found.drives < _FEW_DRIVES:
        share = 100 / np.sqrt(2 * found.drives)
        notes.append(f"{found.drives} drives are few: it is known to some {share:.0f} %, and so are the correlations")
    sequences = found.fitted_on["sequences"]
    names = ", ".join(sequences) if len(sequences) <= _NAMED else f"{len(sequences)} drives"
    title = f"Sigma scale, fitted on {found.steps} steps of the training's validation split ({names})"
    return Table(title, columns, rows, notes=notes)


def _strided(sequence: "Sequence", stride: int) -> "Sequence":
    """Return every `stride`-th frame of a sequence."""
    if stride == 1:
        return sequence
    kept = np.arange(0, sequence.count, stride)
    return dataclasses.replace(
        sequence,
        count=len(kept),
        read=lambda index: sequence.read(stride * index),
        timestamps=None if sequence.timestamps is None else sequence.timestamps[kept],
        poses=None if sequence.poses is None else sequence.poses[kept],
        paths=sequence.paths[::stride],
    )
