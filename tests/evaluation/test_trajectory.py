import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation.trajectory import (
    ALIGNMENTS,
    absolute_error_m,
    align,
    relative_pose_error,
    statistics,
)


def winding_path(count=60, seed=0):
    """A drive with turns and bounce, from the identity."""
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for i in range(count - 1):
        step = rigid([0.02, 0.01, 1.0], [0.002, 0.05 * np.sin(i / 7), 0.001] + 0.003 * rng.standard_normal(3))
        poses.append(poses[-1] @ step)
    return np.array(poses)


def rigid(translation, rotation_vector=(0, 0, 0)):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    pose[:3, 3] = translation
    return pose


def straight_path(count=20, direction=(0, 0, 1.0), speed=1.0):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = speed * np.arange(count)[:, None] * np.asarray(direction) / np.linalg.norm(direction)
    return poses


def similar(poses, scale, world):
    scaled = poses.copy()
    scaled[:, :3, 3] *= scale
    return world @ scaled


WORLD = rigid([30.0, -4, 7], [0.3, -1.1, 0.4])


class TestAlign:
    @pytest.mark.parametrize("how", ALIGNMENTS)
    def test_truth_in_another_world_comes_back(self, how):
        truth = winding_path()
        scale = 3.0 if how in ("scale", "sim3") else 1.0
        aligned = align(similar(truth, 1 / scale, WORLD), truth, how)
        np.testing.assert_allclose(aligned.poses, truth, atol=1e-9)
        assert aligned.scale == pytest.approx(scale) and aligned.note == ""

    def test_none_and_se3_leave_the_size(self):
        truth = winding_path()
        for how in ("none", "se3"):
            aligned = align(similar(truth, 0.5, WORLD), truth, how)
            lengths = np.linalg.norm(np.diff(aligned.poses[:, :3, 3], axis=0), axis=1)
            np.testing.assert_allclose(lengths, 0.5 * np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))

    def test_scale_is_the_least_squares_factor_and_nothing_else(self):
        truth, estimate = winding_path(seed=0), winding_path(seed=1)
        aligned = align(estimate, truth, "scale")
        np.testing.assert_allclose(aligned.poses[:, :3, :3], estimate[:, :3, :3], atol=1e-12)
        np.testing.assert_allclose(aligned.poses[:, :3, 3], aligned.scale * estimate[:, :3, 3], atol=1e-12)
        cost = [
            ((s * estimate[:, :3, 3] - truth[:, :3, 3]) ** 2).sum() for s in aligned.scale + np.array([-1e-4, 0, 1e-4])
        ]
        assert cost[1] < min(cost[0], cost[2])

    @settings(max_examples=25, deadline=None)
    @given(st.integers(0, 10_000), st.sampled_from(["se3", "sim3"]))
    def test_no_small_change_of_the_alignment_is_better(self, seed, how):
        rng = np.random.default_rng(seed)
        truth, estimate = winding_path(seed=seed), similar(winding_path(seed=seed + 1), 2.0, WORLD)
        best = align(estimate, truth, how).poses[:, :3, 3]
        cost = ((best - truth[:, :3, 3]) ** 2).sum()
        nudge = rigid(0.01 * rng.standard_normal(3), 0.01 * rng.standard_normal(3))
        scale = 1 + (0.01 * rng.standard_normal() if how == "sim3" else 0)
        nudged = scale * best @ nudge[:3, :3].T + nudge[:3, 3]
        assert ((nudged - truth[:, :3, 3]) ** 2).sum() >= cost - 1e-9

    @pytest.mark.parametrize("how", ["se3", "sim3"])
    @pytest.mark.parametrize("direction", [(0, 0, 1.0), (1.0, 2, -3), (-1.0, 0, 0)])
    def test_a_straight_line_is_aligned_by_the_least_rotation(self, how, direction):
        truth = straight_path(direction=direction)
        estimate = straight_path(speed=0.5 if how == "sim3" else 1.0)
        aligned = align(estimate, truth, how)
        np.testing.assert_allclose(aligned.poses[:, :3, 3], truth[:, :3, 3], atol=1e-9)
        assert aligned.scale == pytest.approx(2.0 if how == "sim3" else 1.0)
        assert "straight line" in aligned.note
        # The angle of the rotation is that between the directions: nothing is turned about the line.
        rotation = Rotation.from_matrix(aligned.poses[0, :3, :3])
        cosine = np.dot([0, 0, 1.0], direction) / np.linalg.norm(direction)
        assert rotation.magnitude() == pytest.approx(np.arccos(cosine), abs=1e-7)

    def test_a_line_the_other_way_round_takes_half_a_turn(self):
        truth = straight_path(direction=(0, 0, -1.0))
        aligned = align(straight_path(), truth, "se3")
        np.testing.assert_allclose(aligned.poses[:, :3, 3], truth[:, :3, 3], atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(aligned.poses[0, :3, :3]), 1)

    def test_a_line_written_with_seven_digits_is_still_a_line(self):
        truth = straight_path(count=200, direction=(1.0, 2, -3))
        rough = np.round(truth, 7)
        assert "straight line" in align(rough, truth, "sim3").note

    def test_a_line_against_a_curve_is_best_by_its_direction(self):
        truth, estimate = winding_path(), straight_path(count=60)
        aligned = align(estimate, truth, "sim3")
        assert "straight line" in aligned.note
        # At the optimum no small similarity of the result is better.
        cost = absolute_error_m(aligned.poses, truth)
        rng = np.random.default_rng(0)
        for _ in range(50):
            nudged = similar(
                aligned.poses, 1 + 1e-3 * rng.standard_normal(), rigid(*1e-2 * rng.standard_normal((2, 3)))
            )
            assert (absolute_error_m(nudged, truth) ** 2).sum() >= (cost**2).sum() - 1e-9

    def test_a_gentle_curve_is_not_a_line(self):
        truth = straight_path(count=50)
        truth[:, 0, 3] = 1e-4 * np.arange(50) ** 2
        assert align(similar(truth, 1.0, WORLD), truth, "se3").note == ""

    @pytest.mark.parametrize("how", ALIGNMENTS)
    @pytest.mark.parametrize("still", ["estimate", "truth", "both"])
    def test_standing_still_never_crashes(self, how, still):
        standing, moving = np.tile(WORLD, (20, 1, 1)), straight_path()
        estimate = moving if still == "truth" else standing
        truth = moving if still == "estimate" else standing
        aligned = align(estimate, truth, how)
        assert np.isfinite(aligned.poses).all()
        assert aligned.scale == 1.0
        if how != "none" and still != "truth":
            assert "not determined" in aligned.note

    def test_going_backwards_fits_no_positive_scale(self):
        aligned = align(straight_path(speed=-1.0), straight_path(), "scale")
        assert aligned.scale == 1.0 and "no positive scale" in aligned.note


class TestRelativePoseError:
    def test_translation_and_angle_of_a_known_error(self):
        truth = straight_path(count=5, speed=2.0)
        # Every step is 0.3 m short and turns by 2 degrees about y; the turn comes after the translation.
        step = rigid([0, 0, 1.7], [0, np.deg2rad(2), 0])
        estimate = np.array([np.linalg.matrix_power(step, i) for i in range(5)])
        found = relative_pose_error(estimate, truth, np.arange(5))
        np.testing.assert_allclose(found.translation_m, 0.3, atol=1e-12)
        np.testing.assert_allclose(found.rotation_deg, 2, atol=1e-6)
        assert found.frames.tolist() == [1, 2, 3, 4]

    def test_the_world_does_not_matter(self):
        truth, estimate = winding_path(seed=0), winding_path(seed=1)
        frames = np.arange(60)
        here, there = relative_pose_error(estimate, truth, frames), relative_pose_error(WORLD @ estimate, truth, frames)
        np.testing.assert_allclose(here.translation_m, there.translation_m, atol=1e-9)

    def test_delta_in_frames_takes_consecutive_pairs(self):
        truth, estimate = winding_path(seed=0), winding_path(seed=1)
        found = relative_pose_error(estimate, truth, np.arange(60), delta=7)
        assert found.frames.tolist() == [7, 14, 21, 28, 35, 42, 49, 56]
        expected = [_error(estimate, truth, i, i + 7)[0] for i in range(0, 56, 7)]
        np.testing.assert_allclose(found.translation_m, expected, atol=1e-12)

    def test_delta_in_metres_goes_by_the_reference(self):
        truth, estimate = straight_path(count=30, speed=2.0), straight_path(count=30, speed=20.0)
        found = relative_pose_error(estimate, truth, np.arange(30), delta=10, unit="metres")
        # 10 m are 5 steps of the reference, in which the estimate goes 100 m.
        assert found.frames.tolist() == [5, 10, 15, 20, 25]
        np.testing.assert_allclose(found.translation_m, 90)

    def test_no_pair_spans_a_gap(self):
        truth, estimate = winding_path(seed=0), winding_path(seed=1)
        frames = np.array([3, 4, 5, 9, 10, 20, 31, 32])
        found = relative_pose_error(estimate[frames], truth[frames], frames)
        assert found.frames.tolist() == [4, 5, 10, 32]
        expected = [_error(estimate, truth, i, i + 1) for i in (3, 4, 9, 31)]
        np.testing.assert_allclose(found.translation_m, [error for error, _ in expected], atol=1e-12)
        np.testing.assert_allclose(found.rotation_deg, [angle for _, angle in expected], atol=1e-6)

    def test_every_second_frame_pairs_at_delta_two(self):
        truth = winding_path()
        frames = np.arange(0, 60, 2)
        found = relative_pose_error(truth[frames], truth[frames], frames, delta=2)
        assert found.frames.tolist() == list(range(2, 60, 2))
        with pytest.raises(InputError, match="among 30 frames that are 2 or more apart"):
            relative_pose_error(truth[frames], truth[frames], frames)

    def test_metres_with_every_second_frame_and_a_gap(self):
        truth = straight_path(count=40)
        frames = np.array([0, 2, 4, 6, 8, 20, 22, 24, 26])
        found = relative_pose_error(truth[frames], truth[frames], frames, delta=4, unit="metres")
        assert found.frames.tolist() == [4, 8, 24]

    @pytest.mark.parametrize(
        ("delta", "unit"), [(0, "frames"), (-1, "frames"), (1.5, "frames"), (np.nan, "metres"), (0, "metres")]
    )
    def test_delta_must_be_a_distance(self, delta, unit):
        with pytest.raises(InputError, match="expected a positive number, whole for frames"):
            relative_pose_error(winding_path(), winding_path(), np.arange(60), delta=delta, unit=unit)

    def test_a_delta_beyond_the_path(self):
        with pytest.raises(InputError, match="choose another --delta"):
            relative_pose_error(winding_path(), winding_path(), np.arange(60), delta=1000, unit="metres")


def test_absolute_error_is_the_distance_of_positions():
    truth = winding_path()
    shifted = rigid([3.0, 0, 4]) @ truth
    np.testing.assert_allclose(absolute_error_m(shifted, truth), 5)


def test_statistics():
    found = statistics(np.array([1.0, 2.0, 4.0]))
    assert found.rmse == pytest.approx(np.sqrt(7))
    assert (found.max, found.min, found.median, found.count) == (4, 1, 2, 3)
    assert found.mean == pytest.approx(7 / 3)
    assert found.std == pytest.approx(np.sqrt(7 - 49 / 9))


def _error(estimate, truth, i, j):
    """Translation and angle in degrees of the error of the step from i to j."""
    steps = [np.linalg.inv(poses[i]) @ poses[j] for poses in (truth, estimate)]
    error = np.linalg.inv(steps[0]) @ steps[1]
    return np.linalg.norm(error[:3, 3]), np.rad2deg(Rotation.from_matrix(error[:3, :3]).magnitude())
