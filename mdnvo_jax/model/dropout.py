"""Dropout whose random bits cost little on a processor: a hash of the element's number, keyed.

`jax.random` spends some 9 ns on the bits of one element on a CPU, more than the convolutions of a narrow network spend
on it (BENCHMARKS.md). Which units drop needs no cryptographic generator: here each element's number goes through a
32-bit mixing function twice, with a word of the key before each. The mask depends on the key and the element's place
alone, not on devices or sharding.
"""

import jax
import jax.numpy as jnp
from jax import Array, lax

# Multipliers and shifts of Wellons' "lowbias32", a bijection of 32 bits with little avalanche bias.
_MULTIPLIERS = (0x7FEB352D, 0x846CA68B)
_SHIFTS = (16, 15, 16)


def drop(x: Array, rate: float, rng: Array) -> Array:
    """Return `x` with a share of its elements set to zero, the others scaled by 1 / (1 - rate).

    Args:
      x: any shape.
      rate: chance of an element to be dropped, in [0, 1).
      rng: a PRNG key.

    Raises:
      ValueError: the rate is outside its range.
    """
    if not 0 <= rate < 1:
        raise ValueError(f"the rate of dropout is {rate}: expected one in [0, 1)")
    kept = counter_bits(rng, x.shape) >= jnp.uint32(round(rate * 2**32))
    return jnp.where(kept, x / (1 - rate), jnp.zeros_like(x))


def counter_bits(rng: Array, shape: tuple[int, ...]) -> Array:
    """Return uint32 of `shape`, uniform; for choices such as dropout, not for what an adversary might predict."""
    words = jax.random.bits(rng, (2,), jnp.uint32)
    number = jnp.zeros(shape, jnp.uint32)
    for axis, size in enumerate(shape):
        number = number * jnp.uint32(size) + lax.broadcasted_iota(jnp.uint32, shape, axis)
    return _mix(_mix(number ^ words[0]) + words[1])


def _mix(h: Array) -> Array:
    for shift, multiplier in zip(_SHIFTS, (*_MULTIPLIERS, None), strict=True):
        h = h ^ (h >> jnp.uint32(shift))
        h = h if multiplier is None else h * jnp.uint32(multiplier)
    return h
