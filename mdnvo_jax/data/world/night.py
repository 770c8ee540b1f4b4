"""Light after dark: the cone of the car's own headlights, street lamps, and how they fall on surfaces."""

import jax.numpy as jnp
from jax import Array, lax

from mdnvo_jax.data.world.look import Look, View
from mdnvo_jax.data.world.texture import Vector

# Low beams: the distance at which half of the light is left, m; half widths of the bright middle and of the wide rest,
# as tangents; how far above the horizon of the camera a trace of light goes.
_REACH_M = 14.0
_NARROW, _WIDE = 0.3, 0.9
_CUTOFF = 0.035
# Height above the ground for which a street lamp gives what its strength says straight below, m.
_LAMP_M = 7.0


def lamplight(
    point: Vector, normal: Vector, ground: Array, view: View, lamps: Array, rotation: Array, look: Look
) -> Array:
    """Return the light of headlights and street lamps on surfaces, in units of a clear noon; 0 by day.

    Args:
      point: relative to the eye, world axes, m.
      normal: of the surface.
      ground: whether it is the ground, which low beams light evenly as they are made to.
      view: how the samples see.
      lamps: heads of the nearest street lamps relative to the eye, `[k, 3]`, far away where there are fewer.
      rotation: camera to world.
      look: of the world.
    """

    def lit(_: None) -> Array:
        x, y, z = (sum(view.towards[j] * rotation[j, i] for j in range(3)) for i in range(3))
        aside, down = x / jnp.maximum(z, 0.05), y / jnp.maximum(z, 0.05)
        beam = 0.7 * jnp.exp(-((aside / _NARROW) ** 2)) + 0.3 * jnp.exp(-((aside / _WIDE) ** 2))
        beam = beam * (0.04 + 0.96 * jnp.clip((down + _CUTOFF) / (2 * _CUTOFF), 0, 1))
        facing = jnp.abs(sum(n * t for n, t in zip(normal, view.towards, strict=True)))
        beam = beam / (1 + (view.distance_m / _REACH_M) ** 2) * jnp.where(ground, 1, facing)
        total = look.headlight * beam
        for k in range(lamps.shape[0]):
            away = [lamps[k, i] - point[i] for i in range(3)]
            squared = sum(a * a for a in away) + 0.1
            cosine = jnp.maximum(sum(a * n for a, n in zip(away, normal, strict=True)), 0)
            # Shades keep the light of a street lamp out of the sky.
            cosine = cosine * jnp.clip(away[1] * -1.0, 0, 1)
            total += look.lamps * _LAMP_M**2 * cosine * lax.rsqrt(squared) / squared
        return total

    return lax.cond(look.headlight > 0, lit, lambda _: jnp.zeros_like(view.distance_m), None)
