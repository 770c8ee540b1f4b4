"""Which pose of an estimate belongs to which frame of the reference."""

from dataclasses import dataclass

import numpy as np

from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation.formats import PoseFile

# evo's default as well; half the interval of a 50 Hz camera.
TIME_TOLERANCE_S = 0.01


@dataclass(frozen=True)
class Paired:
    """An estimate and the reference, frame by frame.

    Attributes:
      estimate: `T_world_camera` of the frames that both have, `[m, 4, 4]`, in the estimate's own world.
      reference: `T_world_camera` of every frame of the reference, `[N, 4, 4]`.
      frames: their frame numbers, `[m]` int64, increasing.
      rows_of_reference: the rows of `reference` that they belong to, `[m]`; the frame numbers, unless the reference
        states its own.
      rows_of_estimate: the rows of the estimate's file that were used, `[m]`, increasing.
      how: by what they were matched, in words.
    """

    estimate: np.ndarray
    reference: np.ndarray
    frames: np.ndarray
    rows_of_reference: np.ndarray
    rows_of_estimate: np.ndarray
    how: str


def pair(
    estimate: PoseFile,
    reference: PoseFile,
    *,
    tolerance_s: float = TIME_TOLERANCE_S,
    reference_times: np.ndarray | None = None,
    first_frame: int | None = None,
) -> Paired:
    """Match the poses of `estimate` to the frames of `reference`.

    By frame number where the estimate states them; else by `first_frame` where it is given; else row by row where our
    own output folder has as many poses as the reference; else by time where both have times; else row by row where the
    counts agree. Nothing else is guessed.

    Args:
      estimate: the poses to match.
      reference: the ground truth. A row is a frame; its number is the row unless the file states numbers.
      tolerance_s: how far apart two timestamps may be, s.
      reference_times: `[N]` s, for a reference whose file has no timestamps.
      first_frame: frame number of the first pose of an estimate without frame numbers.

    Raises:
      InputError: it cannot be told which frames the poses are, or fewer than two frames match.
    """
    count, total = len(estimate.poses), len(reference.poses)
    times = reference.timestamps if reference_times is None else reference_times
    if times is not None and len(times) != total:
        raise InputError(f"{len(times)} times for the {total} poses of {reference.path}: expected one a pose")
    numbers = np.arange(total) if reference.frames is None else reference.frames
    wanted = estimate.frames
    if wanted is None and first_frame is not None:
        wanted = first_frame + np.arange(count)
    if wanted is not None:
        how = "frame number"
        rows, there = _by_number(estimate.path, wanted, numbers)
    elif count == total and (estimate.format == "output" or estimate.timestamps is None or times is None):
        how = "row"
        rows = there = np.arange(total)
    elif estimate.timestamps is not None and times is not None:
        how = f"time within {tolerance_s:g} s"
        rows, there = _by_time(estimate.timestamps, times, tolerance_s)
        if len(rows) < 2:
            raise InputError(
                f"{estimate.path}: {len(rows)} of {count} timestamps are within {tolerance_s:g} s of one of "
                f"{reference.path}; the estimate has {_range(estimate.timestamps)}, the reference {_range(times)}: "
                "check clock and unit, or widen --tolerance"
            )
    else:
        raise InputError(
            f"{estimate.path} has {count} poses, {reference.path} has {total}, and nothing says which frames they are: "
            "give --first-frame, put the frame number before the 12 numbers, or give timestamps on both sides "
            "(--reference-times)"
        )
    if len(rows) < 2:
        raise InputError(f"{estimate.path}: {len(rows)} poses match frames of {reference.path}; expected two or more")
    return Paired(estimate.poses[rows], reference.poses, numbers[there], there, rows, how)


def _by_number(path: str, wanted: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of the estimate and of the reference that share a frame number."""
    outside = np.flatnonzero((wanted < numbers[0]) | (wanted > numbers[-1]))
    if outside.size:
        raise InputError(
            f"{path}: frame {wanted[outside[0]]} is outside the reference, whose frames are {numbers[0]} to "
            f"{numbers[-1]}: check that they are of the same sequence and count from the same number"
        )
    # The reference itself may miss frames in between.
    rows = np.flatnonzero(np.isin(wanted, numbers))
    return rows, np.searchsorted(numbers, wanted[rows])


def _by_time(stamps: np.ndarray, times: np.ndarray, tolerance_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of `stamps` and `times` that are nearest to each other, both ways, within the tolerance."""
    gaps_to = np.abs(stamps[:, None] - times[_neighbours(stamps, times)])
    frames = _neighbours(stamps, times)[np.arange(len(stamps)), gaps_to.argmin(axis=1)]
    gaps = gaps_to.min(axis=1)
    # Of several poses nearest to the same frame the closest stays, so that no frame counts twice.
    order = np.lexsort((gaps, frames))
    first = np.r_[True, np.diff(frames[order]) > 0]
    rows = np.sort(order[first])
    # A hair of slack: 0.01 s apart in decimal is not exactly 0.01 in binary.
    rows = rows[gaps[rows] <= tolerance_s * (1 + 1e-6)]
    return rows, frames[rows]


def _neighbours(stamps: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the rows of `times` on either side of each stamp, `[n, 2]`."""
    right = np.searchsorted(times, stamps)
    return np.clip(np.stack([right - 1, right], axis=1), 0, len(times) - 1)


def _range(times: np.ndarray) -> str:
    """Return first and last of `times` as text."""
    return f"{times[0]:.6g} to {times[-1]:.6g} s"
