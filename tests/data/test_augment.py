import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnvo_jax import geometry
from mdnvo_jax.data import synthetic
from mdnvo_jax.data.augment import (
    draw_sway,
    mirror_flow,
    mirror_frame,
    most_pan,
    narrow,
    overexpose,
    photometric,
    sway_flow,
    sway_frames,
    sway_sequence,
    sway_steps,
)
from mdnvo_jax.errors import InputError


def blobs(camera, size, points):
    """Return what a camera sees of smooth blobs around points (x, y, z) in its axes."""
    fx, fy, cx, cy = camera
    v, u = np.mgrid[: size[0], : size[1]]
    light = sum(np.exp(-((u - fx * x / z - cx) ** 2 + (v - fy * y / z - cy) ** 2) / 18) for x, y, z in points)
    return np.rint(220 * light).astype(np.uint8)[..., None]


POINTS = [(-2.0, 0.3, 6.0), (1.0, -0.5, 5.0), (2.5, 0.4, 9.0)]
MIRRORED = [(-x, y, z) for x, y, z in POINTS]


@pytest.mark.parametrize("cx", [63.5, 63.0, 60.0, 60.8, 68.3])
def test_mirror_shows_the_mirrored_world_to_the_same_camera(cx):
    camera = (100.0, 95.0, cx, 30.0)
    frame = blobs(camera, (64, 128), POINTS)
    expected = blobs(camera, (64, 128), MIRRORED)
    found = mirror_frame(frame, camera)
    assert found.shape == frame.shape and found.dtype == np.uint8
    # Between pixels the light is interpolated, which flattens the top of a blob a little.
    np.testing.assert_allclose(found.astype(int), expected.astype(int), atol=4)
    assert np.abs(found.astype(int) - frame).max() > 100


@given(width=st.integers(6, 40), shift=st.integers(-5, 5))
def test_mirroring_twice_gives_the_frame_back_where_it_is_covered(width, shift):
    frame = np.random.default_rng(width).integers(0, 256, (3, width, 1), dtype=np.uint8)
    camera = (9.0, 9.0, (width - 1 + shift) / 2, 1.0)  # whole pixels are exchanged for whole pixels
    back = mirror_frame(mirror_frame(frame, camera), camera)
    covered = slice(max(0, shift), width + min(0, shift))
    np.testing.assert_array_equal(back[:, covered], frame[:, covered])


def test_mirror_without_a_camera_flips_the_frame():
    frame = np.random.default_rng(0).integers(0, 256, (6, 10, 3), dtype=np.uint8)
    np.testing.assert_array_equal(mirror_frame(frame, None), frame[:, ::-1])
    np.testing.assert_array_equal(mirror_frame(frame, (9.0, 9.0, 4.5, 2.5)), frame[:, ::-1])


def test_mirror_repeats_the_edge_where_it_sees_past_it():
    frame = np.tile(np.arange(10, dtype=np.uint8) * 20, (4, 1))[..., None]
    found = mirror_frame(frame, (9.0, 9.0, 6.5, 1.5))
    # Pixel u shows pixel 13 - u: the first four are past the right edge.
    np.testing.assert_array_equal(found[2, :, 0], [180, 180, 180, 180, 180, 160, 140, 120, 100, 80])


def draw(frames, seed, strength=1.0):
    return photometric(frames, strength, np.random.default_rng(seed))


def test_photometric_changes_the_window_as_one():
    """The light differs much between windows, little between the frames of one, and noise less than that."""
    frames = np.full((5, 60, 80, 3), 120, np.uint8)
    windows = np.stack([draw(frames, seed) for seed in range(40)]).astype(float)
    assert windows.dtype == float and draw(frames, 0).dtype == np.uint8 and draw(frames, 0).shape == frames.shape
    of_windows = windows.mean((1, 2, 3, 4))
    of_frames = windows.mean((2, 3, 4)) - of_windows[:, None]
    assert 15 < of_windows.std() < 60
    assert 0.5 < of_frames.std() < 8
    assert 0.5 < np.median(windows.std((2, 3))) < 8
    gentle = np.stack([draw(frames, seed, 0.1) for seed in range(40)]).astype(float)
    assert 1 < gentle.mean((1, 2, 3, 4)).std() < 8


def test_photometric_keeps_the_order_of_grey_levels():
    ramp = np.tile(np.arange(256, dtype=np.uint8), (2, 64, 1))[..., None]
    for seed in range(20):
        curve = draw(ramp, seed)[0, :, :, 0].astype(float).mean(0)  # noise averages out
        assert (np.diff(np.convolve(curve, np.ones(16) / 16, "valid")) > -0.6).all()


def test_photometric_is_a_function_of_its_draw():
    frames = np.random.default_rng(0).integers(0, 256, (3, 8, 10, 1), dtype=np.uint8)
    before = frames.copy()
    np.testing.assert_array_equal(draw(frames, 7), draw(frames, 7))
    assert (draw(frames, 7) != draw(frames, 8)).any()
    np.testing.assert_array_equal(frames, before)
    np.testing.assert_array_equal(draw(frames, 7, 0.0), frames)


def test_the_noise_of_two_frames_is_not_the_same():
    frames = np.full((2, 40, 50, 1), 128, np.uint8)
    first, second = draw(frames, 4, 2.0).astype(float)
    assert first.std() > 1
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.1


def test_colours_are_toned_by_their_own_gain():
    frames = np.full((1, 30, 30, 3), 128, np.uint8)
    means = np.stack([draw(frames, seed).mean((0, 1, 2)) for seed in range(30)])
    assert 1 < (means - means.mean(1, keepdims=True)).std() < 15


def test_overexposed_frames_are_brighter_by_one_gain_until_they_are_white():
    frames = np.tile(np.arange(256, dtype=np.uint8), (3, 4, 1))[..., None]
    gains = []
    for seed in range(200):
        window = overexpose(frames, np.random.default_rng(seed))
        assert window.dtype == np.uint8 and window.shape == frames.shape
        np.testing.assert_array_equal(window, window[:1, :1].repeat(3, 0).repeat(4, 1))
        curve = window[0, 0, :, 0].astype(float)
        gain = curve[40] / 40
        np.testing.assert_allclose(curve, np.minimum(gain * np.arange(256), 255), atol=256 * 0.5 / 40 + 0.5)
        gains.append(gain)
    assert 0.98 < min(gains) < 1.03 and 2.4 < max(gains) < 2.53 and 1.4 < np.median(gains) < 1.75


# Optical flow and narrower views


def flow_field(camera, size, motion):
    """Return the flow, in cells of 8 pixels, of a wall of uneven depth under a small motion (x, y, z) of the camera."""
    fx, fy, cx, cy = (value / 8 for value in camera)
    v, u = np.mgrid[: size[0], : size[1]].astype(float)
    x, y = (u - cx) / fx, (v - cy) / fy
    moved = np.stack([x - motion[0], y - motion[1], np.ones_like(x) - motion[2]])
    return np.stack([fx * moved[0] / moved[2] + cx - u, fy * moved[1] / moved[2] + cy - v], -1)


@pytest.mark.parametrize("cx", [44.0, 45.5, 42.2])
def test_mirrored_flow_is_that_of_the_mirrored_motion(cx):
    """A plane at depth 1: its flow is linear in the column, so blending two cells is exact."""
    camera = (80.0, 80.0, cx, 20.0)
    flow = flow_field(camera, (6, 12), (0.03, -0.01, 0.0))[None]
    found = mirror_flow(flow, camera)
    expected = flow_field(camera, (6, 12), (-0.03, -0.01, 0.0))[None]
    known = np.isfinite(found).all(-1)
    np.testing.assert_allclose(found[known], expected[known], atol=1e-12)
    # Cells whose mirror is off the map know nothing; the others do.
    mirror = 2 * cx / 8 - np.arange(12)
    np.testing.assert_array_equal(known[0, 0], (mirror >= 0) & (mirror <= 11))


def test_mirrored_flow_moves_with_the_column():
    """Forward motion: flow points away from the middle on both sides, also after mirroring."""
    camera = (80.0, 80.0, 40.0, 20.0)
    flow = flow_field(camera, (6, 11), (0.01, 0, 0.1))[None]
    found = mirror_flow(flow, camera)
    np.testing.assert_allclose(found, flow_field(camera, (6, 11), (-0.01, 0, 0.1))[None], atol=1e-12)
    flow[0, 2, 3] = np.nan
    assert np.isnan(mirror_flow(flow, camera)[0, 2, 7]).all() and np.isnan(mirror_flow(flow, camera)).sum() == 2
    assert np.isnan(mirror_flow(flow, None)).all()


def test_a_narrower_view_repeats_its_edge_in_all_frames_alike():
    frames = np.random.default_rng(0).integers(0, 256, (3, 40, 60, 1), dtype=np.uint8)
    seen = []
    for seed in range(40):
        found = narrow(frames, np.random.default_rng(seed))
        same = (found == frames).all((0, 3))
        rows, columns = np.flatnonzero(same.any(1)), np.flatnonzero(same.any(0))
        top, bottom, left, right = rows[0], rows[-1], columns[0], columns[-1]
        np.testing.assert_array_equal(found, np.pad(
            frames[:, top : bottom + 1, left : right + 1],
            ((0, 0), (top, 39 - bottom), (left, 59 - right), (0, 0)),
            mode="edge",
        ))  # fmt: skip
        seen.append((top, 39 - bottom, left, 59 - right))
    # Up to 30 % above, 12 % below, 25 % on either side.
    assert (np.max(seen, axis=0) <= (12, 5, 15, 15)).all() and (np.max(seen, axis=0) >= (8, 3, 10, 10)).all()


# A swaying camera

CAMERA = (100.0, 95.0, 60.0, 30.0)


def rotations(*attitudes_deg):
    return geometry.exp_so3(np.deg2rad(np.array(attitudes_deg)))


def test_a_swaying_camera_sees_what_a_turned_one_would():
    """Points keep their place in the world, so the turned camera has them at R^T p."""
    turns = rotations((0, 0, 0), (1.5, 0, 0), (0, -2.0, 0), (0, 0, 2.5), (-0.8, 1.1, -1.4))
    frame = blobs(CAMERA, (64, 128), POINTS)
    found = sway_frames(np.stack([frame] * len(turns)), CAMERA, turns).astype(int)
    for shown, turn in zip(found, turns, strict=True):
        expected = blobs(CAMERA, (64, 128), [turn.T @ point for point in POINTS]).astype(int)
        inner = np.s_[6:-6, 6:-6]
        np.testing.assert_allclose(shown[inner], expected[inner], atol=8)
    assert np.abs(found[1] - found[0]).max() > 50


def test_a_camera_that_does_not_turn_changes_nothing():
    still = rotations(*[(0, 0, 0)] * 4)
    frames = np.random.default_rng(0).integers(0, 256, (4, 20, 30, 3), dtype=np.uint8)
    np.testing.assert_array_equal(sway_frames(frames, CAMERA, still), frames)
    flow = np.random.default_rng(1).normal(size=(3, 4, 6, 2)).astype(np.float32)
    flow[0, 1, 2] = np.nan
    np.testing.assert_allclose(sway_flow(flow, CAMERA, still), flow, atol=1e-6)
    steps = np.random.default_rng(2).normal(0, 0.3, (3, 6))
    np.testing.assert_allclose(sway_steps(steps, still), steps, atol=1e-12)


def test_what_some_swaying_frame_does_not_see_repeats_the_edge_in_all_alike():
    """The second frame lacks about 7 rows at its bottom and the third 13 columns at its left: none shows them."""
    turns = rotations((0, 0, 0), (-4.0, 0, 0), (0, -5.0, 0))
    frames = np.random.default_rng(0).integers(0, 256, (3, 48, 120, 1), dtype=np.uint8)
    found = sway_frames(frames, CAMERA, turns)
    rows = (found == found[:, -1:]).all((0, 2, 3))
    columns = (found == found[:, :, :1]).all((0, 1, 3))
    assert rows[-7:].all() and not rows[:-8].any()
    assert columns[:13].all() and not columns[14:].any()
    np.testing.assert_array_equal(found[0][4:-8, 14:-16], frames[0][4:-8, 14:-16])


def test_swaying_steps_are_those_of_the_turned_poses():
    rng = np.random.default_rng(3)
    poses = geometry.accumulate(geometry.step_to_matrix(rng.normal(0, 0.4, (7, 6))))
    turns = draw_sway(8, rng, most_pan_rad=0.2)
    turned = poses.copy()
    turned[:, :3, :3] = poses[:, :3, :3] @ turns
    found = sway_steps(geometry.matrix_to_step(geometry.relative_steps(poses)), turns)
    np.testing.assert_allclose(found, geometry.matrix_to_step(geometry.relative_steps(turned)), atol=1e-12)


def test_a_turning_camera_gives_far_things_a_flow():
    """The wall at infinity does not move for the camera that does not turn; for the other its flow is all rotation."""
    turns = rotations((0, 0, 0), (0.5, 0, 0), (0.5, 1.0, -0.5))
    found = sway_flow(np.zeros((2, 6, 16, 2), np.float32), CAMERA, turns)
    fx, fy, cx, cy = (value / 8 for value in CAMERA)
    v, u = np.mgrid[:6, :16].astype(float)
    ray = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], -1)
    for step in (0, 1):
        # R_{t+1}^T R_t takes directions from the one camera's axes to the next one's.
        next_ray = ray @ (turns[step + 1].T @ turns[step]).T
        place = next_ray[..., :2] / next_ray[..., 2:] * (fx, fy) + (cx, cy)
        expected = place - np.stack([u, v], -1)
        known = np.isfinite(found[step]).all(-1)
        assert known.mean() > 0.6
        np.testing.assert_allclose(found[step][known], expected[known], atol=1e-5)
    assert np.isfinite(found[0]).all()  # frame 0 is not turned: it sees all of its map


@pytest.mark.parametrize("seed", [3, 5])
def test_swaying_flow_and_steps_fit_together_in_a_rendered_world(seed):
    """What stands still obeys x^T [t] R x' = 0 with the flow and the step of the swaying camera, and not without."""
    camera = (111.2, 111.2, 95.5, 18.5)
    drive = synthetic.drive(seed, 7, height=48, width=192, camera=camera)
    flow, steps = np.stack([drive.flow(index) for index in range(6)]), drive.steps()
    turns = draw_sway(7, np.random.default_rng(seed), most_pan_rad=0.2)

    def residual(flow, steps):
        fx, fy, cx, cy = (value / 8 for value in camera)
        v, u = np.mgrid[: flow.shape[1], : flow.shape[2]].astype(float)
        here, there = (
            np.stack([(column - cx) / fx, (row - cy) / fy, np.ones_like(column)], -1)
            for column, row in ((u + 0 * flow[..., 0], v + 0 * flow[..., 0]), (u + flow[..., 0], v + flow[..., 1]))
        )
        essential = geometry.hat(steps[:, :3]) @ geometry.exp_so3(steps[:, 3:])
        return np.nanmedian(abs(np.einsum("thwi,tij,thwj->thw", here, essential, there)), axis=(1, 2)).mean()

    swaying = sway_flow(flow, camera, turns)
    right = residual(swaying, sway_steps(steps, turns))
    assert right < residual(swaying, steps) / 5
    assert right < 1e-3 * np.linalg.norm(steps[:, :3], axis=1).mean()


def test_sway_is_of_every_axis_looks_about_and_pans_as_fast_as_corners_turn():
    rng = np.random.default_rng(0)
    steps = np.stack([sway_steps(np.zeros((12, 6)), draw_sway(13, rng, most_pan_rad=0.5)) for _ in range(400)])
    deviation_deg = np.rad2deg(steps[..., 3:].std((0, 1)))
    np.testing.assert_allclose(deviation_deg, [0.30, 0.84, 0.33], atol=0.05)
    # What swings is taken back over the window, what grows is not.
    trend_deg = np.rad2deg(steps[..., 3:].mean(1).std(0))
    np.testing.assert_allclose(trend_deg, [0.1, 0.8, 0.15], rtol=0.15)
    assert np.abs(steps[..., :3]).max() < 1e-12
    still = np.rad2deg(geometry.log_so3(np.stack([draw_sway(13, rng, most_pan_rad=0.0) for _ in range(400)])))
    assert still.std((0, 1)) == pytest.approx([1.51, 2.51, 1.02], rel=0.1) and np.abs(still).max() < 10


def test_a_pan_goes_no_further_than_it_may_however_long_the_window():
    camera = (80.0, 80.0, 63.5, 23.5)
    most_rad = most_pan(camera, 128)
    assert np.tan(most_rad) * camera[0] == pytest.approx(128 / 4)

    def end_to_end_rad(count, seed):
        turns = draw_sway(count, np.random.default_rng(seed), most_pan_rad=most_rad)
        return np.diff(geometry.log_so3(turns[[0, -1]])[:, 1])[0]

    swung_deg = np.rad2deg(np.abs([[end_to_end_rad(count, seed) / 2 for count in (13, 101)] for seed in range(100)]))
    # What a window of 13 has no time for is the rule in one of 101; the sway itself adds a degree or two.
    limit_deg = np.rad2deg(most_rad)
    assert (swung_deg < limit_deg + 1.5).all()
    assert (swung_deg[:, 0] > limit_deg - 1.5).mean() < 0.05 and (swung_deg[:, 1] > limit_deg - 1.5).mean() > 0.4


def test_a_swaying_drive_has_its_frames_and_poses_turned_alike():
    camera = (40.0, 40.0, 31.5, 11.5)
    drive = synthetic.drive(4, 8, height=24, width=64, camera=camera)
    swaying = sway_sequence(drive, 9)
    turns = np.linalg.inv(drive.poses[:, :3, :3]) @ swaying.poses[:, :3, :3]
    np.testing.assert_allclose(swaying.steps(), sway_steps(drive.steps(), turns), atol=1e-9)
    expected = sway_frames(np.stack([drive.read(index) for index in range(8)]), camera, turns)
    # In any order, as often as one likes.
    for index in (5, 0, 7, 5):
        np.testing.assert_array_equal(swaying.read(index), expected[index])
    assert swaying.flow is None
    attitude_deg = np.rad2deg(geometry.log_so3(turns))
    assert 0.02 < np.diff(attitude_deg, axis=0).std() < 2 and np.abs(attitude_deg).max() < 5
    with pytest.raises(InputError, match="no intrinsics"):
        sway_sequence(dataclasses.replace(drive, camera=None), 9)
