"""A trained model on sequences with known poses: what `evaluate model` does."""

import argparse
import dataclasses
import functools
from collections.abc import Iterator
from collections.abc import Sequence as Many
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnvo_jax.baselines import constant
from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation import calibration_tables as tabled
from mdnvo_jax.evaluation import drift, scoring
from mdnvo_jax.evaluation.association import Paired
from mdnvo_jax.evaluation.calibration import StepScores
from mdnvo_jax.evaluation.calibration_tables import CalibrationRow
from mdnvo_jax.evaluation.compare import CONSTANT, MeanStep, constant_score, true_steps
from mdnvo_jax.evaluation.drift import Drift
from mdnvo_jax.evaluation.formats import PoseFile
from mdnvo_jax.evaluation.report import CalibrationPictures, PathPicture, Report, UncertaintyPicture
from mdnvo_jax.evaluation.scoring import PathScore
from mdnvo_jax.mixture import add_noise
from mdnvo_jax.odometry import COMPONENTS, Trajectory, trajectory

if TYPE_CHECKING:
    from mdnvo_jax.config import Config
    from mdnvo_jax.data.sequence import Sequence

# The split of the rows over all sequences.
_ALL = "all"
_ROOTS = {"kitti": "KITTI, which holds sequences/ and poses/", "nuscenes": "nuScenes, which holds samples/ and sweeps/"}


@dataclasses.dataclass(frozen=True)
class Predicted:
    """What a model says of one sequence: its name, the prediction, and the true poses `[N, 4, 4]` of every frame."""

    name: str
    trajectory: Trajectory
    truth: np.ndarray


def from_options(options: argparse.Namespace) -> Report:
    """Predict and judge as the options of `evaluate model` say.

    Raises:
      InputError: an option, the checkpoint or the data is unusable.
    """
    from mdnvo_jax import predictor
    from mdnvo_jax.data import augment

    if options.block < 1:
        raise InputError(f"--block is {options.block}: expected 1 frame or more")
    reference_sigma = _reference_sigma(options.reference_sigma)
    if options.other_lenses and options.dataset != "synthetic":
        raise InputError(f"--other-lenses is for --dataset synthetic, and this is {options.dataset}: leave it out")
    model = predictor.load(
        options.checkpoint, recalibrated=not options.no_recalibration, camera_height_m=options.camera_height
    )
    predicted = []
    for number, sequence in enumerate(sequences(options, model.config)):
        if options.sway:
            sequence = augment.sway_sequence(sequence, number)
        if sequence.poses is None or sequence.count < 2:
            raise InputError(f"sequence {sequence.name} has no poses of two frames: there is nothing to judge against")
        bar = functools.partial(track, name=sequence.name)
        path = predictor.predict(
            model, sequence, mode=options.mode, estimate=options.estimate, scale_sigma=options.scale_sigma, progress=bar
        )
        predicted.append(Predicted(sequence.name, path, sequence.poses))
    labels = model.model.labels
    step = MeanStep(np.asarray(labels.mean, float), np.asarray(labels.std, float), "mean step of the training split")
    how = f"{options.mode}, {options.estimate}{'' if model.sigma_scale is None else ', sigma recalibrated'}"
    if options.sway:
        how += ", swaying camera"
    if scale_sigma := predicted[0].trajectory.scale_sigma:
        how += f", scale known to {100 * scale_sigma:.1f} %"
    return evaluate(f"model ({how})", predicted, step, block=options.block, reference_sigma=reference_sigma)


def _reference_sigma(given: Many[float] | None) -> np.ndarray:
    """Return what the reference is wrong by, as given in m and degrees: 1 sigma of a step's components, m and rad.

    Raises:
      InputError: a number is negative, or none.
    """
    sigma = np.zeros(len(COMPONENTS)) if given is None else np.array(given, float)
    if not (np.isfinite(sigma) & (sigma >= 0)).all():
        raise InputError(f"--reference-sigma {' '.join(map(str, sigma))}: expected six numbers of 0 or more")
    return np.where(np.arange(len(sigma)) < 3, sigma, np.deg2rad(sigma))


def evaluate(
    name: str,
    predicted: Many[Predicted],
    constant_step: MeanStep,
    *,
    block: int,
    reference_sigma: np.ndarray | None = None,
) -> Report:
    """Judge predictions, with the constant predictor beside them, by sequence and over all sequences.

    Args:
      name: of the method, in tables.
      predicted: of each sequence.
      constant_step: mean and deviation of the training split's steps.
      block: frames in a bootstrap block.
      reference_sigma: standard deviation of the reference's own errors in a step, `[6]`, m and rad. Then the densities
        of steps are judged as those of the reference, `mixture.add_noise`; paths and drift are not changed by it.
    """
    reference_sigma = np.zeros(len(COMPONENTS)) if reference_sigma is None else reference_sigma
    pairs = [_score(name, item, constant_step) for item in predicted]
    drifts = [row for item in predicted for row in _drifts(name, item, constant_step)]
    rows: list[CalibrationRow] = []
    if len(predicted) > 1:
        for item in predicted:
            rows += _calibrations(name, item.name, [item], constant_step, block, reference_sigma)[0]
        model_scores, floors = zip(*pairs, strict=True)
        pairs.append((scoring.pool(model_scores, _ALL), scoring.pool(floors, _ALL)))
    split = _ALL if len(predicted) > 1 else predicted[0].name
    found, scores = _calibrations(name, split, predicted, constant_step, block, reference_sigma)
    rows += found
    entries = [entry for score, floor in pairs for entry in ((score, floor), (floor, None))]
    table, summaries = scoring.comparison("Pose error", entries, [f"{CONSTANT}: {constant_step.source}"], block=block)
    sequences = ", ".join(item.name for item in predicted)
    calibrations = [tabled.calibration_data(row) for row in rows]
    notes = _reference_notes(reference_sigma)
    means = []
    if len(predicted) > 1:
        paths, scored = ([item for item in found if item["split"] != _ALL] for found in (summaries, calibrations))
        means.append(drift.means_table(paths, scored, drifts))
    return Report(
        [table, tabled.calibration_table(rows, notes), drift.drift_table(drifts), *means],
        [*scoring.segment_tables(summaries), tabled.component_table(rows, notes)],
        {
            "paths": summaries,
            "calibration": calibrations,
            "drift": [{"name": of, "split": split, **vars(found)} for of, split, _, found in drifts],
        },
        [
            PathPicture(
                f"trajectory-{safe(item.name)}.png",
                f"Path from above, split {item.name}, no alignment but of the first pose",
                {name: score.poses},
                item.truth,
            )
            for item, (score, _) in zip(predicted, pairs, strict=False)
        ],
        [CalibrationPictures("", f"{name}, split {sequences}, sigma of the whole mixture, no alignment", scores)],
        [
            UncertaintyPicture(
                f"uncertainty-{safe(item.name)}.png",
                f"Steps of {name}, split {item.name}, with 3-sigma bands (no alignment)",
                item.trajectory,
                true_steps(item.truth),
            )
            for item in predicted
        ],
    )


def _reference_notes(sigma: np.ndarray) -> list[str]:
    """Return what tables of calibration say of the reference's own errors, m and rad, `[6]`."""
    if not sigma.any():
        return []
    translation, rotation = (" ".join(f"{value:g}" for value in part) for part in (sigma[:3], np.rad2deg(sigma[3:])))
    return [f"Judged as densities of a reference that is wrong by {translation} m and {rotation} deg a step (1 sigma)."]


def _score(name: str, item: Predicted, constant_step: MeanStep) -> tuple[PathScore, PathScore]:
    """Judge a prediction of one sequence, and the constant predictor on it."""
    frames = np.arange(len(item.truth))
    paired = Paired(item.trajectory.poses, item.truth, frames, frames, frames, "row")
    reference = PoseFile(item.name, "kitti", item.truth)
    floor = constant_score(constant_step, reference, item.name, "none", delta=1, unit="frames")
    return scoring.score_path(name, item.name, paired, "none"), floor


def _drifts(name: str, item: Predicted, constant_step: MeanStep) -> list[tuple[str, str, int, Drift]]:
    """Measure the drift of a prediction of one sequence, and of the constant predictor on it."""
    steps = len(item.truth) - 1
    floor = trajectory(constant.constant_mixture(constant_step.mean, constant_step.std, steps), coupling="independent")
    paths = {name: item.trajectory, CONSTANT: floor}
    return [(of, item.name, len(item.truth), drift.drift(path, item.truth)) for of, path in paths.items()]


def track(chunks: Iterator[Any], total: int, *, name: str) -> Iterator[Any]:
    """Show how far the prediction of a sequence is."""
    from mdnvo_jax.training import logs

    return logs.track(chunks, f"predicting {name}", total)


def _calibrations(
    name: str, split: str, predicted: Many[Predicted], step: MeanStep, block: int, reference_sigma: np.ndarray
) -> tuple[list[CalibrationRow], StepScores]:
    """Calibrate the model and the constant predictor; the scores are those of the model's whole mixture."""
    truths = [true_steps(item.truth) for item in predicted]
    frames = sum(len(item.truth) for item in predicted)
    rows, scores = tabled.calibration_rows(
        name,
        split,
        [
            (add_noise(item.trajectory.mixture, reference_sigma), truth)
            for item, truth in zip(predicted, truths, strict=True)
        ],
        coupling=predicted[0].trajectory.coupling,
        frames=(frames, frames),
        block=block,
    )
    floor, _ = tabled.calibration_rows(
        CONSTANT,
        split,
        [
            (add_noise(constant.constant_mixture(step.mean, step.std, len(truth)), reference_sigma), truth)
            for truth in truths
        ],
        coupling="independent",
        frames=(frames, frames),
        block=block,
    )
    return [*rows, *floor], scores[0]


def sequences(options: argparse.Namespace, config: "Config") -> list["Sequence"]:
    """Return the sequences to judge on."""
    from mdnvo_jax.data import load

    if options.dataset == "synthetic":
        wrong = [name for name in options.sequences if not name.isdecimal()]
        if wrong:
            raise InputError(f"--sequences {wrong[0]}: expected seeds of worlds, such as {load.TEST_SEED}")
        if options.camera_height is not None:
            # Worlds of just this height, and their own metres.
            data = dataclasses.replace(config.data, camera_height_shares=(1.0, 1.0))
            config = dataclasses.replace(config, data=data)
        seeds = [int(name) for name in options.sequences]
        return load.synthetic_sequences(seeds, config, other_lenses=options.other_lenses)
    if not options.root:
        raise InputError(f"--root is missing: give the folder of {_ROOTS[options.dataset]}")
    given = {"camera_folder": options.camera_folder, "version": options.nuscenes_version}
    data = dataclasses.replace(
        config.data,
        dataset=options.dataset,
        root=options.root,
        cache="",
        **{name: value for name, value in given.items() if value},
    )
    read = load.nuscenes_sequences if options.dataset == "nuscenes" else load.kitti_sequences
    return read(options.sequences, dataclasses.replace(config, data=data))


def safe(name: str) -> str:
    """Return a sequence's name as part of a file name."""
    return name.replace("/", "_")
