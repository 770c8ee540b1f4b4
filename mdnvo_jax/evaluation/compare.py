"""Files of estimated poses against a file of true ones: what `evaluate trajectory` does."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mdnvo_jax import geometry
from mdnvo_jax.baselines import constant
from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation import bootstrap, scoring
from mdnvo_jax.evaluation import calibration_tables as tabled
from mdnvo_jax.evaluation.association import TIME_TOLERANCE_S, Paired, pair
from mdnvo_jax.evaluation.calibration_tables import CalibrationRow
from mdnvo_jax.evaluation.formats import Format, PoseFile, read_times, read_trajectory, why_lost
from mdnvo_jax.evaluation.report import CalibrationPictures, PathPicture, Report
from mdnvo_jax.evaluation.scoring import PathScore
from mdnvo_jax.evaluation.trajectory import Alignment, DeltaUnit
from mdnvo_jax.mixture import Mixture

CONSTANT = "constant predictor"


@dataclass(frozen=True)
class Candidate:
    """An estimate to judge: its name in tables, its poses or why there are none, and how to align them."""

    name: str
    poses: PoseFile | str
    alignment: Alignment


@dataclass(frozen=True)
class MeanStep:
    """The step that the constant predictor repeats: mean and deviation `[6]`, and where they are from, in words."""

    mean: np.ndarray
    std: np.ndarray
    source: str


def from_options(options: argparse.Namespace) -> Report:
    """Judge as the options of `evaluate trajectory` say.

    Raises:
      InputError: an option or a file is unusable.
    """
    if options.block < 1:
        raise InputError(f"--block is {options.block}: expected 1 frame or more")
    if not (np.isfinite(options.tolerance) and options.tolerance >= 0):
        raise InputError(f"--tolerance is {options.tolerance:g}: expected seconds, 0 or more")
    reference = read_trajectory(options.reference, format=options.reference_format)
    return compare(
        candidates(options.estimates, names=options.names, formats=options.format, alignments=options.align),
        reference,
        mean_step(reference, options.constant_from),
        split=options.split or Path(options.reference).stem,
        delta=options.delta,
        unit=options.delta_unit,
        times_path=options.reference_times,
        tolerance_s=options.tolerance,
        first_frame=options.first_frame,
        block=options.block,
    )


def candidates(
    paths: Sequence[str], *, names: Sequence[str], formats: Sequence[Format], alignments: Sequence[Alignment]
) -> list[Candidate]:
    """Read the estimates at `paths`; each option is given never, once for all, or once an estimate.

    Raises:
      InputError: an option is given another number of times, two names are the same, or a file is unusable.
    """
    for what, given in (("--names", names), ("--format", formats), ("--align", alignments)):
        if len(given) not in ((0, len(paths)) if what == "--names" else (0, 1, len(paths))):
            raise InputError(f"{what} is given {len(given)} times for {len(paths)} estimates: give one for each")
    labels = list(names) or _labels(paths)
    if len(set(labels)) < len(labels):
        raise InputError(f"two estimates have the same name ({', '.join(labels)}): tell them apart with --names")
    kinds = _spread(formats, len(paths), None)
    hows = _spread(alignments, len(paths), "none")
    return [
        Candidate(label, why_lost(path) or read_trajectory(path, format=kind), how)
        for label, path, kind, how in zip(labels, paths, kinds, hows, strict=True)
    ]


def mean_step(reference: PoseFile, training_paths: Sequence[str]) -> MeanStep:
    """Return what the constant predictor repeats: the mean step of training files, or of the reference itself."""
    if not training_paths:
        mean, std = constant.step_statistics([reference.poses])
        return MeanStep(mean, std, "oracle: mean step of this very reference")
    mean, std = constant.step_statistics([read_trajectory(path).poses for path in training_paths])
    return MeanStep(mean, std, f"mean step of {', '.join(Path(path).stem for path in training_paths)}")


def compare(
    estimates: Sequence[Candidate],
    reference: PoseFile,
    constant_step: MeanStep,
    *,
    split: str,
    delta: float = 1,
    unit: DeltaUnit = "frames",
    times_path: str | None = None,
    tolerance_s: float = TIME_TOLERANCE_S,
    first_frame: int | None = None,
    block: int = bootstrap.BLOCK_FRAMES,
) -> Report:
    """Judge estimates against a reference, with the constant predictor beside them.

    Args:
      estimates: from `candidates`.
      reference: the ground truth.
      constant_step: from `mean_step`.
      split: what the reference is called in tables.
      delta: of the RPE.
      unit: of `delta`.
      times_path: file of the reference's timestamps, where its own file has none.
      tolerance_s: between timestamps that belong together.
      first_frame: frame number of the first pose of estimates without frame numbers.
      block: frames in a bootstrap block.

    Raises:
      InputError: estimates cannot be matched to the reference, or no pair of frames is `delta` apart.
    """
    times = None if times_path is None else read_times(times_path)
    floors = {
        how: constant_score(constant_step, reference, split, how, delta=delta, unit=unit)
        for how in dict.fromkeys(estimate.alignment for estimate in estimates)
    }
    entries: list[tuple[PathScore, PathScore | None]] = []
    notes: list[str] = []
    rows: list[CalibrationRow] = []
    pictures: list[CalibrationPictures] = []
    for estimate in estimates:
        floor = floors[estimate.alignment]
        if isinstance(estimate.poses, str):
            entries.append((scoring.no_path(estimate.name, floor, estimate.alignment), floor))
            notes.append(f"{estimate.name}: {estimate.poses}")
            continue
        paired = pair(
            estimate.poses, reference, tolerance_s=tolerance_s, reference_times=times, first_frame=first_frame
        )
        score = scoring.score_path(estimate.name, split, paired, estimate.alignment, delta=delta, unit=unit)
        entries.append((score, floor))
        notes.append(f"{estimate.name}: frames matched by {paired.how}")
        if estimate.poses.mixture is not None:
            found, drawn = _calibrate(estimate.name, estimate.poses, paired, split, block)
            rows += found
            pictures.append(drawn)
    paths = {f"{score.name} ({score.alignment})": score.poses for score, _ in entries if score.covered}
    entries += [(floor, None) for floor in floors.values()]
    notes.append(f"{CONSTANT}: {constant_step.source}")
    table, summaries = scoring.comparison(f"Pose error on {split}", entries, notes, block=block)
    results: dict[str, Any] = {"paths": summaries}
    shown = [table]
    if rows:
        rows += _constant_calibration(constant_step, reference, split, block)
        shown.append(tabled.calibration_table(rows))
        results["calibration"] = [tabled.calibration_data(row) for row in rows]
    details = [*scoring.segment_tables(summaries), *([tabled.component_table(rows)] if rows else [])]
    picture = PathPicture(
        "trajectory.png", f"Paths from above, split {split}, alignment in brackets", paths, reference.poses
    )
    return Report(shown, details, results, [picture], pictures)


def constant_score(
    step: MeanStep, reference: PoseFile, split: str, how: Alignment, *, delta: float, unit: DeltaUnit
) -> PathScore:
    """Judge the constant predictor on `reference` as any other estimate."""
    total = len(reference.poses)
    numbers = np.arange(total) if reference.frames is None else reference.frames
    poses = constant.constant_poses(step.mean, int(numbers[-1] - numbers[0]))[numbers - numbers[0]]
    paired = Paired(poses, reference.poses, numbers, np.arange(total), np.arange(total), "row")
    return scoring.score_path(CONSTANT, split, paired, how, delta=delta, unit=unit)


def true_steps(poses: np.ndarray) -> np.ndarray:
    """Return the steps between consecutive `poses`, `[n, 4, 4]`: `[n-1, 6]`, m and rad."""
    return np.asarray(geometry.matrix_to_step(geometry.relative_steps(poses)))


def _calibrate(
    name: str, poses: PoseFile, paired: Paired, split: str, block: int
) -> tuple[list[CalibrationRow], CalibrationPictures]:
    """Calibrate the densities in an output folder on the steps whose two frames are matched."""
    mixture, rows = poses.mixture, paired.rows_of_estimate
    assert mixture is not None
    both = np.flatnonzero(np.diff(rows) == 1)
    if not both.size:
        raise InputError(f"{name}: no two consecutive poses are in the reference: check the times")
    truth = geometry.matrix_to_step(
        geometry.inverse(paired.reference[paired.rows_of_reference[both]])
        @ paired.reference[paired.rows_of_reference[both + 1]]
    )
    steps = Mixture(*(leaf[rows[both]] for leaf in mixture))
    found, scores = tabled.calibration_rows(
        name,
        split,
        [(steps, np.asarray(truth))],
        coupling=poses.coupling,
        frames=(len(rows), len(paired.reference)),
        block=block,
    )
    title = f"{name}, {split}, sigma of the whole mixture, no alignment"
    return found, CalibrationPictures(f"calibration-{name}", title, scores[0])


def _constant_calibration(step: MeanStep, reference: PoseFile, split: str, block: int) -> list[CalibrationRow]:
    """Calibrate the constant predictor on every step of the reference."""
    truth = true_steps(reference.poses)
    steps = constant.constant_mixture(step.mean, step.std, len(truth))
    total = len(reference.poses)
    rows, _ = tabled.calibration_rows(
        CONSTANT, split, [(steps, truth)], coupling="independent", frames=(total, total), block=block
    )
    return rows


def _labels(paths: Sequence[str]) -> list[str]:
    """Return a name for each path: its stem, with as many folders before it as tell them apart."""
    parts = [Path(path).resolve().with_suffix("").parts for path in paths]
    for length in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-length:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [Path(path).stem for path in paths]


def _spread(given: Sequence[Any], count: int, default: Any) -> list[Any]:
    """Return what is given for each of `count`: never, once, or for each."""
    return list(given) if len(given) == count else [given[0] if given else default] * count
