"""The tables of nuScenes v1.0, read row by row: as much of them as the poses of its front camera need.

A version is a folder of JSON files, each a list of rows that name each other by token. sample_data and ego_pose have
2.6 million rows in v1.0-trainval: parsed as a whole they take several GB, so rows are decoded one at a time and most of
them dropped at once.

Source: Caesar et al., "nuScenes: A multimodal dataset for autonomous driving", CVPR 2020, and the schema published with
it. The development kit is not needed.
"""

import array
import dataclasses
import functools
import json
import math
import operator
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any, NamedTuple, TextIO

import numpy as np

from mdnvo_jax.data.sequence import Camera
from mdnvo_jax.errors import InputError

CAMERA = "CAM_FRONT"
TABLES = ("sensor", "calibrated_sensor", "scene", "sample", "sample_data", "ego_pose")
# Characters read at once, and how long a row may be: the longest in use has under a thousand.
_CHUNK = 1 << 20
_LONGEST_ROW = 1 << 16
# Fields whose values are text.
_TEXTS = frozenset(
    (
        *("token", "channel", "name", "description", "filename", "scene_token", "sample_token", "sensor_token"),
        *("ego_pose_token", "calibrated_sensor_token"),
    )
)
# Microseconds since 1970 until the year 2255: those that float64 has exactly.
_LATEST_US = 1 << 53
_BETWEEN_ROWS = re.compile(r"[\s,]*")
# Tables larger than this are announced: reading them takes more than a few seconds.
_LARGE_BYTES = 200_000_000

# Translation x, y, z in m, then quaternion w, x, y, z.
Rigid = tuple[float, float, float, float, float, float, float]


class SceneRow(NamedTuple):
    """A row of scene.json."""

    token: str
    name: str
    description: str


class Image(NamedTuple):
    """A row of sample_data.json of the front camera; microseconds since 1970, `size` is (height, width).

    `calibration` is a token, `ego` the number of a row of `Tables.egos`.
    """

    time_us: int
    file: str
    is_key_frame: bool
    calibration: str
    ego: int
    size: tuple[int, int]


class Calibration(NamedTuple):
    """A row of calibrated_sensor.json: `T_ego_camera` and the intrinsics of one camera on one vehicle."""

    placement: Rigid
    camera: Camera


@dataclasses.dataclass(frozen=True)
class Tables:
    """What the tables of one version say about the front camera.

    Attributes:
      folder: the folder of the tables.
      scenes: by name.
      images: of each scene, by its token, in the order of time.
      calibrations: by token.
      egos: `T_global_ego` at a time, `[E, 8]` float64: microseconds (exact), then as in `Rigid`; NaN where missing.
      tracks: numbers of the ego poses of every sensor's rows in a scene, by its token; empty if not asked for.
    """

    folder: Path
    scenes: dict[str, SceneRow]
    images: dict[str, list[Image]]
    calibrations: dict[str, Calibration]
    egos: np.ndarray
    tracks: dict[str, array.array]


def read_tables(root: str | Path, version: str, *, every_sensor: bool) -> Tables:
    """Return the tables in `root/version`; those read last stay in memory, and are read again when a file changes.

    A token that occurs twice with the same row counts once. The links `next` and `prev` are not followed, so that it
    does not matter where they lead: the images of a scene are those whose sample is in it, by time.

    Args:
      root: the folder that holds samples, sweeps and the versions.
      version: such as v1.0-mini or v1.0-trainval.
      every_sensor: also keep the ego poses of the other sensors' rows. v1.0-trainval then takes about 0.8 GB, and
        0.3 GB without; reading it takes about half a minute either way.

    Raises:
      InputError: a table is missing or malformed, or a token leads nowhere or to two rows.
    """
    folder = Path(root) / version
    if not folder.is_dir():
        there = sorted(path.name for path in Path(root).glob("v1.0-*") if path.is_dir())
        raise InputError(
            f"no folder {version} in {root}: found {', '.join(there) or 'no v1.0-* folder'}; set data.root to the "
            "folder that holds samples, sweeps and v1.0-mini or v1.0-trainval, and data.version to one that is there"
        )
    paths = [folder / f"{name}.json" for name in TABLES]
    missing = [path.name for path in paths if not path.is_file()]
    if missing:
        raise InputError(f"{folder} has no {', '.join(missing)}: expected the metadata of nuScenes v1.0")
    stats = [path.stat() for path in paths]
    return _read_tables(folder, every_sensor, tuple((stat.st_size, stat.st_mtime_ns) for stat in stats))


# Two: with and without every sensor.
@functools.lru_cache(maxsize=2)
def _read_tables(folder: Path, every_sensor: bool, stamps: tuple[tuple[int, int], ...]) -> Tables:
    size = sum(size for size, _ in stamps)
    if size > _LARGE_BYTES:
        print(f"reading {size / 1e9:.1f} GB of tables in {folder}: this takes a while", file=sys.stderr)
    channels: dict[str, str] = dict(rows(folder / "sensor.json", ("token", "channel")))
    sensors, calibrations = _calibrations(folder / "calibrated_sensor.json", channels)
    scenes = _scenes(folder / "scene.json")
    scene_of: dict[str, str] = dict(rows(folder / "sample.json", ("token", "scene_token")))
    images, numbers, tracks = _images(folder / "sample_data.json", sensors, calibrations, scene_of, every_sensor)
    egos = _egos(folder / "ego_pose.json", numbers)
    return Tables(folder, scenes, images, calibrations, egos, tracks)


def rows(path: Path, fields: tuple[str, str, *tuple[str, ...]]) -> Iterator[tuple[Any, ...]]:
    """Yield `fields` of every row of a table, holding no more of the file than a megabyte.

    Raises:
      InputError: the file is no JSON list of objects that have these fields; the message names the line.
    """
    pick = operator.itemgetter(*fields)
    texts = [index for index, name in enumerate(fields) if name in _TEXTS]
    decode = json.JSONDecoder().raw_decode
    line = 1
    with path.open(encoding="utf-8") as file:
        text = _more(file, path)
        at = len(text) - len(text.lstrip())
        if text[at : at + 1] != "[":
            raise InputError(f"{path} does not begin with [: expected a JSON list of rows; unpack the metadata again")
        at += 1
        while True:
            between = _BETWEEN_ROWS.match(text, at)
            at = between.end() if between else at
            if text[at : at + 1] == "]":
                if (text[at + 1 :] + _more(file, path)).strip():
                    raise _malformed(path, line, text[: at + 1], "something comes after the last row")
                return
            try:
                row, end = decode(text, at)
            except json.JSONDecodeError as error:
                # The row may go on in the next chunk.
                more = _more(file, path) if len(text) - at < _LONGEST_ROW else ""
                if not more:
                    what = "the file ends too early" if error.pos >= len(text) else error.msg
                    raise _malformed(path, line, text[: error.pos], what) from error
                line += text.count("\n", 0, at)
                text, at = text[at:] + more, 0
                continue
            except (ValueError, RecursionError) as error:
                # A number of thousands of digits, or lists in lists in lists.
                raise _malformed(path, line, text[:at], str(error)) from error
            try:
                found = pick(row)
            except (KeyError, TypeError) as error:
                lacking = [name for name in fields if not isinstance(row, dict) or name not in row]
                raise _malformed(path, line, text[:at], f"a row without {', '.join(lacking)}") from error
            for index in texts:
                if type(found[index]) is not str:
                    what = f"{fields[index]} {str(found[index])[:40]} is no text"
                    raise _malformed(path, line, text[:at], what)
            yield found
            at = end


def _malformed(path: Path, line: int, before: str, what: str) -> InputError:
    """Return the complaint about what comes after `before`, which begins in `line`."""
    line += before.count("\n")
    return InputError(f"{path}, line {line}: {what}: expected a table of nuScenes v1.0; unpack the metadata again")


def _more(file: TextIO, path: Path) -> str:
    try:
        return file.read(_CHUNK)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path} ({error}): expected a JSON table of nuScenes v1.0") from error


def _scenes(path: Path) -> dict[str, SceneRow]:
    """Return the scenes by name."""
    scenes: dict[str, SceneRow] = {}
    for row in map(SceneRow._make, rows(path, SceneRow._fields)):
        if scenes.setdefault(row.name, row) != row:
            raise InputError(f"{path} has two scenes {row.name}: expected each name once")
    if not scenes:
        raise InputError(f"{path} has no scene: unpack the metadata again")
    return scenes


def _calibrations(path: Path, channels: dict[str, str]) -> tuple[set[str], dict[str, Calibration]]:
    """Return the tokens of all calibrated sensors, and the calibrations of the front camera."""
    sensors: set[str] = set()
    calibrations: dict[str, Calibration] = {}
    fields = ("token", "sensor_token", "translation", "rotation", "camera_intrinsic")
    for token, sensor, translation, rotation, intrinsic in rows(path, fields):
        sensors.add(token)
        if channels.get(sensor) != CAMERA:
            continue
        where = f"{path}, token {token}"
        found = Calibration(_rigid(translation, rotation, where), _camera(intrinsic, where))
        if calibrations.setdefault(token, found) != found:
            raise InputError(f"{where}: two rows that differ: expected each token once")
    if not calibrations:
        raise InputError(f"{path} has no row of a sensor {CAMERA}: found sensors {', '.join(channels.values())}")
    return sensors, calibrations


def _images(
    path: Path, sensors: set[str], calibrations: dict[str, Calibration], scene_of: dict[str, str], every_sensor: bool
) -> tuple[dict[str, list[Image]], dict[str, int], dict[str, array.array]]:
    """Return images by scene in the order of time, numbers of the ego poses by token, and of those in a scene."""
    by_token: dict[str, Image] = {}
    images: dict[str, list[Image]] = defaultdict(list)
    numbers: dict[str, int] = {}
    tracks: dict[str, array.array] = defaultdict(lambda: array.array("q"))
    fields = (
        *("token", "sample_token", "ego_pose_token", "calibrated_sensor_token"),
        *("timestamp", "filename", "is_key_frame", "height", "width"),
    )
    for token, sample, ego, sensor, time_us, file, is_key_frame, height, width in rows(path, fields):
        scene = scene_of.get(sample)
        if every_sensor and scene is not None:
            tracks[scene].append(numbers.setdefault(ego, len(numbers)))
        if sensor not in calibrations:
            if sensor not in sensors:
                raise InputError(f"{path}, token {token}: no calibrated_sensor {sensor}: unpack the metadata again")
            continue
        if scene is None:
            raise InputError(f"{path}, token {token}: no sample {sample}: unpack the metadata again")
        number = numbers.setdefault(ego, len(numbers))
        try:
            found = Image(int(time_us), str(file), bool(is_key_frame), sensor, number, (int(height), int(width)))
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{path}, token {token}: {error}: expected timestamp, height and width") from error
        if not 0 <= found.time_us <= _LATEST_US:
            raise InputError(f"{path}, token {token}: timestamp {str(time_us)[:40]}: expected microseconds since 1970")
        if "\0" in file or ".." in PurePath(file).parts or PurePath(file).is_absolute():
            # Such a name would lead to files that nobody meant to show.
            raise InputError(
                f"{path}, token {token}: filename {file[:80]!r}: expected a path below the data set's root"
            )
        if token not in by_token:
            by_token[token] = found
            images[scene].append(found)
        elif by_token[token] != found:
            raise InputError(f"{path}, token {token}: two rows that differ: expected each token once")
    for found_here in images.values():
        found_here.sort(key=lambda image: image.time_us)
    return dict(images), numbers, dict(tracks)


def _egos(path: Path, numbers: dict[str, int]) -> np.ndarray:
    """Return the ego poses of these numbers, as `Tables.egos`."""
    egos = np.full((len(numbers), 8), np.nan)
    for token, time_us, translation, rotation in rows(path, ("token", "timestamp", "translation", "rotation")):
        number = numbers.get(token)
        if number is None:
            continue
        where = f"{path}, token {token}"
        pose = _rigid(translation, rotation, where)
        try:
            found = float(time_us), *pose
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{where}: timestamp {str(time_us)[:40]}: expected microseconds") from error
        if not 0 <= found[0] <= _LATEST_US:
            raise InputError(f"{where}: timestamp {found[0]:.3g}: expected microseconds since 1970")
        if not np.isnan(egos[number, 0]) and tuple(egos[number]) != found:
            raise InputError(f"{where}: two rows that differ: expected each token once")
        egos[number] = found
    return egos


def _rigid(translation: Any, rotation: Any, where: str) -> Rigid:
    """Return the seven numbers of a rigid motion."""
    try:
        x, y, z = translation
        w, i, j, k = rotation
        values = float(x), float(y), float(z), float(w), float(i), float(j), float(k)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: expected a translation of 3 numbers and a rotation of 4 (w, x, y, z)") from error
    # A quaternion has length 1 up to the digits of the file; what has not, such as NaN, is no rotation.
    if not (abs(sum(value * value for value in values[3:]) - 1) < 1e-3 and all(map(math.isfinite, values))):
        raise InputError(f"{where}: translation {translation}, rotation {rotation}: expected metres, a unit quaternion")
    return values


def _camera(intrinsic: Any, where: str) -> Camera:
    """Return the intrinsics in a 3x3 matrix."""
    try:
        matrix = np.array(intrinsic, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise InputError(f"{where}: camera_intrinsic {intrinsic}: expected the 3x3 matrix of a camera")
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
