"""Cameras, weather and light of the synthetic world: what they change in frames, and what they must leave alone."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnvo_jax import geometry
from mdnvo_jax.data import synthetic
from mdnvo_jax.data.world import film, lens, motion, pavement, render, world
from mdnvo_jax.data.world.cars import car_parts
from mdnvo_jax.data.world.motion import draw_mount, road_coordinate
from mdnvo_jax.data.world.style import draw_style
from mdnvo_jax.data.world.things import BALL, BOX
from mdnvo_jax.errors import InputError

# The size of the other tests of rendered drives, so that everything is compiled once.
HEIGHT, WIDTH = 192, 640
SIZE = {"height": HEIGHT, "width": WIDTH}
CAMERA = world.single(synthetic.kitti_camera(HEIGHT, WIDTH))
STYLES = [draw_style(seed) for seed in range(300)]


def first_seed(wanted):
    return next(style.seed for style in STYLES if style.cruise_mps > 5 and wanted(style))


def picture(whole, index=0, style=None, **faults):
    """Return a frame without faults, but for those named, of a world, or of its places in another style."""
    style = style or whole.style
    row = film.Film(*map(world.single, film.films(style, 0, np.zeros(1))[0]))._replace(**faults)
    look = world.look_of(style, 1)
    return np.asarray(render.render(world.frame_at(whole, index, 1), look, row, CAMERA, index, **SIZE, samples=2))[
        ..., 0
    ]


@pytest.fixture(scope="module")
def day():
    """A world on a clear, dry day."""
    return world.build_world(first_seed(lambda s: s.daylight == 1 and s.wet == 0 and s.built > 0.3), 4)


# The camera and its ride


def test_cameras_vary_and_their_poses_are_where_they_are():
    heights = np.array([draw_mount(seed).height_m for seed in range(300)])
    assert heights.min() < 1.57 and heights.max() > 1.73
    low, high = (world.build_world(3, 2, (h, h)) for h in (1.2, 2.2))
    # One metre up, along the upright of a car that leans a little.
    np.testing.assert_allclose(low.poses[:, 1, 3] - high.poses[:, 1, 3], 1.0, atol=0.02)
    np.testing.assert_array_equal(low.poses[:, :3, :3], high.poses[:, :3, :3])
    straight = first_seed(lambda s: not s.winding)
    depth = [synthetic.truth(straight, 2, 0, **SIZE, camera_height_m=(h, h)).depth[-1].mean() for h in (1.2, 2.2)]
    assert depth[1] / depth[0] == pytest.approx(2.2 / 1.2, rel=0.05)
    with pytest.raises(InputError, match="camera_height_m 2 to 1"):
        synthetic.drive(0, 2, **SIZE, camera_height_m=(2, 1))
    cameras = np.array([synthetic.varied_camera(seed, HEIGHT, WIDTH) for seed in range(300)])
    ratio = cameras[:, 0] / synthetic.kitti_camera(HEIGHT, WIDTH)[0]
    assert 0.7 < ratio.min() < 0.75 and 1.35 < ratio.max() < 1.41
    np.testing.assert_allclose(cameras[:, 0], cameras[:, 1])
    assert np.ptp(cameras[:, 2]) > 0.05 * WIDTH and np.ptp(cameras[:, 3]) > 0.14 * HEIGHT


def test_mounts_lean_so_that_a_turn_is_not_always_level():
    """As KITTI's do: turning, its cameras pitch by 0.013 to 0.032 of the yaw, 0.7 to 1.8 degrees."""
    mounts = [draw_mount(seed) for seed in range(400)]
    rolls = np.rad2deg([mount.roll_rad for mount in mounts])
    assert 1.3 < rolls.std() < 1.7 and abs(rolls.mean()) < 0.2 and np.abs(rolls).max() <= 4
    assert {round(mount.ahead_m) for mount in mounts} == {0, 1, 2}


def test_a_cornering_car_looks_into_the_bend():
    """The rear axle moves outwards of where the car looks, by an angle that grows with the lateral acceleration.

    On the clips of KITTI that turns at 10 to 12 m/s take about 0.3 degrees for a m/s^2.
    """
    found = []
    for seed in [seed for seed in range(400) if (s := draw_style(seed)).winding and s.cruise_mps > 8][:6]:
        _, _, poses = world.path(seed, 100)
        mount = draw_mount(seed)
        body = poses[:, :3, :3] @ np.linalg.inv(
            motion.turn(mount.yaw_rad, 1) @ motion.turn(mount.pitch_rad, 0) @ motion.turn(mount.roll_rad, 2)
        )
        axle = poses[:, :3, 3] - body @ np.array([0.0, -mount.height_m, mount.ahead_m])
        forward = (body[:-1] + body[1:])[:, :, 2] / 2
        moved = np.diff(axle, axis=0)
        looks, goes = (np.arctan2(vector[:, 0], vector[:, 2]) for vector in (forward, moved))
        inwards = np.unwrap(looks - goes)
        speed, yaw_rate = np.linalg.norm(moved, axis=1) / 0.1, np.gradient(np.unwrap(goes)) / 0.1
        cornering = speed * yaw_rate
        # A wander in the lane turns the path, too, and is followed without slip by the rear axle.
        slope, _ = np.polyfit(cornering, np.rad2deg(inwards), 1)
        assert np.abs(cornering).max() > 1.2 and np.corrcoef(cornering, inwards)[0, 1] > 0.9
        found.append(slope)
    assert min(found) > 0.04 and max(found) < 0.42 and np.ptp(found) > 0.1


def test_a_bump_rings_in_the_labels(monkeypatch):
    """Poses move by the pitch and the heave of the body, no less and no more; a car that stands does not ring."""
    seed = first_seed(
        lambda s: not s.winding and abs(motion._bumps(s, np.arange(0.0, 200), np.full(200, 10.0))[0]).max() > 0.005
    )
    style, road, poses = world.path(seed, 100)
    s = road_coordinate(road, 0.1 * np.arange(100))
    pitch, heave = motion._bumps(style, s, np.gradient(s, 0.1))
    assert 0.002 < np.abs(pitch).max() < np.deg2rad(2) and np.abs(heave).max() > 0.003
    np.testing.assert_array_equal(motion._bumps(style, np.zeros(3), np.zeros(3)), 0)
    monkeypatch.setattr(motion, "_bumps", lambda style, s, speed: (0 * s, 0 * s))
    smooth = world.path(seed, 100)[2]
    turned = geometry.matrix_to_step(geometry.inverse(smooth) @ poses)
    # The ends differ by how the speed was differentiated.
    inner = slice(2, -2)
    np.testing.assert_allclose(np.linalg.norm(turned[inner, 3:], axis=1), np.abs(pitch)[inner], atol=1e-4)
    mount = draw_mount(seed)
    risen = smooth[:, 1, 3] - poses[:, 1, 3]
    np.testing.assert_allclose(risen[inner], (heave + mount.ahead_m * pitch)[inner], atol=2e-3)


def test_yaw_rates_reach_those_of_sharp_turns():
    steps = np.concatenate(
        [geometry.matrix_to_step(geometry.relative_steps(world.path(seed, 60)[2])) for seed in range(100)]
    )
    rate = 10 * np.abs(steps[:, 4])
    assert rate.max() > 0.4 and 0.02 < (rate > 0.2).mean() < 0.2


# Light and weather


def test_textures_do_not_depend_on_what_stands_nearest(day):
    """The ground keeps its texture when another thing is the nearest: two frames would else show two roads."""
    frame = world.frame_at(day, 1, 1)
    other = frame._replace(paint=frame.paint._replace(seed=frame.paint.seed + 1))
    look = world.look_of(day.style, 1)
    plain = film.Film(*map(world.single, film.films(day.style, 0, np.zeros(1))[0]))
    first, second = (render.render(f, look, plain, CAMERA, 0, **SIZE, samples=2) for f in (frame, other))
    truth = synthetic.truth(day.style.seed, 4, 1, **SIZE)
    same = np.asarray(first)[..., 0] == np.asarray(second)[..., 0]
    assert same[np.isinf(truth.depth)].mean() > 0.9 and same[-HEIGHT // 3 :].mean() > 0.5
    assert not same.all()


def test_night_is_dark_but_for_lamps(day):
    dark = day.style._replace(
        sun_strength=0.0, sky_strength=0.01, daylight=0.01, headlight=0.6, lamps=0.0, seed=day.style.seed
    )
    exposure = picture(day, style=dark).astype(float)
    # Straight ahead the road is lit, beside it and above it is the dark.
    lit = exposure[140:170, 260:380].mean()
    assert lit > 40 and exposure[:60].mean() < 0.35 * lit and exposure[140:170, :60].mean() < 0.6 * lit
    lamps = picture(day, style=dark._replace(lamps=0.5), exposure=picture_exposure(dark)).astype(float)
    heads = day.lamps[np.abs(day.lamps[:, 0] - day.s[0]) < 40]
    assert len(heads) == 0 or (lamps - exposure).mean() > 0
    nights = [style.headlight > 0 for style in STYLES]
    assert 0.06 < np.mean(nights) < 0.2
    for style in STYLES:
        assert (style.headlight > 0) == (style.daylight < 1) and (style.lamps == 0 or style.headlight > 0)


def picture_exposure(style):
    return world.single(film.films(style, 0, np.zeros(1))[0][0])


def test_street_lamps_light_what_is_below_them():
    seed = first_seed(lambda s: s.lamps > 0.2)
    whole = world.build_world(seed, 2)
    off = picture(whole, style=whole.style._replace(lamps=0.0), exposure=picture_exposure(whole.style)).astype(float)
    on = picture(whole).astype(float)
    assert (on - off).min() > -2 and (on - off).max() > 20


def test_a_wet_road_is_darker_near_and_mirrors_the_sky_far_away(day):
    dry, wet = (picture(day, style=day.style._replace(wet=w)).astype(float) for w in (0.0, 1.0))
    truth = synthetic.truth(day.style.seed, 4, 0, **SIZE)
    assert wet[-20:, 250:390].mean() < 0.9 * dry[-20:, 250:390].mean()
    ratio = [wet[rows, 250:390].mean() / dry[rows, 250:390].mean() for rows in (slice(-20, None), slice(112, 120))]
    assert ratio[1] > 1.05 * ratio[0]
    assert (wet == dry)[np.isinf(truth.depth)].mean() > 0.99


def test_rain_is_on_the_film_and_not_in_the_world():
    seed = first_seed(lambda s: s.rain > 0.5 and s.headlight == 0)
    style = STYLES[seed]
    whole = world.build_world(seed, 2)
    clear, rainy = picture(whole).astype(float), picture(whole, rain=world.single(style.rain)).astype(float)
    assert 0.01 < (np.abs(rainy - clear) > 4).mean() < 0.6
    assert film.films(style, 1, np.zeros(1))[0][film.Film._fields.index("rain")] == np.float64(style.rain)
    assert style.sun_strength < 0.2 and style.wet > 0
    # Streaks fall: another frame has others. Drops on the glass stay.
    flat = jnp.full((HEIGHT, WIDTH, 1), 0.2)
    first, second = (np.asarray(lens.rain(flat, jnp.float32(1), jnp.int32(i), jnp.int32(0)))[..., 0] for i in (0, 1))
    streaks = [image > 0.25 for image in (first, second)]
    assert 0.002 < streaks[0].mean() < 0.2 and np.corrcoef(streaks[0].ravel(), streaks[1].ravel())[0, 1] < 0.2
    np.testing.assert_array_equal(lens.rain(flat, jnp.float32(0), jnp.int32(0), jnp.int32(0)), flat)


def test_the_exposure_steps_and_lags():
    seed = first_seed(lambda s: np.ptp(np.diff(film._levels(s, np.arange(0, 40, 0.1)))) > 0.3)
    style = STYLES[seed]
    time = np.arange(0, 40, 0.1)
    level = film._levels(style, time)
    # Changes begin every few seconds and end by themselves.
    change = np.abs(np.diff(level))
    assert change.max() > 0.05 and np.median(change) < 0.1 * change.max()
    starts = np.flatnonzero(change > 0.5 * change.max())
    assert (np.abs((time[starts] / film._LEVEL_S + 0.5) % 1 - 0.5) * film._LEVEL_S < 1.5).all()
    np.testing.assert_array_equal(film._levels(style, time[:50]), level[:50])
    assert np.ptp(film.films(style, 0, time)[:, 0]) == 0 and np.ptp(np.log(film.films(style, 1, time)[:, 0])) > 0.3


# The lens and the file


def test_motion_blur_follows_the_flow():
    """A point under a camera that moves to the right becomes a streak of the length that its depth says."""
    light = jnp.zeros((9, 41, 1)).at[4, 20].set(1.0)
    motion = jnp.eye(4).at[0, 3].set(-1.0)
    camera = jnp.float32([50, 50, 20, 4])
    smear = jax.jit(lens.smear)
    streak = np.asarray(smear(light, jnp.full((9, 41), 1 / 5), motion, camera, jnp.float32(0.8)))[..., 0]
    assert streak[4].sum() == pytest.approx(1, abs=1e-4) and streak[[3, 5]].max() < 1e-4
    lit = np.flatnonzero(streak[4] > 1e-3)
    # 50 * 1 / 5 px a frame, of which the shutter is open for 0.8.
    assert lit.min() >= 15 and lit.max() <= 25 and np.ptp(lit) == pytest.approx(7, abs=1)
    np.testing.assert_array_equal(smear(light, jnp.full((9, 41), 0.2), motion, camera, jnp.float32(0)), light)
    # Half as far for what is twice as far away.
    far = np.asarray(smear(light, jnp.full((9, 41), 1 / 10), motion, camera, jnp.float32(0.8)))[4, :, 0]
    assert np.ptp(np.flatnonzero(far > 1e-3)) == pytest.approx(4, abs=1)


def test_the_sun_veils_what_is_near_it():
    light = jnp.full((20, 40, 1), 0.2)
    camera = jnp.float32([20, 20, 19.5, 9.5])
    glare = jax.jit(lens.glare)
    towards = jnp.float32([0.4, -0.3, 0.87])
    veiled = np.asarray(glare(light, towards, jnp.eye(3), camera, jnp.float32(0.5)))[..., 0]
    v, u = np.unravel_index(veiled.argmax(), veiled.shape)
    assert abs(u - (19.5 + 20 * 0.4 / 0.87)) < 1.5 and abs(v - (9.5 - 20 * 0.3 / 0.87)) < 1.5
    assert (veiled >= 0.2 - 1e-6).all() and veiled.max() > 0.6
    for sun, strength in ((-towards, 0.5), (towards, 0.0)):
        np.testing.assert_array_equal(glare(light, sun, jnp.eye(3), camera, jnp.float32(strength)), light)


def test_jpeg_is_opencv_s_and_leaves_poses_alone():
    frame = np.random.default_rng(0).integers(0, 255, (32, 48, 3), np.uint8)
    frame = cv2.GaussianBlur(frame, (0, 0), 2)
    coarse, fine = (synthetic._through_jpeg(frame, quality).astype(int) for quality in (30, 95))
    assert 0 < np.abs(fine - frame).mean() < np.abs(coarse - frame).mean() < 10
    grey = synthetic._through_jpeg(frame[..., :1], 90)
    assert grey.shape == (32, 48, 1) and 0 < np.abs(grey.astype(int) - frame[..., :1]).mean() < 3
    assert synthetic._through_jpeg(frame, 0) is frame
    quality = np.array([film.films(style, 1, np.zeros(1))[0][-1] for style in STYLES])
    assert 0.3 < (quality == 0).mean() < 0.7 and quality[quality > 0].min() >= 40
    seed = STYLES[int(np.argmax(quality > 0))].seed
    np.testing.assert_array_equal(
        synthetic.drive(seed, 3, **SIZE).poses, synthetic.drive(seed, 3, **SIZE, effects=0).poses
    )


# The road and what drives on it


def test_a_road_of_stones_has_joints(day):
    smooth, stones = (picture(day, style=day.style._replace(stone_m=m)).astype(np.float32) for m in (0.0, 0.4))
    near = (slice(-30, None), slice(250, 390))
    grain = [np.abs(np.diff(image[near], axis=1)).mean() / image[near].mean() for image in (smooth, stones)]
    assert grain[1] > 1.3 * grain[0]
    surfaces = np.array([[style.stone_m > 0, style.centre_line > 0] for style in STYLES])
    assert 0.02 < surfaces[:, 0].mean() < 0.2 and not surfaces.all(1).any()


def test_arrows_point_the_way_their_lane_goes(day):
    look = world.look_of(day.style._replace(arrows=1.0, lane_m=3.0, lanes=1, side=1), 1)
    s, d = (
        x.astype(np.float32) for x in np.meshgrid(np.arange(-39.95, 40, 0.1), np.arange(-2.95, 3, 0.1), indexing="ij")
    )
    painted = np.asarray(pavement._arrows(jnp.array(s), jnp.array(d), jnp.full(s.shape, 0.05), look))
    width = [0.1 * (painted * (d * way > 0)).sum(1) for way in (1, -1)]
    # Stem, then a head that narrows, 20 to 25 m into each block of 40 m; the other lane is its image.
    ahead = s[:, 0] % 40 - 20
    assert width[0][(ahead < 0) | (ahead > 5)].max() == 0
    np.testing.assert_allclose(width[0][(ahead > 0.1) & (ahead < 2.9)], 0.16, atol=0.08)
    assert width[0][(ahead > 3) & (ahead < 3.3)].min() > 0.7 and width[0][(ahead > 4.7) & (ahead < 5)].max() < 0.25
    np.testing.assert_allclose(width[1], width[0][::-1], atol=0.11)
    assert not pavement._arrows(jnp.array(s), jnp.array(d), jnp.full(s.shape, 0.05), look._replace(arrows=0.0)).any()


def test_cars_have_a_greenhouse_and_vans_hide_it():
    draw = np.random.default_rng(0).random((200, 5))
    body, cabin, lights = car_parts(draw)
    big = draw[:, 2] < 0.1
    above = cabin.bottom_m + 2 * cabin.half[:, 1] - body.bottom_m - 2 * body.half[:, 1]
    assert big.any() and (above[big] < 0).all() and (above[~big] > 0.4).all()
    assert (cabin.shape == BALL).all() and (body.shape == BOX).all()
    # A car is about 1.5 m high, and its lights end it in front and behind.
    assert ((cabin.bottom_m + 2 * cabin.half[:, 1])[~big] < 1.7).all()
    assert (lights.half[:, 2] > body.half[:, 2]).all() and (lights.half[:, 0] < body.half[:, 0]).all()
    assert (lights.bottom_m + 2 * lights.half[:, 1] < body.bottom_m + 2 * body.half[:, 1]).all()


def test_dry_asphalt_mirrors_the_sun_where_it_stands_ahead(day):
    """The ground brightens towards the sun, the sky does not, and away from the sun nothing changes."""
    ahead = day.poses[0, :3, 2] * (1, 0, 1)

    def gain(towards, sheen):
        sun = towards * np.cos(0.5) / np.linalg.norm(towards) + np.array([0, -np.sin(0.5), 0])
        style = day.style._replace(sun=sun, sun_strength=0.7, sky_strength=0.3)
        before, after = (picture(day, style=style._replace(sheen=value)).astype(float) for value in (0.0, sheen))
        return (after + 1) / (before + 1)

    facing, away = gain(ahead, 0.3), gain(-ahead, 0.3)
    road = np.s_[-40:, WIDTH // 2 - 40 : WIDTH // 2 + 40]
    assert facing[road].mean() > 1.15 and facing[: HEIGHT // 4].max() < 1.02
    np.testing.assert_allclose(away, 1, atol=0.02)


def test_new_asphalt_shows_little_of_itself(day):
    road = np.s_[-40:, WIDTH // 2 - 40 : WIDTH // 2 + 40]

    def contrast(**cover):
        frame = picture(day, style=day.style._replace(arrows=0.0, zebra=0.0, stone_m=0.0, **cover))[road].astype(float)
        return (frame - cv2.GaussianBlur(frame, (0, 0), 6)).std() / frame.mean()

    assert contrast(roughness=0.02, history=0.1) < 0.4 * contrast(roughness=0.3, history=1.0)
