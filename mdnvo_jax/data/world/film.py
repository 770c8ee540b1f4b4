"""From radiance to grey levels: exposure, tone curve, and the faults of lenses and sensors."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mdnvo_jax.data.world.style import Style, stream
from mdnvo_jax.data.world.texture import hashed


class Film(NamedTuple):
    """How radiance L becomes a value from 0 to 1.

    `((1 - vignette r^2) exposure L)^gamma`, r from 0 in the middle to 1 in the corners, clipped; before it a blur with
    the kernel (blur, 1 - 2 blur, blur) each way, after it noise of variance `noise^2 (0.3 + value)`.
    """

    exposure: Array
    gamma: Array
    vignette: Array
    blur: Array
    noise: Array


def films(style: Style, effects: float, time: np.ndarray) -> np.ndarray:
    """Return the `Film` of a world at `time`, s `[n]`, as rows `[n, 5]`; `effects` scales its faults, 1 is ordinary."""
    rng = stream(style.seed, "film")
    gamma, target = rng.uniform(0.6, 0.95), rng.uniform(0.22, 0.4)
    ground = (np.array([0.7, 0.3]) @ style.colours[:2]).mean() * (style.sun_strength + style.sky_strength)
    drift = 0.06 * np.sin(2 * np.pi * (rng.uniform(0.02, 0.1) * time + rng.random()))
    ordinary = rng.uniform(0, [0.25, 0.12, 0.012])
    exposure = target ** (1 / gamma) / ground * np.exp(effects * drift)
    constant = np.outer([gamma, *(effects * ordinary)], np.ones_like(time))
    return np.stack([exposure, *constant], 1)


def develop(light: Array, film: Film, index: Array) -> Array:
    """Return the frame `[H, W, C]` uint8 that `film` makes of `light` `[H, W, C]`; `index` varies the noise."""
    height, width, channels = light.shape
    for axis in (0, 1):
        padded = jnp.pad(light, [(1, 1) if a == axis else (0, 0) for a in range(3)], mode="edge")
        size = light.shape[axis]
        one, two, three = (jnp.take(padded, jnp.arange(k, k + size), axis) for k in range(3))
        light = two + film.blur * (one + three - 2 * two)
    v, u = jnp.linspace(-1, 1, height)[:, None, None], jnp.linspace(-1, 1, width)[:, None]
    light = light * (1 - film.vignette * (u * u + v * v) / 2) * film.exposure
    value = jnp.clip(light, 1e-6, 1) ** film.gamma
    i, j, k = jnp.meshgrid(*(jnp.arange(n, dtype=jnp.int32) for n in light.shape), indexing="ij")
    # The sum of three uniform numbers from -1 to 1 has unit variance and looks normal enough.
    grain = sum(hashed((i, j, k + channels * index), 1000 + draw) for draw in range(3))
    value = value + film.noise * jnp.sqrt(0.3 + value) * grain
    return jnp.clip(jnp.rint(255 * value), 0, 255).astype(jnp.uint8)
