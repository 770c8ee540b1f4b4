"""Gaps between frames of nuScenes, and poses that are interpolated."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nuscenes_fixture import VERSION, Spec, edit_table, token, write_nuscenes
from nuscenes_reading import read, rebased
from scipy.spatial.transform import Rotation, Slerp

from mdnvo_jax.data import nuscenes
from mdnvo_jax.data.nuscenes import interpolate_poses
from mdnvo_jax.errors import InputError

GAPPY = (Spec("scene-1077", "Night", dropped=(4, 5, 12)),)


def test_dropped_frames_are_gaps(tmp_path):
    write_nuscenes(tmp_path, GAPPY)
    (scene,) = nuscenes.scenes(tmp_path, VERSION)
    # Frames 4 and 5 leave 3 and 6 apart by revolutions 5 to 10; frame 12 leaves 18 to 21.
    assert [gap.frame for gap in scene.gaps] == [4, 10]
    assert [gap.seconds for gap in scene.gaps] == pytest.approx([0.25, 0.15], abs=1e-6)
    assert (scene.frames, scene.key_frames) == (21, 3)
    keys = read(tmp_path, "scene-1077", key_frames_only=True)
    assert [gap.frame for gap in nuscenes.find_gaps(keys.timestamps, nuscenes.KEY_FRAME_GAP_S)] == [2]


def test_no_gap_where_nothing_was_dropped(mini):
    root, _ = mini
    gaps = {scene.name: scene.gaps for scene in nuscenes.scenes(root, VERSION)}
    assert [name for name, found in gaps.items() if found] == ["scene-1077"]


def test_interpolation_changes_nothing_where_the_poses_are_those_of_the_images(mini):
    root, truth = mini
    poses = read(root, "scene-1077", interpolate=True).poses
    np.testing.assert_allclose(poses, rebased(truth["scene-1077"].poses), atol=1e-9)


def test_interpolation_bridges_missing_ego_poses(one):
    root, truth = one
    front = set(truth.times_us[[0, 7, 8, 15]])
    edit_table(root, "ego_pose", lambda rows: [row for row in rows if row["timestamp"] not in front])
    with pytest.raises(InputError, match=r"4 of 24 frames have no row in ego_pose.json, the first samples/CAM_FRONT"):
        read(root)
    # Between the ego poses of the other sensors, at most 0.05 s apart, at accelerations of some m/s^2.
    np.testing.assert_allclose(read(root, interpolate=True).poses, rebased(truth.poses), atol=5e-3)


def test_interpolation_is_at_the_time_of_the_image(one):
    """Ego poses of the image rows that are late by 25 ms, as of a slower localisation: their own times tell."""
    root, truth = one
    late = {token("scene-0061", "CAM_FRONT", revolution) for revolution in range(100)}
    others = {}

    def shift(rows):
        others.update({row["token"]: row for row in rows})
        scanner = [row for row in rows if row["token"] not in late and row["timestamp"] % 50_000 == 47_500]
        return scanner + [{**scanner[0], "token": key} for key in late]

    edit_table(root, "ego_pose", shift)
    np.testing.assert_allclose(read(root, interpolate=True).poses, rebased(truth.poses), atol=5e-3)
    assert np.ptp(read(root).poses[:, 2, 3]) < 1e-9  # as the rows have it, the camera stands still


@pytest.mark.parametrize(
    ("kept", "message"),
    [
        (lambda t: t > 0.3, r"5 of 24 frames cannot be interpolated, the first, samples/.*beyond the ego poses"),
        (lambda t: t < 1.5, "beyond the ego poses"),
        (lambda t: not 0.3 < t < 1.1, r"between ego poses 0.8\d s apart"),
        (lambda t: t == 0, "1 ego poses for 24 frames"),
    ],
)
def test_interpolation_does_not_guess(one, kept, message):
    root, truth = one
    edit_table(
        root, "ego_pose", lambda rows: [row for row in rows if kept((row["timestamp"] - truth.times_us[0]) / 1e6)]
    )
    with pytest.raises(InputError, match=message):
        read(root, interpolate=True)


def test_a_pose_at_the_time_of_the_image_needs_no_neighbours(tmp_path):
    truth = write_nuscenes(tmp_path, (Spec("scene-0061", "A long drop", dropped=tuple(range(3, 13))),))["scene-0061"]
    front = set(truth.times_us)
    edit_table(tmp_path, "ego_pose", lambda rows: [row for row in rows if row["timestamp"] in front])
    np.testing.assert_allclose(read(tmp_path, interpolate=True).poses, rebased(truth.poses), atol=1e-9)


@given(st.integers(0, 2**31), st.integers(2, 6))
def test_interpolated_poses_are_those_of_scipy(seed, count):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 0.5, count))
    rotations, translations = Rotation.random(count, random_state=seed), rng.normal(size=(count, 3))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations.as_matrix(), translations
    at = np.concatenate([rng.uniform(times[0], times[-1], 5), times])
    found = interpolate_poses(times, poses, at)
    np.testing.assert_allclose(found[:, :3, :3], Slerp(times, rotations)(at).as_matrix(), atol=1e-9)
    expected = [np.interp(at, times, translations[:, axis]) for axis in range(3)]
    np.testing.assert_allclose(found[:, :3, 3].T, expected, atol=1e-12)
