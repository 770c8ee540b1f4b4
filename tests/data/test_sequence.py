import numpy as np
import pytest

from mdnvo_jax.data.sequence import Sequence, one_size, rigid
from mdnvo_jax.errors import InputError


def test_steps_compose_to_the_poses_again(toy, poses):
    sequence = toy(30)
    pose = sequence.poses[0]
    from scipy.spatial.transform import Rotation

    for index, step in enumerate(sequence.steps(), 1):
        T = np.eye(4)
        T[:3, 3], T[:3, :3] = step[:3], Rotation.from_rotvec(step[3:]).as_matrix()
        pose = pose @ T
        np.testing.assert_allclose(pose, sequence.poses[index], atol=1e-12)


def test_steps_are_in_the_axes_of_the_earlier_camera(toy):
    # The camera looks along world x (a yaw of +90 degrees turns z to x), then drives 2 m forwards and turns on.
    yaw = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    ahead = np.eye(4)
    ahead[2, 3] = 2.0
    sequence = toy(2, poses=np.stack([yaw, yaw @ ahead @ yaw]))
    np.testing.assert_allclose(sequence.steps(), [[0, 0, 2, 0, np.pi / 2, 0]], atol=1e-12)
    np.testing.assert_allclose(sequence.poses[1, :3, 3], [2, 0, 0], atol=1e-12)


def test_subsequence_keeps_frames_poses_times_and_names_together(toy):
    whole = toy(10, timestamps=np.arange(10) / 10.0, paths=[f"f{i}" for i in range(10)])
    part = whole.subsequence(3, 7).subsequence(1, 3)
    assert (part.count, part.read(0)[0, 0, 0], part.read(1)[0, 0, 0]) == (2, 4, 5)
    np.testing.assert_array_equal(part.poses, whole.poses[4:6])
    np.testing.assert_array_equal(part.timestamps, [0.4, 0.5])
    assert part.label(1) == "f5"
    assert toy(3).label(2) == "frame 2 of sequence toy"
    for start, stop in ((0, 11), (-1, 3), (4, 4)):
        with pytest.raises(InputError, match=r"has 10 frames"):
            whole.subsequence(start, stop)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"poses": np.zeros((3, 4, 4))}, r"poses of shape \(3, 4, 4\) for 4 frames"),
        ({"timestamps": np.zeros(5)}, r"timestamps of shape \(5,\) for 4 frames"),
        ({"timestamps": np.array([0.0, 1.0, np.nan, 3.0])}, "frame 2 has timestamps that are not finite"),
        ({"poses": np.full((4, 4, 4), np.inf)}, "frame 0 has poses that are not finite"),
        ({"paths": ["a"]}, "1 paths for 4 frames"),
        ({"camera": (1.0, 2.0, 3.0)}, "expected the four numbers"),
    ],
)
def test_what_does_not_fit_is_refused(values, message):
    with pytest.raises(InputError, match=message):
        Sequence("s", 4, lambda index: np.zeros((2, 2, 1), np.uint8), **values)


def test_without_poses_there_are_no_labels(toy):
    with pytest.raises(InputError, match=r"has no poses"):
        toy(4, poses=None).steps()


def test_rigid_gives_rotations_close_to_rounded_ones(poses):
    exact = poses(20)
    rounded = np.round(exact[:, :3], 5)
    result = rigid(rounded)
    identity = np.einsum("nij,nkj->nik", result[:, :3, :3], result[:, :3, :3])
    np.testing.assert_allclose(identity, np.tile(np.eye(3), (20, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(result[:, :3, :3], exact[:, :3, :3], atol=1e-5)
    np.testing.assert_array_equal(result[:, :3, 3], rounded[:, :, 3])


def test_one_size_names_both_frames():
    frames = [np.zeros((4, 6, 1), np.uint8), np.zeros((4, 6, 1), np.uint8), np.zeros((6, 4, 1), np.uint8)]
    read = one_size(frames.__getitem__, lambda index: f"f{index}.png")
    assert read(0).shape == read(1).shape
    with pytest.raises(InputError, match=r"f2.png is 4x6 but f0.png is 6x4"):
        read(2)
    assert read(1) is frames[1]
