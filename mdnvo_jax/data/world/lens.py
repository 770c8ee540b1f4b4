"""What happens to light on its way to the film: motion blur, glare of the sun, rain in the air and on the glass.

Each is a pure function of an image of radiance `[H, W, C]`, and costs nothing where its strength is 0.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mdnvo_jax.data.world.texture import hashed, mix, value_noise

# Places along its path where a moving point is looked up, and the longest path, in pixels.
_TAPS = 4
_LONGEST_PX = 12.0
# Lengths, widths and drift to the side of streaks, as shares of the height of the frame: far and near drops.
_STREAKS = ((0.08, 0.009, 0.15), (0.2, 0.018, 0.25))
# Cells of drops on the glass, as a share of the height.
_DROP = 0.07


def smear(light: Array, nearness: Array, motion: Array, camera: Array, shutter: Array) -> Array:
    """Return `light` blurred along the flow of what stands still, for the share `shutter` of the frame interval.

    A pixel is the mean of `light` along its path from `-shutter / 2` to `shutter / 2`. What moves by itself is smeared
    as if it stood.

    Args:
      light: `[H, W, C]`.
      nearness: 1 / depth, `[H, W]`, 1/m.
      motion: `T_{i+1,i}`, `[4, 4]`.
      camera: (fx, fy, cx, cy).
      shutter: 0 for none.
    """
    height, width, channels = light.shape

    def along_path(light: Array) -> Array:
        u, v = jnp.arange(width, dtype=jnp.float32), jnp.arange(height, dtype=jnp.float32)[:, None]
        x, y = (u - camera[2]) / camera[0], (v - camera[3]) / camera[1]
        moved = [m[0] * x + m[1] * y + m[2] + m[3] * nearness for m in motion[:3]]
        ahead = jnp.maximum(moved[2], 0.05)
        du = (camera[0] * moved[0] / ahead + camera[2] - u) * shutter
        dv = (camera[1] * moved[1] / ahead + camera[3] - v) * shutter
        shorten = jnp.minimum(1, _LONGEST_PX / jnp.maximum(jnp.sqrt(du * du + dv * dv), 1e-6))
        du, dv = du * shorten, dv * shorten
        flat = light.reshape(-1, channels)
        total = jnp.zeros_like(light)
        for tap in np.linspace(-0.5, 0.5, _TAPS + 1)[:-1] + 0.5 / _TAPS:
            at_u, at_v = jnp.clip(u + tap * du, 0, width - 1), jnp.clip(v + tap * dv, 0, height - 1)
            left, top = (jnp.minimum(jnp.floor(a), n - 2) for a, n in ((at_u, width), (at_v, height)))
            first = (top * width + left).astype(jnp.int32)
            right, down = (at_u - left)[..., None], (at_v - top)[..., None]
            upper, lower = (mix(flat[first + k], flat[first + k + 1], right) for k in (0, width))
            total = total + mix(upper, lower, down)
        return total / _TAPS

    return lax.cond(shutter > 0, along_path, lambda light: light, light)


def glare(light: Array, sun: Array, rotation: Array, camera: Array, strength: Array) -> Array:
    """Return `light` with the veil and the ghosts that the sun in front of a dirty lens throws.

    The veil falls with the angle from the sun, as `cos^6` and a narrow `cos^80` about it; three ghosts lie on the line
    from the sun through the middle of the frame.

    Args:
      light: `[H, W, C]`.
      sun: unit vector towards the sun, world axes.
      rotation: camera to world.
      camera: (fx, fy, cx, cy).
      strength: radiance of the veil next to the sun; 0 for none.
    """
    height, width, _ = light.shape
    x, y, z = (sum(rotation[j, i] * sun[j] for j in range(3)) for i in range(3))

    def shine(light: Array) -> Array:
        u = (jnp.arange(width, dtype=jnp.float32) - camera[2]) / camera[0]
        v = (jnp.arange(height, dtype=jnp.float32)[:, None] - camera[3]) / camera[1]
        cosine = jnp.maximum((u * x + v * y + z) / jnp.sqrt(u * u + v * v + 1), 0)
        near = cosine**2
        veil = 0.4 * near**3 + near**40
        for place, size, share in ((-0.4, 0.03, 0.15), (-0.9, 0.07, 0.1), (0.45, 0.02, 0.2)):
            away = (u - place * x / jnp.maximum(z, 0.1)) ** 2 + (v - place * y / jnp.maximum(z, 0.1)) ** 2
            veil += share * jnp.clip(1.5 - away / size**2, 0, 1) * (z > 0.3)
        return light + strength * veil[..., None]

    return lax.cond((strength > 0) & (z > -0.3), shine, lambda light: light, light)


def rain(light: Array, amount: Array, index: Array, seed: Array) -> Array:
    """Return `light` with rain of `amount` 0 to 1: streaks, new in every frame, and drops on the glass that stay."""
    height, width, _ = light.shape

    def fall(light: Array) -> Array:
        u = jnp.broadcast_to(jnp.arange(width, dtype=jnp.float32), (height, width)) / height
        v = jnp.broadcast_to(jnp.arange(height, dtype=jnp.float32)[:, None], (height, width)) / height
        bright = light.mean((0, 1))
        drop = jnp.clip(4 * value_noise((u / _DROP, v / _DROP), seed + 41) - 2.2, 0, 1)
        # A drop is a small lens: it shows the frame upside down, out of focus.
        light = mix(light, mix(0.7 * bright, 1.3 * bright, v[..., None]), 0.6 * amount * drop[..., None])
        wet = jnp.zeros_like(u)
        for layer, (length, thick, slant) in enumerate(_STREAKS):
            across = (u + slant * (v - 0.5) * jnp.sign(u - 0.5 * width / height)) / thick
            column = jnp.floor(across).astype(jnp.int32)
            fallen = v / length + 50 * hashed((column, index), seed + 42 + layer)
            row = jnp.floor(fallen)
            there = hashed((column, row.astype(jnp.int32), index), seed + 44 + layer) > 1 - 0.16 * amount
            shape = (1 - jnp.abs(2 * (across - column) - 1)) * 4 * (fallen - row) * (1 - fallen + row)
            wet = wet + there * shape
        return mix(light, 1.6 * bright, 0.5 * wet[..., None])

    return lax.cond(amount > 0, fall, lambda light: light, light)
