"""The stop-watch: contenders take turns, so that whatever else the machine does meets all of them alike."""

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from mdnvo_jax.evaluation.tables import Value

# Said in the report wherever a ratio stands.
RATIO = (
    "A ratio is the peer's time over ours in the same round: above 1 we are faster. The median over the rounds, with "
    "the lower and upper quartile in brackets."
)

# Does one piece of work; its result is waited for.
Contender = Callable[[], Any]


class Untimed(NamedTuple):
    """What a contender returns that spent some of its time on what is not to be timed, such as opening a file."""

    seconds: float


def interleaved(
    contenders: Mapping[str, Contender],
    rounds: int,
    *,
    warm_up: int = 1,
    budget_s: float = math.inf,
    least: int = 3,
) -> dict[str, list[float]]:
    """Return the seconds of every contender in every round.

    In a round each contender runs once, and each round begins with another one, so that none always follows the same
    state of clock and caches.

    Args:
      contenders: by name.
      rounds: how many, at most.
      warm_up: rounds before the first that is timed.
      budget_s: no round begins after so many seconds,
      least: except where there have been fewer than this many.
    """
    names = list(contenders)
    for name in names * warm_up:
        seconds(contenders[name])
    found: dict[str, list[float]] = {name: [] for name in names}
    began = time.perf_counter()
    for number in range(rounds):
        if number >= least and time.perf_counter() - began > budget_s:
            break
        first = number % len(names)
        for name in names[first:] + names[:first]:
            found[name].append(seconds(contenders[name]))
    return found


def seconds(contender: Contender) -> float:
    """Return how long `contender` takes until its result is ready."""
    import jax

    began = time.perf_counter()
    result = jax.block_until_ready(contender())
    took = time.perf_counter() - began
    return took - result.seconds if isinstance(result, Untimed) else took


def spread(values: Sequence[float], scale: float = 1.0) -> Value:
    """Return the median of `values`, times `scale`, with the quartiles as its interval."""
    low, middle, high = np.quantile(np.asarray(values, np.float64) * scale, [0.25, 0.5, 0.75])
    return Value(float(middle), low=float(low), high=float(high))


def rate(values: Sequence[float], count: float) -> Value:
    """Return how many of `count` things a second were done in rounds that took `values` seconds."""
    return spread([count / value for value in values])


def fastest(times: Mapping[str, Sequence[float]], names: Iterable[str]) -> str:
    """Return which of `names` took the least time by the median."""
    return min(names, key=lambda name: float(np.median(times[name])))


def ratio(peer: Sequence[float], ours: Sequence[float]) -> Value:
    """Return the median over rounds of the peer's seconds over ours, with quartiles; see `RATIO`."""
    return spread([theirs / our for theirs, our in zip(peer, ours, strict=True)])
