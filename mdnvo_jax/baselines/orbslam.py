"""ORB-SLAM as a rival: `python -m mdnvo_jax.baselines.orbslam IMAGES --vocabulary FILE --output DIR`.

The real thing: ORB-SLAM3 (Campos et al., "ORB-SLAM3: An Accurate Open-Source Library for Visual, Visual-Inertial, and
Multimap SLAM", IEEE Transactions on Robotics, 2021) through `pyorbslam3`, monocular, with loop closing off, so that it
does odometry as the network does. It is under the GPL-3: an extra, called in a process of its own. Its trajectory has
an unknown scale, and misses the frames before it initialised and those where it was lost.

What is written to DIR, frames being numbered from 0 as they lie in IMAGES, whatever the stride:

| file | content |
|---|---|
| trajectory_kitti_indexed.txt | a line a tracked frame: its number, the 12 numbers of `T_world_camera`, row by row |
| trajectory_tum.txt | the same poses as `timestamp tx ty tz qx qy qz qw`; frame numbers for want of timestamps |
| summary.json | frames, coverage, what was lost, settings, versions, times |

Exit codes: 0; 2 for what the user can mend; 3 for no trajectory, where only summary.json is written and tables print
"-"; 4 where ORB-SLAM died on the way, and what it had tracked by then is written.
"""

import hashlib
import json
import shlex
import sys
import time
from collections.abc import Callable, Iterable
from collections.abc import Sequence as Many
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from mdnvo_jax import files
from mdnvo_jax.baselines import orbslam_system
from mdnvo_jax.baselines.orbslam_system import BEFORE_A_MAP, TRACKED, Answer, ProcessError, System
from mdnvo_jax.config import intrinsics
from mdnvo_jax.errors import InputError, Parser, exit_code

if TYPE_CHECKING:
    from mdnvo_jax.data.sequence import Sequence

Poses = Literal["final", "live"]

# Poses that make a step.
_FEWEST = 2
# Exit codes.
NO_TRAJECTORY = 3
DIED = 4
# KITTI's, for frames that come without timestamps.
_DEFAULT_RATE_HZ = 10.0
# Of ORB-SLAM3's own settings for KITTI.
FEATURES = 2000
# More than mapping took on any frame of KITTI, on two cores that were busy with other work.
PATIENCE_S = 5.0
INDEXED, TUM, SUMMARY = "trajectory_kitti_indexed.txt", "trajectory_tum.txt", "summary.json"


@dataclass(frozen=True)
class Tracked:
    """What ORB-SLAM made of a sequence.

    Attributes:
      count: frames of the sequence.
      indices: of the frames that have a pose, `[n]` int64, increasing.
      poses: their `T_world_camera`, `[n, 4, 4]` float64, up to an unknown scale.
      kind: "final", as the last optimisation left them, or "live", each as it was when its frame came in.
      states: of tracking after each frame, in ORB-SLAM's words: `count` of them, or fewer where it died.
      maps: first and last frame tracked, and how many, of every map that was begun. Maps are worlds apart, each with
        a scale of its own: the poses are of one of them.
      track_s: what tracking took, by frame, s.
      settle_s: how long mapping was then waited for, by frame, s.
      unsettled: frames after which mapping was not done in the time it was given.
      settings: what it ran with, by name.
      died: how ORB-SLAM died, or empty.
    """

    count: int
    indices: np.ndarray
    poses: np.ndarray
    kind: Poses
    states: Many[str]
    maps: Many[tuple[int, int, int]]
    track_s: np.ndarray
    settle_s: np.ndarray
    unsettled: int
    settings: dict[str, Any]
    died: str = ""


def track(
    sequence: "Sequence",
    vocabulary: str | Path,
    *,
    features: int = FEATURES,
    rate_hz: float | None = None,
    patience_s: float = PATIENCE_S,
    poses: Poses = "final",
    progress: Callable[[Iterable[int], int], Iterable[int]] | None = None,
) -> Tracked:
    """Run ORB-SLAM over a sequence.

    Frames are fed one at a time: the next one when the last is tracked, the map has taken it in, and `1 / rate_hz` has
    gone by. Mapping turns key frames down while it is busy, so that it loses track when it is rushed; thus a slow or
    loaded machine makes the run longer, not worse.

    Args:
      sequence: grey frames, `[h, w, 1]`, without distortion, with a camera. Its timestamps, if any, must increase.
      vocabulary: a file for `orbslam_system.unpack_vocabulary`.
      features: ORB features a frame.
      rate_hz: frames fed a second, at most; None for the rate of the timestamps, or KITTI's (10) where there are none.
      patience_s: how long to wait at most for the map to take in a frame; with 0, `rate_hz` alone sets the pace.
      poses: "final" for the trajectory that ORB-SLAM saves at its end, in which later frames have improved earlier
        ones; "live" for what it said of each frame at once.
      progress: wraps the iterator over frames to show how far it is; told their number.

    Returns:
      The poses of the frames after which the state of tracking was OK: none where it never initialised. Of several maps
      they are of the one with most key frames ("final") or most frames ("live"). Live ones stand in where ORB-SLAM has
      no map left to save, since it throws away one that it soon loses, or dies on the way: then `died` says how.

    Raises:
      InputError: pyorbslam3 is not installed or does not load, the vocabulary is none, the sequence has no camera or
        times that do not increase, an option is out of range, or a frame cannot be read.
    """
    from mdnvo_jax.data.sequence import rigid

    orbslam_system.require()
    if sequence.camera is None:
        raise InputError(f"{sequence.name} has no camera: ORB-SLAM needs the intrinsics: give --camera fx,fy,cx,cy")
    times_s, own_rate_hz = _times(sequence)
    fed_hz = own_rate_hz if rate_hz is None else rate_hz
    settings = {
        "camera": list(sequence.camera),
        "features": features,
        "scale_factor": orbslam_system.SCALE_FACTOR,
        "levels": orbslam_system.LEVELS,
        "fast_thresholds": list(orbslam_system.FAST_THRESHOLDS),
        "rate_hz": fed_hz,
        "patience_s": patience_s,
    }
    if features < 1 or not 0 < fed_hz < np.inf or not 0 <= patience_s < np.inf:
        raise InputError(
            f"{features} features, {fed_hz:g} Hz, patience {patience_s:g} s: expected numbers above 0 (patience: or 0)"
        )
    height, width = _grey(sequence, 0).shape
    if poses not in get_args(Poses):
        raise InputError(f"poses {poses!r}: expected 'final' or 'live'")
    answers: list[Answer] = []
    final, died = None, ""
    with System(
        vocabulary, sequence.camera, (height, width), features=features, rate_hz=own_rate_hz, patience_s=patience_s
    ) as system:
        every = range(sequence.count)
        try:
            for index in every if progress is None else progress(every, sequence.count):
                image = _grey(sequence, index)
                begin = time.monotonic()
                answers.append(system.track(image, times_s[index]))
                time.sleep(max(0.0, begin + 1 / fed_hz - time.monotonic()))
            # Asked for a trajectory before it has a map, it crashes.
            if poses == "final" and any(answer.state == TRACKED for answer in answers):
                final = _final(*system.finish(), times_s, answers)
        except ProcessError as error:
            # It also crashes when it has thrown its map away, after losing track soon, and saves none: no accident.
            if len(answers) < sequence.count or answers[-1].state not in BEFORE_A_MAP:
                died = str(error)
    maps = maps_of([answer.state for answer in answers])
    if final is not None and len(final[0]) < _FEWEST:
        final = None
    indices, found = _live(answers, maps) if final is None else final
    return Tracked(
        count=sequence.count,
        indices=indices,
        poses=rigid(found),
        kind="live" if final is None else "final",
        states=[answer.state for answer in answers],
        maps=maps,
        track_s=np.array([answer.track_s for answer in answers]),
        settle_s=np.array([answer.settle_s for answer in answers]),
        unsettled=sum(not answer.settled for answer in answers),
        settings=settings,
        died=died,
    )


def maps_of(states: Many[str]) -> list[tuple[int, int, int]]:
    """Return first frame, last frame and number of frames tracked of each map, in order.

    A map begins where tracking is OK after there was none; to be lost for a while does not end it.
    """
    runs: list[list[int]] = []
    in_map = False
    for index, state in enumerate(states):
        if state in BEFORE_A_MAP:
            in_map = False
        elif state == TRACKED:
            if not in_map:
                runs.append([])
            in_map = True
            runs[-1].append(index)
    return [(run[0], run[-1], len(run)) for run in runs]


def write(tracked: Tracked, directory: Path, numbers: np.ndarray, timestamps: np.ndarray | None, **about: Any) -> None:
    """Write the files of a run; where it has no trajectory, those that an earlier run left are removed.

    Args:
      tracked: the run.
      directory: an existing folder.
      numbers: of each frame of the sequence, `[count]`.
      timestamps: of each frame, `[count]`, s, or None.
      about: what summary.json is to say besides.
    """
    from mdnvo_jax import geometry

    if has_trajectory(tracked):
        frames = numbers[tracked.indices]
        stamps = frames if timestamps is None else timestamps[tracked.indices]
        quaternions = geometry.quaternion_from_matrix(tracked.poses[:, :3, :3])
        indexed = [f"{frame} {_row(pose[:3])}\n" for frame, pose in zip(frames, tracked.poses, strict=True)]
        rows = np.concatenate([tracked.poses[:, :3, 3], quaternions], axis=1)
        tum = [f"{stamp:.9f} {_row(row)}\n" for stamp, row in zip(stamps, rows, strict=True)]
        files.write_text(directory / INDEXED, "".join(indexed))
        files.write_text(directory / TUM, "".join(tum))
    else:
        for name in (INDEXED, TUM):
            (directory / name).unlink(missing_ok=True)
    summary = {
        **summarise(tracked, numbers),
        "timestamps": "frame numbers" if timestamps is None else "given",
        **about,
    }
    files.write_text(directory / SUMMARY, json.dumps(summary, indent=2) + "\n")


def has_trajectory(tracked: Tracked) -> bool:
    """Return whether there is a step to judge."""
    return len(tracked.indices) >= _FEWEST


def failure(tracked: Tracked) -> str:
    """Return what went wrong, in a line, or nothing."""
    if tracked.died:
        return f"ORB-SLAM died after {len(tracked.states)} of {tracked.count} frames: {tracked.died}"
    if not has_trajectory(tracked):
        how = "lost track as soon as it had initialised" if tracked.maps else "did not initialise"
        return f"no trajectory: ORB-SLAM {how} ({tracked.count} frames, {tracked.settings['features']} features)"
    return ""


def summarise(tracked: Tracked, numbers: np.ndarray) -> dict[str, Any]:
    """Return what summary.json says of a run whose frames have `numbers`, `[count]`."""
    indices = tracked.indices if has_trajectory(tracked) else tracked.indices[:0]
    lost = np.setdiff1d(np.arange(tracked.count), indices)
    gaps = np.split(lost, np.flatnonzero(np.diff(lost) > 1) + 1) if len(lost) else []
    return {
        "method": "ORB-SLAM3, monocular, loop closing off",
        "frames": tracked.count,
        "tracked": len(indices),
        "coverage": len(indices) / tracked.count,
        "first_tracked": int(numbers[indices[0]]) if len(indices) else None,
        "last_tracked": int(numbers[indices[-1]]) if len(indices) else None,
        "lost_frames": [[int(numbers[gap[0]]), int(numbers[gap[-1]])] for gap in gaps],
        "maps": [
            {"first": int(numbers[first]), "last": int(numbers[last]), "tracked": count}
            for first, last, count in tracked.maps
        ],
        "poses": tracked.kind,
        "scale": "up to an unknown scale: align with Sim(3) before metres are compared",
        "failure": failure(tracked) or None,
        "settings": tracked.settings,
        "median_ms_per_frame": {
            "tracking": _median_ms(tracked.track_s),
            "waiting_for_mapping": _median_ms(tracked.settle_s),
        },
        "frames_mapping_did_not_finish": tracked.unsettled,
    }


def main(arguments: Many[str]) -> None:
    """Run ORB-SLAM as the command line says."""
    parser = Parser(
        "python -m mdnvo_jax.baselines.orbslam",
        description="Estimate a trajectory up to scale with ORB-SLAM: monocular, no loop closing.",
        epilog=f"Exit code {NO_TRAJECTORY}: it did not initialise, there is no trajectory. {DIED}: it died on the way.",
    )
    add = parser.add_argument
    add("images", metavar="IMAGES", help="a folder, a glob in quotes, a video, or a KITTI sequence")
    add("--vocabulary", required=True, metavar="FILE", help="ORB words of DBoW2 as .txt, .txt.gz or .tar.gz")
    add("--output", required=True, metavar="DIR", help="the files are written here")
    add("--force", action="store_true", help="overwrite files in --output")
    add("--camera", type=intrinsics, metavar="fx,fy,cx,cy", help="intrinsics of the frames in pixels [calib.txt]")
    add("--timestamps", metavar="FILE", help="a time in seconds a line, one for each frame")
    add("--stride", type=int, default=1, metavar="N", help="use every Nth frame")
    add("--rate", type=float, metavar="HZ", help="feed no more frames a second [that of the timestamps, or 10]")
    add("--patience", type=float, default=PATIENCE_S, metavar="S", help="wait for mapping, 0: never [%(default)s]")
    add("--features", type=int, default=FEATURES, metavar="N", help="ORB features a frame [%(default)s]")
    add("--poses", choices=("final", "live"), default="final", help="as optimised at the end, or as first estimated")
    options = parser.parse_args(arguments)
    orbslam_system.require()
    output = files.claim_output(options.output, force=options.force)

    from mdnvo_jax.data.folder import read_frames
    from mdnvo_jax.training import logs

    def bar(indices: Iterable[int], total: int) -> Iterable[int]:
        return logs.track(indices, "tracking", total)

    frames = read_frames(options.images, 1, stride=options.stride, timestamps=options.timestamps, camera=options.camera)
    tracked = track(
        frames,
        options.vocabulary,
        features=options.features,
        rate_hz=options.rate,
        patience_s=options.patience,
        poses=options.poses,
        progress=bar,
    )
    write(
        tracked,
        output,
        np.arange(frames.count) * options.stride,
        frames.timestamps,
        images=options.images,
        stride=options.stride,
        vocabulary={"file": options.vocabulary, "sha256": _sha256(options.vocabulary)},
        command=shlex.join(sys.orig_argv),
        versions=logs.versions("pyorbslam3"),
    )
    if wrong := failure(tracked):
        print(f"error: {wrong}; {output / SUMMARY} says more", file=sys.stderr)
        raise SystemExit(DIED if tracked.died else NO_TRAJECTORY)
    maps = f", in one of {len(tracked.maps)} maps" if len(tracked.maps) > 1 else ""
    ms = f"{_median_ms(tracked.track_s):.0f} tracking + {_median_ms(tracked.settle_s):.0f} waiting for mapping"
    print(
        f"{len(tracked.indices)} of {tracked.count} frames tracked{maps}, up to scale, {tracked.kind} poses, "
        f"ms a frame {ms}; the files are in {output}"
    )


def _times(sequence: "Sequence") -> tuple[np.ndarray, float]:
    """Return times to feed frames with, `[count]`, s from the first, and their rate, Hz."""
    if sequence.timestamps is None:
        return np.arange(sequence.count) / _DEFAULT_RATE_HZ, _DEFAULT_RATE_HZ
    gaps = np.diff(sequence.timestamps)
    if (wrong := np.flatnonzero(gaps <= 0)).size:
        raise InputError(
            f"{sequence.label(int(wrong[0]) + 1)} is not later than the frame before it: expected timestamps that "
            "increase: mend them"
        )
    return sequence.timestamps - sequence.timestamps[0], float(1 / np.median(gaps))


def _grey(sequence: "Sequence", index: int) -> np.ndarray:
    """Return a frame as grey `[h, w]`."""
    frame = sequence.read(index)
    if frame.shape[2:] != (1,):
        raise InputError(f"{sequence.label(index)} has shape {frame.shape}: expected a grey frame, [h, w, 1]")
    return frame[:, :, 0]


def _live(answers: Many[Answer], maps: Many[tuple[int, int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Return indices and poses as they came in, of the map with most frames."""
    first, last, _ = max(maps, key=lambda found: found[2], default=(0, -1, 0))
    kept = [index for index in range(first, last + 1) if answers[index].state == TRACKED]
    return np.array(kept, np.int64), np.array([answers[index].pose for index in kept]).reshape(-1, 4, 4)


def _final(
    saved_s: np.ndarray, poses: np.ndarray, times_s: np.ndarray, answers: Many[Answer]
) -> tuple[np.ndarray, np.ndarray]:
    """Return indices and poses of a saved trajectory with times `saved_s`, `[n]`, where tracking was OK."""
    indices = np.searchsorted((times_s[1:] + times_s[:-1]) / 2, saved_s)
    # A frame on which tracking was lost for a moment is saved too, with a guess of its pose.
    tracked = np.array([answers[index].state == TRACKED for index in indices], bool)
    return indices[tracked], poses[tracked]


def _row(values: np.ndarray) -> str:
    return " ".join(f"{value:.9e}" for value in values.reshape(-1))


def _median_ms(seconds: np.ndarray) -> float:
    return round(1e3 * float(np.median(seconds)), 1) if len(seconds) else 0.0


def _sha256(path: str) -> str:
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


if __name__ == "__main__":
    raise SystemExit(exit_code(main))
