"""Writes a small data set in the layout of nuScenes v1.0, whose right answers are known; no test itself.

    truth = write_nuscenes(tmp_path, frames=24)
    read_nuscenes(tmp_path, "scene-0061", version=VERSION).poses  # those of truth["scene-0061"], re-based

It has what the real one has and readers trip over: rows in no order, rows of other sensors (without their files),
frames 0.05 and 0.1 s apart, dropped frames, two vehicles with their own calibration, key frames in samples/ and the
others in sweeps/, coordinates in the kilometres. And, by `SCENES`, an image that is not there and a scene of one frame.
"""

import dataclasses
import hashlib
import json
import random
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

VERSION = "v1.0-mini"
REVOLUTION_US = 50_000
START_US = 1_532_402_927_600_000
# From the axes of a car (x ahead, y left, z up) to those of a camera that looks ahead (x right, y down, z ahead).
CAR_FROM_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
# When a sensor fires within a revolution of the laser scanner.
OFFSET_US = {"CAM_FRONT": 12_460, "CAM_BACK": 37_525, "LIDAR_TOP": -2_500}


@dataclasses.dataclass(frozen=True)
class Spec:
    """A scene to write: `dropped` frames are in no table, `missing` ones are, but not on disk."""

    name: str
    description: str
    frames: int | None = None
    dropped: tuple[int, ...] = ()
    missing: tuple[int, ...] = ()


# Every condition in training and in test, and the scenes that the paper shows.
SCENES = (
    Spec("scene-0061", "Parked lorry, crossing, turn left, behind a van"),
    Spec("scene-0103", "Many people on the right, a bicycle rack", missing=(3,)),
    Spec("scene-0553", "Wait at a crossing", frames=1),
    Spec("scene-0571", "Rain, behind a car, puddles"),
    Spec("scene-1077", "Night, a wide street, a bus stop", dropped=(4, 5)),
    Spec("scene-0655", "Car park, a terrain vehicle, a train behind the fence"),
    Spec("scene-0572", "Turn right, rain, people with umbrellas"),
    Spec("scene-0768", "Turn left at a junction, a lorry"),
    Spec("scene-0972", "Low sun, a narrow street"),
    Spec("scene-0999", "Night, after rain, a lit crossing"),
)


@dataclasses.dataclass(frozen=True)
class Truth:
    """What the tables of one scene say of the front camera, frame by frame.

    Attributes:
      numbers: of the frames before any was dropped; shows in the brightness of the images, see `brightness`.
      times_us: `[N]`.
      poses: `T_global_camera`, `[N, 4, 4]`.
      is_key_frame: `[N]`.
      camera: fx, fy, cx, cy.
      files: relative to the root.
    """

    numbers: np.ndarray
    times_us: np.ndarray
    poses: np.ndarray
    is_key_frame: np.ndarray
    camera: tuple[float, float, float, float]
    files: list[str]


@dataclasses.dataclass(frozen=True)
class Vehicle:
    """Where the front camera sits in a car, and its intrinsics for a given size."""

    log: str
    T_ego_camera: np.ndarray
    camera: tuple[float, float, float, float]


def write_nuscenes(
    root: Path,
    scenes: Iterable[Spec] = SCENES,
    frames: int = 24,
    *,
    size: tuple[int, int] = (36, 64),
    rendered: bool = False,
    version: str = VERSION,
) -> dict[str, Truth]:
    """Write the tables and images of `scenes` under `root` and return what is true of each, by name.

    Args:
      root: a folder; made where it is not there.
      scenes: what to write.
      frames: of the front camera in a scene that does not say, about 12 a second.
      size: height and width of the images.
      rendered: draw them by `synthetic.drive`, so that there is something to learn; else they are noise.
      version: name of the tables' folder.
    """
    tables: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
    vehicles = [_vehicle(number, size) for number in range(2)]
    for channel in OFFSET_US:
        modality = "lidar" if channel.startswith("LIDAR") else "camera"
        tables["sensor"].append({"token": token(channel), "channel": channel, "modality": modality})
    for vehicle in vehicles:
        tables["log"].append(
            {
                "token": token(vehicle.log),
                "logfile": f"{vehicle.log}-2018-07-24-11-22-45+0800",
                "vehicle": vehicle.log,
                "date_captured": "2018-07-24",
                "location": "singapore-onenorth",
            }
        )
        tables["calibrated_sensor"] += [_calibration(vehicle, channel) for channel in OFFSET_US]
    truth = {}
    for number, spec in enumerate(scenes):
        vehicle = vehicles[number % 2]
        truth[spec.name] = _write_scene(root, tables, spec, number, vehicle, spec.frames or frames, size, rendered)
    folder = root / version
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        random.Random(name).shuffle(rows)
        (folder / f"{name}.json").write_text(json.dumps(rows, indent=0))
    return truth


TABLES = (
    *("attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map"),
    *("sample", "sample_annotation", "sample_data", "scene", "sensor", "visibility"),
)


def edit_table(root: Path, name: str, change: Callable[[list[dict[str, Any]]], Any], version: str = VERSION) -> None:
    """Replace a table by what `change` returns of its rows, or by the rows that it changed in place."""
    path = root / version / f"{name}.json"
    rows = json.loads(path.read_text())
    result = change(rows)
    path.write_text(json.dumps(rows if result is None else result, indent=0))


def brightness(number: int) -> int:
    """Return the mean of a noise image, which tells the number of its frame."""
    return 30 + 5 * (number % 40)


def token(*words: object) -> str:
    """Return a token as nuScenes has them."""
    return hashlib.md5(" ".join(map(str, words)).encode()).hexdigest()


def _vehicle(number: int, size: tuple[int, int]) -> Vehicle:
    T = np.eye(4)
    turn = Rotation.from_rotvec([0.02 - 0.03 * number, 0.09 + 0.02 * number, -0.015])
    T[:3, :3] = CAR_FROM_CAMERA @ turn.as_matrix()
    T[:3, 3] = 1.70 + 0.05 * number, 0.016, 1.51
    height, width = size
    focal = (0.79 + 0.01 * number) * width
    return Vehicle(f"n{number:03}", T, (focal, focal, 0.51 * width, 0.546 * height))


def _calibration(vehicle: Vehicle, channel: str) -> dict[str, Any]:
    T, (fx, fy, cx, cy) = vehicle.T_ego_camera, vehicle.camera
    is_camera = channel.startswith("CAM")
    if channel != "CAM_FRONT":
        T = np.eye(4)
        T[:3, 3] = -0.5, 0.1, 1.6
    return {
        "token": token("calibrated", vehicle.log, channel),
        "sensor_token": token(channel),
        **_as_row(T),
        "camera_intrinsic": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]] if is_camera else [],
    }


def _as_row(T: np.ndarray) -> dict[str, list[float]]:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {"translation": T[:3, 3].tolist(), "rotation": [float(value) for value in (w, x, y, z)]}


def _write_scene(
    root: Path,
    tables: dict[str, list[dict[str, Any]]],
    spec: Spec,
    number: int,
    vehicle: Vehicle,
    frames: int,
    size: tuple[int, int],
    rendered: bool,
) -> Truth:
    # The two vehicles drive at the same time, in different places.
    start_us = START_US + number // 2 * 60_000_000
    # Revolutions 0, 1, 3, 5, 6, 8, 10: 12 of 20 a second; every sixth frame is a key frame, half a second apart.
    fired = np.arange(frames) * 5 // 3
    times_us = start_us + OFFSET_US["CAM_FRONT"] + fired * REVOLUTION_US
    draw, ego_at = (
        _rendered_drive(number, times_us, size, vehicle) if rendered else _noise_drive(number, start_us, size)
    )
    sample_revolutions = np.arange(0, fired[-1] + 1, 10)
    samples = [token(spec.name, "sample", revolution) for revolution in sample_revolutions]
    logfile = f"{vehicle.log}-2018-07-24-11-22-45+0800"

    for index, revolution in enumerate(sample_revolutions):
        tables["sample"].append(
            {
                "token": samples[index],
                "timestamp": int(start_us + revolution * REVOLUTION_US),
                "prev": samples[index - 1] if index else "",
                "next": samples[index + 1] if index + 1 < len(samples) else "",
                "scene_token": token(spec.name),
            }
        )
    tables["scene"].append(
        {
            "token": token(spec.name),
            "log_token": token(vehicle.log),
            "nbr_samples": len(samples),
            "first_sample_token": samples[0],
            "last_sample_token": samples[-1],
            "name": spec.name,
            "description": spec.description,
        }
    )

    kept = [index for index in range(frames) if index not in spec.dropped]
    fires = {
        "CAM_FRONT": fired[kept],
        "CAM_BACK": fired,
        "LIDAR_TOP": np.arange(fired[-1] + 2),
    }
    files: list[str] = []
    for channel, revolutions in fires.items():
        tokens = [token(spec.name, channel, revolution) for revolution in revolutions]
        for index, revolution in enumerate(revolutions):
            time_us = int(start_us + revolution * REVOLUTION_US + OFFSET_US[channel])
            is_key_frame = bool(revolution % 10 == 0 and revolution <= sample_revolutions[-1])
            suffix = "jpg" if channel.startswith("CAM") else "pcd.bin"
            place = "samples" if is_key_frame else "sweeps"
            file = f"{place}/{channel}/{logfile}__{channel}__{time_us}.{suffix}"
            # A sweep belongs to the sample that follows it, the last ones to the last.
            sample = samples[min(-(-int(revolution) // 10), len(samples) - 1)]
            is_camera = channel.startswith("CAM")
            tables["sample_data"].append(
                {
                    "token": tokens[index],
                    "sample_token": sample,
                    "ego_pose_token": tokens[index],
                    "calibrated_sensor_token": token("calibrated", vehicle.log, channel),
                    "timestamp": time_us,
                    "fileformat": suffix.split(".")[0],
                    "is_key_frame": is_key_frame,
                    "height": size[0] if is_camera else 0,
                    "width": size[1] if is_camera else 0,
                    "filename": file,
                    "prev": tokens[index - 1] if index else "",
                    "next": tokens[index + 1] if index + 1 < len(tokens) else "",
                }
            )
            tables["ego_pose"].append({"token": tokens[index], "timestamp": time_us, **_as_row(ego_at(time_us))})
            if channel == "CAM_FRONT":
                files.append(file)
    for index, file in zip(kept, files, strict=True):
        if index not in spec.missing:
            (root / file).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(root / file), draw(index)[..., ::-1])  # OpenCV writes BGR
    return Truth(
        numbers=np.array(kept),
        times_us=times_us[kept],
        poses=np.stack([ego_at(time_us) @ vehicle.T_ego_camera for time_us in times_us[kept]]),
        is_key_frame=fired[kept] % 10 == 0,
        camera=vehicle.camera,
        files=files,
    )


Draw = Callable[[int], np.ndarray]
EgoAt = Callable[[int], np.ndarray]


def _planar(x: float, y: float, yaw: float) -> np.ndarray:
    """Return an ego pose as nuScenes has them: at height 0, upright."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    T[:3, 3] = x, y, 0.0
    return T


def _noise_drive(number: int, start_us: int, size: tuple[int, int]) -> tuple[Draw, EgoAt]:
    """Return images of noise and a drive on a smooth curve."""
    heading = 0.7 * number

    def draw(index: int) -> np.ndarray:
        rng = np.random.default_rng((number, index))
        noise = rng.integers(-20, 21, (*size, 1))
        return np.clip(brightness(index) + noise - noise.mean(), 0, 255).astype(np.uint8).repeat(3, -1)

    def ego_at(time_us: int) -> np.ndarray:
        t = (int(time_us) - start_us) / 1e6
        ahead, left = 8.0 * t + 0.4 * t * t, 1.5 * np.sin(0.8 * t)
        cos, sin = np.cos(heading), np.sin(heading)
        x, y = 600 + 90 * number + cos * ahead - sin * left, 1600 - 70 * number + sin * ahead + cos * left
        return _planar(x, y, heading + 0.15 * np.sin(0.8 * t + 0.3))

    return draw, ego_at


def _rendered_drive(number: int, times_us: np.ndarray, size: tuple[int, int], vehicle: Vehicle) -> tuple[Draw, EgoAt]:
    """Return a rendered drive, with its motion flattened as the localisation of nuScenes does."""
    from mdnvo_jax.data import synthetic

    height, width = size
    drive = synthetic.drive(number, len(times_us), height=height, width=width, channels=3, camera=vehicle.camera)
    assert drive.poses is not None
    # The world of the drive is its first camera; the car drives where the camera, seen from above, does.
    flat = CAR_FROM_CAMERA @ drive.poses[:, :3, :3] @ vehicle.T_ego_camera[:3, :3].T
    yaw = np.unwrap(np.arctan2(flat[:, 1, 0], flat[:, 0, 0]))
    cos, sin = np.cos(yaw), np.sin(yaw)
    ahead, left = vehicle.T_ego_camera[:2, 3]
    lever = np.stack([cos * ahead - sin * left, sin * ahead + cos * left], -1)
    xy = (drive.poses[:, :3, 3] @ CAR_FROM_CAMERA.T)[:, :2] - lever

    def ego_at(time_us: int) -> np.ndarray:
        x, y, angle = (np.interp(time_us, times_us, values) for values in (xy[:, 0], xy[:, 1], yaw))
        return _planar(700.0 + x, 1500.0 + y, angle)

    return drive.read, ego_at
