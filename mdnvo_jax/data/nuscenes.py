"""nuScenes v1.0: scenes of 20 s of the front camera, with poses, conditions and a split for odometry.

The front camera takes about 12 frames a second: it fires as the laser scanner, at 20 revolutions a second, passes its
centre, but not at every one, so that frames are 0.05 or 0.1 s apart, more where some were dropped. About two frames a
second are key frames. Ego poses come from a localisation in the plane: their height is 0, and roll and pitch are small
and hardly vary, so that the labels ty, rx and rz are nearly constant and say little of the true bounce of the car
(`windows.STD_FLOOR` and the floors of the model keep their scales from running to 0).

The split. The benchmark has none for odometry and the paper gives none of its own, so this is ours: the scenes of the
paper's figures (`FIGURE_SCENES`) are for test; any other scene is placed by a hash of its name (`split_of`), 70 % for
training, 10 % for validation, 20 % for test, and so, but for chance, in every condition. A scene is in the same part
whatever else is on disk, in v1.0-mini as in v1.0-trainval. Scenes of one drive may be in different parts. Of the ten
scenes of v1.0-mini, 0655 is for validation, 0757 and 1094 (night) for test, the others for training; the salt of the
hash was chosen for that, so that they will do to try things.

Sources: see `nuscenes_tables`.
"""

import dataclasses
import hashlib
import itertools
import re
from collections.abc import Mapping
from collections.abc import Sequence as Many
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from mdnvo_jax import geometry
from mdnvo_jax.data import images
from mdnvo_jax.data.nuscenes_tables import CAMERA, Image, Tables, read_tables
from mdnvo_jax.data.sequence import Sequence, rigid
from mdnvo_jax.errors import InputError

Condition = Literal["daylight", "rain", "night", "unknown"]
Split = Literal["train", "validation", "test"]

# The scenes that the paper shows: daylight 0972, rain 0572, night 0999, and 0768 for the uncertainty.
FIGURE_SCENES = ("scene-0572", "scene-0768", "scene-0972", "scene-0999")
_SALT = "mdn-vo 118 "
# Frames further apart than this: the camera's longest regular interval is 0.1 s, and one dropped frame makes it 0.15 s.
SWEEP_GAP_S = 0.125
# The same of key frames, which are 0.5 s apart, give or take a revolution of the laser scanner.
KEY_FRAME_GAP_S = 0.75
# Ego poses further apart than this, a little over a key frame's period, are not interpolated: over 0.6 s, a car that
# brakes or turns at 4 m/s^2 is up to 0.18 m from where a constant velocity has it.
_LONGEST_BRIDGE_S = 0.6


class Gap(NamedTuple):
    """A longer time than usual before frame number `frame` of a scene, in s."""

    frame: int
    seconds: float


@dataclasses.dataclass(frozen=True)
class Scene:
    """What is known of a scene without its images.

    Attributes:
      name: such as scene-0061.
      token: in the tables.
      description: as the annotators wrote it.
      condition: see `condition_of`.
      split: see `split_of`.
      frames: of the front camera, key frames among them.
      key_frames: of the front camera.
      gaps: where frames were dropped, counted in all frames; see `find_gaps`.
    """

    name: str
    token: str
    description: str
    condition: Condition
    split: Split
    frames: int
    key_frames: int
    gaps: tuple[Gap, ...]


def scenes(root: str | Path, version: str) -> list[Scene]:
    """Return the scenes of a version, by name, whether or not their images are on disk.

    Args:
      root: the folder that holds samples, sweeps and the versions.
      version: such as v1.0-mini or v1.0-trainval.

    Raises:
      InputError: see `nuscenes_tables.read_tables`, whose memory and time this takes the first time.
    """
    tables = read_tables(root, version, every_sensor=False)
    result = []
    for row in sorted(tables.scenes.values(), key=lambda row: row.name):
        frames = tables.images.get(row.token, [])
        result.append(
            Scene(
                name=row.name,
                token=row.token,
                description=row.description,
                condition=condition_of(row.description),
                split=split_of(row.name),
                frames=len(frames),
                key_frames=sum(frame.is_key_frame for frame in frames),
                gaps=find_gaps(_seconds(frames), SWEEP_GAP_S),
            )
        )
    return result


def read_nuscenes(
    root: str | Path,
    scene: str,
    *,
    version: str,
    channels: int = 3,
    key_frames_only: bool = False,
    interpolate: bool = False,
) -> Sequence:
    """Return the front camera's frames of one scene in the order of time, with poses, times and intrinsics.

    A pose is `T_global_ego @ T_ego_camera` of the image's own rows, in float64, re-based to the first frame. The axes
    of nuScenes' cameras are those of this package. Times are seconds since 1970, as in the file names. Images of
    nuScenes are undistorted.

    With `interpolate`, `T_global_ego` is that at the time of the image, between the ego poses before and after it among
    those of all sensors' rows in the scene: linear in the translation, along the geodesic in the rotation. Where an
    image's own ego pose has the image's time, as in v1.0 itself, that changes nothing; it serves tables whose ego poses
    are of other times or incomplete, such as conversions of other recordings.

    Args:
      root: the folder that holds samples, sweeps and the versions.
      scene: its name, such as scene-0061.
      version: such as v1.0-mini or v1.0-trainval.
      channels: 3 for RGB, 1 for grey; images are converted.
      key_frames_only: two frames a second instead of about twelve.
      interpolate: see above.

    Returns:
      The sequence, named as the scene. Its `read` raises `InputError` for an image that is missing, damaged or not of
      the size that the tables state.

    Raises:
      InputError: the tables are malformed (see `nuscenes_tables.read_tables`), there is no such scene, or it has no
        frame, two frames at one time, two cameras, or a frame without an ego pose.
    """
    tables = read_tables(root, version, every_sensor=interpolate)
    if scene not in tables.scenes:
        names = sorted(tables.scenes)
        raise InputError(f"no scene {scene} in {tables.folder}: found {len(names)}, from {names[0]} to {names[-1]}")
    token = tables.scenes[scene].token
    frames = [frame for frame in tables.images.get(token, []) if frame.is_key_frame or not key_frames_only]
    if not frames:
        raise InputError(f"{tables.folder}: {scene} has no frame of {CAMERA}: leave it out")
    for first, second in itertools.pairwise(frames):
        if first.time_us == second.time_us:
            raise InputError(
                f"{tables.folder}: {first.file} and {second.file} have the same timestamp: expected one frame at a time"
            )
    cameras = {tables.calibrations[frame.calibration].camera for frame in frames}
    if len(cameras) > 1:
        raise InputError(f"{tables.folder}: {scene} has {len(cameras)} intrinsics of {CAMERA}: expected one camera")
    egos = _interpolated_egos(tables, token, frames) if interpolate else _own_egos(tables, frames)
    placements = _matrices(np.array([tables.calibrations[frame.calibration].placement for frame in frames]))
    poses = geometry.compose(egos, placements)
    root = Path(root)
    paths = [str(root / frame.file) for frame in frames]

    def read(index: int) -> np.ndarray:
        image = images.read_image(paths[index], channels)
        height, width = frames[index].size
        if image.shape[:2] != (height, width):
            raise InputError(
                f"{paths[index]} is {image.shape[1]}x{image.shape[0]} but the tables say {width}x{height}, which the "
                "intrinsics are for: expected the original image"
            )
        return image

    return Sequence(
        name=scene,
        count=len(frames),
        read=read,
        timestamps=_seconds(frames),
        poses=rigid(geometry.compose(geometry.inverse(poses[0]), poses)),
        camera=cameras.pop(),
        paths=paths,
    )


def condition_of(description: str) -> Condition:
    """Return the condition that a scene's description names.

    "night" where a word begins with night, whatever the weather; else "rain" where a word begins with rain ("after
    rain" counts: the road is wet); else "daylight". "unknown" where there is no description, as in v1.0-test. Upper and
    lower case are the same.
    """
    for condition in ("night", "rain"):
        if re.search(rf"\b{condition}", description, re.IGNORECASE):
            return condition
    return "daylight" if description.strip() else "unknown"


def split_of(scene: str) -> Split:
    """Return the part that a scene of this name is in: the rule at the top of this module.

    With h the first 8 bytes of the SHA-256 of "mdn-vo 118 " and the name, as a number, most significant byte first:
    h mod 10 of 0 to 6 is for training, 7 for validation, 8 and 9 for test.
    """
    if scene in FIGURE_SCENES:
        return "test"
    tenth = int.from_bytes(hashlib.sha256(f"{_SALT}{scene}".encode()).digest()[:8], "big") % 10
    return "train" if tenth < 7 else "validation" if tenth < 8 else "test"


def find_gaps(timestamps: np.ndarray, longest_s: float) -> tuple[Gap, ...]:
    """Return where `timestamps`, `[N]` s, are more than `longest_s` apart; see `SWEEP_GAP_S` and `KEY_FRAME_GAP_S`."""
    intervals = np.diff(timestamps)
    return tuple(Gap(int(index) + 1, float(intervals[index])) for index in np.flatnonzero(intervals > longest_s))


def missing_images(sequence: Sequence) -> list[str]:
    """Return the paths of a sequence of files that are not on disk."""
    # One by one: a scene has some hundred images, and its folder those of all the others.
    return [path for path in sequence.paths if not Path(path).is_file()]


def left_out(unusable: Mapping[str, Many[str]]) -> list[str]:
    """Return a line on the scenes that were left out for each reason, with the names of up to five of them."""
    return [
        f"scenes left out, {reason}: {len(names)} ({', '.join(names[:5])}{', ...' if len(names) > 5 else ''})"
        for reason, names in unusable.items()
        if names
    ]


def interpolate_poses(times: np.ndarray, poses: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return poses at the times `at`, linear in the translation and along the geodesic in the rotation.

    With s the share of the interval that has passed, `R = R_0 exp(s log(R_0^T R_1))`.

    Args:
      times: `[K]`, increasing, K of 2 or more.
      poses: `[K, 4, 4]` at `times`.
      at: `[N]`, within `times`.

    Returns:
      `[N, 4, 4]` float64.
    """
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    start, end = poses[after - 1], poses[after]
    share = ((at - times[after - 1]) / (times[after] - times[after - 1]))[:, None]
    result = start.copy()
    result[:, :3, 3] += share * (end[:, :3, 3] - start[:, :3, 3])
    turn = geometry.log_so3(np.swapaxes(start[:, :3, :3], 1, 2) @ end[:, :3, :3])
    result[:, :3, :3] = start[:, :3, :3] @ geometry.exp_so3(share * turn)
    return result


def _seconds(frames: list[Image]) -> np.ndarray:
    return np.array([frame.time_us for frame in frames], np.float64) / 1e6


def _matrices(values: np.ndarray) -> np.ndarray:
    """Return x, y, z and the quaternion w, x, y, z, `[N, 7]`, as `[N, 4, 4]`."""
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, 3] = values[:, :3]
    poses[:, :3, :3] = geometry.matrix_from_quaternion(values[:, [4, 5, 6, 3]])
    return poses


def _own_egos(tables: Tables, frames: list[Image]) -> np.ndarray:
    """Return `T_global_ego` by the images' own rows, `[N, 4, 4]`."""
    rows = tables.egos[[frame.ego for frame in frames]]
    missing = np.flatnonzero(np.isnan(rows[:, 0]))
    if len(missing):
        raise InputError(
            f"{tables.folder}: {len(missing)} of {len(frames)} frames have no row in ego_pose.json, the first "
            f"{frames[missing[0]].file}: unpack the metadata again, or bridge them with data.interpolate true"
        )
    return _matrices(rows[:, 1:])


def _interpolated_egos(tables: Tables, scene: str, frames: list[Image]) -> np.ndarray:
    """Return `T_global_ego` at the times of the images, between the ego poses of all sensors, `[N, 4, 4]`."""
    rows = tables.egos[np.array(tables.tracks[scene])]
    rows = rows[~np.isnan(rows[:, 0])]
    # Sensors that fire at once share their ego pose.
    times_us, first = np.unique(rows[:, 0], return_index=True)
    at_us = np.array([frame.time_us for frame in frames], np.float64)
    if len(times_us) < 2:
        raise InputError(f"{tables.folder}: {len(times_us)} ego poses for {len(frames)} frames: expected two or more")
    # Microseconds since 1970 are exact in float64, but only their differences are in seconds.
    times, at = (times_us - times_us[0]) / 1e6, (at_us - times_us[0]) / 1e6
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    apart = times[after] - times[after - 1]
    known = np.isin(at_us, times_us)
    bad = np.flatnonzero(~known & ((at < 0) | (at > times[-1]) | (apart > _LONGEST_BRIDGE_S)))
    if len(bad):
        where = (
            f"between ego poses {apart[bad[0]]:.2f} s apart" if 0 < at[bad[0]] < times[-1] else "beyond the ego poses"
        )
        raise InputError(
            f"{tables.folder}: {len(bad)} of {len(frames)} frames cannot be interpolated, the first, "
            f"{frames[bad[0]].file}, lies {where}: expected poses {_LONGEST_BRIDGE_S} s apart or less on both sides"
        )
    return interpolate_poses(times, _matrices(rows[first, 1:]), at)
