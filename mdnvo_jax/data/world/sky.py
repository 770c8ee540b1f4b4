"""What is infinitely far: sky, clouds, the glow about the sun, and trees or houses on the horizon."""

import jax.numpy as jnp
from jax import Array

from mdnvo_jax.data.world.look import Colour, Look, Skin, View
from mdnvo_jax.data.world.texture import mix, value_noise

# Cells of noise in a radian of azimuth and elevation of the far trees.
_PER_RAD = 120.0


def backdrop(view: View, look: Look) -> tuple[Array, Skin]:
    """Return (whether a ray ends on the far trees rather than in the sky, where the texture of either lives)."""
    x, y, z = view.towards
    horizontal = jnp.sqrt(x * x + z * z) + 1e-6
    azimuth = (_PER_RAD * x / horizontal, _PER_RAD * z / horizontal)
    coarse = value_noise((azimuth[0] / 12, azimuth[1] / 12), look.seed + 21)
    fine = value_noise((azimuth[0], azimuth[1]), look.seed + 22)
    far = -y < look.backdrop_rad * (0.6 + 0.5 * coarse + 0.15 * fine)
    # Clouds lie in a plane overhead, which is bent down a little so that they do not shrink to nothing.
    overhead = jnp.maximum(-y, 0.02) + 0.06
    clouds = (2 * x / overhead, 2 * z / overhead)
    point = (
        jnp.where(far, azimuth[0], clouds[0]),
        jnp.where(far, azimuth[1], clouds[1]),
        jnp.where(far, _PER_RAD * y, 0.0),
    )
    footprint = view.pixel_rad * jnp.where(far, _PER_RAD, 2 / overhead)
    return far, Skin(point, jnp.where(far, 5.0, 1.5), footprint)


def heaven(view: View, far: Array, noise: Array, look: Look) -> Colour:
    """Return the radiance of what is infinitely far, given the texture `noise` there."""
    elevation = -view.towards[1]
    glow = sum(t * look.sun[i] for i, t in enumerate(view.towards))
    glow = jnp.maximum(glow, 0) ** 2
    glow = look.sun_strength * 0.8 * glow**4
    cover = look.clouds * jnp.clip(0.5 + 0.9 * noise, 0, 1)
    rise = jnp.sqrt(jnp.clip(elevation * 2.2, 0, 1))
    colour = []
    for c in range(look.colours.shape[1]):
        trees, zenith, horizon = look.colours[3, c], look.colours[4, c], look.colours[5, c]
        clear = mix(horizon, zenith, rise) + glow
        distant = mix(0.35 * horizon, trees * (1 + 0.8 * noise), 0.75)
        colour.append(look.daylight * jnp.where(far, distant, mix(clear, 1 + 0.25 * noise, cover)))
    return tuple(colour)
