"""From radiance to grey levels: exposure, tone curve, and the faults of lenses and sensors."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mdnvo_jax.data.world.motion import FRAME_S
from mdnvo_jax.data.world.style import Style, stream
from mdnvo_jax.data.world.texture import hashed

# How long a level of the automatic exposure lasts, s.
_LEVEL_S = 4.0


class Film(NamedTuple):
    """How radiance L becomes a value from 0 to 1.

    `((1 - vignette r^2) (1 + rolling sin(2 pi (2.3 v + phase))) exposure L)^gamma`, r from 0 in the middle to 1 in the
    corners, v from 0 at the top to 1 at the bottom, clipped; before it a blur with the kernel (blur, 1 - 2 blur, blur)
    each way, after it noise of variance `noise^2 (0.3 + value)`.

    Attributes:
      shutter: share of the frame interval that motion blurs; glare: of the sun; rain: 0 to 1; see `lens`.
      quality: of the JPEG that a frame goes through, 0 for none.
    """

    exposure: Array
    gamma: Array
    vignette: Array
    blur: Array
    noise: Array
    rolling: Array
    phase: Array
    shutter: Array
    glare: Array
    rain: Array
    quality: Array


def films(style: Style, effects: float, time: np.ndarray) -> np.ndarray:
    """Return the `Film` of a world at `time`, s `[n]`, as rows `[n, 11]`; `effects` scales faults, 1 is ordinary."""
    rng = stream(style.seed, "film")
    gamma, target = rng.uniform(0.6, 0.95), rng.uniform(0.22, 0.4)
    light = style.sun_strength + style.sky_strength + 0.12 * style.headlight + 0.1 * style.lamps
    ground = (np.array([0.7, 0.3]) @ style.colours[:2]).mean() * light
    drift = 0.06 * np.sin(2 * np.pi * (rng.uniform(0.02, 0.1) * time + rng.random())) + _levels(style, time)
    vignette, blur, noise = rng.uniform(0, [0.25, 0.12, 0.012])
    night = style.headlight > 0
    # Night is exposed darker and longer, and amplified.
    target, noise = target * (0.6 if night else 1), noise * (3 if night else 1)
    rng = stream(style.seed, "camera faults")
    rolling, shutter, glare = rng.uniform(0, [0.08, 0.3 if night else 0.08, 0.5])
    there = rng.random(4) < [0.25, 0.6, 0.5, 0.5]
    beat, quality = rng.uniform(-0.4, 0.4), np.rint(rng.uniform(40, 95))
    faults = [vignette, blur, noise, rolling * there[0], beat, shutter * there[1], glare * there[2], style.rain]
    rows = np.zeros((len(time), len(Film._fields)))
    rows[:, 1:-1] = [gamma, *(effects * np.array(faults))]
    rows[:, 0] = target ** (1 / gamma) / ground * np.exp(effects * drift)
    rows[:, 6] = beat * time / FRAME_S
    rows[:, -1] = quality * there[3] * (effects > 0)
    return rows


def _levels(style: Style, time: np.ndarray) -> np.ndarray:
    """Return the logarithm of the automatic exposure at `time`: it goes to a new level now and then, fast or slowly."""
    rng = stream(style.seed, "exposure")
    spread, lag_s = rng.uniform(0, 0.3), np.exp(rng.uniform(np.log(0.03), np.log(1.5)))
    draw = stream(style.seed, "exposure levels").normal(size=int(time.max() / _LEVEL_S) + 2)
    level = spread * draw
    segment = (time / _LEVEL_S).astype(int)
    start = _LEVEL_S * segment
    return level[segment + 1] + (level[segment] - level[segment + 1]) * np.exp(-(time - start) / lag_s)


def develop(light: Array, film: Film, index: Array) -> Array:
    """Return the frame `[H, W, C]` uint8 that `film` makes of `light` `[H, W, C]`; `index` varies the noise."""
    height, width, channels = light.shape
    for axis in (0, 1):
        padded = jnp.pad(light, [(1, 1) if a == axis else (0, 0) for a in range(3)], mode="edge")
        size = light.shape[axis]
        one, two, three = (jnp.take(padded, jnp.arange(k, k + size), axis) for k in range(3))
        light = two + film.blur * (one + three - 2 * two)
    v, u = jnp.linspace(-1, 1, height)[:, None, None], jnp.linspace(-1, 1, width)[:, None]
    rolling = 1 + film.rolling * jnp.sin(2 * jnp.pi * (1.15 * (v + 1) + film.phase))
    light = light * (1 - film.vignette * (u * u + v * v) / 2) * rolling * film.exposure
    value = jnp.clip(light, 1e-6, 1) ** film.gamma
    i, j, k = jnp.meshgrid(*(jnp.arange(n, dtype=jnp.int32) for n in light.shape), indexing="ij")
    # The sum of three uniform numbers from -1 to 1 has unit variance and looks normal enough.
    grain = sum(hashed((i, j, k + channels * index), 1000 + draw) for draw in range(3))
    value = value + film.noise * jnp.sqrt(0.3 + value) * grain
    return jnp.clip(jnp.rint(255 * value), 0, 255).astype(jnp.uint8)
