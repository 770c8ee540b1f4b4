"""All frames, each step from the window that sees most on both sides of it: in constant memory, nothing computed twice.

Nothing waits for a result before more work is under way: while the device computes one group of pairs, the frames of
the next are read and handed to it.
"""

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mdnvo_jax import mixture
from mdnvo_jax.data.ahead import Chunk
from mdnvo_jax.mixture import Mixture
from mdnvo_jax.model.head import Labels
from mdnvo_jax.odometry import window_plan
from mdnvo_jax.streaming import held_step

# Pairs that go through the convolutions at a time, and chunks of them that go through the LSTM together: its kernels
# are larger than any cache, so that reading them once for few pairs costs as much as for many.
PAIRS = 8
CHUNKS = 6
# Groups under way at a time.
_GROUPS_AHEAD = 1

# (start, first, last): the window from step `start` gives the steps `first` to `last - 1`.
_Entry = tuple[int, int, int]
Features = Callable[[np.ndarray], Any]
Densities = Callable[[Any, tuple[Any, ...], np.ndarray, np.ndarray], tuple[Any, Mixture]]


def windows_in_group(hop: int) -> int:
    """Return the most windows that a group of pairs can complete, the last window of a sequence included."""
    return -(-PAIRS * CHUNKS // hop) + 1


def step_densities(
    features: Features, densities: Densities, tail: Any, count: int, chunks: Iterator[Chunk], *, window: int, hop: int
) -> tuple[Mixture, np.ndarray]:
    """Return the density of every step, and which steps had two readable frames.

    Args:
      features: frames `[PAIRS + 1, H, W, C]` -> the features of their pairs.
      densities: (tail, features of `CHUNKS` chunks, rows, mask) -> (tail, mixtures `[B, window]`): the densities of
        windows made of the rows `[B, window]` of the tail and the features behind it, where `mask` is true; and the
        last `window` of them all, for the next call.
      tail: the tail before the first frame.
      count: steps in the sequence.
      chunks: their frames.
      window: steps in a window.
      hop: steps between windows.
    """
    plan = deque(window_plan(count, window, hop))
    usable = np.zeros(0, bool)
    group: list[Any] = []
    under_way: deque[tuple[Mixture, list[_Entry]]] = deque()
    results: list[Mixture] = []
    begin = 0
    for chunk in chunks:
        group.append(features(chunk.frames))
        usable = np.concatenate([usable, chunk.usable])
        if len(group) < CHUNKS and len(usable) < count:
            continue
        group += group[-1:] * (CHUNKS - len(group))
        entries = []
        while plan and min(plan[0][0] + window, count) <= len(usable):
            entries.append(plan.popleft())
        rows = np.zeros((windows_in_group(hop), window), np.int32)
        mask = np.zeros(rows.shape, bool)
        for row, (start, _, _) in enumerate(entries):
            steps = np.arange(start, min(start + window, count))
            rows[row, : len(steps)] = steps - (begin - window)
            mask[row, : len(steps)] = usable[steps]
        tail, found = densities(tail, tuple(group), rows, mask)
        under_way.append((found, entries))
        if len(under_way) > _GROUPS_AHEAD:
            results += _collect(*under_way.popleft())
        begin, group = len(usable), []
    for item in under_way:
        results += _collect(*item)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *results), usable


def _collect(found: Mixture, entries: list[_Entry]) -> list[Mixture]:
    """Return the densities of the steps that each window gives, once they are computed."""
    leaves: list[Any] = [np.asarray(leaf) for leaf in found]
    return [
        Mixture(*(leaf[row, first - start : last - start] for leaf in leaves))
        for row, (start, first, last) in enumerate(entries)
    ]


def hold(densities: Mixture, usable: np.ndarray, labels: Labels) -> Mixture:
    """Return densities whose unusable steps repeat the last usable one, less surely; see `streaming.held_step`."""
    if usable.all():
        return densities
    held = jax.tree.map(np.copy, densities)
    means, variances = mixture.mean(densities), mixture.variance(densities)
    mean, variance = jnp.asarray(labels.mean), jnp.zeros(6)
    for index, good in enumerate(usable):
        if good:
            mean, variance = means[index], variances[index]
            continue
        for leaf, value in zip(held, held_step(mean, variance, labels, densities.logits.shape[-1]), strict=True):
            leaf[index] = np.asarray(value)
    return held
