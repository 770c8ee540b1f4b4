"""The error measure of the KITTI odometry benchmark: relative errors of whole segments of the path.

From the benchmark's description (Geiger, Lenz, Urtasun, CVPR 2012, and the readme of its development kit): from every
tenth frame, segments of 100, 200, ..., 800 m are compared; errors are divided by the length and averaged over all
segments, by length, and by speed. No alignment enters, since a segment is seen from its own first camera.
"""

from dataclasses import dataclass

import numpy as np

LENGTHS_M = tuple(range(100, 801, 100))
# Frames between the starts of two segments.
START_EVERY = 10
# The kit's speeds assume KITTI's ten frames a second.
FRAME_INTERVAL_S = 0.1
# Speeds at which the kit averages, and how far a segment's speed may be from one, m/s.
SPEEDS_MPS = tuple(range(2, 25, 2))
SPEED_REACH_MPS = 2.0
# The kit prints no average of fewer. Here that goes for the overall figures too: one segment is no statistic.
FEWEST_SEGMENTS = 3


@dataclass(frozen=True)
class Segments:
    """Errors of the segments of a path.

    Attributes:
      start: first frame of each segment, `[k]`, not decreasing.
      length_m: nominal length, `[k]`.
      translation: translation error over the length, a fraction, `[k]`.
      rotation_rad_per_m: rotation error over the length, `[k]`.
      speed_mps: mean speed, `[k]`.
      possible: segments that the reference holds; fewer are compared where the estimate misses frames.
    """

    start: np.ndarray
    length_m: np.ndarray
    translation: np.ndarray
    rotation_rad_per_m: np.ndarray
    speed_mps: np.ndarray
    possible: int

    @property
    def translation_percent(self) -> float:
        """t_rel: mean translation error, % of the length; NaN of fewer than three segments."""
        return _average(self.translation) * 100

    @property
    def rotation_deg_per_100m(self) -> float:
        """r_rel: mean rotation error, degrees in 100 m; NaN of fewer than three segments."""
        return float(np.rad2deg(_average(self.rotation_rad_per_m))) * 100


@dataclass(frozen=True)
class SegmentAverage:
    """An average over the segments of one length or speed.

    Attributes:
      at: the length in m, or the speed in m/s.
      translation_percent: as t_rel.
      rotation_deg_per_100m: as r_rel.
      count: how many segments.
    """

    at: float
    translation_percent: float
    rotation_deg_per_100m: float
    count: int


def segment_errors(
    estimate: np.ndarray, reference: np.ndarray, frames: np.ndarray, *, interval_s: float = FRAME_INTERVAL_S
) -> Segments:
    """Compare all segments whose two ends the estimate has.

    A segment begins at frames 0, 10, 20, ... of the reference and ends at the first frame that is more than its length
    further along the reference's path.

    Args:
      estimate: `T_world_camera`, `[m, 4, 4]`.
      reference: of every frame, `[N, 4, 4]`.
      frames: the rows of `reference` that `estimate` belongs to, `[m]`.
      interval_s: time between frames, for speeds.
    """
    total = len(reference)
    row = np.full(total, -1)
    row[frames] = np.arange(len(frames))
    hops_m = np.linalg.norm(np.diff(reference[:, :3, 3], axis=0), axis=1)
    distance_m = np.concatenate([[0.0], np.cumsum(hops_m)])
    # Start by start, and by length within a start.
    first = np.repeat(np.arange(0, total, START_EVERY), len(LENGTHS_M))
    length_m = np.resize(np.array(LENGTHS_M, float), first.shape)
    last = np.searchsorted(distance_m, distance_m[first] + length_m, side="right")
    inside = last < total
    first, last, length_m = first[inside], last[inside], length_m[inside]
    there = (row[first] >= 0) & (row[last] >= 0)
    first, last, length_m = first[there], last[there], length_m[there]
    true_motion = np.linalg.inv(reference[first]) @ reference[last]
    motion = np.linalg.inv(estimate[row[first]]) @ estimate[row[last]]
    error = np.linalg.inv(motion) @ true_motion
    cosine = (np.trace(error[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    return Segments(
        start=first,
        length_m=length_m,
        translation=np.linalg.norm(error[:, :3, 3], axis=1) / length_m,
        rotation_rad_per_m=np.arccos(np.clip(cosine, -1, 1)) / length_m,
        speed_mps=length_m / (interval_s * (last - first + 1)),
        possible=int(inside.sum()),
    )


def by_length(segments: Segments) -> list[SegmentAverage]:
    """Average over the segments of each length that has at least three."""
    return _averages(segments, [(length, segments.length_m == length) for length in LENGTHS_M])


def by_speed(segments: Segments) -> list[SegmentAverage]:
    """Average over the segments less than 2 m/s from each of 2, 4, ..., 24 m/s; a segment counts in two of them."""
    near = [(speed, np.abs(segments.speed_mps - speed) < SPEED_REACH_MPS) for speed in SPEEDS_MPS]
    return _averages(segments, near)


def _averages(segments: Segments, chosen: list[tuple[int, np.ndarray]]) -> list[SegmentAverage]:
    """Average over each choice of segments that is large enough."""
    return [
        SegmentAverage(
            float(at),
            _average(segments.translation[of_these]) * 100,
            float(np.rad2deg(_average(segments.rotation_rad_per_m[of_these]))) * 100,
            int(of_these.sum()),
        )
        for at, of_these in chosen
        if of_these.sum() >= FEWEST_SEGMENTS
    ]


def _average(values: np.ndarray) -> float:
    """Return the mean of enough values, else NaN."""
    return float(values.mean()) if len(values) >= FEWEST_SEGMENTS else float("nan")
