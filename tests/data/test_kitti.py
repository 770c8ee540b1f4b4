import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mdnvo_jax.data.kitti import mercator_poses, read_kitti, read_kitti_raw, read_poses, read_times
from mdnvo_jax.errors import InputError


def composed(steps, first):
    """Return the poses that `steps` lead to, one matrix product after the other."""
    poses = [first]
    for step in steps:
        T = np.eye(4)
        T[:3, 3], T[:3, :3] = step[:3], Rotation.from_rotvec(step[3:]).as_matrix()
        poses.append(poses[-1] @ T)
    return np.stack(poses)


# Real data


@pytest.mark.parametrize("name", ["00", "02", "04", "10"])
def test_labels_of_whole_real_sequences_compose_to_their_poses(data_root, toy, name):
    poses = read_poses(data_root / "trajectories" / "ground_truth" / f"{name}.txt")
    assert {"00": 4541, "02": 4661, "04": 271, "10": 1201}[name] == len(poses)
    sequence = toy(len(poses), poses=poses)
    np.testing.assert_allclose(composed(sequence.steps(), poses[0]), poses, atol=1e-6)
    # The poses are those of the file, rotations moved by no more than its digits allow.
    raw = np.loadtxt(data_root / "trajectories" / "ground_truth" / f"{name}.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(poses[:, :3], raw, atol=3e-6)
    np.testing.assert_array_equal(poses[:, :3, 3], raw[:, :, 3])


@pytest.mark.parametrize(("name", "count", "size"), [("00", 300, (376, 1241)), ("06", 51, (370, 1226))])
def test_reading_real_clips(data_root, name, count, size):
    sequence = read_kitti(data_root / "kitti", name, camera_folder="image_0", channels=1)
    assert sequence.count == count == len(sequence.poses)
    frame = sequence.read(count - 1)
    assert frame.shape == (*size, 1) and frame.dtype == np.uint8 and 60 < frame.mean() < 160
    assert sequence.camera[0] == pytest.approx({"00": 718.856, "06": 707.0912}[name])
    # A car drives forwards, about level, and does not roll.
    steps = sequence.steps()
    assert (steps[:, 2] > 0.2).all() and np.abs(steps[:, :2]).max() < 0.1 and np.abs(steps[:, [3, 5]]).max() < 0.03


def test_a_camera_that_real_data_lacks_is_named(data_root):
    with pytest.raises(InputError, match=r"no folder image_2 in .*/01: found image_0; use data.camera_folder image_0"):
        read_kitti(data_root / "kitti", "01")


# A made-up root


def test_frames_poses_times_and_camera_of_camera_0(kitti_root, poses):
    sequence = read_kitti(kitti_root, "00", camera_folder="image_0", channels=1)
    assert (sequence.name, sequence.count) == ("00", 12)
    assert [int(sequence.read(i)[0, 0, 0]) for i in range(12)] == list(range(0, 36, 3))
    np.testing.assert_allclose(sequence.timestamps, np.arange(12) / 10)
    assert sequence.camera == pytest.approx((72.0, 71.0, 60.7, 18.5))
    np.testing.assert_allclose(sequence.poses, poses(12), atol=1e-5)
    determinants = np.linalg.det(sequence.poses[:, :3, :3])
    np.testing.assert_allclose(determinants, 1, atol=1e-14)
    assert sequence.label(3).endswith("sequences/00/image_0/000003.png")


def test_colour_is_rgb_and_jpg_is_read(kitti_root):
    red, green, blue = read_kitti(kitti_root, "00").read(5)[-1, 60]
    assert red == pytest.approx(2 * green, abs=2) and red == pytest.approx(4 * blue, abs=4) and red > 100
    assert read_kitti(kitti_root, "07", channels=1).read(7).shape == (37, 124, 1)


def test_poses_of_another_camera_are_those_of_that_camera(kitti_root):
    """A point that camera 0 and camera 2 both see is at one place in the world."""
    left, right = (read_kitti(kitti_root, "07", camera_folder=folder) for folder in ("image_0", "image_2"))
    point_in_0 = np.array([1.0, -0.5, 9.0, 1.0])
    point_in_2 = point_in_0 - [-0.06, 0.01, -0.003, 0]  # camera 2 sits there in the axes of camera 0
    np.testing.assert_allclose(right.poses @ point_in_2, left.poses @ point_in_0, atol=1e-12)
    # In a bend the two move differently, so the labels differ too.
    assert np.abs(right.steps() - left.steps()).max() > 1e-4
    np.testing.assert_allclose(composed(right.steps(), right.poses[0]), right.poses, atol=1e-9)


def test_without_calibration_camera_0_still_works(kitti_root):
    (kitti_root / "sequences" / "00" / "calib.txt").unlink()
    assert read_kitti(kitti_root, "00", camera_folder="image_0").camera is None
    with pytest.raises(InputError, match=r"no .*calib.txt: poses are those of camera 0, and image_2 is beside it"):
        read_kitti(kitti_root, "00")


def test_without_times_and_poses(kitti_root):
    (kitti_root / "sequences" / "00" / "times.txt").unlink()
    (kitti_root / "poses" / "00.txt").unlink()
    with pytest.raises(InputError, match=r"no poses at .*00.txt"):
        read_kitti(kitti_root, "00")
    sequence = read_kitti(kitti_root, "00", require_poses=False)
    assert sequence.poses is None and sequence.timestamps is None and sequence.count == 12


def test_frames_go_by_their_numbers(kitti_root):
    folder = kitti_root / "sequences" / "00" / "image_0"
    for path in folder.iterdir():
        path.rename(folder / f"{int(path.stem)}.png")
    sequence = read_kitti(kitti_root, "00", camera_folder="image_0", channels=1)
    assert [int(sequence.read(i)[0, 0, 0]) for i in range(12)] == list(range(0, 36, 3))


def test_a_frame_of_another_size_is_refused(kitti_root):
    cv2.imwrite(str(kitti_root / "sequences" / "00" / "image_0" / "000004.png"), np.zeros((30, 124), np.uint8))
    sequence = read_kitti(kitti_root, "00", camera_folder="image_0")
    assert sequence.read(3).shape == (37, 124, 3)
    with pytest.raises(InputError, match=r"000004.png is 124x30 but .*000003.png is 124x37"):
        sequence.read(4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:-1], "has 11 poses but .*image_2 has 12 frames: expected one pose a frame"),
        (lambda lines: [*lines, lines[-1]], "has 13 poses but .* has 12 frames"),
        (lambda lines: [*lines[:4], lines[4] + " 7", *lines[5:]], "line 5: found 13 numbers, expected 12"),
        (lambda lines: [*lines[:2], "", *lines[2:]], "line 3: found 0 numbers"),
        (lambda lines: [lines[0].replace("0.0", "x", 1), *lines[1:]], "line 1: could not convert"),
        (lambda lines: ["nan " + lines[0].partition(" ")[2], *lines[1:]], "line 1: not every number is finite"),
        (lambda lines: [*lines[:6], "1 0 0 0 1 0 0 0 1 4 5 6", *lines[7:]], "line 7: .* are no rotation matrix"),
        (lambda lines: ["-1 0 0 0 0 1 0 0 0 0 1 0", *lines[1:]], "line 1: .* are no rotation matrix"),
        (lambda lines: [], "is empty"),
    ],
)
def test_malformed_poses_are_named(kitti_root, change, message):
    path = kitti_root / "poses" / "00.txt"
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")
    with pytest.raises(InputError, match=message):
        read_kitti(kitti_root, "00")


def test_a_missing_frame_is_hinted_at(kitti_root):
    (kitti_root / "sequences" / "00" / "image_2" / "000006.png").unlink()
    with pytest.raises(InputError, match=r"12 poses .* 11 frames \(number 6 is missing\)"):
        read_kitti(kitti_root, "00")


def test_other_mistakes_are_named(kitti_root):
    with pytest.raises(InputError, match=r"no sequence 03 in .*: found 00, 07"):
        read_kitti(kitti_root, "03")
    with pytest.raises(InputError, match=r"found none"):
        read_kitti(kitti_root / "poses", "03")
    with pytest.raises(InputError, match=r"no folder image_3 in .*: found image_0, image_2; use"):
        read_kitti(kitti_root, "00", camera_folder="image_3")
    folder = kitti_root / "sequences" / "00"
    cv2.imwrite(str(folder / "image_2" / "000003.jpg"), np.zeros((37, 124), np.uint8))
    with pytest.raises(InputError, match=r"two pictures of one number"):
        read_kitti(kitti_root, "00")
    (folder / "image_3").mkdir()
    with pytest.raises(InputError, match=r"0 frames in .*image_3"):
        read_kitti(kitti_root, "00", camera_folder="image_3")
    calibration = (folder / "calib.txt").read_text()
    (folder / "calib.txt").write_text(calibration.replace("P0", "Q0"))
    with pytest.raises(InputError, match=r"calib.txt has no line P0: found Q0, P1, P2, P3"):
        read_kitti(kitti_root, "00", camera_folder="image_0")
    (folder / "calib.txt").write_text(calibration.replace("P0:", "P0: 3.5"))
    with pytest.raises(InputError, match=r"calib.txt, line P0: found 13 numbers, expected 12"):
        read_kitti(kitti_root, "00", camera_folder="image_0")
    (folder / "calib.txt").write_text(calibration)
    (folder / "times.txt").write_text("0.0\n0.1\n")
    with pytest.raises(InputError, match=r"times.txt has 2 times for 12 frames"):
        read_kitti(kitti_root, "00", camera_folder="image_0")


def test_times_may_be_a_tum_trajectory_with_comments(tmp_path):
    path = tmp_path / "times.txt"
    path.write_text("# time x y z\n\n1.5 0 0 0 0 0 0 1\n2.25 # second\n")
    np.testing.assert_array_equal(read_times(path, 2), [1.5, 2.25])
    path.write_text("1.5\nnoon\n")
    with pytest.raises(InputError, match=r"line 2"):
        read_times(path, 2)
    assert read_times(tmp_path / "none.txt", 2) is None


# Raw drives

CAMERA_FROM_CAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


def test_a_raw_drive_gives_the_poses_of_its_camera(raw_root):
    sequence = read_kitti_raw(raw_root, "2011_09_26/2011_09_26_drive_0001_sync", channels=1)
    assert sequence.count == 4 and sequence.camera == (70.0, 70.0, 60.0, 18.0)
    assert [int(sequence.read(i)[0, 0, 0]) for i in range(4)] == [0, 9, 18, 27]
    np.testing.assert_allclose(sequence.timestamps, [0, 0.100000001, 0.200000002, 0.300000003], atol=1e-12)
    # By hand: where the unit was, and where the camera sits on the car.
    T_imu = np.tile(np.eye(4), (4, 1, 1))
    T_imu[:, :2, 3] = [(0, 0), (2, 0), (4, 0), (5, 1)]
    T_imu[3, :3, :3] = Rotation.from_euler("z", 45, degrees=True).as_matrix()
    velodyne_imu, camera_velodyne, rectify = np.eye(4), np.eye(4), np.eye(4)
    velodyne_imu[:3, 3] = -0.8, 0.3, -0.8
    camera_velodyne[:3, :3] = CAMERA_FROM_CAR
    camera_velodyne[:3, 3] = 0, 0, -0.3
    rectify[:3, :3] = Rotation.from_rotvec([0.01, -0.02, 0.005]).as_matrix()
    offset = np.eye(4)
    offset[:3, 3] = -0.06, 0, -0.003
    T_imu_camera = np.linalg.inv(rectify @ camera_velodyne @ velodyne_imu) @ offset
    expected = np.linalg.inv(T_imu[:-1] @ T_imu_camera) @ T_imu[1:] @ T_imu_camera
    found = np.linalg.inv(sequence.poses[:-1]) @ sequence.poses[1:]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(sequence.poses[0], offset, atol=1e-9)
    # East at a yaw of zero is straight ahead, up to the rectifying turn; the last step turns left.
    np.testing.assert_allclose(sequence.steps()[0], [0, 0, 2, 0, 0, 0], atol=0.05)
    assert sequence.steps()[2, 4] == pytest.approx(-np.pi / 4, abs=0.02)


def test_mercator_axes_are_east_north_up():
    start = [49.0, 8.4, 100.0, 0.0, 0.0, 0.0]
    poses = mercator_poses(np.array([start, [49.001, 8.4, 100, 0, 0, 0], [49.0, 8.401, 103, 0.1, 0.2, 0.3]]))
    moved = poses[1:, :3, 3] - poses[0, :3, 3]
    # A minute of latitude is about a nautical mile; a thousandth of a degree 111.3 m, of longitude that by cos(49).
    np.testing.assert_allclose(moved, [[0, 111.32, 0], [73.03, 0, 3]], atol=0.01)
    expected = Rotation.from_euler("ZYX", [0.3, 0.2, 0.1]).as_matrix()
    np.testing.assert_allclose(poses[2, :3, :3], expected, atol=1e-12)


def test_mistakes_in_raw_drives_are_named(raw_root):
    name = "2011_09_26/2011_09_26_drive_0001_sync"
    with pytest.raises(InputError, match=r"no folder image_03 in .*: found image_02"):
        read_kitti_raw(raw_root, name, camera_folder="image_03")
    packet = raw_root / name / "oxts" / "data" / "0000000002.txt"
    packet.write_text("49.0 8.4")
    with pytest.raises(InputError, match=r"0000000002.txt has 2 numbers: expected 30"):
        read_kitti_raw(raw_root, name)
    packet.unlink()
    with pytest.raises(InputError, match=r"no .*0000000002.txt for the frame of that number \(1 missing\)"):
        read_kitti_raw(raw_root, name)
    (raw_root / "2011_09_26" / "calib_cam_to_cam.txt").write_text("S_02: 1 2\n")
    packet.write_text(" ".join("0" * 30))
    with pytest.raises(InputError, match=r"calib_cam_to_cam.txt has no line P_rect_02: found S_02"):
        read_kitti_raw(raw_root, name)


def test_malformed_files_of_raw_drives_are_named(raw_root):
    name = "2011_09_26/2011_09_26_drive_0001_sync"
    stamps = raw_root / name / "image_02" / "timestamps.txt"
    lines = stamps.read_text().splitlines()
    stamps.write_text("\n".join([lines[0], "noon", *lines[2:]]))
    with pytest.raises(InputError, match=r"timestamps.txt, line 2: .*: expected a date and a time"):
        read_kitti_raw(raw_root, name)
    stamps.write_text("\n".join(lines[:3]))
    with pytest.raises(InputError, match=r"timestamps.txt has 3 times for 4 frames"):
        read_kitti_raw(raw_root, name)
    stamps.unlink()
    assert read_kitti_raw(raw_root, name).timestamps is None
    calibration = raw_root / "2011_09_26" / "calib_velo_to_cam.txt"
    calibration.write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match=r"cannot read .*calib_velo_to_cam.txt .*: expected a text file"):
        read_kitti_raw(raw_root, name)
    calibration.unlink()
    with pytest.raises(InputError, match=r"cannot read .*calib_velo_to_cam.txt"):
        read_kitti_raw(raw_root, name)
