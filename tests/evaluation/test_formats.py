import io
import json

import numpy as np
import pytest

from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation.formats import read_times, read_trajectory

# A quarter turn about y (z ahead becomes x), 1, 2, 3 away.
ROTATION = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
QUATERNION_XYZW = np.array([0, np.sqrt(0.5), 0, np.sqrt(0.5)])


def pose(translation=(1.0, 2.0, 3.0), rotation=ROTATION):
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, translation
    return result


def kitti_line(matrix):
    return " ".join(f"{value:.9e}" for value in matrix[:3].reshape(-1))


IDENTITY_LINE = kitti_line(np.eye(4))
TURNED_LINE = kitti_line(pose())
TUM_LINE = "0.5 1 2 3 " + " ".join(f"{value:.9f}" for value in QUATERNION_XYZW)


@pytest.fixture
def write(tmp_path):
    def write_file(content, name="poses.txt"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write_file


def test_kitti_lines_are_the_upper_rows_of_the_pose(write):
    found = read_trajectory(write(f"{IDENTITY_LINE}\n{TURNED_LINE}\n"))
    assert found.format == "kitti"
    assert found.frames is None and found.timestamps is None
    np.testing.assert_allclose(found.poses, [np.eye(4), pose()], atol=1e-9)


def test_indexed_lines_carry_the_frame_and_are_sorted(write):
    found = read_trajectory(write(f"7 {TURNED_LINE}\n3 {IDENTITY_LINE}\n"))
    assert found.format == "indexed"
    assert found.frames.tolist() == [3, 7]
    np.testing.assert_allclose(found.poses, [np.eye(4), pose()], atol=1e-9)


def test_tum_has_the_scalar_of_the_quaternion_last(write):
    found = read_trajectory(write(f"# timestamp tx ty tz qx qy qz qw\n{TUM_LINE}\n0.25 0 0 0 0 0 0 1\n"))
    assert found.format == "tum"
    assert found.timestamps.tolist() == [0.25, 0.5]
    np.testing.assert_allclose(found.poses, [np.eye(4), pose()], atol=1e-8)


@pytest.mark.parametrize("header", ["#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m]", "timestamp,tx,ty,tz,qw,qx,qy,qz"])
@pytest.mark.parametrize("more", ["", ",0.1,0.2,0.3,0,0,0,0,0,0"])
def test_euroc_has_nanoseconds_and_the_scalar_first(write, header, more):
    x, y, z, w = QUATERNION_XYZW
    line = f"1500000000,1,2,3,{w:.9f},{x:.9f},{y:.9f},{z:.9f}{more}"
    found = read_trajectory(write(f"{header}\n{line}\n", "data.csv"))
    assert found.format == "euroc"
    assert found.timestamps.tolist() == [1.5]
    np.testing.assert_allclose(found.poses, [pose()], atol=1e-8)


def test_csv_without_a_header_is_asked_for_and_then_read(write):
    path = write("1500000000,1,2,3,1,0,0,0\n", "data.csv")
    with pytest.raises(InputError, match=r"line 1: a csv without a header.*--format"):
        read_trajectory(path)
    np.testing.assert_allclose(read_trajectory(path, format="euroc").timestamps, [1.5])
    np.testing.assert_allclose(read_trajectory(write("1.5,1,2,3,0,0,0,1\n"), format="tum").timestamps, [1.5])


def test_a_comma_in_a_comment_makes_no_csv(write):
    assert read_trajectory(write(f"# timestamp, tx, ty, tz, qx, qy, qz, qw\n{TUM_LINE}\n")).format == "tum"


def test_rotations_are_projected(write):
    rough = np.round(pose(rotation=_about_y(0.3)), 4)
    rotation = read_trajectory(write(kitti_line(rough))).poses[0, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation, _about_y(0.3), atol=1e-4)


@pytest.mark.parametrize(
    "encoded",
    [
        lambda text: b"\xef\xbb\xbf" + text.encode(),
        lambda text: text.encode("utf-16"),
        lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
        lambda text: text.replace("\n", "\r\n").encode(),
        lambda text: ("\n\n# comment\n" + text).encode(),
    ],
    ids=["utf-8 with mark", "utf-16 little", "utf-16 big", "windows line ends", "blank and comment"],
)
def test_text_may_come_from_any_system(write, encoded):
    found = read_trajectory(write(encoded(f"{IDENTITY_LINE}\n{TURNED_LINE}\n")))
    np.testing.assert_allclose(found.poses[1], pose(), atol=1e-9)


SCALED = kitti_line(pose(rotation=10 * ROTATION))
MIRRORED = kitti_line(pose(rotation=np.diag([1.0, 1, -1])))
ELEVEN = " ".join(IDENTITY_LINE.split()[:11])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "holds no poses"),
        (b"\n \n# nothing\n", "holds no poses"),
        (b"#timestamp,tx,ty\n", "holds no poses"),
        (f"{IDENTITY_LINE}\n{ELEVEN}\n", "line 2: 11 entries; expected 12"),
        (f"{ELEVEN}\n", r"line 1: 11 entries; expected 12 \(KITTI\), 13"),
        (f"{IDENTITY_LINE}\n{IDENTITY_LINE} 5\n", "line 2: 13 entries; expected 12"),
        (f"{IDENTITY_LINE}\n{IDENTITY_LINE[:-4]}x\n", "line 2: .* is no number"),
        (IDENTITY_LINE.replace("1.000000000e+00", "nan", 1), "line 1: a number that is not finite"),
        (IDENTITY_LINE.replace("1.000000000e+00", "1e999", 1), "line 1: a number that is not finite"),
        (IDENTITY_LINE.replace("0.000000000e+00", "1_0", 1), "line 1: '1_0' is no number"),
        (f"{IDENTITY_LINE}\n\n{SCALED}\n", "line 3: columns 1-3 .* are no rotation"),
        (MIRRORED, "line 1: .*determinant -1"),
        (f"1.5 {IDENTITY_LINE}", "line 1: frame number 1.5; expected a whole number"),
        (f"-1 {IDENTITY_LINE}", "line 1: frame number -1"),
        (f"4 {IDENTITY_LINE}\n5 {IDENTITY_LINE}\n4 {IDENTITY_LINE}\n", "line 3: frame 4 is there twice"),
        (f"{TUM_LINE}\n{TUM_LINE}\n", "line 2: timestamp 0.5 is there twice"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 0.5\n", "line 2: the quaternion has norm 0.5"),
        ("0 0 0 0 0 0 0 0\n", "line 1: the quaternion has norm 0"),
        (b"\x89PNG\r\n\x1a\n\x00\x00\xff\xfe", "is no text file"),
        (b"abc\x00def", "is a binary file"),
        (b"\xff\xfe1", "is no text file"),
    ],
)
def test_malformed_files_are_named_with_line_and_reason(write, content, message):
    path = write(content)
    with pytest.raises(InputError, match=message) as raised:
        read_trajectory(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_missing_file_and_wrong_kind_of_path(tmp_path, write):
    with pytest.raises(InputError, match="no such file"):
        read_trajectory(tmp_path / "absent.txt")
    with pytest.raises(InputError, match=r"has no trajectory_kitti\.txt"):
        read_trajectory(tmp_path)
    with pytest.raises(InputError, match="is a folder; expected a file of format tum"):
        read_trajectory(tmp_path, format="tum")
    with pytest.raises(InputError, match="is no folder"):
        read_trajectory(write(IDENTITY_LINE), format="output")


def test_wrong_format_given_is_a_wrong_count(write):
    with pytest.raises(InputError, match="line 1: 12 entries; expected 8: timestamp"):
        read_trajectory(write(IDENTITY_LINE), format="tum")


def output_folder(folder, *, poses=3, times=3, steps=2, summary=None):
    folder.mkdir(exist_ok=True)
    (folder / "trajectory_kitti.txt").write_text(f"{TURNED_LINE}\n" * poses)
    (folder / "trajectory_tum.txt").write_text("".join(f"{i / 10} 1 2 3 0 0 0 1\n" for i in range(times)))
    if steps is not None:
        shapes = {"logits": (steps, 2), "mean": (steps, 2, 6), "log_scale": (steps, 2, 6)}
        np.savez(folder / "mixture.npz", **{name: np.zeros(shape, np.float32) for name, shape in shapes.items()})
    if summary is not None:
        (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def test_our_own_folder_gives_poses_times_and_densities(tmp_path):
    found = read_trajectory(output_folder(tmp_path / "run", summary={"coupling": "joint"}))
    assert (found.format, found.coupling) == ("output", "joint")
    np.testing.assert_allclose(found.poses[2], pose(), atol=1e-9)
    np.testing.assert_allclose(found.timestamps, [0, 0.1, 0.2])
    assert found.mixture.mean.shape == (2, 2, 6) and found.mixture.mean.dtype == np.float64


def test_frame_numbers_in_place_of_times_are_no_times(tmp_path):
    folder = output_folder(tmp_path / "run", steps=None, summary={"timestamps": "frame numbers"})
    found = read_trajectory(folder)
    assert found.timestamps is None and found.mixture is None and found.coupling == "independent"


def test_a_folder_of_orbslam_has_numbered_frames(tmp_path):
    (tmp_path / "trajectory_kitti_indexed.txt").write_text(f"4 {TURNED_LINE}\n7 {TURNED_LINE}\n")
    found = read_trajectory(tmp_path)
    assert found.frames.tolist() == [4, 7] and found.path == str(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"times": 2}, "3 poses in trajectory_kitti.txt but 2 in trajectory_tum.txt"),
        ({"steps": 3}, r"means of shape \(3, 2, 6\); expected \[2, M, 6\]"),
    ],
)
def test_our_own_folder_must_agree_with_itself(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        read_trajectory(output_folder(tmp_path / "run", **change))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no archive", b"text"])
def test_damaged_mixture(tmp_path, content):
    folder = output_folder(tmp_path / "run")
    (folder / "mixture.npz").write_bytes(content)
    with pytest.raises(InputError, match="is not a mixture that predict wrote"):
        read_trajectory(folder)


def test_damaged_summary(tmp_path):
    folder = output_folder(tmp_path / "run")
    (folder / "summary.json").write_text("{")
    with pytest.raises(InputError, match="is not a summary"):
        read_trajectory(folder)


def test_mixture_without_a_field(tmp_path):
    folder = output_folder(tmp_path / "run")
    buffer = io.BytesIO()
    np.savez(buffer, logits=np.zeros((2, 1)))
    (folder / "mixture.npz").write_bytes(buffer.getvalue())
    with pytest.raises(InputError, match="is not a mixture"):
        read_trajectory(folder)


def test_times(write):
    np.testing.assert_allclose(read_times(write("0.0e+00\n1.03e-01\n")), [0, 0.103])
    with pytest.raises(InputError, match="line 3: the time does not increase"):
        read_times(write("0\n1\n1\n"))
    with pytest.raises(InputError, match="line 1: 2 entries; expected 1"):
        read_times(write("0 1\n"))


def _about_y(angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
