"""Frames read ahead: in order, each once, no more at a time than asked for."""

import threading
import time
from collections import defaultdict

import numpy as np
import pytest

from mdnvo_jax.config import ImageConfig
from mdnvo_jax.data import ahead
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError

IMAGE = ImageConfig(height=4, width=6, channels=1)


def numbered(count, *, bad=(), in_order=False, seen=None, delay=0.0):
    """Frames whose pixels are their number; the later of two neighbours is read faster."""

    def read(index):
        time.sleep(delay * (index % 2 == 0))
        if seen is not None:
            seen.append(index)
        if index in bad:
            raise InputError(f"frame {index} is bad")
        return np.full((4, 6, 1), index, np.uint8)

    return Sequence(name="numbers", count=count, read=read, in_order=in_order)


def chunks(sequence, size, hold=False):
    return ahead.chunks(sequence, IMAGE, size, hold=hold, seconds=defaultdict(float))


@pytest.mark.parametrize(("count", "size"), [(2, 1), (2, 8), (9, 8), (10, 8), (17, 4), (5, 1)])
def test_every_pair_comes_once_and_in_order(count, size):
    seen = []
    found = list(chunks(numbered(count, seen=seen, delay=2e-3), size))
    assert sorted(seen) == list(range(count))
    pairs = [(int(c.frames[i, 0, 0, 0]), int(c.frames[i + 1, 0, 0, 0])) for c in found for i in range(c.pairs)]
    assert pairs == [(i, i + 1) for i in range(count - 1)]
    assert {c.frames.shape for c in found} == {(size + 1, 4, 6, 1)}
    # What fills up the last chunk is blank, and does not count.
    assert not found[-1].frames[found[-1].pairs + 1 :].any()
    assert not found[-1].readable[found[-1].pairs + 1 :].any()
    assert all(c.usable.all() and len(c.usable) == c.pairs for c in found)


def test_a_bad_frame_spoils_two_pairs_or_ends_it():
    found = list(chunks(numbered(10, bad=(0, 4)), 4, hold=True))
    assert np.concatenate([c.usable for c in found]).tolist() == [i not in (0, 3, 4) for i in range(9)]
    assert not found[1].frames[0].any()
    with pytest.raises(InputError, match="frame 4"):
        list(chunks(numbered(10, bad=(4,)), 4))


def test_reading_stays_a_little_ahead_and_stops_with_the_reader():
    seen = []
    found = chunks(numbered(100, seen=seen), 4)
    next(found)
    time.sleep(0.05)
    # The five frames of the chunk, two chunks more, and what a thread is at.
    assert len(seen) <= 5 + 8 + 1
    found.close()
    slow = chunks(numbered(100, seen=seen, delay=0.02), 4)
    next(slow)
    slow.close()
    count = len(seen)
    time.sleep(0.1)
    assert len(seen) == count
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("frames")]


def test_frames_that_are_cheap_in_order_only_are_read_in_order():
    seen = []
    list(chunks(numbered(30, in_order=True, seen=seen, delay=1e-3), 4))
    assert seen == list(range(30))


def test_time_is_accounted_for():
    seconds = defaultdict(float)
    list(ahead.chunks(numbered(9, delay=5e-3), IMAGE, 4, hold=False, seconds=seconds))
    assert seconds["read"] >= 5 * 5e-3
    assert 0 < seconds["wait"] <= seconds["read"] + 0.1
