"""Files of camera poses: the formats that estimates and ground truth come in, told apart by what is in them.

| format | a line | frames known by |
|---|---|---|
| `kitti` | the 12 numbers of `T_world_camera`, row by row | the line, if no frame is missing |
| `indexed` | the frame number, then those 12 numbers | the number |
| `tum` | `timestamp tx ty tz qx qy qz qw` | the timestamp, s |
| `euroc` | csv: `timestamp[ns],tx,ty,tz,qw,qx,qy,qz,...`, with a header line | the timestamp |
| `output` | the folder that `predict` or `baselines.orbslam` writes | the line, the timestamp; the number |

12 numbers a line are `kitti`, 13 are `indexed`, 8 are `tum`, a csv with a header line that begins with `#timestamp` or
`timestamp` is `euroc`. A csv without a header could be several things, so the caller has to say which.
"""

import codecs
import dataclasses
import json
import os
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from mdnvo_jax.errors import InputError
from mdnvo_jax.files import LARGEST_NUMBER

if TYPE_CHECKING:
    from mdnvo_jax.mixture import Coupling, Mixture

Format = Literal["kitti", "indexed", "tum", "euroc", "output"]
FORMATS: tuple[Format, ...] = get_args(Format)

# What output folders hold: of predict, and of baselines.orbslam.
_KITTI, _INDEXED, _SUMMARY = "trajectory_kitti.txt", "trajectory_kitti_indexed.txt", "summary.json"
# Numbers a line of each text format. EuRoC's ground truth has velocities and biases after the first eight: 17 columns.
_COLUMNS: dict[Format, int] = {"kitti": 12, "indexed": 13, "tum": 8, "euroc": 8}
_BY_COLUMNS: dict[int, Format] = {12: "kitti", 13: "indexed", 8: "tum"}
_FORMAT_HINT = f"say what it is with --format ({', '.join(FORMATS)})"
# What a rotation or a unit quaternion may be off by: files with three decimals pass, Sim(3) matrices do not.
_ROTATION_TOLERANCE = 1e-2
_NANOSECONDS = 1e-9
# Python's float() also takes "1_000" and "nan"; a pose file with an underscore in a number is damaged.
_NUMBER = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|inf|infinity|nan)", re.ASCII | re.IGNORECASE)


@dataclass(frozen=True)
class PoseFile:
    """The poses of one file, in the order of time.

    Attributes:
      path: where they came from, as given.
      format: one of `FORMATS`.
      poses: `T_world_camera`, `[n, 4, 4]` float64, rotations in SO(3), translations in metres.
      frames: `[n]` int64 frame numbers, increasing, or None where the file does not state them.
      timestamps: `[n]` float64 seconds, increasing, or None.
      mixture: the predicted density of each step, batch shape `[n-1]`, from our own output folder, or None.
      coupling: how that density combines its dimensions.
    """

    path: str
    format: Format
    poses: np.ndarray
    frames: np.ndarray | None = None
    timestamps: np.ndarray | None = None
    mixture: "Mixture | None" = None
    coupling: "Coupling" = "independent"


def read_trajectory(path: str | os.PathLike[str], *, format: Format | None = None) -> PoseFile:
    """Read a file of poses, or the output folder of `predict` or `baselines.orbslam`.

    Rotations are projected onto SO(3), since files carry few digits. Lines out of order are sorted by frame number or
    timestamp. Lines that are empty or begin with `#` are skipped.

    Args:
      path: the file or folder.
      format: what it is; None tells by what is in it.

    Raises:
      InputError: no such file, not text, no poses, a line with the wrong count of numbers, something that is no number,
        not finite, no rotation, not a unit quaternion, a frame or timestamp twice, or a format that cannot be told.
    """
    path = Path(path)
    if path.is_dir():
        if format not in (None, "output"):
            raise InputError(f"{path} is a folder; expected a file of format {format}: name the file in it")
        return _read_output(path)
    if format == "output":
        raise InputError(f"{path} is no folder: expected one that predict wrote, with trajectory_kitti.txt in it")
    lines = _text_lines(path)
    if format is None:
        format = _tell_format(path, lines)
    numbers, positions = _parse(path, lines, format)
    if format in ("kitti", "indexed"):
        poses = _poses_from_rows(path, numbers[:, -12:], positions)
        if format == "kitti":
            return PoseFile(str(path), format, poses)
        frames = _frame_numbers(path, numbers[:, 0], positions)
        order = _increasing(path, frames, positions, "frame")
        return PoseFile(str(path), format, poses[order], frames=frames[order])
    if format == "euroc":
        timestamps, quaternions = numbers[:, 0] * _NANOSECONDS, numbers[:, [5, 6, 7, 4]]
    else:
        timestamps, quaternions = numbers[:, 0], numbers[:, 4:8]
    poses = _poses_from_quaternions(path, numbers[:, 1:4], quaternions, positions)
    order = _increasing(path, timestamps, positions, "timestamp")
    return PoseFile(str(path), format, poses[order], timestamps=timestamps[order])


def why_lost(path: str | os.PathLike[str]) -> str:
    """Return why a run of `baselines.orbslam` left no trajectory in the folder `path`; nothing where that is not so.

    Raises:
      InputError: its summary is damaged.
    """
    summary = _read_summary(Path(path) / _SUMMARY)
    return str(summary.get("failure") or "no trajectory") if summary.get("tracked") == 0 else ""


def read_times(path: str | os.PathLike[str]) -> np.ndarray:
    """Read a file of one timestamp a line (KITTI's `times.txt`): `[N]` float64 seconds.

    Raises:
      InputError: as `read_trajectory`, or the times do not increase.
    """
    path = Path(path)
    lines = _text_lines(path)
    times = np.array([_numbers(path, line, text, 1, "one timestamp in seconds")[0] for line, text in lines])
    if (falls := np.flatnonzero(np.diff(times) <= 0)).size:
        line = lines[int(falls[0]) + 1][0]
        raise InputError(f"{path}, line {line}: the time does not increase: expected one timestamp a frame, in order")
    return times


def _text_lines(path: Path) -> list[tuple[int, str]]:
    """Return (line number, text) of the lines of `path` that are not blank; the number counts from 1."""
    if not path.exists():
        raise InputError(f"no such file: {path}: expected a file of poses, or an output folder of predict")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path} ({error.strerror}): expected a file of poses") from error
    # Windows shells write a byte order mark, and UTF-16 when output is redirected with `>`.
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text file: expected numbers, one pose a line") from error
    if "\0" in text:
        raise InputError(f"{path} is a binary file: expected text, one pose a line")
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    if all(line.startswith("#") or _is_header(line) for _, line in lines):
        raise InputError(f"{path} holds no poses: expected one a line")
    return lines


def _is_header(text: str) -> bool:
    """Return whether `text` is the first line of a EuRoC csv."""
    return "," in text and text.lstrip("# ").lower().startswith("timestamp")


def _tell_format(path: Path, lines: list[tuple[int, str]]) -> Format:
    """Return the format of a text file, by its header and by the count of numbers in its first line of data."""
    first = next(i for i, (_, text) in enumerate(lines) if not text.startswith("#") and not _is_header(text))
    number, text = lines[first]
    if "," in text:
        if any(_is_header(before) for _, before in lines[:first]):
            return "euroc"
        raise InputError(f"{path}, line {number}: a csv without a header line, which could be several: {_FORMAT_HINT}")
    columns = len(text.split())
    if columns not in _BY_COLUMNS:
        raise InputError(
            f"{path}, line {number}: {columns} entries; expected 12 (KITTI), 13 (frame number + KITTI), "
            f"8 (TUM) or a EuRoC csv with its header: convert it, or {_FORMAT_HINT}"
        )
    return _BY_COLUMNS[columns]


def _parse(path: Path, lines: list[tuple[int, str]], format: Format) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers `[n, columns]` of the lines of data, and the line number of each, `[n]`."""
    described = {
        "kitti": "the 12 numbers of a pose",
        "indexed": "a frame number and the 12 numbers of a pose",
        "tum": "timestamp tx ty tz qx qy qz qw",
        "euroc": "timestamp,tx,ty,tz,qw,qx,qy,qz",
    }[format]
    columns = _COLUMNS[format]
    rows, positions = [], []
    for position, text in lines:
        if text.startswith("#") or (format == "euroc" and _is_header(text)):
            continue
        rows.append(_numbers(path, position, text, columns, described, more=format == "euroc"))
        positions.append(position)
    return np.array(rows), np.array(positions)


def _numbers(path: Path, line: int, text: str, count: int, described: str, *, more: bool = False) -> list[float]:
    """Return the first `count` numbers of `text`; others may follow where `more`."""
    entries = re.split(r"\s*,\s*|\s+", text.rstrip(", "))
    if len(entries) != count and not (more and len(entries) > count):
        raise InputError(f"{path}, line {line}: {len(entries)} entries; expected {count}: {described}")
    for entry in entries[:count]:
        if not _NUMBER.fullmatch(entry):
            raise InputError(f"{path}, line {line}: {entry[:40]!r} is no number; expected {described}")
    values = [float(entry) for entry in entries[:count]]
    if not (np.abs(values) <= LARGEST_NUMBER).all():
        raise InputError(f"{path}, line {line}: a number that is not finite; expected {described}")
    return values


def _frame_numbers(path: Path, values: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return the first column of an `indexed` file as integers."""
    wrong = np.flatnonzero((values != np.round(values)) | (values < 0))
    if wrong.size:
        raise InputError(
            f"{path}, line {positions[wrong[0]]}: frame number {values[wrong[0]]:g}; expected a whole number from 0 up"
        )
    return values.astype(np.int64)


def _increasing(path: Path, keys: np.ndarray, positions: np.ndarray, what: str) -> np.ndarray:
    """Return the order that sorts `keys`, which must all differ."""
    order = np.argsort(keys, kind="stable")
    twice = np.flatnonzero(np.diff(keys[order]) == 0)
    if twice.size:
        line = positions[order[twice[0] + 1]]
        raise InputError(
            f"{path}, line {line}: {what} {keys[order[twice[0]]]:.15g} is there twice: keep one line of it"
        )
    return order


def _poses_from_rows(path: Path, rows: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return the poses `[n, 4, 4]` of `[n, 12]` numbers, rotations projected onto SO(3)."""
    from mdnvo_jax import geometry

    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    rotations = poses[:, :3, :3]
    deviation = np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    wrong = np.flatnonzero((deviation > _ROTATION_TOLERANCE) | (np.linalg.det(rotations) < 0))
    if wrong.size:
        raise InputError(
            f"{path}, line {positions[wrong[0]]}: columns 1-3 of the 3x4 pose are no rotation "
            f"(R R^T is off by {deviation[wrong[0]]:.2g}, determinant {np.linalg.det(rotations[wrong[0]]):.2g}); "
            "expected T_world_camera row by row, without a scale"
        )
    poses[:, :3, :3] = geometry.project_to_so3(rotations)
    return poses


def _poses_from_quaternions(
    path: Path, translations: np.ndarray, quaternions: np.ndarray, positions: np.ndarray
) -> np.ndarray:
    """Return the poses `[n, 4, 4]` of translations `[n, 3]` and unit quaternions `[n, 4]` (x, y, z, w)."""
    from mdnvo_jax import geometry

    norms = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(np.abs(norms - 1) > _ROTATION_TOLERANCE)
    if wrong.size:
        raise InputError(
            f"{path}, line {positions[wrong[0]]}: the quaternion has norm {norms[wrong[0]]:.4g}; expected 1: "
            "check the order of the columns"
        )
    poses = np.tile(np.eye(4), (len(translations), 1, 1))
    poses[:, :3, 3] = translations
    poses[:, :3, :3] = geometry.matrix_from_quaternion(quaternions / norms[:, None])
    return poses


def _read_output(folder: Path) -> PoseFile:
    """Read the folder that `predict` or `baselines.orbslam` writes."""
    kitti, tum, density = (folder / name for name in (_KITTI, "trajectory_tum.txt", "mixture.npz"))
    if not kitti.is_file():
        if (folder / _INDEXED).is_file():
            return dataclasses.replace(read_trajectory(folder / _INDEXED, format="indexed"), path=str(folder))
        raise InputError(f"{folder} has no {_KITTI}: expected an output folder of predict, or a file")
    summary = _read_summary(folder / _SUMMARY)
    poses = read_trajectory(kitti, format="kitti").poses
    timestamps = None
    # Frames without times are written with their numbers, which are no seconds.
    if tum.is_file() and summary.get("timestamps") != "frame numbers":
        timestamps = read_trajectory(tum, format="tum").timestamps
        assert timestamps is not None
        if len(timestamps) != len(poses):
            raise InputError(
                f"{folder}: {len(poses)} poses in {kitti.name} but {len(timestamps)} in {tum.name}: predict again"
            )
    mixture = _read_mixture(density, len(poses) - 1) if density.is_file() else None
    coupling: Coupling = "joint" if summary.get("coupling") == "joint" else "independent"
    return PoseFile(str(folder), "output", poses, timestamps=timestamps, mixture=mixture, coupling=coupling)


def _read_summary(path: Path) -> dict[str, Any]:
    """Return what summary.json says, nothing where there is none."""
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is not a summary that predict wrote ({error}): predict again") from error
    return found if isinstance(found, dict) else {}


def _read_mixture(path: Path, steps: int) -> "Mixture":
    """Read the densities of `steps` steps."""
    from mdnvo_jax.mixture import Mixture

    try:
        # Opened here: numpy leaves a file open whose archive is damaged.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            leaves: list[Any] = [np.asarray(stored[name], np.float64) for name in ("logits", "mean", "log_scale")]
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is not a mixture that predict wrote ({error}): predict again") from error
    mixture = Mixture(*leaves)
    if mixture.mean.ndim != 3 or mixture.mean.shape[0] != steps or mixture.mean.shape[2] != 6:
        raise InputError(f"{path}: means of shape {mixture.mean.shape}; expected [{steps}, M, 6]: predict again")
    return mixture
