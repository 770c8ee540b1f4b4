"""The renderer: one frame of a world as a pure function of arrays, and the exact depth and flow that belong to it."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array, lax

from mdnvo_jax.data.world import lens, shade, trace
from mdnvo_jax.data.world.film import Film, develop
from mdnvo_jax.data.world.look import Colour, Look
from mdnvo_jax.data.world.texture import Vector
from mdnvo_jax.data.world.trace import SKY, Hit, Shapes
from mdnvo_jax.data.world.world import Frame


def render(
    frame: Frame, look: Look, film: Film, camera: Array, index: int, *, height: int, width: int, samples: int
) -> Array:
    """Return a frame, uint8 `[H, W, C]`.

    Each stage is compiled by itself: in one piece, the compiler computes what several stages need once for each.

    Args:
      frame: what is there.
      look: of the world; its colours decide C.
      film: of this frame.
      camera: (fx, fy, cx, cy) in pixels, pixel centres at whole numbers.
      index: of the frame, which noise varies with.
      height: H.
      width: W.
      samples: rays a pixel, 1, 2 or 4.
    """
    frame = jax.device_put(frame)
    size = {"height": height, "width": width, "samples": samples}
    rays, hit = _cast(frame, camera, **size)
    shadows = _shadow(frame, hit, look, camera, **size)
    light = _shade(frame, rays, hit, shadows, look, camera, **size)
    return _develop(frame, light, hit.depth, look, film, camera, index, **size)


_stage = partial(jax.jit, static_argnames=("height", "width", "samples"))


@_stage
def _cast(frame: Frame, camera: Array, *, height: int, width: int, samples: int) -> tuple[Vector, Hit]:
    rays = trace.rays(frame.rotation, camera, height, width, samples)
    size = (height, width)
    return rays, trace.cast(frame.shapes, frame.hills, frame.eye_m, rays, frame.rotation, camera, size)


@_stage
def _shadow(
    frame: Frame, hit: Hit, look: Look, camera: Array, *, height: int, width: int, samples: int
) -> tuple[Array, Array]:
    return trace.shadow(frame.shapes, hit, look.sun, frame.rotation, camera, (height, width))


@_stage
def _shade(
    frame: Frame,
    rays: Vector,
    hit: Hit,
    shadows: tuple[Array, Array],
    look: Look,
    camera: Array,
    *,
    height: int,
    width: int,
    samples: int,
) -> Colour:
    def band(part: tuple[Vector, Hit, tuple[Array, Array]]) -> Colour:
        rays, hit, shadows = part
        view = shade.look_along(rays, hit.depth, camera[0], samples)
        return shade.radiance(hit, view, frame.shapes, frame.paint, frame.lane, look, shadows, frame.rotation)

    # Row by row of tiles: what is in work then fits the processor's cache.
    parts = jax.tree.map(lambda x: x.reshape(_rows(height), -1, x.shape[-1]), (rays, hit, shadows))
    return jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), lax.map(band, parts))


def _rows(height: int) -> int:
    return -(-height // trace.TILE)


@_stage
def _develop(
    frame: Frame,
    light: Colour,
    depth: Array,
    look: Look,
    film: Film,
    camera: Array,
    index: int,
    *,
    height: int,
    width: int,
    samples: int,
) -> Array:
    size, index_ = (height, width, samples), jnp.int32(index)
    picture = jnp.stack([trace.image(c, *size) for c in light], -1)
    picture = lens.smear(picture, trace.image(1 / depth, *size), frame.motion, camera, film.shutter)
    picture = lens.glare(picture, look.sun, frame.rotation, camera, film.glare * look.sun_strength)
    picture = lens.rain(picture, film.rain, index_, look.seed)
    return develop(picture, film, index_)


@partial(jax.jit, static_argnames=("height", "width"))
def geometry(
    frame: Frame, moved: Shapes, next_from_this: Array, camera: Array, *, height: int, width: int
) -> tuple[Array, Array, Array]:
    """Return (depth m, flow px `[H, W, 2]`, whether the thing seen moves), `[H, W]`, for the centres of pixels.

    A point p seen at u moves to p' by its thing and is seen next at `u' = project(T_{i+1,i} p')`; the flow is u' - u.

    Args:
      frame: what is there.
      moved: its things at the next frame, relative to this frame's eye in the world's axes.
      next_from_this: `T_{i+1,i}`, `[4, 4]`.
      camera: (fx, fy, cx, cy).
      height: H.
      width: W.

    Returns:
      Depth is infinite in the sky, whose flow is that of the rotation. Flow is NaN where the next frame has the point
      behind the camera.
    """
    rays = trace.rays(frame.rotation, camera, height, width, 1)
    hit = trace.cast(frame.shapes, frame.hills, frame.eye_m, rays, frame.rotation, camera, (height, width))
    row = jnp.maximum(hit.thing, 0)
    moves = jnp.any(moved.centre != frame.shapes.centre, 1) | jnp.any(moved.axes != frame.shapes.axes, (1, 2))
    moving = moves[row] & (hit.thing >= 0)
    sky = hit.thing == SKY
    carried = [
        moved.centre[:, i][row] + sum(moved.axes[:, i, j][row] * hit.local[j] for j in range(3)) for i in range(3)
    ]
    world = [jnp.where(moving, c, jnp.where(sky, r, p)) for c, r, p in zip(carried, rays, hit.point, strict=True)]
    here = [sum(frame.rotation[j, i] * world[j] for j in range(3)) for i in range(3)]
    x, y, z = (
        sum(next_from_this[i, j] * here[j] for j in range(3)) + jnp.where(sky, 0, next_from_this[i, 3])
        for i in range(3)
    )
    ahead = jnp.where(z > 1e-3, z, jnp.nan)
    u = camera[0] * x / ahead + camera[2]
    v = camera[1] * y / ahead + camera[3]

    def grid(values: Array) -> Array:
        return trace.image(values, height, width, 1)

    flow = jnp.stack([grid(u) - jnp.arange(width), grid(v) - jnp.arange(height)[:, None]], -1)
    return grid(jnp.where(sky, jnp.inf, hit.depth)), flow, grid(moving.astype(jnp.float32)) > 0.5
