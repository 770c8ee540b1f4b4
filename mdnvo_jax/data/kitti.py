"""KITTI: the layout of the odometry benchmark, and raw drives with their GPS and inertial poses.

Sources: Geiger et al., "Are we ready for autonomous driving?", CVPR 2012, and the development kits' readme files.
"""

import math
from collections.abc import Sequence as Many
from pathlib import Path

import numpy as np

from mdnvo_jax.data import images
from mdnvo_jax.data.sequence import Camera, Sequence, one_size, rigid
from mdnvo_jax.errors import InputError
from mdnvo_jax.files import LARGEST_NUMBER

# Equatorial radius of the WGS 84 ellipsoid, m.
_EARTH_RADIUS_M = 6378137.0
# How far R R^T may be from the identity: the seven digits of the files leave 1e-6, a transposition or a wrong column 1.
_ROTATION_TOLERANCE = 1e-3


def read_kitti(
    root: str | Path,
    name: str,
    *,
    camera_folder: str = "image_2",
    channels: int = 3,
    require_poses: bool = True,
) -> Sequence:
    """Return one sequence of the odometry benchmark, or a clip laid out like it.

    Read are `root/sequences/NAME/CAMERA_FOLDER/*.png` (or jpg), `calib.txt`, `times.txt` where there is one, and
    `root/poses/NAME.txt`, whose lines are the 3x4 of `T_world_camera0`, frame for frame. The poses of another camera
    than 0 are `T_world_camera0 @ T_camera0_camera`, with the offset that calib.txt gives; the world stays that of the
    file, so the first pose of image_2 is not the identity.

    Args:
      root: the folder that holds `sequences` and `poses`.
      name: of the sequence, such as "00".
      camera_folder: image_0 to image_3; the benchmark's image_2 is the left colour camera.
      channels: 3 for RGB, 1 for grey; pictures are converted.
      require_poses: whether a missing pose file is a mistake. Without: poses are read where they are, else None.

    Raises:
      InputError: something is missing, malformed, or not one a frame; the message names file and line.
    """
    root = Path(root)
    folder = root / "sequences" / name
    if not folder.is_dir():
        there = ", ".join(_folders(root / "sequences")) or "none"
        raise InputError(f"no sequence {name} in {root / 'sequences'}: found {there}; choose one, or another root")
    frames = frame_files(folder, camera_folder)
    pose_file = root / "poses" / f"{name}.txt"
    calibration = _calibration(folder)
    poses = None
    if pose_file.is_file():
        poses = read_poses(pose_file) @ _camera_offset(calibration, camera_folder, folder)
        if len(poses) != len(frames):
            raise InputError(
                f"{pose_file} has {len(poses)} poses but {folder / camera_folder} has {len(frames)} frames"
                f"{_gap(frames)}: expected one pose a frame"
            )
    elif require_poses:
        raise InputError(f"no poses at {pose_file}: training and evaluation need one line of 12 numbers a frame")
    return Sequence(
        name=name,
        count=len(frames),
        read=one_size(lambda index: images.read_image(frames[index], channels), lambda index: str(frames[index])),
        timestamps=read_times(folder / "times.txt", len(frames)),
        poses=poses,
        camera=_intrinsics(calibration, camera_folder, folder),
        paths=[str(path) for path in frames],
    )


def read_kitti_raw(
    root: str | Path,
    name: str,
    *,
    camera_folder: str = "image_02",
    channels: int = 3,
) -> Sequence:
    """Return one synchronised and rectified raw drive, with the poses of its camera from the GPS and inertial unit.

    Read are `CAMERA_FOLDER/data/*.png`, `CAMERA_FOLDER/timestamps.txt` and `oxts/data/*.txt` in the drive's folder,
    and `calib_cam_to_cam.txt`, `calib_imu_to_velo.txt`, `calib_velo_to_cam.txt` in the folder of its date. Latitude
    and longitude (rad here) become metres by the Mercator projection scaled at the first frame, as in the raw
    development kit: with `s = cos(lat_0)` and the earth's radius r, `x = s r lon`,
    `y = s r log(tan(pi / 4 + lat / 2))`, `z` the altitude; the rotation of the unit is `Rz(yaw) Ry(pitch) Rx(roll)`.
    The world is camera 0 of the first frame.

    Args:
      root: the folder that holds the dates, such as 2011_09_26.
      name: the drive under `root`, such as 2011_09_26/2011_09_26_drive_0001_sync.
      camera_folder: image_00 to image_03.
      channels: 3 for RGB, 1 for grey; pictures are converted.

    Raises:
      InputError: something is missing or malformed, or a frame has no packet of GPS.
    """
    drive = Path(root) / name
    frames = frame_files(drive, camera_folder, "data")
    packets = [drive / "oxts" / "data" / f"{path.stem}.txt" for path in frames]
    missing = [path for path in packets if not path.is_file()]
    if missing:
        raise InputError(f"no {missing[0]} for the frame of that number ({len(missing)} missing): expected one a frame")
    camera_file = drive.parent / "calib_cam_to_cam.txt"
    camera_table = _table(camera_file)
    number = camera_number(camera_folder, "image_00")
    projection = _numbers(camera_table, f"P_rect_{number:02d}", 12, camera_file).reshape(3, 4)
    rectify = np.eye(4)
    rectify[:3, :3] = _numbers(camera_table, "R_rect_00", 9, camera_file).reshape(3, 3)
    T_camera_velodyne = _rigid_file(drive.parent / "calib_velo_to_cam.txt")
    T_velodyne_imu = _rigid_file(drive.parent / "calib_imu_to_velo.txt")
    T_camera0_imu = rectify @ T_camera_velodyne @ T_velodyne_imu
    T_camera0_camera = _offset_of(projection)
    T_mercator_imu = mercator_poses(np.stack([_oxts(path) for path in packets]))
    T_mercator_camera0 = T_mercator_imu @ np.linalg.inv(T_camera0_imu)
    T_world_camera0 = np.linalg.inv(T_mercator_camera0[0]) @ T_mercator_camera0
    return Sequence(
        name=name,
        count=len(frames),
        read=one_size(lambda index: images.read_image(frames[index], channels), lambda index: str(frames[index])),
        timestamps=_clock_times(drive / camera_folder / "timestamps.txt", len(frames)),
        poses=rigid(T_world_camera0 @ T_camera0_camera),
        camera=_intrinsics_of(projection),
        paths=[str(path) for path in frames],
    )


def read_poses(path: str | Path) -> np.ndarray:
    """Return the poses of a KITTI pose file, `[N, 4, 4]` float64, rotations in SO(3).

    Raises:
      InputError: a line does not hold the 12 finite numbers of a 3x4 rigid transform; it names the line.
    """
    path = Path(path)
    lines = _text(path).rstrip().splitlines()
    if not lines:
        raise InputError(f"{path} is empty: expected a line of 12 numbers a frame")
    poses = np.stack([_row(line, 12, f"{path}, line {n}") for n, line in enumerate(lines, 1)]).reshape(-1, 3, 4)
    rotations = poses[:, :, :3]
    error = np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max((1, 2))
    wrong = np.flatnonzero((error > _ROTATION_TOLERANCE) | (np.linalg.det(rotations) < 0))
    if len(wrong):
        raise InputError(
            f"{path}, line {wrong[0] + 1}: columns 1 to 3, 5 to 7 and 9 to 11 are no rotation matrix: "
            "expected the 3x4 of T_world_camera, row by row"
        )
    return rigid(poses)


def read_times(path: str | Path, count: int) -> np.ndarray | None:
    """Return the `count` times in the file at `path`, `[count]` s, or None where there is no file.

    A line holds the time of a frame, in seconds, in its first column (a TUM trajectory will do); `#` begins a comment.

    Raises:
      InputError: a line does not begin with a finite number, or there is not one line a frame.
    """
    path = Path(path)
    if not path.is_file():
        return None
    lines = [(n, line.split("#")[0].split()) for n, line in enumerate(_text(path).splitlines(), 1)]
    times = np.array([_row(words[0], 1, f"{path}, line {n}")[0] for n, words in lines if words])
    if len(times) != count:
        raise InputError(f"{path} has {len(times)} times for {count} frames: expected one line a frame")
    return times


def frame_files(folder: Path, camera_folder: str, below: str = "") -> list[Path]:
    """Return the pictures of one camera in the order of their numbers.

    Raises:
      InputError: the folder of that camera is missing (the message lists those there) or holds no pictures.
    """
    place = folder / camera_folder / below
    if not place.is_dir():
        there = [name for name in _folders(folder) if name.startswith("image_")]
        hint = (
            f"found {', '.join(there)}; use data.camera_folder {there[0]}"
            if there
            else "found no image_* folder at all"
        )
        raise InputError(f"no folder {camera_folder} in {folder}: {hint}")
    found = [path for path in place.iterdir() if path.suffix in (".png", ".jpg") and path.stem.isdecimal()]
    frames = sorted(found, key=lambda path: int(path.stem))
    if len(frames) < 2:
        raise InputError(f"{len(frames)} frames in {place}: expected two or more, named 000000.png (or jpg) and so on")
    numbers = [int(path.stem) for path in frames]
    if len(set(numbers)) < len(numbers):
        raise InputError(f"{place} has two pictures of one number, such as a png and a jpg: remove one kind")
    return frames


def read_camera(folder: Path, camera_folder: str) -> Camera | None:
    """Return the intrinsics of a camera by the calib.txt in `folder`, or None where there is no such file.

    Raises:
      InputError: calib.txt is malformed or has no line for this camera.
    """
    return _intrinsics(_calibration(folder), camera_folder, folder)


def mercator_poses(oxts: np.ndarray) -> np.ndarray:
    """Return `T_mercator_imu`, `[N, 4, 4]`, of packets (latitude, longitude deg; altitude m; roll, pitch, yaw rad).

    The formula stands at `read_kitti_raw`; x points east, y north, z up.
    """
    latitude, longitude = np.radians(oxts[:, 0]), np.radians(oxts[:, 1])
    radius = math.cos(latitude[0]) * _EARTH_RADIUS_M
    poses = np.tile(np.eye(4), (len(oxts), 1, 1))
    poses[:, 0, 3] = radius * longitude
    poses[:, 1, 3] = radius * np.log(np.tan(math.pi / 4 + latitude / 2))
    poses[:, 2, 3] = oxts[:, 2]
    poses[:, :3, :3] = _turn(oxts[:, 5], 2) @ _turn(oxts[:, 4], 1) @ _turn(oxts[:, 3], 0)
    return poses


def _turn(angle: np.ndarray, axis: int) -> np.ndarray:
    """Return the rotations by `angle` `[N]` about coordinate axis `axis`, `[N, 3, 3]`."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    result = np.tile(np.eye(3), (len(angle), 1, 1))
    result[:, i, i] = result[:, j, j] = np.cos(angle)
    result[:, j, i] = np.sin(angle)
    result[:, i, j] = -np.sin(angle)
    return result


def _calibration(folder: Path) -> dict[str, str]:
    """Return calib.txt as a table of its lines, empty where there is no such file."""
    return _table(folder / "calib.txt") if (folder / "calib.txt").is_file() else {}


def _projection(calibration: dict[str, str], camera_folder: str, folder: Path) -> np.ndarray:
    """Return the 3x4 projection of a camera from calib.txt."""
    number = camera_number(camera_folder, "image_2")
    return _numbers(calibration, f"P{number}", 12, folder / "calib.txt").reshape(3, 4)


def _intrinsics(calibration: dict[str, str], camera_folder: str, folder: Path) -> Camera | None:
    return _intrinsics_of(_projection(calibration, camera_folder, folder)) if calibration else None


def _camera_offset(calibration: dict[str, str], camera_folder: str, folder: Path) -> np.ndarray:
    """Return `T_camera0_camera`; the identity for camera 0, for which no calib.txt is needed."""
    if camera_number(camera_folder, "image_2") == 0:
        return np.eye(4)
    if not calibration:
        raise InputError(f"no {folder / 'calib.txt'}: poses are those of camera 0, and {camera_folder} is beside it")
    return _offset_of(_projection(calibration, camera_folder, folder))


def _intrinsics_of(projection: np.ndarray) -> Camera:
    return float(projection[0, 0]), float(projection[1, 1]), float(projection[0, 2]), float(projection[1, 2])


def _offset_of(projection: np.ndarray) -> np.ndarray:
    """Return `T_camera0_camera` of a rectified camera: its projection is `K [I | t]`, with t from camera 0 to it."""
    offset = np.eye(4)
    try:
        offset[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    except np.linalg.LinAlgError:
        offset[:3, 3] = np.inf
    if not (np.abs(offset) <= LARGEST_NUMBER).all():
        raise InputError(f"calibration: {projection[:, :3].tolist()} is no matrix of a camera's intrinsics")
    return offset


def camera_number(camera_folder: str, example: str) -> int:
    """Return the 2 of image_2 or image_02.

    Raises:
      InputError: the name is not of this form; the message gives `example`.
    """
    digits = camera_folder.removeprefix("image_")
    if digits == camera_folder or not digits.isdecimal():
        raise InputError(f"camera folder {camera_folder!r}: expected a name such as {example}")
    return int(digits)


def _rigid_file(path: Path) -> np.ndarray:
    """Return the 4x4 of a calibration file with lines R and T."""
    table = _table(path)
    result = np.eye(4)
    result[:3, :3] = _numbers(table, "R", 9, path).reshape(3, 3)
    result[:3, 3] = _numbers(table, "T", 3, path)
    return result


def _table(path: Path) -> dict[str, str]:
    """Return a file of lines `KEY: VALUES` as a table."""
    rows = [line.partition(":") for line in _text(path).splitlines() if line.strip()]
    return {key.strip(): values for key, _, values in rows}


def _numbers(table: dict[str, str], key: str, count: int, path: Path) -> np.ndarray:
    if key not in table:
        raise InputError(f"{path} has no line {key}: found {', '.join(table) or 'nothing'}; choose another camera")
    return _row(table[key], count, f"{path}, line {key}")


def _oxts(path: Path) -> np.ndarray:
    """Return latitude, longitude, altitude, roll, pitch and yaw, which begin a packet."""
    words = _text(path).split()
    if len(words) < 6:
        raise InputError(f"{path} has {len(words)} numbers: expected 30, beginning with latitude")
    return _row(" ".join(words[:6]), 6, str(path))


def _row(text: str, count: int, where: str) -> np.ndarray:
    """Return the `count` finite numbers in `text`."""
    words = text.split()
    if len(words) != count:
        raise InputError(f"{where}: found {len(words)} numbers, expected {count}")
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"{where}: {error}: expected {count} numbers") from error
    if not (np.abs(values) <= LARGEST_NUMBER).all():
        raise InputError(f"{where}: not every number is finite")
    return values


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path} ({error}): expected a text file") from error


def _clock_times(path: Path, count: int) -> np.ndarray | None:
    """Return the times of a raw drive, such as 2011-09-26 13:02:25.964389445, in s since its first."""
    if not path.is_file():
        return None
    lines = _text(path).split("\n")
    stamps = []
    for number, line in enumerate(lines, 1):
        if line.strip():
            try:
                stamps.append(np.datetime64(line.strip(), "ns"))
            except ValueError as error:
                raise InputError(f"{path}, line {number}: {error}: expected a date and a time") from error
    if len(stamps) != count:
        raise InputError(f"{path} has {len(stamps)} times for {count} frames: expected one line a frame")
    return (np.array(stamps) - stamps[0]) / np.timedelta64(1, "s")


def _folders(place: Path) -> list[str]:
    return sorted(path.name for path in place.iterdir() if path.is_dir()) if place.is_dir() else []


def _gap(frames: Many[Path]) -> str:
    """Return a hint at the first number missing among `frames`, or nothing."""
    numbers = {int(path.stem) for path in frames}
    missing = [number for number in range(min(numbers), max(numbers)) if number not in numbers]
    return f" (number {missing[0]} is missing)" if missing else ""
