"""Poses, times and calibrations of any text: each file is read or refused."""

from pathlib import Path

import cv2
import numpy as np
from hostile_files import PICTURE, in_one_line, quickly
from hypothesis import example, given
from hypothesis import strategies as st

from mdnvo_jax.config import ImageConfig
from mdnvo_jax.data import images, kitti
from mdnvo_jax.data.folder import read_frames
from mdnvo_jax.evaluation import formats

numbers = st.floats(allow_nan=True).map(repr) | st.integers(-(10**25), 10**25).map(str) | st.floats(-2, 2).map(str)
words = numbers | st.sampled_from(
    ["1_0", "0x1", "#", "NaT", "inf", "-", "1e999", "\ud800".encode("utf-8", "replace").decode()]
)
lines = st.lists(words, min_size=0, max_size=14).map(" ".join)
rotations = st.sampled_from(["1 0 0 {} 0 1 0 {} 0 0 1 {}", "1 0 0 {} 0 0 -1 {} 0 1 0 {}", "{} 0 0 1 0 1 0 1 0 0 1 1"])
poses = st.tuples(rotations, numbers, numbers, numbers).map(lambda item: item[0].format(*item[1:]))
texts = st.lists(lines | poses | st.text(max_size=20), max_size=5).map("\n".join).map(str.encode) | st.binary(
    max_size=60
)


@given(data=texts)
@quickly
def test_any_pose_file_is_read_or_refused(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_bytes(data)
    found = in_one_line(lambda: kitti.read_poses(path))
    assert found is None or np.isfinite(found).all()
    for format in (None, "kitti", "indexed", "tum", "euroc"):
        read = in_one_line(lambda format=format: formats.read_trajectory(path, format=format))
        assert read is None or np.isfinite(read.poses).all()


@given(data=texts | st.lists(numbers, min_size=3, max_size=3).map("\n".join).map(str.encode))
@quickly
def test_any_file_of_times_is_read_or_refused(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "times.txt"
    path.write_bytes(data)
    found = in_one_line(lambda: kitti.read_times(path, 3))
    assert found is None or (found.shape == (3,) and np.isfinite(found).all())
    in_one_line(lambda: formats.read_times(path))


@given(
    data=texts
    | st.lists(poses | lines, max_size=4)
    .map(lambda rows: "\n".join(f"P{i}: {row}" for i, row in enumerate(rows)))
    .map(str.encode)
)
# Its offset from camera 0 is beyond all numbers.
@example(data=b"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nP1: 2.2e-311 0 0 1 0 1 0 1 0 0 1 1")
@quickly
def test_any_calibration_is_read_or_refused(data: bytes, tmp_path: Path) -> None:
    folder = tmp_path / "sequences" / "00"
    for camera in ("image_0", "image_1"):
        if not (folder / camera).is_dir():
            (folder / camera).mkdir(parents=True)
            for number in range(2):
                cv2.imwrite(str(folder / camera / f"{number:06}.png"), PICTURE)
            (tmp_path / "poses").mkdir(exist_ok=True)
            (tmp_path / "poses" / "00.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 1\n")
    (folder / "calib.txt").write_bytes(data)
    config = ImageConfig(height=20, width=40, channels=1, camera=(30.0, 30.0, 19.5, 9.5))
    for camera in ("image_0", "image_1"):
        sequence = in_one_line(lambda camera=camera: kitti.read_kitti(tmp_path, "00", camera_folder=camera, channels=1))
        if sequence is not None:
            assert np.isfinite(sequence.poses).all()
            in_one_line(lambda sequence=sequence: images.prepare(sequence.read(0), sequence.camera, config))
        in_one_line(lambda camera=camera: read_frames(folder / camera, 1))
