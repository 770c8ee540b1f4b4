"""Small made-up sequences in memory and on disk, whose right answers are known."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from nuscenes_fixture import write_nuscenes
from nuscenes_reading import ONE
from scipy.spatial.transform import Rotation

from mdnvo_jax.data.sequence import Sequence

# Left grey, right grey, left colour, right colour; round numbers near KITTI's, at a tenth of its size.
K = np.array([[72.0, 0.0, 60.7], [0.0, 71.0, 18.5], [0.0, 0.0, 1.0]])
# Where each camera sits in the axes of camera 0, m.
POSITIONS = np.array([[0.0, 0.0, 0.0], [0.54, 0.0, 0.0], [-0.06, 0.01, -0.003], [0.48, 0.002, 0.001]])


def made_up_poses(count: int, seed: int = 0, step_m: float = 0.8) -> np.ndarray:
    """Return the poses of a winding drive that turns about every axis, `[count, 4, 4]`."""
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(count - 1):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(rng.normal(0, (0.01, 0.05, 0.01))).as_matrix()
        step[:3, 3] = rng.normal((0, 0, step_m), (0.02, 0.02, 0.2))
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def numbered_frame(index: int, height: int = 37, width: int = 124) -> np.ndarray:
    """Return a grey frame from whose top left pixel the index can be read."""
    frame = np.tile(np.linspace(60, 200, width).astype(np.uint8), (height, 1))
    frame[: height // 2] = 3 * index
    return frame


@pytest.fixture
def poses() -> Callable[..., np.ndarray]:
    return made_up_poses


@pytest.fixture
def toy() -> Callable[..., Sequence]:
    """Make a sequence in memory whose frame i is filled with the number `first + i`."""

    def make(count: int, *, name: str = "toy", first: int = 0, seed: int = 0, size=(8, 16), **more) -> Sequence:
        values = {"poses": made_up_poses(count, seed), **more}
        return Sequence(name, count, lambda index: np.full((*size, 1), first + index, np.uint8), **values)

    return make


@pytest.fixture
def kitti_root(tmp_path: Path) -> Path:
    """A root in KITTI's layout: sequences 00 (12 frames, png) and 07 (8 frames, jpg), cameras 0 and 2."""
    root = tmp_path / "kitti"
    (root / "poses").mkdir(parents=True)
    for name, count, suffix in (("00", 12, "png"), ("07", 8, "jpg")):
        folder = root / "sequences" / name
        for camera in ("image_0", "image_2"):
            (folder / camera).mkdir(parents=True)
            for index in range(count):
                frame = numbered_frame(index)
                if camera == "image_2":
                    frame = np.stack([frame, frame // 2, frame // 4], -1)[..., ::-1]  # OpenCV writes BGR
                cv2.imwrite(str(folder / camera / f"{index:06}.{suffix}"), frame)
        lines = [
            f"P{i}: " + " ".join(repr(float(v)) for v in (K @ np.c_[np.eye(3), -position]).ravel())
            for i, position in enumerate(POSITIONS)
        ]
        (folder / "calib.txt").write_text("\n".join(lines) + "\n")
        (folder / "times.txt").write_text("".join(f"{0.1 * i:.6e}\n" for i in range(count)))
        values = made_up_poses(count, int(name))[:, :3].reshape(count, 12)
        # Seven digits, as in the benchmark: rotations are not quite rotations.
        (root / "poses" / f"{name}.txt").write_text("".join(" ".join(f"{v:.6e}" for v in row) + "\n" for row in values))
    return root


EARTH_RADIUS_M = 6378137.0
# Axes of KITTI's sensors: the inertial unit and the laser scanner x forward, y left, z up; the camera z forward.
CAMERA_FROM_CAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


@pytest.fixture
def raw_root(tmp_path):
    """A raw drive: three frames heading east, 2 m each, then one step north-east at a yaw of 45 degrees."""
    date = tmp_path / "2011_09_26"
    drive = date / "2011_09_26_drive_0001_sync"
    (drive / "oxts" / "data").mkdir(parents=True)
    (drive / "image_02" / "data").mkdir(parents=True)
    latitude, longitude = 49.0, 8.4
    east = np.degrees(1 / (EARTH_RADIUS_M * np.cos(np.radians(latitude))))
    north = np.degrees(1 / EARTH_RADIUS_M)
    at = [(0, 0, 0.0), (2, 0, 0.0), (4, 0, 0.0), (5, 1, np.pi / 4)]
    stamps = []
    for index, (x, y, yaw) in enumerate(at):
        values = [latitude + y * north, longitude + x * east, 112.0, 0.0, 0.0, yaw, *np.zeros(24)]
        (drive / "oxts" / "data" / f"{index:010}.txt").write_text(" ".join(repr(float(v)) for v in values))
        cv2.imwrite(str(drive / "image_02" / "data" / f"{index:010}.png"), np.full((37, 124), 9 * index, np.uint8))
        stamps.append(f"2011-09-26 13:59:59.{500000000 + 100000001 * index}")
    (drive / "image_02" / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    eye = "1 0 0 0 1 0 0 0 1"
    # The camera 1.1 m ahead of the unit and 0.8 m above, in two steps; a small rectifying turn; camera 2 to the left.
    (date / "calib_imu_to_velo.txt").write_text(f"calib_time: 25-May-2012 16:47:16\nR: {eye}\nT: -0.8 0.3 -0.8\n")
    (date / "calib_velo_to_cam.txt").write_text(
        f"R: {' '.join(str(v) for v in CAMERA_FROM_CAR.ravel())}\nT: 0 0 -0.3\ndelta_f: 0 0\n"
    )
    turn = Rotation.from_rotvec([0.01, -0.02, 0.005]).as_matrix()
    (date / "calib_cam_to_cam.txt").write_text(
        "corner_dist: 9.95e-02\n"
        f"R_rect_00: {' '.join(repr(float(v)) for v in turn.ravel())}\nP_rect_00: 70 0 60 0 0 70 18 0 0 0 1 0\n"
        f"P_rect_02: 70 0 60 {70 * 0.06 + 60 * 0.003} 0 70 18 {18 * 0.003} 0 0 1 0.003\n"
    )
    return tmp_path


# nuScenes, as nuscenes_fixture writes it.


@pytest.fixture(scope="module")
def mini(tmp_path_factory):
    """The whole fixture, to read only: (root, truth by scene)."""
    root = tmp_path_factory.mktemp("nuscenes")
    return root, write_nuscenes(root)


@pytest.fixture
def one(tmp_path):
    """A data set of one scene, to spoil: (root, truth)."""
    return tmp_path, write_nuscenes(tmp_path, ONE)["scene-0061"]
