"""Drives through the synthetic world: what they show, and that poses, depth and flow agree with it and each other."""

import concurrent.futures
import hashlib
import subprocess
import sys

import cv2
import jax
import numpy as np
import pytest

from mdnvo_jax import geometry
from mdnvo_jax.data import images, synthetic
from mdnvo_jax.data.world import film, render, trace, world
from mdnvo_jax.data.world.motion import draw_mount
from mdnvo_jax.errors import InputError

# One size for all, so that everything is compiled once.
HEIGHT, WIDTH = 192, 640
SIZE = {"height": HEIGHT, "width": WIDTH}
FRAMES = 24
# Worlds that drive, of several kinds: a motorway, a wood, a town, a road with bends.
MOVING = (0, 3, 5, 10)


@pytest.fixture(scope="module")
def drives():
    return {seed: synthetic.drive(seed, FRAMES, **SIZE, effects=0) for seed in MOVING}


@pytest.fixture(scope="module")
def truths():
    return {seed: synthetic.truth(seed, FRAMES, 12, **SIZE) for seed in MOVING}


def matrix(camera):
    fx, fy, cx, cy = camera
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def pixels():
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([u, v], -1).astype(np.float64)


def angle_deg(R):
    return np.degrees(np.linalg.norm(cv2.Rodrigues(R)[0]))


def between_deg(a, b):
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


# What a drive is


def test_a_drive_is_a_sequence(drives):
    drive = drives[0]
    assert drive.count == FRAMES and drive.name == "world_000000"
    np.testing.assert_allclose(drive.timestamps, 0.1 * np.arange(FRAMES))
    np.testing.assert_allclose(drive.poses[0], np.eye(4), atol=1e-12)
    rotations = drive.poses[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-12)
    assert drive.steps().shape == (FRAMES - 1, 6)
    frame = drive.read(3)
    assert frame.shape == (HEIGHT, WIDTH, 1) and frame.dtype == np.uint8
    # KITTI's field of view.
    fov = np.degrees(
        np.arctan((drive.camera[2] + 0.5) / drive.camera[0])
        + np.arctan((WIDTH - 0.5 - drive.camera[2]) / drive.camera[0])
    )
    assert fov == pytest.approx(81.6, abs=0.3)
    camera = (718.856, 718.856, 607.1928, 185.2157)
    assert synthetic.kitti_camera(376, 1241) == pytest.approx(camera)
    assert synthetic.kitti_camera(752, 2482) == pytest.approx(images.scaled_camera(camera, (376, 1241), (752, 2482)))
    with pytest.raises(IndexError):
        drive.read(FRAMES)


def test_frames_look_like_photographs():
    """Grey levels spread as on KITTI, and the road close by has its grain.

    On KITTI frames of this size the mean is 75 to 95, and the mean deviation of the asphalt ahead from its own blur is
    4 to 8 % of its brightness.
    """
    frames = [synthetic.drive(seed, 8, **SIZE).read(6)[..., 0] for seed in range(8)]
    means = [frame.mean() for frame in frames]
    assert min(means) > 30 and max(means) < 190 and 70 < np.mean(means) < 140
    road = [frame[172:, 240:400].astype(np.float32) for frame in frames]
    grain = [np.abs(part - cv2.GaussianBlur(part, (0, 0), 2)).mean() / part.mean() for part in road]
    assert 0.03 < np.median(grain) < 0.12
    assert len({frame.tobytes() for frame in frames}) == len(frames)


def test_same_bits_however_frames_are_read(drives):
    forward = [drives[5].read(index) for index in range(8)]
    again = synthetic.drive(5, FRAMES, **SIZE, effects=0)
    order = np.random.default_rng(0).permutation(np.repeat(np.arange(8), 2)).tolist()
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        for index, frame in zip(order, pool.map(again.read, order), strict=True):
            np.testing.assert_array_equal(frame, forward[index])
    # A shorter drive is the beginning of a longer one.
    np.testing.assert_array_equal(synthetic.drive(5, 4, **SIZE, effects=0).read(3), forward[3])


def test_same_bits_in_another_process(drives):
    program = (
        "import hashlib; from mdnvo_jax.data import synthetic;"
        f"d = synthetic.drive(10, {FRAMES}, height={HEIGHT}, width={WIDTH}, effects=0);"
        "print(hashlib.sha256(d.read(7).tobytes() + d.poses.tobytes()).hexdigest())"
    )
    there = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout.strip()
    drive = drives[10]
    assert hashlib.sha256(drive.read(7).tobytes() + drive.poses.tobytes()).hexdigest() == there


def test_colour_and_effects(drives):
    colour = synthetic.drive(3, FRAMES, **SIZE, channels=3, effects=0).read(5)
    assert colour.shape == (HEIGHT, WIDTH, 3)
    grey = drives[3].read(5)[..., 0].astype(float)
    assert np.ptp(colour.astype(int), axis=-1).mean() > 3
    # Grey is rendered from the luma of every colour, which a tone curve and mixing do not quite commute with.
    assert np.abs(colour @ [0.299, 0.587, 0.114] - grey).mean() < 4
    noisy = synthetic.drive(3, FRAMES, **SIZE, effects=3).read(5)[..., 0].astype(float)
    assert 1 < np.abs(noisy - grey).mean() < 30


@pytest.mark.parametrize(
    "change",
    [
        {"seed": -1},
        {"frames": 0},
        {"height": 4},
        {"width": 0},
        {"channels": 2},
        {"samples": 3},
        {"effects": -1},
        {"effects": float("nan")},
        {"camera": (0, 1, 2, 3)},
        {"camera": (1, 1, 2)},
        {"camera": (1, 1, 2, float("inf"))},
    ],
)
def test_bad_arguments_are_named(change):
    arguments = {"seed": 0, "frames": 4, **SIZE, **change}
    with pytest.raises(InputError, match="expected"):
        synthetic.drive(arguments.pop("seed"), arguments.pop("frames"), **arguments)


def test_truth_of_a_frame_that_is_not_there():
    with pytest.raises(InputError, match="frame 4 of a drive of 4"):
        synthetic.depth(0, 4, 4, **SIZE)


# Depth and flow


def test_flow_is_depth_carried_by_the_pose(drives, truths):
    """OpenCV's own projection of the points that depth gives, seen from the next pose."""
    for seed in MOVING:
        truth, drive = truths[seed], drives[seed]
        still = np.isfinite(truth.depth) & ~truth.moving & np.isfinite(truth.flow).all(-1)
        K = matrix(drive.camera)
        points = np.concatenate([pixels(), np.ones((HEIGHT, WIDTH, 1))], -1)[still] @ np.linalg.inv(K).T
        points *= truth.depth[still, None]
        T = np.linalg.inv(drive.poses[13]) @ drive.poses[12]
        seen = cv2.projectPoints(points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, None)[0][:, 0]
        ahead = (points @ T[:3, :3].T + T[:3, 3])[:, 2] > 1
        np.testing.assert_allclose((seen - pixels()[still])[ahead], truth.flow[still][ahead], atol=2e-2)
        assert still.mean() > 0.3


def test_sky_is_infinitely_far_and_flows_with_the_rotation(drives, truths):
    truth, drive = truths[0], drives[0]
    sky = np.isinf(truth.depth)
    assert 0.05 < sky.mean() < 0.7 and sky[: HEIGHT // 4].mean() > sky[-HEIGHT // 4 :].mean() == 0
    K = matrix(drive.camera)
    R = (np.linalg.inv(drive.poses[13]) @ drive.poses[12])[:3, :3]
    ray = np.concatenate([pixels(), np.ones((HEIGHT, WIDTH, 1))], -1)[sky] @ (K @ R @ np.linalg.inv(K)).T
    np.testing.assert_allclose(ray[:, :2] / ray[:, 2:] - pixels()[sky], truth.flow[sky], atol=2e-3)


def test_pose_from_depth_and_flow(drives, truths):
    """PnP on points from depth, seen where the flow leads, gives the label of the step: conventions are the field's."""
    for seed in MOVING:
        truth, drive = truths[seed], drives[seed]
        good = (truth.depth < 60) & ~truth.moving & np.isfinite(truth.flow).all(-1)
        good &= np.random.default_rng(0).random(good.shape) < 0.02
        K = matrix(drive.camera)
        points = np.concatenate([pixels(), np.ones((HEIGHT, WIDTH, 1))], -1)[good] @ np.linalg.inv(K).T
        found, rotation, translation = cv2.solvePnP(
            points * truth.depth[good, None], (pixels() + truth.flow)[good], K, None, flags=cv2.SOLVEPNP_SQPNP
        )
        assert found
        # PnP gives T_{13,12}; the label is its inverse.
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
        step = geometry.matrix_to_step(np.linalg.inv(T))
        np.testing.assert_allclose(step, drive.steps()[12], atol=2e-3)


def test_pose_from_flow_alone(drives, truths):
    for seed in MOVING:
        truth, drive = truths[seed], drives[seed]
        good = np.isfinite(truth.depth) & ~truth.moving & np.isfinite(truth.flow).all(-1)
        good &= np.random.default_rng(0).random(good.shape) < 0.02
        here = pixels()[good]
        R, t = _from_matches(here, here + truth.flow[good], drive.camera, 0.05)
        T = geometry.relative_steps(drive.poses)[12]
        assert angle_deg(R.T @ T[:3, :3]) < 0.01
        assert between_deg(t, T[:3, 3]) < 0.1


def test_next_frame_shows_what_the_flow_says(drives, truths):
    """Warped back by the flow, the next frame is this one, where both see the same still thing."""
    for seed in MOVING:
        truth, drive = truths[seed], drives[seed]
        after = synthetic.depth(seed, FRAMES, 13, **SIZE)
        where = (pixels() + truth.flow).astype(np.float32)
        u, v = np.nan_to_num(where[..., 0], nan=-1), np.nan_to_num(where[..., 1], nan=-1)
        this, following = (drive.read(index)[..., 0].astype(np.float32) for index in (12, 13))
        warped = cv2.remap(following, u, v, cv2.INTER_LINEAR)
        K = matrix(drive.camera)
        finite = np.where(np.isfinite(truth.depth), truth.depth, 0)
        points = finite[..., None] * (np.concatenate([pixels(), np.ones((HEIGHT, WIDTH, 1))], -1) @ np.linalg.inv(K).T)
        T = np.linalg.inv(drive.poses[13]) @ drive.poses[12]
        z = (points @ T[:3, :3].T + T[:3, 3])[..., 2]
        inside = (u > 1) & (u < WIDTH - 2) & (v > 1) & (v < HEIGHT - 2)
        same = np.abs(cv2.remap(after, u, v, cv2.INTER_NEAREST) - z) < 0.02 * z
        shown = inside & same & ~truth.moving & np.isfinite(truth.depth)
        assert shown.mean() > 0.25
        error, change = np.abs(warped - this)[shown], np.abs(following - this)[shown]
        assert np.median(error) < 5
        assert error.mean() < 0.45 * change.mean()


@pytest.mark.parametrize("seed", [9, 29])
def test_the_grain_of_the_road_moves_with_it(seed):
    drive = synthetic.drive(seed, FRAMES, **SIZE, effects=0)
    where = (pixels() + synthetic.optical_flow(seed, FRAMES, 12, **SIZE)).astype(np.float32)
    this, following = (drive.read(index)[..., 0].astype(np.float32) for index in (12, 13))
    warped = cv2.remap(following, where, None, cv2.INTER_LINEAR)
    grain = [image - cv2.GaussianBlur(image, (0, 0), 3) for image in (this, warped)]
    road = (where[..., 1] < HEIGHT - 2) & (pixels()[..., 1] > 0.62 * HEIGHT)
    road &= (where[..., 0] > 1) & (where[..., 0] < WIDTH - 2)
    assert road.sum() > 5000
    assert np.corrcoef(grain[0][road], grain[1][road])[0, 1] > 0.8


def test_cars_move_and_say_so():
    moving = 0
    for seed in (42, 43, 21, 6):
        truth = synthetic.truth(seed, FRAMES, 5, **SIZE)
        drive = synthetic.drive(seed, FRAMES, **SIZE)
        if not truth.moving.any():
            continue
        moving += 1
        T = np.linalg.inv(drive.poses[6]) @ drive.poses[5]
        K = matrix(drive.camera)
        depth = truth.depth[truth.moving][:, None]
        points = depth * (
            np.concatenate([pixels(), np.ones((HEIGHT, WIDTH, 1))], -1)[truth.moving] @ np.linalg.inv(K).T
        )
        seen = cv2.projectPoints(points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, None)[0][:, 0]
        # Were it still, it would be seen elsewhere.
        assert np.abs(seen - pixels()[truth.moving] - truth.flow[truth.moving]).max() > 0.05
    assert moving >= 2


def test_a_still_camera_sees_a_still_world():
    seed = next(seed for seed in range(100) if np.ptp(synthetic.drive(seed, 4, **SIZE).poses[:, 2, 3]) < 1e-3)
    truth = synthetic.truth(seed, 4, 1, **SIZE)
    assert np.abs(truth.flow[~truth.moving]).max() < 0.5
    drive = synthetic.drive(seed, 4, **SIZE, effects=0)
    assert np.abs(drive.read(1).astype(int) - drive.read(2)).mean() < 2


def test_the_sun_lights_the_ground_and_things_throw_shadows():
    whole = world.build_world(42, 42)
    frame, look = world.frame_at(whole, 40, 1), world.look_of(whole.style, 1)
    camera = world.single(synthetic.kitti_camera(HEIGHT, WIDTH))
    rays, hit = render._cast(frame, camera, **SIZE, samples=2)
    solid, leafy = render._shadow(frame, hit, look, camera, **SIZE, samples=2)
    light = render._shade(frame, rays, hit, (solid, leafy), look, camera, **SIZE, samples=2)[0]
    near = (hit.thing == trace.GROUND) & (hit.depth < 25)
    sunny, shady = near & (solid + leafy == 0), near & (solid > 0)
    assert min(sunny.sum(), shady.sum()) > 100
    # The sky lights both; the sun, which gives the rest, only one.
    style = whole.style
    expected = (style.sun_strength + style.sky_strength) / style.sky_strength
    assert expected > 2
    assert 0.6 * expected < light[sunny].mean() / light[shady].mean() < 1.6 * expected


def test_the_order_of_things_does_not_matter():
    whole = world.build_world(10, 14)
    frame, look = world.frame_at(whole, 12, 1), world.look_of(whole.style, 1)
    order = np.concatenate([np.arange(trace.BOXES)[::-1], trace.BOXES + np.arange(trace.ROUNDS)[::-1]])
    shapes, paint = (jax.tree.map(lambda column: column[order], part) for part in (frame.shapes, frame.paint))
    plain = film.Film(*map(world.single, film.films(whole.style, 0, np.zeros(1))[0]))
    first, second = (
        render.render(f, look, plain, world.single(synthetic.kitti_camera(HEIGHT, WIDTH)), 0, **SIZE, samples=2)
        for f in (frame, frame._replace(shapes=shapes, paint=paint))
    )
    assert (np.abs(np.int32(first) - np.int32(second)) > 1).mean() < 0.005


def test_another_camera_sees_the_same_world():
    """A camera of half the focal length sees at its centre what the first sees, at half the size."""
    camera = synthetic.kitti_camera(HEIGHT, WIDTH)
    wide = (camera[0] / 2, camera[1] / 2, (camera[2] + 0.5) / 2 - 0.5, (camera[3] + 0.5) / 2 - 0.5)
    near, far = (synthetic.depth(3, 4, 2, **SIZE, camera=c) for c in (camera, wide))
    # Pixel (u, v) of the wide one is the corner of four pixels of the other.
    blocks = near.reshape(HEIGHT // 2, 2, WIDTH // 2, 2)
    low, high = blocks.min((1, 3)), blocks.max((1, 3))
    same = far[: HEIGHT // 2, : WIDTH // 2]
    inside = (same > 0.999 * low) & (same < 1.001 * high)
    assert (inside | (np.isinf(same) & np.isinf(high))).mean() > 0.97


# What can be seen of the motion


def _from_matches(here, there, camera, threshold):
    """Return (R, t / |t|) of T_{t-1,t} from the essential matrix of matched pixels."""
    K = matrix(camera)
    E, mask = cv2.findEssentialMat(here, there, K, method=cv2.USAC_MAGSAC, prob=0.9999, threshold=threshold)
    _, R, t, _ = cv2.recoverPose(E, here, there, K, mask=mask)
    return R.T, -R.T @ t[:, 0]


# World 0 is a plain under clouds: what a plane shows of the motion is ambiguous.
@pytest.mark.parametrize("seed", [3, 5, 10, 13])
def test_classical_odometry_works_on_the_pictures(seed):
    """Corners tracked from picture to picture, with noise and blur on, give rotation and direction of travel."""
    drive = synthetic.drive(seed, FRAMES, **SIZE)
    first, second = (drive.read(index)[..., 0] for index in (12, 13))
    corners = cv2.goodFeaturesToTrack(first, 1500, 0.003, 6)
    window = {"winSize": (15, 15), "maxLevel": 4}
    moved, ok, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, **window)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(second, first, moved, None, **window)
    good = (ok[:, 0] > 0) & (ok_back[:, 0] > 0) & (np.abs(back - corners).reshape(-1, 2).max(1) < 0.5)
    here, there = (points[good].reshape(-1, 2).astype(np.float64) for points in (corners, moved))
    assert len(here) > 80
    R, t = _from_matches(here, there, drive.camera, 0.5)
    T = geometry.relative_steps(drive.poses)[12]
    assert angle_deg(R.T @ T[:3, :3]) < 0.3
    assert between_deg(t, T[:3, 3]) < 4
    # The tracks themselves follow the exact flow.
    flow = synthetic.optical_flow(seed, FRAMES, 12, **SIZE)
    nearest = np.rint(here).astype(int)
    error = there - here - flow[nearest[:, 1], nearest[:, 0]]
    assert np.abs(np.median(error, axis=0)).max() < 0.15
    assert np.quantile(np.linalg.norm(error, axis=1), 0.4) < 0.5


def test_the_flow_for_training_is_that_of_every_eighth_pixel():
    drive = synthetic.drive(3, FRAMES, **SIZE)
    found, flow = drive.flow(12), synthetic.truth(3, FRAMES, 12, **SIZE).flow
    assert found.shape == (HEIGHT // 8, WIDTH // 8, 2)
    close = np.abs(8 * found - flow[::8, ::8]).max(-1) < 0.05
    # At the edges of things the ray of the one may pass where that of the other does not.
    assert close.mean() > 0.99


def test_a_world_scaled_to_a_height_shows_the_same_frames():
    """What one camera sees does not tell how large it is: metres are those of the height above the ground."""
    heights = (1.2, 2.2)
    plain = synthetic.drive(5, 4, **SIZE, camera_height_m=heights)
    scaled = synthetic.drive(5, 4, **SIZE, camera_height_m=heights, scaled_to_height_m=1.65)
    np.testing.assert_array_equal(plain.read(2), scaled.read(2))
    factor = 1.65 / draw_mount(5, heights).height_m
    assert abs(factor - 1) > 0.05
    np.testing.assert_allclose(scaled.steps()[:, :3], factor * plain.steps()[:, :3], atol=1e-12)
    np.testing.assert_allclose(scaled.steps()[:, 3:], plain.steps()[:, 3:], atol=1e-12)
