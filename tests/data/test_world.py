"""The parts of the synthetic world against formulas and slow references that share no code with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnvo_jax import geometry
from mdnvo_jax.data.world import pavement, texture, world
from mdnvo_jax.data.world.motion import FRAME_S, camera_poses, draw_mount, road_coordinate, turn
from mdnvo_jax.data.world.road import (
    BEHIND_M,
    NODE_M,
    TURNING_RADIUS_M,
    build_road,
    clearance_to_side_roads,
    distance_to_road,
    ego_lane_m,
    ground,
    place,
)
from mdnvo_jax.data.world.style import draw_style
from mdnvo_jax.data.world.things import CYLINDER, fits

SEEDS = range(60)


@pytest.fixture(scope="module")
def paths():
    return [world.path(seed, 100) for seed in SEEDS]


# Road and motion


def test_an_arc_of_road_is_a_circle():
    style = draw_style(3)
    road = build_road(style, 10, FRAME_S)
    bent = road._replace(curvature=np.full_like(road.curvature, 0.05), heading=0.05 * NODE_M * np.arange(len(road.x)))
    start = bent._replace(x=20 - 20 * np.cos(bent.heading), z=20 * np.sin(bent.heading))
    # A bend to the right with radius 20 m about (20, 0), from the origin northwards.
    s = np.linspace(-3, 90, 50)
    x, z, heading = place(start, s - BEHIND_M, np.full_like(s, 4.0))
    np.testing.assert_allclose(x, 20 - 16 * np.cos(s / 20), atol=1e-9)
    np.testing.assert_allclose(z, 16 * np.sin(s / 20), atol=1e-9)
    np.testing.assert_allclose(heading, s / 20, atol=1e-12)


def test_nodes_lie_on_the_integral_of_the_heading(paths):
    for _, road, _ in paths[:10]:
        s = -BEHIND_M + NODE_M * np.arange(len(road.x))
        x, z, heading = place(road, s, np.zeros_like(s))
        np.testing.assert_allclose(x, road.x, atol=1e-9)
        # From one node to the next, along the middle of a small step.
        fine = np.linspace(0, 60, 6001)
        x, z, heading = place(road, fine, np.zeros_like(fine))
        length = np.hypot(np.diff(x), np.diff(z))
        np.testing.assert_allclose(length, 0.01, rtol=1e-5)
        np.testing.assert_allclose(np.diff(x), 0.01 * np.sin(heading[1:]), atol=2e-5)


def test_road_coordinates_undo_place(paths):
    undo = jax.jit(pavement.road_coordinates)
    for seed in (2, 5, 11):
        whole = world.build_world(seed, 60)
        frame = world.frame_at(whole, 40, 1)
        rng = np.random.default_rng(seed)
        s = whole.s[40] + rng.uniform(-50, 110, 500)
        d = rng.uniform(-5, 5, 500)
        x, z, _ = place(whole.road, s, d)
        eye = whole.poses[40, :3, 3]
        found_s, found_d, _ = undo(np.float32(x - eye[0]), np.float32(z - eye[2]), frame.lane)
        near = np.hypot(x - eye[0], z - eye[2]) < 90
        # On the inside of a corner, a node's length is the shorter the farther it is from the middle, and from a third
        # of the way to its centre on, the road before and behind the corner is as near.
        around = np.rint((s + BEHIND_M) / NODE_M).astype(int) + np.arange(-6, 7)[:, None]
        sharpest = np.abs(whole.road.curvature[around]).max(0)
        near &= sharpest * np.abs(d) < 0.35
        assert near.sum() > 300
        tolerance = np.where(sharpest > 0.1, 0.5, 0.02)[near]
        assert (np.abs(found_s - s)[near] <= tolerance).all()
        assert (np.abs(found_d - d)[near] <= tolerance).all()


def test_slope_is_the_derivative_of_the_height(paths):
    road = paths[3][1]._replace(hills=np.array([[2.0, 0.003, 0.001, 0.2], [1.0, -0.002, 0.004, 0.7]]))
    x, z = np.random.default_rng(0).uniform(-500, 500, (2, 200))
    _, slope_x, slope_z = ground(road, x, z)
    for slope, dx, dz in ((slope_x, 1e-4, 0), (slope_z, 0, 1e-4)):
        numeric = (ground(road, x + dx, z + dz)[0] - ground(road, x - dx, z - dz)[0]) / 2e-4
        np.testing.assert_allclose(slope, numeric, atol=1e-6)


def test_speed_and_turns_stay_within_what_a_car_does(paths):
    for style, road, _ in paths:
        time = FRAME_S * np.arange(0, 100, 0.1)
        speed = np.diff(road_coordinate(road, time)) / (0.1 * FRAME_S)
        assert (speed >= -1e-9).all() and (speed <= 30 + 1e-6).all(), style.seed
        assert np.abs(np.diff(speed) / (0.1 * FRAME_S)).max() <= style.acceleration_mps2 + 1e-3
        assert (road.speed**2 * np.abs(road.curvature)).max() <= style.lateral_mps2
        assert (road.speed * np.abs(road.curvature)).max() <= style.yaw_rate_radps
        assert 1 / np.abs(road.curvature).max() - abs(ego_lane_m(style)) >= TURNING_RADIUS_M - 1e-9


def test_sharp_turns_are_driven_at_every_speed_and_beyond_what_passengers_bear():
    """From a turn of 1.5 to 2.5 degrees a frame no speed follows; cars of clips that are to be read take 4.7 m/s^2."""
    rate, speed = [], []
    for seed in range(300):
        if draw_style(seed).winding:
            poses = world.path(seed, 100)[2]
            step = geometry.matrix_to_step(geometry.inverse(poses[:-1]) @ poses[1:])
            rate.append(np.abs(step[:, 4]) / FRAME_S)
            speed.append(np.linalg.norm(step[:, :3], axis=1) / FRAME_S)
    rate, speed = np.concatenate(rate), np.concatenate(speed)
    turning = (np.deg2rad(15) < rate) & (rate < np.deg2rad(25))
    low, middle, high = np.quantile(speed[turning], [0.05, 0.5, 0.95])
    assert low < 4 and 7 < middle < 11 and high > 13
    assert (rate * speed > 4.7).mean() > 0.08 and (rate > 0.7).mean() > 0.01


def test_roads_wind_in_towns_and_in_the_open_alike():
    """Neither what stands beside the road nor its width tells how sharply it turns."""
    styles = [draw_style(seed) for seed in range(1500)]
    winding = [style for style in styles if style.winding]
    in_the_open = [style for style in winding if style.built < 0.16]
    assert 0.4 < len(in_the_open) / len(winding) < 0.7
    ramps = [style for style in in_the_open if style.edge_line and style.lane_m > 3.3 and style.side_roads < 0.1]
    assert len(ramps) > 0.4 * len(in_the_open)
    # Of those of their speed that do not wind, most are in towns.
    others = [style.built for style in styles if 3 < style.cruise_mps < 20 and not style.winding]
    assert np.mean(np.array(others) < 0.16) < 0.25


def test_some_roads_show_as_little_of_themselves_as_new_asphalt_does():
    styles = [draw_style(seed) for seed in range(1000)]
    new = [style for style in styles if style.history < 1]
    assert 0.2 < len(new) / len(styles) < 0.4
    # Cobbles and gravel are never new asphalt, whatever else the road is.
    assert all(style.stone_m == 0 and style.roughness < 0.23 for style in new)
    assert np.median([style.roughness for style in new]) < 0.12
    assert min(style.roughness for style in styles if style.history == 1) >= 0.12


def test_speeds_are_flat_and_standing_still_is_among_them(paths):
    cruise = np.array([draw_style(seed).cruise_mps for seed in range(1000)])
    assert 0.07 < (cruise == 0).mean() < 0.13 and cruise.max() > 29
    speed = np.concatenate(
        [np.diff(road_coordinate(world.path(seed, 1)[1], FRAME_S * np.arange(100))) / FRAME_S for seed in range(300)]
    )
    share = np.histogram(speed, [0.5, 6, 12, 18, 24, 30])[0] / (speed > 0.5).sum()
    assert share.min() > 0.12 and share.max() < 0.3
    # Some crawl: half of their steps are shorter than 15 cm.
    crawling = np.flatnonzero((cruise > 0) & (cruise < 2.5))[:40]
    steps = [np.diff(road_coordinate(world.path(seed, 1)[1], FRAME_S * np.arange(100))) for seed in crawling]
    assert 0.06 < ((cruise > 0) & (cruise < 2.5)).mean() < 0.12
    assert np.median(np.concatenate(steps)) < 0.15
    still = int(np.argmin(cruise))
    _, _, poses = world.path(still, 50)
    assert np.abs(geometry.matrix_to_step(geometry.relative_steps(poses))[:, :3]).max() < 0.005


def test_stops_are_reached_and_left():
    tried = 0
    for seed in range(200):
        style, road, _ = world.path(seed, 2)
        node = np.flatnonzero((road.pause > 0) & (np.arange(len(road.x)) * NODE_M > BEHIND_M))
        if style.cruise_mps > 3 and len(node):
            stop = node[0] * NODE_M - BEHIND_M
            s = road_coordinate(road, np.arange(0, 400, 0.05))
            standing = np.abs(s - stop) < 1e-6
            assert abs(standing.sum() * 0.05 - road.pause[node[0]]) < 0.11
            assert s[-1] > stop + 1
            tried += 1
    assert tried > 5


def test_motion_looks_like_kitti_s(paths):
    """Bounds around what KITTI's ground truth shows: pitch swings at 1 to 2 Hz, the camera stays at its height."""
    steps = [geometry.matrix_to_step(geometry.relative_steps(poses)) for _, _, poses in paths]
    moving = [step for step in steps if step[:, 2].mean() > 0.3]
    swing = np.degrees([step[:, 3].std() for step in moving])
    assert 0.03 < np.median(swing) < 0.3
    lag = [np.mean([np.corrcoef(step[:-k, 3], step[k:, 3])[0, 1] for step in moving]) for k in (1, 3)]
    assert lag[0] > 0.3 and lag[1] < -0.2
    for style, road, poses in paths:
        height = -poses[:, 1, 3] - ground(road, poses[:, 0, 3], poses[:, 2, 3])[0]
        assert (np.abs(height - draw_mount(style.seed).height_m) < 0.15).all()
    # Forward is z: driving leads along it, but for worlds that roll backwards.
    for (style, _, _), step in zip(paths, steps, strict=True):
        if abs(step[:, 2].mean()) > 0.3:
            assert (step[:, 2].mean() < 0) == style.reversing
            assert np.abs(step[:, 0]).mean() < 0.15 * np.abs(step[:, 2]).mean()


def test_turning_right_is_a_positive_yaw(paths):
    style, road, _ = next(path for path in paths if path[0].cruise_mps > 5)
    bent = road._replace(
        curvature=np.full_like(road.curvature, 0.02),
        heading=0.02 * NODE_M * np.arange(len(road.x)),
        x=50 - 50 * np.cos(0.02 * NODE_M * np.arange(len(road.x))),
        z=50 * np.sin(0.02 * NODE_M * np.arange(len(road.x))),
    )
    step = geometry.matrix_to_step(geometry.relative_steps(camera_poses(style, bent, 20)))
    assert (step[:, 4] > 0).all()
    # Outwards of a bend, here to the left, a body leans: its right side comes up, a negative roll about z.
    upright = -camera_poses(style, bent, 20)[:, 1, 0] - (-camera_poses(style, _straight(bent), 20)[:, 1, 0])
    assert upright.mean() > 0


def _straight(road):
    s = NODE_M * np.arange(len(road.x))
    return road._replace(curvature=0 * s, heading=0 * s, x=0 * s, z=s)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_turn_is_the_exponential_of_an_axis(axis):
    vector = 0.7 * np.eye(3)[axis]
    np.testing.assert_allclose(turn(0.7, axis), geometry.exp_so3(vector), atol=1e-12)


def test_a_longer_drive_begins_like_a_shorter_one():
    for seed in (1, 8, 42):
        short, long = world.build_world(seed, 12), world.build_world(seed, 40)
        np.testing.assert_array_equal(short.poses, long.poses[:12])
        for index in (0, 11):
            frames = world.frame_at(short, index, 3), world.frame_at(long, index, 3)
            jax.tree.map(np.testing.assert_array_equal, *frames)


def test_nothing_stands_in_the_way():
    """No still thing holds the camera, nor comes nearer than a hand, on any frame."""
    for seed in range(25):
        whole = world.build_world(seed, 60)
        for index in range(0, 60, 10):
            local = np.einsum("nij,nj->ni", whole.things.inverse, whole.poses[index, :3, 3] - whole.things.centre)
            size = np.linalg.norm(whole.things.axes, axis=1)
            gap = (np.abs(local) - 1) * size
            assert gap.max(1).min() > 0.1, (seed, index)


def test_nothing_fits_on_a_road_that_bends_back():
    style = draw_style(3)
    straight = build_road(style, 10, FRAME_S)
    angle = NODE_M * np.arange(len(straight.x)) / 20
    circle = straight._replace(
        x=20 - 20 * np.cos(angle),
        z=20 * np.sin(angle),
        heading=angle,
        curvature=np.full_like(angle, 0.05),
        side=np.zeros((0, 8)),
    )
    # 38 m to the right, across the circle, is the road again, 2 m from its middle.
    d = np.array([0.0, style.half_width_m - 0.1, style.half_width_m + 0.5, 20.0, 38.0, -30.0])
    found = fits(style, circle, np.full(len(d), 100.0), d)
    np.testing.assert_array_equal(found, [False, False, True, True, False, True])
    assert not fits(style, circle, np.array([100.0]), np.array([style.half_width_m + 0.5]), 0.6)


def test_posts_and_trunks_stand_beside_the_roads():
    tried = 0
    for seed in range(20):
        whole = world.build_world(seed, 30)
        upright = whole.things.shape == CYLINDER
        x, z = whole.things.centre[upright][:, 0], whole.things.centre[upright][:, 2]
        s = whole.things.s[upright]
        assert (distance_to_road(whole.road, x, z, s) > whole.style.half_width_m).all()
        assert (clearance_to_side_roads(whole.road, x, z, s) > 0).all()
        tried += len(s)
    assert tried > 500


# Textures


def test_pulses_and_bands_are_means_over_their_footprint():
    x = np.linspace(-3, 3, 41)
    for duty, width in ((0.3, 0.2), (0.5, 1.7), (0.06, 0.01)):
        fine = x[:, None] + width * (np.arange(2000) + 0.5) / 2000 - width / 2
        mean = (np.abs(fine - np.floor(fine) - 0.5) < duty / 2).mean(1)
        np.testing.assert_allclose(texture.pulses(jnp.array(x), duty, jnp.full(41, width)), mean, atol=2e-3)
        mean = ((fine > -0.4) & (fine < 0.7)).mean(1)
        np.testing.assert_allclose(texture.band(jnp.array(x), -0.4, 0.7, jnp.full(41, width)), mean, atol=2e-3)


def test_noise_is_smooth_even_and_without_pattern():
    corners = jnp.arange(-50.0, 50)
    grid = jnp.meshgrid(corners, corners)
    noise = jax.jit(texture.value_noise)
    values = np.asarray(noise(tuple(grid), 7))
    assert abs(values.mean()) < 0.02 and abs(values.std() - 3**-0.5) < 0.02
    spectrum = np.abs(np.fft.fft2(values - values.mean()))
    assert spectrum.max() < 5 * np.sqrt((spectrum**2).mean())
    x = jnp.linspace(-2, 2, 4001)
    for point in ((x, 0.3 + 0 * x), (x, 0.3 + 0 * x, 2.6 - x)):
        step = np.diff(np.asarray(noise(point, 7)))
        assert np.abs(step).max() < 0.012
    assert np.abs(values - np.asarray(noise(tuple(grid), 8))).mean() > 0.4


def test_textures_fade_where_pixels_are_too_large():
    x = jnp.linspace(0, 50, 2000)
    point = (x, 0 * x, 0 * x)
    strength = [float(texture.fractal(point, 0 * x + f, 0 * x + 1.0, 0.9, 5, 3).std()) for f in (0, 0.1, 0.4, 2, 20)]
    assert strength == sorted(strength, reverse=True)
    assert strength[0] > 0.4 and strength[-1] == 0
