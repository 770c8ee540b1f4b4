import numpy as np
import pytest

from mdnvo_jax.evaluation.kitti_segments import by_length, by_speed, segment_errors


def straight(count, speed, *, sideways=0.0):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = speed * np.arange(count)
    poses[:, 0, 3] = sideways * np.arange(count)
    return poses


def turning(count, speed, yaw_rate):
    """Straight ahead in position, with a heading that turns steadily: only the rotation of the estimate is wrong."""
    poses = straight(count, speed)
    angles = yaw_rate * np.arange(count)
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(angles)
    poses[:, 0, 2], poses[:, 2, 0] = np.sin(angles), -np.sin(angles)
    return poses


def test_five_per_cent_too_short():
    truth, estimate = straight(1000, 1.5), straight(1000, 1.5 * 0.95)
    found = segment_errors(estimate, truth, np.arange(1000))
    # A segment ends at the first frame beyond its length: 67 steps are 100.5 m, and so on.
    reach_m = 1.5 * (np.floor(found.length_m / 1.5) + 1)
    np.testing.assert_allclose(found.translation, 0.05 * reach_m / found.length_m)
    assert found.translation_percent == pytest.approx(5.0, abs=0.03)
    assert found.rotation_deg_per_100m == pytest.approx(0, abs=1e-6)


def test_the_end_is_strictly_beyond_the_length():
    # After 100 steps of 1 m the path is exactly 100 m, which is not yet more than 100 m.
    found = segment_errors(straight(131, 1.0), straight(131, 1.0), np.arange(131))
    assert found.start.tolist() == [0, 10, 20]
    assert segment_errors(straight(101, 1.0), straight(101, 1.0), np.arange(101)).possible == 0
    assert segment_errors(straight(102, 1.0), straight(102, 1.0), np.arange(102)).possible == 1


def test_starts_are_every_tenth_frame_and_lengths_up_to_800():
    truth = straight(2000, 1.0)
    found = segment_errors(truth, truth, np.arange(2000))
    assert set(found.start % 10) == {0}
    assert sorted(set(found.length_m)) == list(range(100, 801, 100))
    # From frame s a segment of L m needs frame s + L + 1: s <= 1998 - L.
    assert len(found.start) == sum((1998 - length) // 10 + 1 for length in range(100, 801, 100))


def test_rotation_is_the_angle_over_the_length():
    truth, estimate = straight(500, 1.0), turning(500, 1.0, yaw_rate=1e-3)
    found = segment_errors(estimate, truth, np.arange(500))
    np.testing.assert_allclose(found.rotation_rad_per_m, 1e-3 * (found.length_m + 1) / found.length_m, rtol=1e-6)
    assert found.rotation_deg_per_100m == pytest.approx(np.rad2deg(0.1), rel=0.01)


def test_the_heading_of_the_estimate_turns_its_translation():
    # 90 degrees off from the start is no error at all, since a segment is seen from its own first camera.
    quarter = np.array([[0.0, 0, 1, 5], [0, 1, 0, 6], [-1, 0, 0, 7], [0, 0, 0, 1]])
    truth = straight(300, 1.0)
    found = segment_errors(quarter @ truth, truth, np.arange(300))
    np.testing.assert_allclose(found.translation, 0, atol=1e-12)


def test_lengths_are_those_of_the_reference():
    truth, estimate = straight(300, 1.0), straight(300, 0.0)
    found = segment_errors(estimate, truth, np.arange(300))
    np.testing.assert_allclose(found.translation, (found.length_m + 1) / found.length_m)


def test_missing_frames_cost_the_segments_that_end_on_them():
    truth = straight(300, 1.0)
    whole = segment_errors(truth, truth, np.arange(300))
    # Without frame 0 the segments from 0 go; without 111 the one of 100 m from 10.
    frames = np.setdiff1d(np.arange(300), [0, 111])
    found = segment_errors(truth[frames], truth, frames)
    assert found.possible == whole.possible == len(whole.start)
    lost = {(start, length) for start, length in zip(whole.start, whole.length_m, strict=True)} - {
        (start, length) for start, length in zip(found.start, found.length_m, strict=True)
    }
    assert lost == {(0, 100), (0, 200), (10, 100)}
    np.testing.assert_allclose(found.translation, 0, atol=1e-12)


@pytest.mark.parametrize("count", [2, 90, 112])
def test_too_short_a_path_has_no_figure(count):
    truth = straight(count, 1.0)
    found = segment_errors(truth, truth, np.arange(count))
    assert np.isnan(found.translation_percent) and np.isnan(found.rotation_deg_per_100m)
    assert by_length(found) == [] and by_speed(found) == []


def test_three_segments_are_a_figure():
    truth = straight(122, 1.0)
    assert segment_errors(truth, truth, np.arange(122)).translation_percent == pytest.approx(0)


def test_averages_by_length_and_by_speed():
    truth, estimate = straight(400, 1.0), straight(400, 1.0, sideways=0.02)
    found = segment_errors(estimate, truth, np.arange(400))
    lengths = by_length(found)
    assert [row.at for row in lengths] == [100, 200, 300]
    assert [row.count for row in lengths] == [30, 20, 10]
    for row in lengths:
        assert row.translation_percent == pytest.approx(2 * (row.at + 1) / row.at)
    # 1 m every 0.1 s; the kit counts the frames, not the steps, so 100 m take 10.2 s:
    # 9.8 m/s, which is less than 2 from 8 and from 10.
    speeds = by_speed(found)
    assert [row.at for row in speeds] == [8, 10]
    assert [row.count for row in speeds] == [60, 60]
    np.testing.assert_allclose(sorted(set(found.speed_mps)), [100 / 10.2, 200 / 20.2, 300 / 30.2])


def test_standing_at_the_lights_counts_once():
    # 200 frames without motion in between: distances do not grow, so searches must not stumble over equal ones.
    truth = np.concatenate([straight(150, 1.0), np.tile(straight(150, 1.0)[-1], (200, 1, 1))])
    found = segment_errors(truth, truth, np.arange(350))
    assert len(found.start) == 5
    assert found.possible == 5
