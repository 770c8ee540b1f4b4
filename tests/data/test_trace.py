"""Rays and film of the synthetic world against formulas and slow references that share no code with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnvo_jax.data.world import film, trace
from mdnvo_jax.data.world.motion import turn

SIZE = (64, 96)
CAMERA = np.float32([60.0, 60.0, 47.5, 30.0])
SUN = np.array([0.5, -0.6, 0.4]) / np.linalg.norm([0.5, -0.6, 0.4])


def _scene(seed):
    """Return random things about a camera that looks somewhere ahead, and what a slow reference needs of them."""
    rng = np.random.default_rng(seed)
    count = 40
    shape = np.where(np.arange(trace.BOXES + trace.ROUNDS) < trace.BOXES, 0, 1)
    centre = rng.uniform([-20, -4, -5], [20, 2, 60], (len(shape), 3))
    axes = turn(rng.uniform(0, 6, len(shape)), 1) @ turn(rng.uniform(-0.5, 0.5, len(shape)), 2)
    axes = axes * rng.uniform(0.2, 3, (len(shape), 1, 3))
    # Two walls go by the camera, from ahead of it to behind.
    for row, x in ((0, -3.0), (1, 4.0)):
        centre[row], axes[row] = (x, 0.0, 3.0), turn(0.1 * x, 1) @ np.diag([0.3, 1.5, 9.0])
    ball = np.float32(rng.random(len(shape)) < 0.5) * shape
    present = np.isin(np.arange(len(shape)), [*range(count), *range(trace.BOXES, trace.BOXES + count)])
    # None holds the camera.
    present &= (np.linalg.norm(centre, axis=1) > 6) | (np.arange(len(shape)) < 2)
    order = np.argsort(np.linalg.norm(centre, axis=1))
    order = np.concatenate([order[order < trace.BOXES], order[order >= trace.BOXES]])
    columns = (centre, axes, np.linalg.inv(axes), ball, 0 * ball, 1 + 0 * ball, 1.65 + 0 * ball, present)
    shapes = trace.Shapes(*(np.float32(column[order]) for column in columns))
    rotation = turn(rng.uniform(-0.2, 0.2), 1) @ turn(rng.uniform(-0.1, 0.1), 0) @ turn(rng.uniform(-0.1, 0.1), 2)
    return shapes, rotation, shape[order]


def _meets(shapes, shape, origin, direction):
    """Return where rays `[p, 3]` meet things, `[p, n]`, inf where they do not, one thing after the other."""
    result = np.full((len(direction), len(shape)), np.inf)
    for n in np.flatnonzero(shapes.present):
        inverse = np.linalg.inv(np.float64(shapes.axes[n]))
        o, d = (origin - shapes.centre[n]) @ inverse.T, direction @ inverse.T
        if shape[n] == 0:
            with np.errstate(divide="ignore"):
                ends = np.stack([(-1 - o) / d, (1 - o) / d])
            enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
            t = np.where((enter < leave) & (leave > 0), np.maximum(enter, 0), np.inf)
        else:
            weight = np.array([1.0, shapes.ball[n], 1.0])
            a, b, c = (d * d) @ weight, (o * d) @ weight, (o * o) @ weight - 1
            with np.errstate(invalid="ignore"):
                t = (-b - np.sqrt(b * b - a * c)) / a
            t = np.where((t > 0) & (np.abs(o[..., 1] + t * d[:, 1]) <= 1), t, np.inf)
        result[:, n] = t
    return result


def _directions(rotation):
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].reshape(2, -1)
    ray = np.stack([(u - CAMERA[2]) / CAMERA[0], (v - CAMERA[3]) / CAMERA[1], np.ones(u.size)], 1)
    return ray @ rotation.T


@pytest.fixture(scope="module")
def cast():
    @jax.jit
    def run(shapes, rotation):
        rays = trace.rays(rotation, CAMERA, *SIZE, 1)
        hills = jnp.zeros((2, 4))
        hit = trace.cast(shapes, hills, jnp.float32(1.65), rays, rotation, CAMERA, SIZE)
        shadows = trace.shadow(shapes, hit, jnp.float32(SUN), rotation, CAMERA, SIZE)
        return [trace.image(value, *SIZE, 1) for value in (hit.depth, hit.thing, *shadows)]

    return run


@pytest.mark.parametrize("seed", range(4))
def test_rays_meet_what_a_slow_search_finds(cast, seed):
    shapes, rotation, shape = _scene(seed)
    depth, thing, solid, leafy = (np.asarray(x).ravel() for x in cast(shapes, np.float32(rotation)))
    ray = _directions(rotation)
    meets = _meets(shapes, shape, np.zeros(3), ray)
    with np.errstate(divide="ignore"):
        floor = np.where(ray[:, 1] > 0, 1.65 / ray[:, 1], np.inf)
    expected = np.minimum(meets.min(1), np.where(floor < trace.FAR_M, floor, np.inf))
    # At silhouettes the two may differ: one ray in a thousand.
    agree = np.where(np.isinf(expected), depth > trace.FAR_M, np.abs(depth - expected) < 1e-3 * expected)
    assert agree.mean() > 0.998
    np.testing.assert_array_equal((thing == trace.SKY)[agree], np.isinf(expected)[agree])
    np.testing.assert_array_equal(
        (thing == trace.GROUND)[agree], ((floor <= meets.min(1)) & np.isfinite(expected))[agree]
    )
    # Shadows: from every point seen, a ray to the sun, begun a little off the surface.
    seen = agree & np.isfinite(expected)
    point = ray[seen] * expected[seen, None]
    blocked = np.isfinite(_meets(shapes, shape, point + 0.02 * SUN, np.tile(SUN, (seen.sum(), 1)))).any(1)
    ground_only = (thing == trace.GROUND)[seen]
    assert (blocked[ground_only] == (solid[seen] > 0)[ground_only]).mean() > 0.99
    assert 0.02 < blocked[ground_only].mean() < 0.98
    assert leafy.max() == 0


def test_hills_are_met_where_a_fine_search_meets_them():
    hills = np.float32([[2.0, 0.004, 0.001, 0.3], [1.0, -0.002, 0.003, 0.9]])
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-0.8, 0.8, 150), rng.uniform(-0.05, 0.2, 150)

    def height(x, z):
        f = hills[:, 1] * x[..., None] + hills[:, 2] * z[..., None] + hills[:, 3]
        f = f - np.floor(f) - 0.5
        return (hills[:, 0] * 16 * f * (0.5 - np.abs(f))).sum(-1)

    eye = np.float32(height(np.zeros(1), np.zeros(1))[0] + 1.65)
    t = np.geomspace(0.3, trace.FAR_M, 8000)
    above = eye - y[:, None] * t - height(x[:, None] * t, 1.0 * t + 0 * x[:, None])
    expected = np.where((above < 0).any(1), t[(above < 0).argmax(1)], np.inf)
    found = np.asarray(jax.jit(trace.march)(hills, eye, (jnp.array(x), jnp.array(y), jnp.ones(150))))
    hit = np.isfinite(expected)
    assert 50 < hit.sum() < 150
    close = np.abs(found[hit] - expected[hit]) < 2e-3 * expected[hit] + 1e-3
    # Crests that a ray only just touches may be missed by the coarse steps.
    assert close.mean() > 0.98
    assert (found[~hit] >= trace.FAR_M).mean() > 0.98


# Film


def test_film_is_its_formula():
    develop = jax.jit(film.develop)
    light = jnp.full((5, 7, 1), 0.2).at[2, 3].set(0.3)
    plain = film.Film(*jnp.float32([1.5, 0.8] + 9 * [0]))
    frame = np.asarray(develop(light, plain, jnp.int32(0)))
    assert frame.dtype == np.uint8
    assert frame[0, 0, 0] == round(255 * 0.3**0.8) and frame[2, 3, 0] == round(255 * 0.45**0.8)
    blurred = np.asarray(develop(light, plain._replace(blur=jnp.float32(0.2)), jnp.int32(0)))
    assert blurred[2, 3, 0] == round(255 * (1.5 * (0.2 + 0.1 * 0.6**2)) ** 0.8)
    dark = np.asarray(develop(light, plain._replace(vignette=jnp.float32(0.3)), jnp.int32(0)))
    assert dark[2, 0, 0] == round(255 * (0.3 * 0.85) ** 0.8) and dark[2, 3, 0] == frame[2, 3, 0]
    noisy = [develop(jnp.full((60, 60, 1), 0.2), plain._replace(noise=jnp.float32(0.05)), jnp.int32(i)) for i in (0, 1)]
    spread = np.std(np.float64(noisy[0])) / 255
    assert spread == pytest.approx(0.05 * np.sqrt(0.3 + 0.3**0.8), rel=0.05)
    assert abs(np.corrcoef(np.ravel(noisy[0]), np.ravel(noisy[1]))[0, 1]) < 0.1
    rolling = np.asarray(develop(light, plain._replace(rolling=jnp.float32(0.2)), jnp.int32(0)))
    rows = 0.3 * (1 + 0.2 * np.sin(2 * np.pi * 2.3 * np.arange(5) / 4))
    np.testing.assert_array_equal(rolling[:, 0, 0], np.rint(255 * rows**0.8))
