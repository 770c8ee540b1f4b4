"""The types that the shading functions share: a world's look, and how a sample sees its surface."""

from typing import NamedTuple

from jax import Array

from mdnvo_jax.data.world.texture import Vector

# One array for each channel of the frame.
Colour = tuple[Array, ...]


class Look(NamedTuple):
    """A `Style` as the renderer wants it: scalars float32, see there; colours with one column a channel.

    Attributes:
      colours: rows asphalt, verge, sidewalk, backdrop, zenith, horizon, sunlight, `[7, C]`.
      sun: unit vector towards the sun, `[3]`. seed: int32.
    """

    colours: Array
    sun: Array
    seed: Array
    sun_strength: Array
    sky_strength: Array
    clouds: Array
    haze_m: Array
    half_width_m: Array
    side: Array
    lane_m: Array
    lanes: Array
    sidewalk_m: Array
    centre_line: Array
    lane_period_m: Array
    lane_duty: Array
    edge_line: Array
    paint: Array
    wear: Array
    roughness: Array
    history: Array
    sheen: Array
    cracks: Array
    patches: Array
    zebra: Array
    backdrop_rad: Array
    daylight: Array
    headlight: Array
    lamps: Array
    stone_m: Array
    arrows: Array
    wet: Array
    rain: Array


class View(NamedTuple):
    """How each sample sees, `[tiles, samples]`.

    Attributes:
      towards: unit vector of the ray, world axes. distance_m: to the surface.
      pixel_rad: angle that a sample stands for when textures fade. width_m: the same on a surface that faces the eye.
    """

    towards: Vector
    distance_m: Array
    pixel_rad: Array
    width_m: Array


class Skin(NamedTuple):
    """Where the texture of a surface lives: point, largest cell, footprint of a sample, all in the same unit."""

    point: Vector
    cell: Array
    footprint: Array
