"""Procedural patterns that fade where a pixel no longer resolves them, instead of aliasing.

Everything is a pure elementwise function of coordinates, so that a surface looks the same from everywhere.
"""

import jax.numpy as jnp
from jax import Array, lax

# Points as a tuple of coordinates, x, y, z: the trailing axis stays the long one, which the compiler vectorises.
Vector = tuple[Array, ...]
# Each octave is this much finer than the one before.
_LACUNARITY = 2.6
_PRIMES = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)


def hashed(cell: tuple[Array, ...], seed: Array | int) -> Array:
    """Return numbers from -1 to 1 that up to three integers, int32, decide: without a pattern to the eye."""
    h = jnp.asarray(seed).astype(jnp.uint32) * jnp.uint32(0x27D4EB2F)
    for i, prime in zip(cell, _PRIMES, strict=False):
        h = h + i.astype(jnp.uint32) * jnp.uint32(prime)
    return _scatter(h)


def value_noise(point: tuple[Array, ...], seed: Array | int) -> Array:
    """Return smooth noise from -1 to 1 in two or three dimensions, with cells of size 1.

    The corners of a cell are hashed, and blended by `3 f^2 - 2 f^3` along each axis.
    """
    floors = [jnp.floor(p) for p in point]
    blend = [_smooth(p - f) for p, f in zip(point, floors, strict=True)]
    base = jnp.asarray(seed).astype(jnp.uint32) * jnp.uint32(0x27D4EB2F)
    for f, prime in zip(floors, _PRIMES, strict=False):
        base = base + f.astype(jnp.int32).astype(jnp.uint32) * jnp.uint32(prime)

    def corner(axis: int, h: Array) -> Array:
        if axis < 0:
            return _scatter(h)
        low, high = corner(axis - 1, h), corner(axis - 1, h + jnp.uint32(_PRIMES[axis]))
        return low + blend[axis] * (high - low)

    return corner(len(point) - 1, base)


def fractal(point: Vector, footprint_m: Array, cell_m: Array, gain: float, octaves: int, seed: Array | int) -> Array:
    """Return a sum of octaves of noise: cells of `cell_m` and finer, each weaker by `gain`, faded by the footprint."""

    def add(octave: Array, total: Array) -> Array:
        finer = _LACUNARITY**octave / cell_m
        noise = value_noise((point[0] * finer, point[1] * finer, point[2] * finer), seed + 7919 * octave)
        return total + gain**octave * visible(footprint_m * finer) * noise

    return lax.fori_loop(0, octaves, add, jnp.zeros_like(footprint_m))


def visible(footprint_cells: Array) -> Array:
    """Return what is left, 1 to 0, of a pattern whose cells a pixel covers `footprint_cells` of."""
    return _smooth(jnp.clip(1.6 - 1.3 * footprint_cells, 0, 1))


def pulses(x: Array, duty: Array | float, footprint: Array) -> Array:
    """Return the share of `[x - footprint / 2, x + footprint / 2]` that lies in pulses `|frac(x) - 1/2| < duty / 2`.

    The integral of the pulse train is `floor(x) duty + clip(frac(x) - (1 - duty) / 2, 0, duty)`.
    """

    def integral(end: Array) -> Array:
        whole = jnp.floor(end)
        return whole * duty + jnp.clip(end - whole - (1 - duty) / 2, 0, duty)

    footprint = jnp.maximum(footprint, 1e-4)
    return (integral(x + footprint / 2) - integral(x - footprint / 2)) / footprint


def band(x: Array, low: Array | float, high: Array | float, footprint: Array) -> Array:
    """Return the share of `[x - footprint / 2, x + footprint / 2]` that lies in `[low, high]`."""
    footprint = jnp.maximum(footprint, 1e-4)
    return jnp.clip(jnp.minimum(high, x + footprint / 2) - jnp.maximum(low, x - footprint / 2), 0) / footprint


def mix(low: Array | float, high: Array | float, share: Array | float) -> Array:
    """Return `low` where `share` is 0, `high` where it is 1."""
    return jnp.asarray(low + share * (high - low))


def _scatter(h: Array) -> Array:
    """Return the bits of `h`, uint32, well mixed, as a number from -1 to 1."""
    h = (h ^ (h >> 15)) * jnp.uint32(0x2C1B3C6D)
    h = (h ^ (h >> 13)) * jnp.uint32(0x297A2D39)
    return (h >> 8).astype(jnp.int32).astype(jnp.float32) * (2 / 2**24) - 1


def _smooth(f: Array) -> Array:
    return f * f * (3 - 2 * f)
