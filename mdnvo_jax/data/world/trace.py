"""The ray caster: which surface each sample of a frame sees, where, and whether the sun sees it too.

The frame is cut into square tiles. Pairs of a thing and a tile that it may be seen in are listed, and only those are
tested. Arrays of samples are `[tiles, samples of a tile]`. Distances along a ray are in units of depth: directions have
z = 1 in the camera's axes, so that the parameter of a hit is its depth in m.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mdnvo_jax.data.world.texture import Vector

TILE = 16
# Things that a frame can show: boxes come first, then balls and cylinders. Pairs of such a thing and a tile that are
# tested, by tile of the frame: what is farthest is left out first.
BOXES, ROUNDS = 256, 512
_PAIRS = 24
# Nothing nearer than this is seen, m.
_NEAR_M = 0.25
# Nothing of the ground farther than this is seen, m: 0.2 degrees below the horizon from KITTI's camera height.
FAR_M = 400.0
# Places along a ray where its height above the ground is looked at.
_STEPS = 10
_MISS = 1e5
# Bits that hold the row of a thing; what throws a shadow.
_ROWS = 1023
_SOLID, _LEAVES = 1, 2
# `Hit.thing` where no thing was hit.
GROUND, SKY = -1, -2
# Waves, in cycles a metre, whose sum decides where a crown has gaps.
_GAPS = ((0.9, 0.35, 0.55), (-1.2, 1.7, 1.35), (1.7, 3.4, -2.9))
# Where a pixel is sampled, by the number of samples: offsets (u, v) from its centre, in pixels.
_OFFSETS = {
    1: ((0.0, 0.0),),
    2: ((-0.25, -0.25), (0.25, 0.25)),
    4: ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125)),
}
# Corners of the unit cube, its twelve edges, and the edges of a cube with the shadow that it drags along.
_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
_EDGES = np.array([(i, j) for i in range(8) for j in range(i) if np.abs(_CORNERS[i] - _CORNERS[j]).sum() == 2])
_SHADOW_EDGES = np.concatenate([_EDGES, _EDGES + 8, np.stack([np.arange(8), np.arange(8) + 8], 1)])


class Shapes(NamedTuple):
    """The things of a frame, relative to the eye in the world's axes: first boxes, then balls and cylinders.

    Each kind begins with the nearest.

    Attributes:
      centre: `[n, 3]`. axes: unit cube to world, `[n, 3, 3]`. inverse: of the axes.
      ball: 1 for a ball, 0 for a cylinder. leafy: 0, or what the gaps of a ball of leaves vary with. radius: m.
      floor: y of the ground below. present: 0 for padding.
    """

    centre: Array
    axes: Array
    inverse: Array
    ball: Array
    leafy: Array
    radius: Array
    floor: Array
    present: Array


class Hit(NamedTuple):
    """What the samples see, each `[tiles, samples]`.

    Attributes:
      depth: m; `_MISS` or so for the sky. thing: row of the thing seen, or `GROUND`, or `SKY`.
      point: relative to the eye, in the world's axes, m. local: on the unit shape of the thing.
    """

    depth: Array
    thing: Array
    point: Vector
    local: Vector


class Solid(NamedTuple):
    """One thing, or one for each sample: the eye on its unit shape, and see `Shapes`."""

    eye: Vector
    inverse: tuple[Vector, ...]
    ball: Array
    leafy: Array
    radius: Array


# Takes the origin and the direction of a ray on the unit shape of a thing, and the thing.
Test = Callable[[Vector, Vector, Solid], Array]


def rays(rotation: Array, camera: Array, height: int, width: int, samples: int) -> Vector:
    """Return ray directions in the world's axes, `[tiles, samples]`, for a camera (fx, fy, cx, cy)."""
    rows, columns = -(-height // TILE), -(-width // TILE)
    offsets = np.array(_OFFSETS[samples], np.float32)
    inside = np.arange(TILE, dtype=np.float32)
    shape = (rows, columns, samples, TILE, TILE)
    u = TILE * np.arange(columns)[:, None, None, None] + offsets[:, 0, None, None] + inside
    v = TILE * np.arange(rows)[:, None, None, None, None] + offsets[:, 1, None, None] + inside[:, None]
    flat = (rows * columns, samples * TILE * TILE)
    x = (jnp.asarray(np.broadcast_to(u, shape).reshape(flat), jnp.float32) - camera[2]) / camera[0]
    y = (jnp.asarray(np.broadcast_to(v, shape).reshape(flat), jnp.float32) - camera[3]) / camera[1]
    dx, dy, dz = (rotation[i, 0] * x + rotation[i, 1] * y + rotation[i, 2] for i in range(3))
    return dx, dy, dz


def image(values: Array, height: int, width: int, samples: int) -> Array:
    """Return an image `[height, width]`: the mean over the samples of each pixel."""
    rows, columns = -(-height // TILE), -(-width // TILE)
    grid = values.reshape(rows, columns, samples, TILE, TILE).mean(2)
    return grid.transpose(0, 2, 1, 3).reshape(rows * TILE, columns * TILE)[:height, :width]


def cast(
    shapes: Shapes, hills: Array, eye_m: Array, rays_: Vector, rotation: Array, camera: Array, size: tuple[int, int]
) -> Hit:
    """Return what each ray sees first.

    Args:
      shapes: things.
      hills: rows (amplitude, wave vector, phase at the eye) of the ground, see `road.ground`.
      eye_m: height of the eye above the ground's datum.
      rays_: from `rays`.
      rotation: of the camera, camera to world.
      camera: (fx, fy, cx, cy).
      size: (height, width) of the frame.
    """
    corners = shapes.centre[:, None] + _product("nij,cj->nci", shapes.axes, _CORNERS)
    bounds = _bounds(_product("ncj,jk->nck", corners, rotation), _EDGES, camera)
    table = _table(shapes)

    def nearer(best: Array, tile: Array, row: Array, test: Test) -> Array:
        thing = _thing(table, row)
        d = _apply(thing.inverse, tuple(lax.dynamic_index_in_dim(r, tile, keepdims=False) for r in rays_))
        seen = _pack(test(thing.eye, d, thing), row)
        old = lax.dynamic_index_in_dim(best, tile, keepdims=False)
        return lax.dynamic_update_index_in_dim(best, jnp.minimum(old, seen), tile, 0)

    best = jnp.full(rays_[0].shape, _pack(jnp.float32(_MISS), 0))
    best = _for_pairs(partial(nearer, test=_box), best, _pairs(bounds, shapes, size, 0, BOXES))
    best = _for_pairs(partial(nearer, test=_round), best, _pairs(bounds, shapes, size, BOXES, BOXES + ROUNDS))
    # What was packed is good enough to tell which is nearer; the winner is met once more, exactly.
    row = best & _ROWS
    winner = _thing(table, row)
    d = _apply(winner.inverse, rays_)
    t = jnp.where(row < BOXES, _box(winner.eye, d, winner), _round(winner.eye, d, winner))
    t = jnp.where(best < _pack(jnp.float32(_MISS), 0), t, _MISS)
    ground = march(hills, eye_m, rays_)
    sky = jnp.minimum(t, ground) >= FAR_M
    depth = jnp.where(sky, _MISS, jnp.minimum(t, ground))
    point = (rays_[0] * depth, rays_[1] * depth, rays_[2] * depth)
    local = tuple(e + depth * i for e, i in zip(winner.eye, d, strict=True))
    return Hit(depth, jnp.where(sky, SKY, jnp.where(ground < t, GROUND, row)), point, local)


def shadow(
    shapes: Shapes, hit: Hit, sun: Array, rotation: Array, camera: Array, size: tuple[int, int]
) -> tuple[Array, Array]:
    """Return (solid, leafy): 1 where a box or cylinder, or a ball, stands between the point seen and the sun."""
    corners = shapes.centre[:, None] + _product("nij,cj->nci", shapes.axes, _CORNERS)
    # A shadow ends on the ground: a little deeper than right below the thing, for slopes.
    foot = shapes.floor + 0.5
    drop = jnp.minimum((foot[:, None] - corners[..., 1]) / jnp.maximum(-sun[1], 0.1), 60.0)
    cast_ = corners - drop[..., None] * sun
    both = _product("ncj,jk->nck", jnp.concatenate([corners, cast_], 1), rotation)
    bounds = _bounds(both, _SHADOW_EDGES, camera)
    table = _table(shapes)
    towards = (sun[0], sun[1], sun[2])

    def darker(dark: Array, tile: Array, row: Array, test: Test) -> Array:
        thing = _thing(table, row)
        moved = _apply(thing.inverse, tuple(lax.dynamic_index_in_dim(p, tile, keepdims=False) for p in hit.point))
        start = tuple(e + m for e, m in zip(thing.eye, moved, strict=True))
        blocked = test(start, _apply(thing.inverse, towards), thing)
        old = lax.dynamic_index_in_dim(dark, tile, keepdims=False)
        new = old | jnp.where(blocked, jnp.where(thing.leafy > 0, _LEAVES, _SOLID), 0)
        return lax.dynamic_update_index_in_dim(dark, new, tile, 0)

    dark = jnp.zeros(hit.depth.shape, jnp.int32)
    dark = _for_pairs(partial(darker, test=_box_blocks), dark, _pairs(bounds, shapes, size, 0, BOXES))
    dark = _for_pairs(partial(darker, test=_round_blocks), dark, _pairs(bounds, shapes, size, BOXES, BOXES + ROUNDS))
    return jnp.float32((dark & _SOLID) > 0), jnp.float32((dark & _LEAVES) > 0)


def march(hills: Array, eye_m: Array, direction: Vector) -> Array:
    """Return the depth at which each ray first meets the ground, `_MISS` where it does not within `FAR_M`.

    The height of the ray above the ground, `f(t) = eye - d_y t - g(d_x t, d_z t)`, is looked at in growing steps;
    where it changes sign, a secant and Newton steps, kept inside the bracket, find the root.
    """
    dx, dy, dz = direction

    def above(t: Array) -> tuple[Array, Array]:
        value, slope = eye_m - dy * t, -dy
        for hill in range(hills.shape[0]):
            amplitude, kx, kz, phase = (hills[hill, i] for i in range(4))
            rate = kx * dx + kz * dz
            f = rate * t + phase
            f = f - jnp.floor(f) - 0.5
            value -= amplitude * 16 * f * (0.5 - jnp.abs(f))
            slope -= amplitude * (8 - 32 * jnp.abs(f)) * rate
        return value, slope

    def double(step: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        low, low_value, high, high_value = state
        t = jnp.full_like(dx, 2.0 * (FAR_M / 2.0) ** (step / (_STEPS - 1)))
        value, _ = above(t)
        searching = high >= _MISS
        crossing = searching & (value <= 0)
        high, high_value = jnp.where(crossing, t, high), jnp.where(crossing, value, high_value)
        on = searching & ~crossing
        return jnp.where(on, t, low), jnp.where(on, value, low_value), high, high_value

    near, nothing = jnp.full_like(dx, _NEAR_M), jnp.full_like(dx, _MISS)
    state = (near, above(near)[0], nothing, jnp.zeros_like(dx))
    low, low_value, high, high_value = lax.fori_loop(0, _STEPS, double, state)

    def newton(_: Array, t: Array) -> Array:
        value, slope = above(t)
        return jnp.clip(t - value / jnp.minimum(slope, -1e-6), low, high)

    t = low + (high - low) * low_value / jnp.maximum(low_value - high_value, 1e-6)
    t = lax.fori_loop(0, 3, newton, t)
    return jnp.where(high < _MISS, t, _MISS)


def _bounds(points: Array, edges: np.ndarray, camera: Array) -> tuple[Array, ...]:
    """Return (least u, largest u, least v, largest v, least depth), each `[n]`, of hulls of `points` `[n, p, 3]`.

    Edges that pass through the near plane are cut there. What lies behind it altogether gets an infinite depth.
    """
    a, b = points[:, edges[:, 0]], points[:, edges[:, 1]]
    za, zb = a[..., 2:], b[..., 2:]
    through = ((za > _NEAR_M) != (zb > _NEAR_M))[..., 0]
    cut = a + (_NEAR_M - za) / jnp.where(jnp.abs(zb - za) < 1e-6, 1e-6, zb - za) * (b - a)
    everything = jnp.concatenate([points, cut], 1)
    seen = jnp.concatenate([points[..., 2] > _NEAR_M, through], 1)
    depth = jnp.maximum(everything[..., 2], 0.5 * _NEAR_M)
    u = everything[..., 0] / depth * camera[0] + camera[2]
    v = everything[..., 1] / depth * camera[1] + camera[3]

    def least(x: Array) -> Array:
        return jnp.where(seen, x, jnp.inf).min(1)

    return least(u), -least(-u), least(v), -least(-v), least(depth)


def _pairs(
    bounds: tuple[Array, ...], shapes: Shapes, size: tuple[int, int], first: int, last: int
) -> tuple[Array, Array, Array]:
    """Return (number of pairs, their tiles, their rows) of things from `first` to `last` and the tiles they touch."""
    rows, columns = -(-size[0] // TILE), -(-size[1] // TILE)
    tiles = rows * columns
    left, top = TILE * np.arange(columns) - 0.5, TILE * np.arange(rows)[:, None] - 0.5
    u0, u1, v0, v1, depth = (b[first:last, None, None] for b in bounds)
    there = (shapes.present[first:last, None, None] > 0) & jnp.isfinite(depth)
    touches = there & (u0 < left + TILE) & (u1 > left) & (v0 < top + TILE) & (v1 > top)
    # The k-th pair, nearest thing first, is where the running count of touches reaches k.
    reached = jnp.cumsum(touches.reshape(-1), dtype=jnp.int32)
    pair = jnp.searchsorted(reached, jnp.arange(1, _PAIRS * tiles + 1, dtype=jnp.int32))
    return jnp.minimum(reached[-1], _PAIRS * tiles), pair % tiles, first + pair // tiles


def _for_pairs(step: Callable[[Array, Array, Array], Array], start: Array, pairs: tuple[Array, Array, Array]) -> Array:
    """Return `start` after `step(value, tile, row)` for every pair: a loop that is as long as there are pairs."""
    count, tile, row = pairs
    return lax.fori_loop(0, count, lambda k, value: step(value, tile[k], row[k]), start)


def _table(shapes: Shapes) -> Array:
    """Return what `_thing` looks up, a row a thing."""
    eye = -_product("nij,nj->ni", shapes.inverse, shapes.centre)
    more = jnp.stack([shapes.ball, shapes.leafy, shapes.radius], 1)
    return jnp.concatenate([eye, shapes.inverse.reshape(-1, 9), more], 1)


def _thing(table: Array, row: Array) -> Solid:
    """Return a row of a table, or for an array of rows what each is."""
    x, y, z, a, b, c, d, e, f, g, h, i, *more = (table[:, column][row] for column in range(table.shape[1]))
    return Solid((x, y, z), ((a, b, c), (d, e, f), (g, h, i)), *more)


def _product(subscripts: str, a: Array, b: Array | np.ndarray) -> Array:
    """Return an einsum in full float32: accelerators multiply matrices with fewer digits unless told."""
    return jnp.einsum(subscripts, a, b, precision=lax.Precision.HIGHEST)


def _apply(m: tuple[Vector, ...], p: Vector) -> Vector:
    x, y, z = (row[0] * p[0] + row[1] * p[1] + row[2] * p[2] for row in m)
    return x, y, z


def _pack(t: Array, row: Array | int) -> Array:
    """Return an integer that orders as `t > 0` does, to 2^-13 of it, and carries `row` in its lowest bits."""
    return (lax.bitcast_convert_type(t, jnp.int32) & ~_ROWS) | row


def _slabs(o: Vector, d: Vector) -> tuple[Array, Array]:
    """Return where rays enter and leave the cube [-1, 1]^3."""
    enter, leave = jnp.float32(-_MISS), jnp.float32(_MISS)
    for origin, direction in zip(o, d, strict=True):
        inverse = 1 / jnp.where(jnp.abs(direction) < 1e-9, 1e-9, direction)
        middle, half = -origin * inverse, jnp.abs(inverse)
        enter, leave = jnp.maximum(enter, middle - half), jnp.minimum(leave, middle + half)
    return enter, leave


def _box(o: Vector, d: Vector, _: Solid) -> Array:
    enter, leave = _slabs(o, d)
    return jnp.where((enter < leave) & (enter > _NEAR_M), enter, _MISS)


def _box_blocks(o: Vector, d: Vector, _: Solid) -> Array:
    enter, leave = _slabs(o, d)
    return (enter < leave) & (leave > 0.02)


def _roots(o: Vector, d: Vector, ball: Array) -> tuple[Array, Array, Array]:
    """Return (whether a ray meets `x^2 + z^2 + ball y^2 = 1`, where it enters, where it leaves)."""
    a = jnp.maximum(d[0] * d[0] + d[2] * d[2] + ball * d[1] * d[1], 1e-9)
    b = o[0] * d[0] + o[2] * d[2] + ball * o[1] * d[1]
    c = o[0] * o[0] + o[2] * o[2] + ball * o[1] * o[1] - 1
    discriminant = b * b - a * c
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    return discriminant > 0, (-b - root) / a, (-b + root) / a


def _round(o: Vector, d: Vector, thing: Solid) -> Array:
    """Return where a ray meets a cylinder or a ball; through a gap in the leaves it may see the far side."""
    meets, enter, leave = _roots(o, d, thing.ball)
    meets &= enter > _NEAR_M
    front = meets & (jnp.abs(o[1] + enter * d[1]) <= 1) & _leaf(o, d, enter, thing)
    back = meets & (thing.leafy > 0) & _leaf(o, d, leave, thing)
    return jnp.where(front, enter, jnp.where(back, leave, _MISS))


def _leaf(o: Vector, d: Vector, t: Array, thing: Solid) -> Array:
    """Return whether there are leaves at a point of a ball: three oblique waves leave gaps where they add up.

    Gaps close with the distance, before they are too small for a pixel.
    """
    x, y, z = (thing.radius * (o[i] + t * d[i]) for i in range(3))
    wave = jnp.float32(0)
    for kx, ky, kz in _GAPS:
        # Each wave bends the next, or the gaps would lie in rows.
        f = kx * x + ky * y + kz * z + thing.leafy + 0.3 * wave
        f = f - jnp.floor(f) - 0.5
        wave += 16 * f * (0.5 - jnp.abs(f))
    return (wave < 0.4 + 0.02 * t) | (thing.leafy == 0)


def _round_blocks(o: Vector, d: Vector, thing: Solid) -> Array:
    meets, enter, leave = _roots(o, d, thing.ball)
    return meets & (leave > 0.02) & (jnp.abs(o[1] + jnp.maximum(enter, 0) * d[1]) <= 1)
