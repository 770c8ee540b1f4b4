"""Bootstrap intervals for statistics of errors that come in a row and resemble their neighbours.

Drawing single frames would take every frame for news of its own and give intervals far too narrow: on KITTI 10 the RPE
has an autocorrelation of 0.5 (MDN-VO) and 0.9 (DeepVO) at a lag of 20 frames. So whole blocks of consecutive frames are
drawn (Künsch, 1989; circular: Politis and Romano, 1992), or whole sequences where there are several.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from mdnvo_jax.evaluation import optional

# 10 s at KITTI's rate; by then the autocorrelations above have fallen to about -0.1 (MDN-VO) and 0.25 (DeepVO).
BLOCK_FRAMES = 100
# Fewer blocks than this say nothing about spread: shorter sequences get shorter blocks.
FEWEST_BLOCKS = 8
# Sequences from which on whole sequences are drawn.
FEWEST_SEQUENCES = 5
DRAWS = 1000
COVERAGE = 0.95

Interval = tuple[float, float]


class Draws(NamedTuple):
    """Resamples.

    Attributes:
      indices: of the items in each resample.
      units: how many blocks or sequences each of them is made of.
    """

    indices: Sequence[np.ndarray]
    units: int

    def first(self, count: int) -> "Draws":
        """Return the first `count` resamples."""
        return self._replace(indices=self.indices[:count])


def draw(lengths: Sequence[int], *, block: int = BLOCK_FRAMES, draws: int = DRAWS, seed: int = 0) -> Draws:
    """Draw whole sequences where there are five or more, else blocks; arguments as in the two functions below."""
    if len(lengths) >= FEWEST_SEQUENCES:
        return draw_sequences(lengths, draws=draws, seed=seed)
    return draw_blocks(sum(lengths), block=block, draws=draws, seed=seed)


def describe(block: int) -> str:
    """Return what the intervals of `draw` are, in words."""
    return (
        f"[low, high]: 95 % bootstrap interval, {DRAWS} draws of blocks of {block} frames (at most an eighth of the "
        f"sequence), or of whole sequences where there are {FEWEST_SEQUENCES} or more."
    )


def draw_blocks(count: int, *, block: int = BLOCK_FRAMES, draws: int = DRAWS, seed: int = 0) -> Draws:
    """Draw resamples of `count` consecutive items, a block at a time.

    Blocks begin anywhere and wrap around the end, so that every item is drawn equally often. They are at most an eighth
    of `count` long.

    Args:
      count: items, such as frames.
      block: items in a block.
      draws: resamples, of `count` items each.
      seed: the same seed and sizes give the same resamples, so that two methods can be compared pair by pair.
    """
    block = max(1, min(block, count // FEWEST_BLOCKS))
    blocks = -(-count // block)
    starts = np.random.default_rng(seed).integers(count, size=(draws, blocks, 1))
    return Draws(list(((starts + np.arange(block)) % count).reshape(draws, -1)[:, :count]), blocks)


def draw_sequences(lengths: Sequence[int], *, draws: int = DRAWS, seed: int = 0) -> Draws:
    """Draw resamples of whole sequences, for items that are stored one sequence after the other.

    Args:
      lengths: items of each sequence.
      draws: resamples; their sizes differ where the lengths do.
      seed: as in `draw_blocks`.
    """
    ends = np.cumsum(lengths)
    items = [np.arange(end - length, end) for end, length in zip(ends, lengths, strict=True)]
    chosen = np.random.default_rng(seed).integers(len(items), size=(draws, len(items)))
    return Draws([np.concatenate([items[sequence] for sequence in drawn]) for drawn in chosen], len(items))


def interval(
    statistic: Callable[[np.ndarray], float | np.ndarray], draws: Draws, *, coverage: float = COVERAGE
) -> tuple[np.ndarray, np.ndarray]:
    """Expanded percentile interval of a statistic (Hesterberg, The American Statistician 69(4), 2015).

    Plain percentiles are too narrow where few units are drawn, as a Gaussian is beside Student's t. The tails are
    therefore Phi(-sqrt(n / (n - 1)) t) with t of n - 1 degrees for n units, which is the tail asked for as n grows.

    Args:
      statistic: takes indices of the items drawn and returns a number or an array; NaN is left out.
      draws: from `draw_blocks` or `draw_sequences`.
      coverage: probability inside.

    Returns:
      (low, high), each of the shape that `statistic` returns; NaN where it never was a number, or there is one unit.
    """
    return _ends(np.array([statistic(indices) for indices in draws.indices], np.float64), draws.units, coverage)


def mean_interval(values: np.ndarray, draws: Draws, *, coverage: float = COVERAGE) -> tuple[np.ndarray, np.ndarray]:
    """Interval, as above, of the mean of `values`, `[n, ...]`, over their first axis: (low, high), each `[...]`."""
    # How often each item is drawn: a product of matrices in place of a thousand gathers.
    counts = np.array([np.bincount(indices, minlength=len(values)) for indices in draws.indices], np.float64)
    flat = values.reshape(len(values), -1)
    means = (counts @ flat) / counts.sum(axis=1, keepdims=True)
    return _ends(means.reshape(-1, *values.shape[1:]), draws.units, coverage)


def number_interval(statistic: Callable[[np.ndarray], float], draws: Draws, *, coverage: float = COVERAGE) -> Interval:
    """Interval, as above, of a statistic that is one number."""
    low, high = interval(statistic, draws, coverage=coverage)
    return float(low), float(high)


def _ends(values: np.ndarray, units: int, coverage: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the expanded percentiles of redrawn statistics, `[draws, ...]`."""
    stats = optional.load("scipy.stats")
    ends = np.full((2, *values.shape[1:]), np.nan)
    if units > 1:
        tail = stats.norm.cdf(np.sqrt(units / (units - 1)) * stats.t.ppf((1 - coverage) / 2, units - 1))
        usable = ~np.isnan(values).all(axis=0)
        ends[:, usable] = np.nanquantile(values[:, usable], [tail, 1 - tail], axis=0)
    return ends[0], ends[1]
