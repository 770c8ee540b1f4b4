"""The errors of one method on one sequence or several, reduced to statistics with intervals, and to rows of tables."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mdnvo_jax.evaluation import bootstrap, kitti_segments, trajectory
from mdnvo_jax.evaluation.association import Paired
from mdnvo_jax.evaluation.kitti_segments import Segments
from mdnvo_jax.evaluation.tables import Column, Row, Table, Value
from mdnvo_jax.evaluation.trajectory import Alignment, DeltaUnit, RelativeErrors

_PROTOCOL_NOTE = (
    "RPE and ATE by evo. t_rel, r_rel: KITTI's protocol, segments of 100 to 800 m from every tenth frame; "
    "'-' where there are fewer than three."
)

Numbers = dict[str, Value]


@dataclass(frozen=True)
class PathScore:
    """The errors of one method.

    Attributes:
      name: of the method.
      split: what it was judged on.
      alignment: in words, with the scale found.
      poses: aligned, `[m, 4, 4]`; of several sequences none.
      covered: frames that the method gave, of `total`.
      total: frames of the reference.
      delta: in words, with unit.
      relative: RPE, pair by pair.
      absolute_m: ATE, frame by frame, `[m]`.
      segments: errors of KITTI's segments.
      pairs_by_sequence: pairs in `relative` of each sequence.
      notes: what the reader has to know.
    """

    name: str
    split: str
    alignment: str
    poses: np.ndarray
    covered: int
    total: int
    delta: str
    relative: RelativeErrors
    absolute_m: np.ndarray
    segments: Segments
    pairs_by_sequence: Sequence[int]
    notes: Sequence[str] = ()


def score_path(
    name: str, split: str, paired: Paired, how: Alignment, *, delta: float = 1, unit: DeltaUnit = "frames"
) -> PathScore:
    """Align an estimate as `how` says and measure its errors; arguments as in `trajectory` and `association`."""
    aligned = trajectory.align(paired.estimate, paired.reference[paired.rows_of_reference], how)
    reference = paired.reference[paired.rows_of_reference]
    relative = trajectory.relative_pose_error(aligned.poses, reference, paired.frames, delta=delta, unit=unit)
    return PathScore(
        name=name,
        split=split,
        alignment={"scale": f"scale {aligned.scale:.4g}", "sim3": f"sim3, scale {aligned.scale:.4g}"}.get(how, how),
        poses=aligned.poses,
        covered=len(paired.frames),
        total=len(paired.reference),
        delta=f"{delta:g} {unit.removesuffix('s') if delta == 1 else unit}",
        relative=relative,
        absolute_m=trajectory.absolute_error_m(aligned.poses, reference),
        segments=kitti_segments.segment_errors(aligned.poses, paired.reference, paired.rows_of_reference),
        pairs_by_sequence=[len(relative.frames)],
        notes=[f"{name}: {aligned.note}"] if aligned.note else [],
    )


def no_path(name: str, floor: PathScore, how: Alignment) -> PathScore:
    """Return the score of a method without a trajectory, on what `floor` is of: the figures in its row are "-"."""
    figures, frames = np.zeros(0), np.zeros(0, np.int64)
    return dataclasses.replace(
        floor,
        name=name,
        alignment=how,
        poses=np.zeros((0, 4, 4)),
        covered=0,
        relative=RelativeErrors(figures, figures, frames),
        absolute_m=figures,
        segments=Segments(frames, figures, figures, figures, figures, floor.segments.possible),
        pairs_by_sequence=[0],
        notes=(),
    )


def pool(parts: Sequence[PathScore], split: str) -> PathScore:
    """Put the errors of one method on several sequences together: every pair, frame and segment counts the same."""
    first = parts[0]
    # Frame numbers of later sequences follow those of earlier ones, so that none occurs twice.
    offsets = np.cumsum([0, *(part.total for part in parts[:-1])])
    alignments = {part.alignment.replace(",", "").split()[0] for part in parts}
    return PathScore(
        name=first.name,
        split=split,
        alignment="each " + " or ".join(sorted(alignments)) if alignments != {"none"} else "none",
        poses=np.zeros((0, 4, 4)),
        covered=sum(part.covered for part in parts),
        total=sum(part.total for part in parts),
        delta=first.delta,
        relative=RelativeErrors(
            np.concatenate([part.relative.translation_m for part in parts]),
            np.concatenate([part.relative.rotation_deg for part in parts]),
            np.concatenate([part.relative.frames + offset for part, offset in zip(parts, offsets, strict=True)]),
        ),
        absolute_m=np.concatenate([part.absolute_m for part in parts]),
        segments=_pool_segments([part.segments for part in parts], offsets),
        pairs_by_sequence=[len(part.relative.frames) for part in parts],
        notes=[note for part in parts for note in part.notes],
    )


def _pool_segments(parts: Sequence[Segments], offsets: np.ndarray) -> Segments:
    """Put the segments of several sequences together, frames counted on by `offsets`."""

    def joined(field: str) -> np.ndarray:
        return np.concatenate([getattr(part, field) for part in parts])

    return Segments(
        start=np.concatenate([part.start + offset for part, offset in zip(parts, offsets, strict=True)]),
        length_m=joined("length_m"),
        translation=joined("translation"),
        rotation_rad_per_m=joined("rotation_rad_per_m"),
        speed_mps=joined("speed_mps"),
        possible=sum(part.possible for part in parts),
    )


def summarise(score: PathScore, *, block: int = bootstrap.BLOCK_FRAMES) -> dict[str, Any]:
    """Reduce errors to statistics, each with its 95 % bootstrap interval.

    Whole sequences are redrawn where there are five or more, else blocks of `block` frames; for segments, blocks of
    as many starts as lie in `block` frames.

    Returns:
      `rpe_translation_m`, `rpe_rotation_deg`, `ate_m`: statistic to `Value`; `t_rel_percent`, `r_rel_deg_per_100m`:
      `Value`; `by_length`, `by_speed`: KITTI's averages; and what the row says about itself, which is all that there
      is of a method without a trajectory.
    """
    about = {
        "name": score.name,
        "split": score.split,
        "alignment": score.alignment,
        "delta": score.delta,
        "frames_covered": score.covered,
        "frames_total": score.total,
        "pairs": len(score.relative.frames),
        "by_length": kitti_segments.by_length(score.segments),
        "by_speed": kitti_segments.by_speed(score.segments),
        "notes": list(score.notes),
    }
    if not score.covered:
        return about
    draws = bootstrap.draw(score.pairs_by_sequence, block=block)
    frame_draws = bootstrap.draw_blocks(len(score.absolute_m), block=block)
    t_rel, r_rel = _segment_values(score.segments, block)
    return {
        **about,
        "rpe_translation_m": _statistic_values(score.relative.translation_m, draws),
        "rpe_rotation_deg": _statistic_values(score.relative.rotation_deg, draws),
        "ate_m": _statistic_values(score.absolute_m, frame_draws),
        "t_rel_percent": t_rel,
        "r_rel_deg_per_100m": r_rel,
        "segments": len(score.segments.start),
        "segments_possible": score.segments.possible,
    }


def rmse_difference(score: PathScore, other: PathScore, *, block: int = bootstrap.BLOCK_FRAMES) -> Value:
    """RPE translation RMSE of `score` minus that of `other`, m, on the pairs that both have, drawn together.

    An interval that holds zero says that the difference may be noise.
    """
    common, of_score, of_other = np.intersect1d(score.relative.frames, other.relative.frames, return_indices=True)
    if len(common) == 0:
        return Value(float("nan"))
    squares = score.relative.translation_m[of_score] ** 2, other.relative.translation_m[of_other] ** 2

    def difference(indices: np.ndarray) -> float:
        return float(np.sqrt(squares[0][indices].mean()) - np.sqrt(squares[1][indices].mean()))

    same = len(common) == len(score.relative.frames)
    draws = bootstrap.draw(score.pairs_by_sequence if same else [len(common)], block=block)
    return _value(difference, np.arange(len(common)), draws)


COLUMNS = (
    Column("name", "estimate"),
    Column("split", "split"),
    Column("alignment", "alignment"),
    Column("delta", "delta"),
    Column("frames", "frames"),
    Column("rmse", "RPE trans. RMSE (m) [95 %]", 4, "low"),
    Column("max", "max (m)", 4, "low"),
    Column("mean", "mean ± std (m)", 4, "low"),
    Column("rotation", "RPE rot. mean (deg)", 4, "low"),
    Column("t_rel", "t_rel mean (%)", 2, "low"),
    Column("r_rel", "r_rel mean (deg/100 m)", 2, "low"),
    Column("ate", "ATE RMSE (m)", 3, "low"),
    Column("gain", "RPE RMSE minus constant's (m) [95 %]", 4),
)
CONTEXT = ("split", "alignment", "delta", "frames")


def comparison(
    title: str,
    entries: Sequence[tuple[PathScore, PathScore | None]],
    notes: Sequence[str],
    *,
    block: int = bootstrap.BLOCK_FRAMES,
) -> tuple[Table, list[dict[str, Any]]]:
    """Put methods into one table.

    Args:
      title: of the table.
      entries: each method, with the constant predictor that it is measured against, if any.
      notes: to print below, beside what the methods' own notes say.
      block: frames in a bootstrap block.

    Returns:
      The table, and what `summarise` found for each row of it.
    """
    summaries, rows = [], []
    for score, floor in entries:
        summary = summarise(score, block=block)
        if floor is not None:
            summary["rpe_rmse_minus_constant_m"] = rmse_difference(score, floor, block=block)
        summaries.append(summary)
        rows.append(path_row(summary))
    own = dict.fromkeys(note for score, _ in entries for note in score.notes)
    every = [*notes, *own, _PROTOCOL_NOTE, bootstrap.describe(block)]
    return Table(title, COLUMNS, rows, CONTEXT, group="split", notes=every), summaries


def path_row(summary: dict[str, Any]) -> Row:
    """Return the row of `COLUMNS` for what `summarise` found."""
    row: dict[str, Value | str] = {
        **{key: summary[key] for key in ("name", "split", "alignment", "delta")},
        "frames": f"{summary['frames_covered']} of {summary['frames_total']}",
    }
    if not summary["frames_covered"]:
        return row
    translation = summary["rpe_translation_m"]
    row |= {
        "rmse": translation["rmse"],
        "max": Value(translation["max"].value),
        "mean": Value(translation["mean"].value, spread=translation["std"].value),
        "rotation": Value(summary["rpe_rotation_deg"]["mean"].value),
        "t_rel": Value(summary["t_rel_percent"].value),
        "r_rel": Value(summary["r_rel_deg_per_100m"].value),
        "ate": Value(summary["ate_m"]["rmse"].value),
    }
    gain = summary.get("rpe_rmse_minus_constant_m")
    return row if gain is None else {**row, "gain": gain}


def segment_tables(summaries: Sequence[dict[str, Any]]) -> list[Table]:
    """Return KITTI's averages by length and by speed, for the methods that have any."""
    kinds = (("by_length", "segment length (m)", "by length"), ("by_speed", "speed (m/s)", "by speed"))
    tables = []
    for key, header, title in kinds:
        rows = [
            {
                **{name: summary[name] for name in ("name", "split", "alignment")},
                "frames": f"{summary['frames_covered']} of {summary['frames_total']}",
                "at": f"{average.at:g}",
                "t_rel": Value(average.translation_percent),
                "r_rel": Value(average.rotation_deg_per_100m),
                "count": str(average.count),
            }
            for summary in summaries
            for average in summary[key]
        ]
        columns = (
            *(column for column in COLUMNS if column.key in ("name", "split", "alignment", "frames")),
            Column("at", header),
            Column("t_rel", "t_rel mean (%)", 2, "low"),
            Column("r_rel", "r_rel mean (deg/100 m)", 2, "low"),
            Column("count", "segments"),
        )
        if rows:
            # The same length or speed, of the same split, is what methods compare on.
            keyed = [{**row, "group": f"{row['split']} {row['at']}"} for row in rows]
            tables.append(Table(f"KITTI segment errors {title}", columns, keyed, CONTEXT, group="group"))
    return tables


def _statistic_values(errors: np.ndarray, draws: bootstrap.Draws) -> Numbers:
    """Return the statistics of `errors` with their intervals."""
    found = trajectory.statistics(errors)

    def redrawn(indices: np.ndarray) -> np.ndarray:
        drawn = errors[indices]
        mean = drawn.mean()
        square = (drawn * drawn).mean()
        spread = np.sqrt(max(square - mean * mean, 0.0))
        return np.array([np.sqrt(square), drawn.max(), mean, spread, np.median(drawn), drawn.min()])

    low, high = bootstrap.interval(redrawn, draws)
    names = ("rmse", "max", "mean", "std", "median", "min")
    return {name: Value(getattr(found, name), float(low[i]), float(high[i])) for i, name in enumerate(names)}


def _segment_values(segments: Segments, block: int) -> tuple[Value, Value]:
    """Return t_rel and r_rel with their intervals."""
    starts, group = np.unique(segments.start, return_inverse=True)
    if len(starts) < kitti_segments.FEWEST_SEGMENTS:
        return Value(segments.translation_percent), Value(segments.rotation_deg_per_100m)
    counts = np.bincount(group)
    draws = bootstrap.draw_blocks(len(starts), block=max(1, block // kitti_segments.START_EVERY))
    values = []
    for errors, factor in ((segments.translation, 100.0), (segments.rotation_rad_per_m, 100 * 180 / np.pi)):
        sums = factor * np.bincount(group, errors)

        def mean(indices: np.ndarray, sums: np.ndarray = sums) -> float:
            return float(sums[indices].sum() / counts[indices].sum())

        values.append(_value(mean, np.arange(len(starts)), draws))
    return values[0], values[1]


def _value(statistic: Callable[[np.ndarray], float], everything: np.ndarray, draws: bootstrap.Draws) -> Value:
    """Return a statistic of all items, with its interval."""
    return Value(statistic(everything), *bootstrap.number_interval(statistic, draws))
