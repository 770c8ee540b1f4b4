"""Poses, order, times and camera of scenes of nuScenes."""

import numpy as np
import pytest
from nuscenes_fixture import VERSION, brightness, edit_table, write_nuscenes
from nuscenes_reading import ONE, read, rebased

from mdnvo_jax import geometry
from mdnvo_jax.data import nuscenes


@pytest.mark.parametrize("scene", ["scene-0061", "scene-0103", "scene-1077", "scene-0999"])
def test_poses_are_those_of_the_camera_at_its_images(mini, scene):
    root, truth = mini
    sequence, expected = read(root, scene), truth[scene]
    assert (sequence.name, sequence.count) == (scene, len(expected.times_us))
    np.testing.assert_allclose(sequence.poses, rebased(expected.poses), atol=1e-9)
    np.testing.assert_allclose(sequence.timestamps, expected.times_us / 1e6, rtol=0, atol=3e-7)
    assert sequence.camera == pytest.approx(expected.camera)
    assert sequence.paths == [str(root / file) for file in expected.files]


def test_a_car_straight_ahead_moves_its_camera_along_z(tmp_path):
    """By hand: without the extrinsics, or with those of another sensor, the motion would be along x."""
    write_nuscenes(tmp_path, ONE, frames=7)
    start = edit_table(tmp_path, "calibrated_sensor", ahead_looking)
    assert start is None

    def straight(rows):
        for row in rows:
            t = (row["timestamp"] - 1_532_402_927_612_460) / 1e6
            row.update(translation=[100.0, 500.0 + 10 * t, 0.0], rotation=[np.sqrt(0.5), 0, 0, np.sqrt(0.5)])

    edit_table(tmp_path, "ego_pose", straight)
    steps = read(tmp_path).steps()
    np.testing.assert_allclose(steps[:, 2], [0.5, 1, 1, 0.5, 1, 1], atol=1e-9)  # 10 m/s, 0.05 or 0.1 s
    np.testing.assert_allclose(np.delete(steps, 2, axis=1), 0, atol=1e-9)


def ahead_looking(rows):
    for row in rows:
        row["rotation"] = [0.5, -0.5, 0.5, -0.5]  # x right, y down, z ahead, of a car with x ahead, y left


def test_a_turn_swings_the_camera_by_its_lever(tmp_path):
    """By hand: a car that turns left about its rear axle by 0.1 rad swings a camera 2 m ahead of it to the left."""
    write_nuscenes(tmp_path, ONE, frames=2)
    edit_table(tmp_path, "calibrated_sensor", ahead_looking)
    edit_table(tmp_path, "calibrated_sensor", lambda rows: [{**row, "translation": [2.0, 0.0, 1.5]} for row in rows])

    def turning(rows):
        for row in rows:
            angle = 2 * (row["timestamp"] - 1_532_402_927_612_460) / 1e6
            row.update(translation=[9.0, 9.0, 0.0], rotation=[np.cos(angle / 2), 0, 0, np.sin(angle / 2)])

    edit_table(tmp_path, "ego_pose", turning)
    expected = [-2 * np.sin(0.1), 0, 2 * (np.cos(0.1) - 1), 0, -0.1, 0]
    np.testing.assert_allclose(read(tmp_path).steps(), [expected], atol=1e-9)


def test_labels_compose_to_the_poses(mini):
    root, _ = mini
    sequence = read(root, "scene-0999")
    composed = geometry.accumulate(geometry.step_to_matrix(sequence.steps()))
    np.testing.assert_allclose(composed, sequence.poses, atol=1e-10)
    assert sequence.poses.dtype == np.float64
    np.testing.assert_allclose(sequence.poses[0], np.eye(4), atol=1e-12)
    rotations = sequence.poses[:, :3, :3]
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, 1, 2), np.tile(np.eye(3), (24, 1, 1)), atol=1e-14)


def test_coarse_quaternions_still_give_rotations(one):
    root, _ = one
    edit_table(
        root, "ego_pose", lambda rows: [{**row, "rotation": np.round(row["rotation"], 4).tolist()} for row in rows]
    )
    rotations = read(root).poses[:, :3, :3]
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, 1, 2), np.tile(np.eye(3), (24, 1, 1)), atol=1e-14)


def test_frames_come_in_the_order_of_time(mini):
    root, truth = mini
    sequence = read(root, "scene-1077")
    assert np.diff(sequence.timestamps).min() > 0.04
    for index, number in enumerate(truth["scene-1077"].numbers):
        assert sequence.read(index).mean() == pytest.approx(brightness(number), abs=2.0)
    frame = sequence.read(0)
    assert frame.dtype == np.uint8 and frame.shape == (36, 64, 3)
    assert read(root, "scene-1077", channels=1).read(0).shape == (36, 64, 1)


def test_key_frames_are_two_a_second(mini):
    root, truth = mini
    sequence, expected = read(root, "scene-0061", key_frames_only=True), truth["scene-0061"]
    assert sequence.count == 4 and all("samples" in path for path in sequence.paths)
    np.testing.assert_allclose(np.diff(sequence.timestamps), 0.5, atol=1e-6)
    np.testing.assert_allclose(sequence.poses, rebased(expected.poses[expected.is_key_frame]), atol=1e-9)


def test_neither_the_order_of_rows_nor_links_matter(one):
    root, truth = one

    def tangle(rows):
        for row in rows:
            row["next"] = row["prev"] = row["token"]  # a cycle
        return rows[::-1] + rows[:5]  # and rows that occur twice

    edit_table(root, "sample_data", tangle)
    edit_table(root, "ego_pose", lambda rows: rows + rows[:7])
    np.testing.assert_allclose(read(root).poses, rebased(truth.poses), atol=1e-9)
    assert nuscenes.scenes(root, VERSION)[0].frames == 24


def test_the_fixture_renders_drives_that_its_poses_describe(tmp_path):
    truth = write_nuscenes(tmp_path, ONE, frames=8, rendered=True)["scene-0061"]
    sequence = read(tmp_path)
    np.testing.assert_allclose(sequence.poses, rebased(truth.poses), atol=1e-9)
    assert sequence.read(0).std() > 10
    from mdnvo_jax.data import synthetic

    drive = synthetic.drive(0, 8, height=36, width=64, channels=3, camera=sequence.camera)
    # The same motion, but for the bounce that a localisation in the plane does not see.
    np.testing.assert_allclose(sequence.steps()[:, [0, 2, 4]], drive.steps()[:, [0, 2, 4]], atol=0.05)
    assert np.abs(sequence.steps()[:, [1, 3, 5]]).max() < 0.1
