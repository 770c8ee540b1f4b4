"""What is wrong with the frames that a camera gives: said of each step, in words, without changing its estimate.

| word | what it means |
|---|---|
| dark | in one of the two frames 99 % of the samples are 16 or less, of 255: covered, or no light |
| saturated | in one of the two frames 90 % of the samples are 250 or more: blinded |
| duplicate | the two frames are equal, sample for sample: sent twice, or nothing moves before a camera without noise |
| frozen | they are, and so were the two steps before |
| time goes back | the second frame is older than the first |
| time stands still | both have the same time |
| gap | the time between them is over 1.75 times the median of the last 31 steps: frames were dropped |

Frames are judged as the network sees them, after they are brought to its size. Samples are those of all channels.
"""

import itertools
from collections import deque
from collections.abc import Iterator

import numpy as np

from mdnvo_jax.data.ahead import Chunk

DARK_LEVEL, DARK_SHARE = 16, 0.99
SATURATED_LEVEL, SATURATED_SHARE = 250, 0.9
# Equal steps in a row from which on they are called frozen.
FROZEN_STEPS = 3
# Times the median interval. One dropped frame makes two, jitter of a shutter or of a system's clock much less.
GAP = 1.75
# Steps whose intervals the median is of, and the fewest that give one.
INTERVALS, LEAST_INTERVALS = 31, 5


class Watch:
    """Looks at frames one after another, in memory that does not grow."""

    def __init__(self) -> None:
        self._frame: np.ndarray | None = None
        self._blind = ""
        self._time_s: float | None = None
        self._equal = 0
        self._intervals: deque[float] = deque(maxlen=INTERVALS)

    def look(self, frame: np.ndarray | None, time_s: float | None = None) -> list[str]:
        """Return what is to be said of the step from the last frame to this one; of the first frame's, which is none.

        Args:
          frame: uint8, as the network sees it; None for one that could not be read. It is kept until the next call.
          time_s: when it was taken, None where that is not known.
        """
        blind = "" if frame is None else blindness(frame)
        words = [word for word in dict.fromkeys((self._blind, blind)) if word]
        same = frame is not None and self._frame is not None and np.array_equal(frame, self._frame)
        self._equal = self._equal + 1 if same else 0
        if same:
            words.append("frozen" if self._equal >= FROZEN_STEPS else "duplicate")
        if time_s is not None and self._time_s is not None:
            words += self._of_time(time_s - self._time_s)
        self._frame, self._blind, self._time_s = frame, blind, time_s
        return words

    def _of_time(self, interval_s: float) -> list[str]:
        if interval_s <= 0:
            return ["time goes back" if interval_s < 0 else "time stands still"]
        known = len(self._intervals) >= LEAST_INTERVALS
        gap = known and interval_s > GAP * float(np.median(self._intervals))
        self._intervals.append(interval_s)
        return ["gap"] if gap else []


def blindness(frame: np.ndarray) -> str:
    """Return "dark" or "saturated" where an uint8 frame shows nothing, else nothing."""
    if np.count_nonzero(frame <= DARK_LEVEL) >= DARK_SHARE * frame.size:
        return "dark"
    return "saturated" if np.count_nonzero(frame >= SATURATED_LEVEL) >= SATURATED_SHARE * frame.size else ""


def watched(chunks: Iterator[Chunk], timestamps: np.ndarray | None, found: list[list[str]]) -> Iterator[Chunk]:
    """Yield `chunks`, and add to `found` what is to be said of each of their steps.

    Args:
      chunks: of consecutive frames.
      timestamps: of all frames, s, or None.
      found: gets a list of words a step.
    """
    watch = Watch()
    times = itertools.repeat(None) if timestamps is None else map(float, timestamps)
    first = True
    for chunk in chunks:
        frames = zip(chunk.frames[: chunk.pairs + 1], chunk.readable, strict=False)
        if not first:
            next(frames)
        for frame, readable in frames:
            words = watch.look(frame if readable else None, next(times))
            if not first:
                found.append(words)
            first = False
        yield chunk
