"""The tables and figures of the paper (Kaygusuz, Mendez, Bowden, 2021) with what is there: what `evaluate paper` does.

Sequence by sequence of KITTI (Table I), or by condition of nuScenes (Table II), with ORB-SLAM, DeepVO and MDN-VO side
by side as the paper has them, and the constant predictor, which it has not.
"""

import argparse
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from mdnvo_jax.baselines import constant
from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation import paper_tables, scoring
from mdnvo_jax.evaluation.association import Paired, pair
from mdnvo_jax.evaluation.compare import CONSTANT, MeanStep, constant_score
from mdnvo_jax.evaluation.formats import PoseFile, read_trajectory, why_lost
from mdnvo_jax.evaluation.model import safe, sequences, track
from mdnvo_jax.evaluation.paper_tables import METHODS, Line
from mdnvo_jax.evaluation.report import PathPicture, Report, ScenePicture
from mdnvo_jax.evaluation.scoring import PathScore
from mdnvo_jax.evaluation.trajectory import Alignment

if TYPE_CHECKING:
    from mdnvo_jax.config import Config
    from mdnvo_jax.odometry import Trajectory
    from mdnvo_jax.predictor import Predictor

KITTI_TEST = ("03", "05", "06", "07", "10")
KITTI_TRAINING = ("00", "01", "02", "04", "08", "09")
# Whose trajectories the paper draws.
KITTI_DRAWN = ("05", "10")
NUSCENES_DRAWN = ("scene-0972", "scene-0572", "scene-0999")
# A monocular path has no scale of its own.
ALIGNMENT: dict[str, Alignment] = {"ORB-SLAM": "sim3", "DeepVO": "none", "MDN-VO": "none"}
_OPTION = {"ORB-SLAM": "orbslam", "DeepVO": "deepvo", "MDN-VO": "mdn"}


@dataclass(frozen=True)
class Drive:
    """A test sequence: its name, the row of the table it belongs to, and its true poses and times."""

    name: str
    row: str
    truth: PoseFile


@dataclass(frozen=True)
class Estimate:
    """What a method says of a drive: its poses by frame, and the prediction where a checkpoint made it here."""

    paired: Paired
    trajectory: "Trajectory | None" = None


# Of a drive; None with a reason where the method has no trajectory.
Method = Callable[[Drive], tuple[Estimate | None, str]]


def from_options(options: argparse.Namespace) -> Report:
    """Make the table and the figures as the options of `evaluate paper` say.

    Raises:
      InputError: an option, a checkpoint or the data is unusable, or no test sequence is there.
    """
    if options.block < 1:
        raise InputError(f"--block is {options.block}: expected 1 frame or more")
    models = {name: _model(getattr(options, _OPTION[name])) for name in ("DeepVO", "MDN-VO")}
    config = next((model.config for model in (models["MDN-VO"], models["DeepVO"]) if model), None)
    find = _kitti_drives if options.dataset == "kitti" else _nuscenes_drives
    drives, step, notes = find(options, config)
    methods: dict[str, Method | None] = {}
    for name in METHODS:
        folder, model = getattr(options, _OPTION[name]), models.get(name)
        if model is not None:
            methods[name] = functools.partial(_predict, model, options)
            notes.append(f"{name}: offline, mean of the density, head {model.config.model.head}; {model.source}")
        else:
            methods[name] = functools.partial(_read, Path(folder), name, drives) if folder else None
            notes += [] if folder else [f"{name}: not given (--{_OPTION[name]})"]
    scenes, more = _scenes(options, config, methods["MDN-VO"])
    report = evaluate(options.dataset, drives, methods, step, [*notes, *more], block=options.block)
    return dataclasses.replace(report, scenes=scenes)


def evaluate(
    dataset: str,
    drives: Sequence[Drive],
    methods: Mapping[str, Method | None],
    step: MeanStep,
    notes: Sequence[str],
    *,
    block: int,
) -> Report:
    """Judge `methods`, and the constant predictor, on `drives`.

    Args:
      dataset: "kitti" or "nuscenes".
      drives: in the order of the table.
      methods: by the names of the paper; None where one is not given.
      step: what the constant predictor repeats.
      notes: to print below.
      block: frames in a bootstrap block.
    """
    scores: dict[tuple[str, str], PathScore] = {}
    said = list(notes)
    for drive in drives:
        scores[drive.name, CONSTANT] = constant_score(step, drive.truth, drive.name, "none", delta=1, unit="frames")
        for name, method in methods.items():
            if method is None:
                continue
            found, why = method(drive)
            if found is None:
                said.append(f"{name} has no trajectory of {drive.name}: {why}")
            else:
                scores[drive.name, name] = scoring.score_path(name, drive.name, found.paired, ALIGNMENT[name])
    lines = _lines(drives, scores)
    said.append(f"{CONSTANT}: {step.source}")
    entries = [
        (score, None if name == CONSTANT else line.scores[CONSTANT])
        for line in lines
        for name, score in line.scores.items()
    ]
    details, summaries = scoring.comparison("Pose error", entries, [], block=block)
    return Report(
        [paper_tables.own_table(dataset, lines, said), paper_tables.published_table(dataset)],
        [details],
        {"paths": summaries},
        [_picture(drive, scores) for drive in _drawn(dataset, drives)],
    )


def _lines(drives: Sequence[Drive], scores: Mapping[tuple[str, str], PathScore]) -> list[Line]:
    """Put the scores of the drives of each row together, in the order in which the rows first occur."""
    lines = []
    for row in dict.fromkeys(drive.row for drive in drives):
        inside = [drive for drive in drives if drive.row == row]
        frames = sum(len(drive.truth.poses) for drive in inside)
        pooled = {}
        for name in (*METHODS, CONSTANT):
            parts = [scores[drive.name, name] for drive in inside if (drive.name, name) in scores]
            if parts:
                pooled[name] = scoring.pool(parts, row) if len(inside) > 1 else dataclasses.replace(parts[0], split=row)
        lines.append(Line(row, len(inside), frames, pooled))
    return lines


def _model(folder: str | None) -> "Predictor | None":
    """Return the model in `folder`, None where that holds no checkpoint."""
    from mdnvo_jax import predictor
    from mdnvo_jax.training import checkpoint

    if folder is None:
        return None
    if not Path(folder).is_dir():
        raise InputError(f"no folder {folder}: expected a checkpoint, or estimates by sequence")
    try:
        found = checkpoint.locate(folder)
    except InputError:
        return None
    return predictor.load(found)


def _predict(model: "Predictor", options: argparse.Namespace, drive: Drive) -> tuple[Estimate | None, str]:
    """Predict a drive with a checkpoint."""
    from mdnvo_jax import predictor

    (sequence,) = sequences(_only(options, drive.name), model.config)
    path = predictor.predict(model, sequence, progress=functools.partial(track, name=drive.name))
    total = len(drive.truth.poses)
    if len(path.poses) != total:
        raise InputError(
            f"{model.source} takes {len(path.poses)} of the {total} frames of {drive.name}: expected the checkpoints "
            "of both methods to be trained on the same choice of frames"
        )
    frames = np.arange(total)
    return Estimate(Paired(path.poses, drive.truth.poses, frames, frames, frames, "row"), path), ""


def _read(folder: Path, method: str, drives: Sequence[Drive], drive: Drive) -> tuple[Estimate | None, str]:
    """Read what a method left in `folder` for a drive: an output folder, or a file of poses, by the drive's name."""
    places = [folder / drive.name, folder / f"{drive.name}.txt"]
    there = next((place for place in places if place.exists()), None)
    if there is None:
        if not any((folder / other.name).exists() or (folder / f"{other.name}.txt").exists() for other in drives):
            raise InputError(
                f"--{_OPTION[method]} {folder} holds neither a checkpoint nor estimates: expected a folder or a .txt "
                f"for each sequence, such as {places[0].name}"
            )
        return None, f"nothing in {folder}"
    if why := why_lost(there):
        return None, f"its run in {there} ended without one ({why})"
    return Estimate(pair(read_trajectory(there), drive.truth)), ""


def _kitti_drives(options: argparse.Namespace, config: "Config | None") -> tuple[list[Drive], MeanStep, list[str]]:
    """Return the paper's test sequences that are there, the constant step, and what to note."""
    root = Path(options.root)
    # Files of estimates are judged without a single image.
    needs_images = config is not None
    there = [
        name
        for name in KITTI_TEST
        if (root / "poses" / f"{name}.txt").is_file() and (not needs_images or (root / "sequences" / name).is_dir())
    ]
    absent = [name for name in KITTI_TEST if name not in there]
    if not there:
        raise InputError(
            f"{root} has none of the paper's test sequences {' '.join(KITTI_TEST)}: expected KITTI's poses/NN.txt"
            f"{' and sequences/NN' if needs_images else ''}; judge others with `evaluate model`"
        )
    truths = {name: read_trajectory(root / "poses" / f"{name}.txt", format="kitti") for name in there}
    training = [name for name in KITTI_TRAINING if (root / "poses" / f"{name}.txt").is_file()]
    paths = [read_trajectory(root / "poses" / f"{name}.txt", format="kitti").poses for name in training]
    step = _mean_step(paths, f"mean step of the training sequences {' '.join(training)}", list(truths.values()))
    notes = [f"absent from {root}: {' '.join(absent)}"] if absent else []
    return [Drive(name, name, truth) for name, truth in truths.items()], step, notes


def _nuscenes_drives(options: argparse.Namespace, config: "Config | None") -> tuple[list[Drive], MeanStep, list[str]]:
    """Return the test scenes that can be used, in the order of the table, the constant step, and what to note."""
    from mdnvo_jax.config import Config
    from mdnvo_jax.data import nuscenes

    config = config or Config()
    version = options.nuscenes_version or config.data.version
    known = nuscenes.scenes(options.root, version)
    usable = [scene for scene in known if (scene.key_frames if config.data.key_frames_only else scene.frames) >= 2]
    read = {scene.name: sequences(_only(options, scene.name), config)[0] for scene in usable if scene.split == "test"}
    partial = [name for name, sequence in read.items() if nuscenes.missing_images(sequence)]
    drives = []
    for row in get_args(nuscenes.Condition):
        for scene in known:
            if scene.name in read and scene.name not in partial and scene.condition == row:
                sequence = read[scene.name]
                assert sequence.poses is not None
                truth = PoseFile(scene.name, "tum", sequence.poses, timestamps=sequence.timestamps)
                drives.append(Drive(scene.name, row, truth))
    if not drives:
        raise InputError(f"{options.root} has no scene of {version} for test: expected images of v1.0-mini or more")
    paths = [sequences(_only(options, scene.name), config)[0].poses for scene in usable if scene.split == "train"]
    step = _mean_step(
        [poses for poses in paths if poses is not None],
        f"mean step of the {len(paths)} scenes for training",
        [drive.truth for drive in drives],
    )
    short = [scene.name for scene in known if scene.split == "test" and scene.name not in read]
    unusable = {"of fewer than 2 frames": short, "with images that are not on disk": partial}
    notes = [f"test: {line}" for line in nuscenes.left_out(unusable)]
    rows = {drive.row for drive in drives}
    notes += [f"no test scene: {row}" for row in paper_tables.PUBLISHED["nuscenes"] if row not in rows]
    if "unknown" in rows:
        notes.append("unknown: scenes without a description, which is what tells the condition")
    return drives, step, notes


def _mean_step(paths: list[np.ndarray], source: str, truths: Sequence[PoseFile]) -> MeanStep:
    """Return the mean step of training paths, or where there are none of the test drives themselves."""
    if paths:
        return MeanStep(*constant.step_statistics(paths), source)
    mean, std = constant.step_statistics([truth.poses for truth in truths])
    return MeanStep(mean, std, "oracle: mean step of the test sequences, for want of training poses")


def _only(options: argparse.Namespace, name: str) -> argparse.Namespace:
    """Return the options with which `model.sequences` reads one sequence."""
    return argparse.Namespace(**{**vars(options), "sequences": [name]})


def _drawn(dataset: str, drives: Sequence[Drive]) -> list[Drive]:
    """Return the drives that the paper draws; where they are not there, others in their place."""
    if dataset == "kitti":
        return [drive for drive in drives if drive.name in KITTI_DRAWN] or list(drives)
    chosen = []
    for row in dict.fromkeys(drive.row for drive in drives):
        inside = [drive for drive in drives if drive.row == row]
        chosen += [drive for drive in inside if drive.name in NUSCENES_DRAWN] or inside[:1]
    return chosen


def _picture(drive: Drive, scores: Mapping[tuple[str, str], PathScore]) -> PathPicture:
    """Return the picture of one drive."""
    there = {name: scores[drive.name, name] for name in METHODS if (drive.name, name) in scores}
    paths = {f"{name} ({score.alignment})": score.poses for name, score in there.items()}
    about = f"sequence {drive.name}" if drive.name == drive.row else f"{drive.name} ({drive.row})"
    title = f"Paths from above, {about}, alignment in brackets"
    return PathPicture(f"trajectory-{safe(drive.name)}.png", title, paths, drive.truth.poses)


def _scenes(
    options: argparse.Namespace, config: "Config | None", method: Method | None
) -> tuple[list[ScenePicture], list[str]]:
    """Return the uncertainty figure of `--scene`, or a note why there is none."""
    if options.dataset != "nuscenes" or method is None or config is None:
        return [], []
    try:
        (sequence,) = sequences(_only(options, options.scene), config)
        assert sequence.poses is not None
        found, _ = method(Drive(options.scene, "", PoseFile(options.scene, "tum", sequence.poses)))
    except InputError as error:
        return [], [f"no uncertainty figure: {error}"]
    if found is None or found.trajectory is None:
        return [], ["no uncertainty figure: --mdn is no checkpoint"]
    recalibrated = "" if found.trajectory.about.get("sigma_scale", "none") == "none" else ", sigma recalibrated"
    title = f"MDN-VO on {options.scene}: x, y and yaw of every step with 3-sigma bands{recalibrated}"
    return [ScenePicture(f"uncertainty-{safe(options.scene)}.png", title, found.trajectory, sequence.poses)], []
