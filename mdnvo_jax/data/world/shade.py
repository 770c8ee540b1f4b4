"""The light that comes from what a sample hit: texture, sun, shadow, sky light and haze.

Radiance is linear, and 1 for a white surface on level ground at a clear noon.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mdnvo_jax.data.world import night, pavement, sky
from mdnvo_jax.data.world.look import Colour, Look, View
from mdnvo_jax.data.world.pavement import Lane
from mdnvo_jax.data.world.texture import Vector, fractal, hashed, mix, pulses, value_noise, visible
from mdnvo_jax.data.world.things import Paint
from mdnvo_jax.data.world.trace import BOXES, GROUND, SKY, Hit, Shapes

# Share of a pixel that counts when textures fade: a little less than all, like a sharp lens.
_SHARPNESS = 0.8
_OCTAVES, _GAIN = 5, 1.0
# Exponent of the lobe in which dry asphalt mirrors the sun: half of it within 15 degrees.
_GLOSS = 20.0


class Surface(NamedTuple):
    """The surface of the thing that each sample hit, `[tiles, samples]`.

    Attributes:
      normal: unit vector, world axes. facing: cosine between it and the ray.
      metres: place on the thing, for texture, m. above_m: height over the thing's foot.
      pane: share of the footprint that lies on panes. glint: brightness of this pane. roof: looks up.
    """

    normal: Vector
    facing: Array
    metres: Vector
    above_m: Array
    pane: Array
    glint: Array
    roof: Array


def look_along(rays: Vector, depth: Array, focal: Array, samples: int) -> View:
    """Return the `View` of rays (z = 1 in camera axes) that end at `depth`, for a focal length in pixels."""
    length = jnp.sqrt(rays[0] ** 2 + rays[1] ** 2 + rays[2] ** 2)
    pixel = _SHARPNESS / samples**0.5 / focal
    distance = depth * length
    return View((rays[0] / length, rays[1] / length, rays[2] / length), distance, pixel, distance * pixel)


def radiance(
    hit: Hit,
    view: View,
    shapes: Shapes,
    paint: Paint,
    lane: Lane,
    look: Look,
    shadows: tuple[Array, Array],
    rotation: Array,
) -> Colour:
    """Return the radiance of every sample, one array `[tiles, samples]` a channel."""
    ground, away = hit.thing == GROUND, hit.thing == SKY
    row = jnp.maximum(hit.thing, 0)
    skin = _surface(hit, view, shapes, paint, row, look)
    facing = jnp.where(ground, view.towards[1], skin.facing)
    stretched_m = view.width_m / jnp.maximum(facing, 0.02)
    normal = tuple(jnp.where(ground, up, n) for up, n in zip((0.0, -1.0, 0.0), skin.normal, strict=True))
    world = tuple(p + lane.eye[i] for i, p in enumerate(hit.point))

    # Noise is what costs most: it is evaluated once, wherever the surface's texture lives.
    far, beyond = sky.backdrop(view, look)
    point = tuple(
        jnp.where(away, b, jnp.where(ground, w, m)) for b, w, m in zip(beyond.point, world, skin.metres, strict=True)
    )
    cell = jnp.where(away, beyond.cell, jnp.where(ground, 1.8, paint.grain_m[row]))
    footprint = jnp.where(away, beyond.footprint, stretched_m)
    # Ground and sky keep their texture whatever stands nearest.
    own = jnp.where(hit.thing >= 0, 31 * paint.seed[row], 0)
    noise = fractal(point, footprint, cell, _GAIN, _OCTAVES, look.seed + own)

    floor = pavement.pave(hit.point, view, stretched_m, noise, lane, look)
    texture = jnp.maximum(1 + jnp.where(ground, floor.contrast, paint.contrast[row]) * noise, 0.15)
    direct, diffuse = _light(normal, ground, skin.above_m, paint.leafy[row], world, stretched_m, shadows, look)
    lamps = night.lamplight(hit.point, normal, ground, view, lane.lamps, rotation, look)
    # At night panes are lit from within, some more than others.
    glow = paint.glow[row] * skin.pane * skin.glint**4 * (look.headlight > 0)
    # Schlick's formula for water, at the angle of the eye.
    mirror = jnp.where(ground, floor.shine * (0.02 + 0.4 * (1 - jnp.clip(facing, 0, 1)) ** 5), 0)
    sheen = jnp.where(ground, floor.sheen * _glint(view.towards, look), 0) * direct
    clearness = jnp.exp(-jnp.minimum(view.distance_m, 1e4) / look.haze_m)
    heaven = sky.heaven(view, far, noise, look)
    colour = []
    for c in range(look.colours.shape[1]):
        wall = paint.albedo[:, c][row] * jnp.where(skin.roof, paint.top[row], 1) * texture
        wall = mix(wall, paint.window[:, c][row] * skin.glint, skin.pane)
        albedo = jnp.where(ground, mix(floor.colour[c] * texture, look.paint, floor.painted), wall)
        air = 0.8 * look.daylight * look.colours[5, c]
        seen = albedo * (direct * look.colours[6, c] + diffuse + lamps) + glow + sheen * look.colours[6, c]
        seen = mix(seen, air, mirror)
        colour.append(jnp.where(away, heaven[c], mix(air, seen, clearness)))
    return tuple(colour)


def _glint(towards: Vector, look: Look) -> Array:
    """Return how far a level, rough ground mirrors the sun to the eye, 0 to 1: Blinn's lobe about the half vector."""
    half = [s - t for s, t in zip(look.sun, towards, strict=True)]
    length = jnp.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2) + 1e-6
    return jnp.maximum(-half[1] / length, 0) ** _GLOSS


def _surface(hit: Hit, view: View, shapes: Shapes, paint: Paint, row: Array, look: Look) -> Surface:
    box = row < BOXES
    q, size = hit.local, [jnp.sqrt((shapes.axes[:, :, i] ** 2).sum(1))[row] for i in range(3)]
    on_x = jnp.abs(q[0]) > jnp.maximum(jnp.abs(q[1]), jnp.abs(q[2]))
    on_y = ~on_x & (jnp.abs(q[1]) > jnp.abs(q[2]))
    ball = shapes.ball[row]
    unit = (
        jnp.where(box, jnp.where(on_x, jnp.sign(q[0]), 0.0), q[0]),
        jnp.where(box, jnp.where(on_y, jnp.sign(q[1]), 0.0), ball * q[1]),
        jnp.where(box, jnp.where(on_x | on_y, 0.0, jnp.sign(q[2])), q[2]),
    )
    # Normals go the way of the transposed inverse.
    inverse = [[shapes.inverse[:, i, j][row] for j in range(3)] for i in range(3)]
    normal = [inverse[0][j] * unit[0] + inverse[1][j] * unit[1] + inverse[2][j] * unit[2] for j in range(3)]
    length = jnp.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2) + 1e-9
    normal = [n / length for n in normal]
    facing = jnp.abs(sum(n * t for n, t in zip(normal, view.towards, strict=True)))

    stretched = view.width_m / jnp.maximum(facing, 0.02)
    panes = [paint.panes[:, i][row] for i in range(3)]
    count = jnp.where(on_x, panes[2], panes[0])
    along = (jnp.where(on_x, q[2], q[0]) + 1) / 2 * count
    upwards = (1 - q[1]) / 2 * panes[1] - paint.lift[row]
    spread = stretched / (2 * jnp.where(on_x, size[2], size[0])) * count
    pane = pulses(along, paint.width[row], spread)
    pane *= pulses(upwards, paint.height[row], view.width_m / (2 * size[1]) * panes[1])
    # Panes mirror different pieces of the surroundings.
    glint = hashed((jnp.floor(along).astype(jnp.int32), jnp.floor(upwards).astype(jnp.int32)), paint.seed[row])
    return Surface(
        normal=(normal[0], normal[1], normal[2]),
        facing=facing,
        metres=(q[0] * size[0], q[1] * size[1], q[2] * size[2]),
        above_m=(1 - q[1]) * size[1],
        pane=jnp.where(box & ~on_y & (count > 0), pane, 0.0),
        glint=1 + 0.7 * glint * visible(spread),
        roof=normal[1] < -0.7,
    )


def _light(
    normal: Vector,
    ground: Array,
    above_m: Array,
    leafy: Array,
    world: Vector,
    footprint_m: Array,
    shadows: tuple[Array, Array],
    look: Look,
) -> tuple[Array, Array]:
    """Return the (direct, diffuse) light on a surface, as multiples of what level ground gets at a clear noon."""
    solid, leaves = shadows
    # Under leaves there are spots of sun, which blur to a mean where they are not resolved.
    spots = value_noise((world[0] * 2.5, world[2] * 2.5), 77)
    spots = jnp.clip(3 * spots * visible(footprint_m * 2.5) - 0.4, 0, 1)
    lit = (1 - solid) * (1 - leaves * (1 - spots))
    cosine = jnp.maximum(sum(n * look.sun[i] for i, n in enumerate(normal)), 0)
    # Light comes through leaves, and round them.
    cosine = jnp.where(ground, cosine, mix(cosine, 0.25 + 0.6 * cosine, leafy))
    direct = look.sun_strength * lit * cosine / jnp.maximum(-look.sun[1], 0.2)
    # Less of the sky is seen by what looks down, by what is near the foot of things, and under trees.
    open_sky = jnp.where(ground, 1 - 0.35 * leaves, 0.55 + 0.45 * jnp.clip(above_m / 1.2, 0, 1))
    return direct, look.sky_strength * (0.65 - 0.35 * normal[1]) * open_sky
