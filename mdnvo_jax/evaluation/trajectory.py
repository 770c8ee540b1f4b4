"""How far an estimated trajectory is from the true one: alignment, relative and absolute pose error, through evo.

evo (Grupp, 2017) does the arithmetic of RPE, ATE and Umeyama's alignment, so that figures compare with those of papers
that use it. What it leaves open is decided here: frames that are missing, world frames that differ, and paths that
do not determine an alignment.
"""

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation import optional

Alignment = Literal["none", "scale", "se3", "sim3"]
ALIGNMENTS: tuple[Alignment, ...] = get_args(Alignment)
DeltaUnit = Literal["frames", "metres"]
DELTA_UNITS: tuple[DeltaUnit, ...] = get_args(DeltaUnit)

# Width over length below which a path counts as a straight line: what is left of its width is the rounding of files
# with seven digits.
_THINNEST = 1e-6


@dataclass(frozen=True)
class Aligned:
    """An estimate brought into the world of its reference.

    Attributes:
      poses: `T_world_camera`, `[m, 4, 4]`.
      how: the alignment asked for.
      scale: factor that the translations were multiplied by.
      note: what the reader of the result has to know, or empty.
    """

    poses: np.ndarray
    how: Alignment
    scale: float = 1.0
    note: str = ""


@dataclass(frozen=True)
class RelativeErrors:
    """Relative pose errors, pair by pair.

    Attributes:
      translation_m: norm of the translation of `inv(reference step) @ (estimated step)`, `[k]`.
      rotation_deg: angle of its rotation, `[k]`.
      frames: the later frame of each pair, `[k]`.
    """

    translation_m: np.ndarray
    rotation_deg: np.ndarray
    frames: np.ndarray


@dataclass(frozen=True)
class Statistics:
    """Statistics over `count` errors, in the unit of the errors; `std` is the population's, as evo prints it."""

    rmse: float
    max: float
    mean: float
    std: float
    median: float
    min: float
    count: int


def align(estimate: np.ndarray, reference: np.ndarray, how: Alignment) -> Aligned:
    """Bring `estimate` into the world of `reference`.

    - "none": only the first pose is put on the reference's first, since worlds differ between sources.
    - "scale": that, then the translations from there times the s that minimises sum |s p_i - q_i|^2.
    - "se3", "sim3": least squares over positions, without and with scale (Umeyama, 1991), by evo.

    A straight line does not determine the rotation about itself. Then, among the rotations that fit best, the one by
    the least angle is taken, which leaves the absolute error at its minimum; an estimate that does not move keeps its
    orientation and scale. `note` says so.

    Args:
      estimate: `[m, 4, 4]`.
      reference: the same frames, `[m, 4, 4]`.
      how: one of `ALIGNMENTS`.
    """
    if how in ("se3", "sim3"):
        return _umeyama(estimate, reference, how)
    anchored = reference[0] @ np.linalg.inv(estimate[0]) @ estimate
    if how == "none":
        return Aligned(anchored, how)
    origin = reference[0, :3, 3]
    moved, truth = anchored[:, :3, 3] - origin, reference[:, :3, 3] - origin
    square, product = float((moved * moved).sum()), float((moved * truth).sum())
    if square == 0 or product <= 0:
        why = "it does not move" if square == 0 else "no positive scale fits"
        return Aligned(anchored, how, 1.0, f"scale not determined ({why}): left at 1")
    scale = product / square
    anchored[:, :3, 3] = origin + scale * moved
    return Aligned(anchored, how, scale)


def relative_pose_error(
    estimate: np.ndarray,
    reference: np.ndarray,
    frames: np.ndarray,
    *,
    delta: float = 1,
    unit: DeltaUnit = "frames",
) -> RelativeErrors:
    """Relative pose error (Sturm et al., 2012) over consecutive pairs `delta` apart, by evo.

    Pairs follow each other without overlap, as evo takes them: 0 to d, d to 2d, ... Where frames are missing, each run
    of consecutive frames is taken by itself, so that no pair spans a gap. In metres, the distance is that of the
    reference, so that all estimates are judged on the same pairs.

    Args:
      estimate: `[m, 4, 4]`.
      reference: the same frames, `[m, 4, 4]`.
      frames: their numbers, `[m]`, increasing.
      delta: how far the two poses of a pair are apart.
      unit: of `delta`.

    Raises:
      InputError: evo is not installed, `delta` is no distance, or no pair is that far apart.
    """
    metrics, evo_trajectory, filters, units = _evo("metrics", "trajectory", "filters", "units")
    if not (np.isfinite(delta) and delta > 0) or (unit == "frames" and delta != int(delta)):
        raise InputError(f"delta is {delta:g} {unit}; expected a positive number, whole for frames")
    if unit == "frames":
        # evo counts poses, not frames: chains hold the poses that it is to pair.
        runs, evo_delta, evo_unit = _chains(frames, int(delta)), 1.0, units.Unit.frames
    else:
        runs, evo_delta, evo_unit = _runs(frames), delta, units.Unit.meters
    translation: list[np.ndarray] = []
    rotation: list[np.ndarray] = []
    ends: list[np.ndarray] = []
    for run in runs:
        pair = tuple(evo_trajectory.PosePath3D(poses_se3=list(poses[run])) for poses in (reference, estimate))
        for relation, errors in (("translation_part", translation), ("rotation_angle_deg", rotation)):
            kind = getattr(metrics.PoseRelation, relation)
            metric = metrics.RPE(kind, evo_delta, evo_unit, pairs_from_reference=True)
            try:
                metric.process_data(pair)
            except filters.FilterException:
                continue  # a run too short to hold a pair
            errors.append(metric.error)
            if relation == "translation_part":
                ends.append(frames[run[metric.delta_ids]])
    if not ends:
        raise InputError(
            f"no two frames without a gap between them are {delta:g} {unit} apart, among {len(frames)} frames "
            f"that are {_spacing(frames)} or more apart: choose another --delta"
        )
    return RelativeErrors(*(np.concatenate(parts) for parts in (translation, rotation, ends)))


def absolute_error_m(estimate: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Distance of each estimated position from the true one, `[m]` metres, by evo (ATE; align first)."""
    metrics, evo_trajectory = _evo("metrics", "trajectory")
    metric = metrics.APE(metrics.PoseRelation.translation_part)
    metric.process_data(tuple(evo_trajectory.PosePath3D(poses_se3=list(poses)) for poses in (reference, estimate)))
    return np.asarray(metric.error)


def statistics(errors: np.ndarray) -> Statistics:
    """Return the statistics of `errors`, `[k]`, as evo defines them."""
    (metrics,) = _evo("metrics")
    metric = metrics.APE()
    metric.error = errors
    values = metric.get_all_statistics()
    kept = ("rmse", "max", "mean", "std", "median", "min")
    return Statistics(**{name: float(values[name]) for name in kept}, count=len(errors))


def _chains(frames: np.ndarray, delta: int) -> list[np.ndarray]:
    """Return rows of `frames` in chains whose links are `delta` frames apart, without overlap, in order."""
    row_of = {int(frame): row for row, frame in enumerate(frames)}
    chains, row = [], 0
    while row < len(frames):
        chain = [row]
        while (following := row_of.get(int(frames[chain[-1]]) + delta)) is not None:
            chain.append(following)
        if len(chain) > 1:
            chains.append(np.array(chain))
        row = chain[-1] + 1
    return chains


def _runs(frames: np.ndarray) -> list[np.ndarray]:
    """Return rows of `frames` in runs without a gap."""
    return np.split(np.arange(len(frames)), np.flatnonzero(np.diff(frames) > _spacing(frames)) + 1)


def _spacing(frames: np.ndarray) -> int:
    """Return how far apart neighbouring frames are where none is missing."""
    return int(np.diff(frames).min())


def _umeyama(estimate: np.ndarray, reference: np.ndarray, how: Alignment) -> Aligned:
    """Align by evo, or by least rotation where evo cannot or should not."""
    geometry, evo_trajectory = _evo("geometry", "trajectory")
    points, targets = estimate[:, :3, 3], reference[:, :3, 3]
    spread = np.linalg.svd((targets - targets.mean(0)).T @ (points - points.mean(0)), compute_uv=False)
    note = ""
    path = evo_trajectory.PosePath3D(poses_se3=list(estimate))
    try:
        # evo's own test is absolute: rounding noise on a long line passes it, with an arbitrary roll as the result.
        if spread[1] <= _THINNEST**2 * spread[0]:
            raise geometry.GeometryException
        rotation, translation, scale = path.align(
            evo_trajectory.PosePath3D(poses_se3=list(reference)), correct_scale=how == "sim3"
        )
    except geometry.GeometryException:
        rotation, translation, scale, note = _align_lines(points, targets, with_scale=how == "sim3")
    poses = estimate.copy()
    poses[:, :3, :3] = rotation @ estimate[:, :3, :3]
    poses[:, :3, 3] = scale * points @ rotation.T + translation
    return Aligned(poses, how, float(scale), note)


def _align_lines(
    points: np.ndarray, targets: np.ndarray, *, with_scale: bool
) -> tuple[np.ndarray, np.ndarray, float, str]:
    """Align `points` to `targets`, `[m, 3]`, one of which is on a line, by the rotation of least angle.

    The covariance of the two has rank one at most: d u v^T. Every rotation that takes v to u fits equally well.
    """
    centre, target = points.mean(0), targets.mean(0)
    left, values, right = np.linalg.svd((targets - target).T @ (points - centre))
    square = ((points - centre) ** 2).sum()
    if values[0] <= np.finfo(float).eps * (square + ((targets - target) ** 2).sum()) or square == 0:
        note = "alignment not determined (no motion): only the mean positions are brought together"
        return np.eye(3), target - centre, 1.0, note
    rotation = _least_rotation(right[0], left[:, 0])
    scale = float(values[0] / square) if with_scale else 1.0
    note = "straight line: the rotation about it is not determined, the least one is taken"
    return rotation, target - scale * rotation @ centre, scale, note


def _least_rotation(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the rotation by the least angle that takes the unit vector `source` to `target`."""
    cosine = float(source @ target)
    if cosine < -1 + 1e-12:
        # Opposite: half a turn about any axis across; the coordinate axis that is most across is at hand.
        across = np.cross(source, np.eye(3)[np.abs(source).argmin()])
        across /= np.linalg.norm(across)
        return 2 * np.outer(across, across) - np.eye(3)
    x, y, z = np.cross(source, target)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)


def _evo(*names: str) -> list[Any]:
    """Import modules of `evo.core`."""
    return [optional.load(f"evo.core.{name}") for name in names]
