"""The ground: asphalt with its history, markings, kerb, sidewalk, verge, side roads."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from mdnvo_jax.data.world.look import Colour, Look, View
from mdnvo_jax.data.world.road import NODE_M
from mdnvo_jax.data.world.texture import Vector, band, hashed, mix, pulses, value_noise, visible

# Cells of the map from places to nodes of the centreline: their size, m, and number along a side.
CELL_M, CELLS = 8.0, 44
_KERB_M = 0.14
_LINE_M = 0.12


class Lane(NamedTuple):
    """The road about the eye, in the world's axes relative to the eye.

    Attributes:
      nodes: rows (x, z, cos and sin of heading, curvature, s), `[n, 6]`.
      corner: of the map of cells, `[2]`, m. Cells keep their places in the world as the eye moves.
      side: side roads as rows (x, z, direction x, z, half width, reach left, reach right), `[k, 7]`.
      eye: the eye in the world, for textures, `[3]`.
      lamps: heads of the nearest street lamps, `[k, 3]`.
    """

    nodes: Array
    corner: Array
    side: Array
    eye: Array
    lamps: Array


class Floor(NamedTuple):
    """What the ground is made of: colour, contrast of its texture, share of paint on it, how it shines, 0 to 1.

    Water shines as a mirror does (`shine`), dry asphalt with the sun alone, blurred (`sheen`).
    """

    colour: Colour
    contrast: Array
    painted: Array
    shine: Array
    sheen: Array


def road_coordinates(x: Array, z: Array, lane: Lane) -> tuple[Array, Array, Array]:
    """Return (s, d, row of the nearest node) of points on the ground relative to the eye.

    A map of cells leads to a node near by, whose arc gives an s, which leads to the right node. About a node with
    curvature k, with a forward and b to the right: `e = 2 b - k (a^2 + b^2)`, `d = e / (1 + sqrt(1 - k e))` and
    `s = s_i + atan(k a / (1 - k b)) / k`, of which two terms of the series are enough within an arc.
    """
    count = lane.nodes.shape[0]
    middle = (jnp.arange(CELLS) + 0.5) * CELL_M
    grid = jnp.stack(jnp.meshgrid(lane.corner[0] + middle, lane.corner[1] + middle, indexing="ij"), -1).reshape(-1, 2)
    away = (grid[:, 0] - lane.nodes[:, 0, None]) ** 2 + (grid[:, 1] - lane.nodes[:, 1, None]) ** 2
    # The distance with the node in its lowest bits: a plain minimum is faster than argmin.
    packed = (lax.bitcast_convert_type(away, jnp.int32) & ~255) | jnp.arange(count)[:, None]
    nearest = packed.min(0) & 255

    def arc(row: Array) -> tuple[Array, Array]:
        x0, z0, cos, sin, k, s0 = (lane.nodes[:, i][row] for i in range(6))
        forward, right = (x - x0) * sin + (z - z0) * cos, (x - x0) * cos - (z - z0) * sin
        e = 2 * right - k * (forward**2 + right**2)
        d = e / (1 + jnp.sqrt(jnp.maximum(1 - k * e, 1e-4)))
        straight = forward / jnp.maximum(1 - k * right, 0.1)
        return s0 + straight * (1 - (k * straight) ** 2 / 3), d

    i, j = (jnp.clip((p - lane.corner[axis]) / CELL_M, 0, CELLS - 1) for axis, p in enumerate((x, z)))
    s, _ = arc(nearest[i.astype(jnp.int32) * CELLS + j.astype(jnp.int32)])
    row = jnp.clip(jnp.rint((s - lane.nodes[0, 5]) / NODE_M), 0, count - 1).astype(jnp.int32)
    return *arc(row), row


def pave(point: Vector, view: View, stretched_m: Array, noise: Array, lane: Lane, look: Look) -> Floor:
    """Return what the ground is made of at `point`, relative to the eye.

    Args:
      point: what each sample sees.
      view: how it does.
      stretched_m: footprint of a sample along the ground, away from the eye.
      noise: texture at the point, about -1 to 1.
      lane: the road.
      look: of the world.
    """
    s, d, row = road_coordinates(point[0], point[2], lane)
    # Footprint across and along the road, of an ellipse that points away from the eye.
    horizontal = jnp.sqrt(view.towards[0] ** 2 + view.towards[2] ** 2) + 1e-6
    cos, sin = lane.nodes[:, 2][row], lane.nodes[:, 3][row]
    sideways = jnp.abs(view.towards[0] * cos - view.towards[2] * sin) / horizontal
    ahead = jnp.sqrt(jnp.maximum(1 - sideways**2, 0))
    across = stretched_m * sideways + view.width_m * ahead
    along = stretched_m * ahead + view.width_m * sideways

    side = _side_roads(point, lane, stretched_m)
    width = look.half_width_m
    main = band(d, -width, width, across)
    kerb = (band(d, -width - _KERB_M, width + _KERB_M, across) - main) * (1 - side) * (look.sidewalk_m > 0)
    outer = width + _KERB_M + look.sidewalk_m
    walk = (band(d, -outer, outer, across) - main - kerb) * (1 - side) * (look.sidewalk_m > 0)
    asphalt = jnp.maximum(main, side)

    world = (point[0] + lane.eye[0], point[1] + lane.eye[1], point[2] + lane.eye[2])
    wear = _asphalt(world, s, d, along, across, stretched_m, look)
    joints = jnp.maximum(pulses(s / 0.8, 0.06, along / 0.8), pulses(d / 0.8, 0.06, across / 0.8))
    colour = []
    for c in range(look.colours.shape[1]):
        asphalt_c, verge_c, walk_c = look.colours[0, c], look.colours[1, c], look.colours[2, c]
        beside = mix(verge_c, walk_c * (1 - 0.5 * joints), walk)
        dry = mix(mix(beside, 1.15 * walk_c + 0.06, kerb), asphalt_c * wear, asphalt)
        colour.append(dry * (1 - 0.5 * look.wet))
    painted = _markings(s, d, along, across, look) * main * (1 - side)
    fresh = jnp.clip(1 - look.wear * (0.35 + 0.8 * noise), 0, 1)
    # Water stands in ruts and hollows.
    shine = look.wet * jnp.maximum(asphalt, walk) * jnp.clip(0.6 + 0.8 * (1 - wear) - 0.5 * noise, 0, 1)
    return Floor(
        tuple(colour), mix(0.6, look.roughness, asphalt) - 0.35 * walk, painted * fresh, shine, look.sheen * asphalt
    )


def _side_roads(point: Vector, lane: Lane, footprint: Array) -> Array:
    covered = jnp.zeros_like(footprint)
    for k in range(lane.side.shape[0]):
        x0, z0, ux, uz, half, left, right = (lane.side[k, i] for i in range(7))
        dx, dz = point[0] - x0, point[2] - z0
        out = band(dx * ux + dz * uz, -left, right, footprint)
        covered = jnp.maximum(covered, out * band(dx * uz - dz * ux, -half, half, footprint))
    return covered


def _asphalt(world: Vector, s: Array, d: Array, along: Array, across: Array, stretched_m: Array, look: Look) -> Array:
    """Return a factor on the colour of asphalt: its repairs, wheel tracks, streaks, seam and cracks."""
    patch_s, patch_d = s / 7.0 + 0.37 * jnp.floor(d / 1.7), d / 1.7
    cell = (jnp.floor(patch_s).astype(jnp.int32), jnp.floor(patch_d).astype(jnp.int32))
    repair = hashed(cell, look.seed + 11)
    there = hashed(cell, look.seed + 12)
    inside = pulses(patch_s, 0.9, along / 7.0) * pulses(patch_d, 0.85, across / 1.7)
    change = 0.35 * repair * (there > 1 - look.patches) * inside
    change -= 0.08 * pulses(2 * d / look.lane_m, 0.5, 2 * across / look.lane_m)
    streak = value_noise((s / 8, d * 2.5), look.seed + 13)
    change += 0.1 * streak * visible(jnp.maximum(across * 2.5, along / 8))
    change -= 0.35 * band(d, -0.025, 0.025, across)
    ridge = value_noise((world[0] / 1.4, world[2] / 1.4), look.seed + 14)
    ridge += 0.5 * value_noise((world[0] / 0.4, world[2] / 0.4), look.seed + 15)
    where = value_noise((world[0] / 6, world[2] / 6), look.seed + 16)
    crack = band(ridge, -0.03, 0.03, 1.5 * stretched_m) * (where > 1 - 1.6 * look.cracks)
    stones = lax.cond(look.stone_m > 0, _stones, lambda s, *_: jnp.ones_like(s), s, d, along, across, look)
    return (1 + look.history * change) * (1 - 0.65 * look.history * crack) * stones


def _stones(s: Array, d: Array, along: Array, across: Array, look: Look) -> Array:
    """Return a factor on the colour of a road of stones: rows across the road, each shifted by half a stone."""
    row = jnp.floor(s / look.stone_m)
    place = d / look.stone_m + 0.5 * row
    along, across = along / look.stone_m, across / look.stone_m
    joint = jnp.maximum(pulses(s / look.stone_m + 0.5, 0.14, along), pulses(place + 0.5, 0.14, across))
    tone = hashed((row.astype(jnp.int32), jnp.floor(place).astype(jnp.int32)), look.seed + 18)
    return (1 + 0.35 * tone * visible(jnp.maximum(along, across))) * (1 - 0.6 * joint)


def _markings(s: Array, d: Array, along: Array, across: Array, look: Look) -> Array:
    """Return the share of each footprint that markings cover: centre, lanes, edges, pedestrian crossings."""
    dashes = pulses(s / look.lane_period_m, look.lane_duty, along / look.lane_period_m)
    dashed = jnp.where(look.centre_line > 1.5, 1.0, dashes) * (look.centre_line > 0.5)
    centre = band(d, -_LINE_M / 2, _LINE_M / 2, across) * dashed
    lanes = jnp.abs(d) / look.lane_m
    between = jnp.abs(lanes - jnp.rint(lanes)) * look.lane_m
    inner = (lanes > 0.5) & (lanes < look.lanes - 0.5)
    lines = jnp.where(inner, band(between, -_LINE_M / 2, _LINE_M / 2, across) * dashes, 0)
    edge = look.lane_m * look.lanes
    edges = band(jnp.abs(d), edge - _LINE_M, edge, across) * look.edge_line
    crossing = jnp.floor(s / 60.0)
    there = hashed((crossing.astype(jnp.int32),), look.seed + 17) > 1 - 2 * look.zebra
    bars = band(s - 60 * crossing, 28.0, 31.5, along) * pulses(d, 0.5, across) * there
    return jnp.maximum(jnp.maximum(centre, lines), jnp.maximum(jnp.maximum(edges, bars), _arrows(s, d, across, look)))


def _arrows(s: Array, d: Array, across: Array, look: Look) -> Array:
    """Return the share that arrows cover: a stem of 3 m and a head of 2 m in the middle of a lane, the way it goes."""
    lane = jnp.floor(d / look.lane_m)
    onwards = jnp.where(d * look.side > 0, s, -s)
    block = jnp.floor(onwards / 40)
    ahead, aside = onwards - 40 * block - 20, jnp.abs(d - (lane + 0.5) * look.lane_m)
    there = hashed((block.astype(jnp.int32), lane.astype(jnp.int32)), look.seed + 19) > 1 - 2 * look.arrows
    half = jnp.where(ahead < 3, 0.08, 0.45 * (1 - (ahead - 3) / 2))
    on_it = there & (jnp.abs(d) < look.lane_m * look.lanes) & (ahead > 0) & (ahead < 5)
    return jnp.where(on_it, band(aside, -half, half, across), 0)
