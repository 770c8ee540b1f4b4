"""Frames read ahead of their use: decoded and resized on threads of their own, given out in order."""

import os
import time
from collections import defaultdict, deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from mdnvo_jax.config import ImageConfig
from mdnvo_jax.data.images import prepare
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError

# More threads than this decode faster than any network here computes.
_MOST_THREADS = 8

# Spent so far, by stage.
Seconds = defaultdict[str, float]


class Chunk(NamedTuple):
    """Consecutive frames `[n+1, H, W, C]`, blank where `readable` is false; the first ends the chunk before.

    `pairs` of the n pairs are real, the rest pads the chunk to its fixed size.
    """

    frames: np.ndarray
    readable: np.ndarray
    pairs: int

    @property
    def usable(self) -> np.ndarray:
        """Which of the real pairs have two readable frames."""
        return (self.readable[1:] & self.readable[:-1])[: self.pairs]


def chunks(
    sequence: Sequence, image_config: ImageConfig, size: int, *, hold: bool, seconds: Seconds
) -> Iterator[Chunk]:
    """Yield the pairs of a sequence in order, `size` at a time, the next ones being read meanwhile.

    Args:
      sequence: the frames.
      image_config: what they are brought to.
      size: pairs in a chunk.
      hold: whether a frame that cannot be read is blank instead of an error.
      seconds: "read" is increased by what the threads spend, all together, and "wait" by how long the caller waits.

    Raises:
      InputError: a frame cannot be read and `hold` is false.
    """
    blank = np.zeros((image_config.height, image_config.width, image_config.channels), np.uint8)
    found = _frames(sequence, image_config, 2 * size, hold, seconds)
    last = next(found)
    for start in range(0, sequence.count - 1, size):
        pairs = min(size, sequence.count - 1 - start)
        frames = [last, *(next(found) for _ in range(pairs)), *[None] * (size - pairs)]
        last = frames[pairs]
        yield Chunk(
            np.stack([blank if frame is None else frame for frame in frames]),
            np.array([frame is not None for frame in frames]),
            pairs,
        )


def _frames(
    sequence: Sequence, image_config: ImageConfig, ahead: int, hold: bool, seconds: Seconds
) -> Iterator[np.ndarray | None]:
    """Yield every frame as the network sees it, None for one that cannot be read, with `ahead` more on the way."""

    def read(index: int) -> tuple[np.ndarray | None, float]:
        began = time.perf_counter()
        try:
            frame = prepare(sequence.read(index), sequence.camera, image_config)
        except InputError:
            if not hold:
                raise
            frame = None
        return frame, time.perf_counter() - began

    threads = 1 if sequence.in_order else min(os.cpu_count() or 1, _MOST_THREADS)
    pool = ThreadPoolExecutor(max_workers=threads, thread_name_prefix="frames")
    pending: deque[Future[tuple[np.ndarray | None, float]]] = deque()
    try:
        for index in range(sequence.count + ahead):
            if index < sequence.count:
                pending.append(pool.submit(read, index))
            if index >= ahead and pending:
                began = time.perf_counter()
                frame, spent = pending.popleft().result()
                seconds["wait"] += time.perf_counter() - began
                seconds["read"] += spent
                yield frame
    finally:
        pool.shutdown(cancel_futures=True)
