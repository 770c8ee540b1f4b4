"""Windows over all frames: each is made of its own steps, whatever group of pairs they came in."""

from collections import defaultdict

import numpy as np
import pytest

from mdnvo_jax import offline
from mdnvo_jax.config import ImageConfig
from mdnvo_jax.data import ahead
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError
from mdnvo_jax.mixture import Mixture
from mdnvo_jax.odometry import window_plan

WINDOW = 4


def frame_reader(brightness, bad):
    def read(index):
        if index in bad:
            raise InputError("bad")
        return np.full((1, 1, 1), brightness[index], np.uint8)

    return read


@pytest.mark.parametrize(
    ("steps", "hop"), [(1, 1), (3, 1), (4, 2), (5, 2), (12, 2), (13, 4), (24, 1), (48, 2), (49, 1), (119, 3), (130, 4)]
)
def test_every_step_is_that_of_its_window(monkeypatch: pytest.MonkeyPatch, steps: int, hop: int) -> None:
    """A step's feature is the brighter frame's surplus; a window "estimates" from each step and from all it holds."""
    monkeypatch.setattr(offline, "PAIRS", 4)
    monkeypatch.setattr(offline, "CHUNKS", 3)
    brightness = np.random.default_rng(steps).integers(0, 256, steps + 1)
    bad = set(np.flatnonzero(np.random.default_rng(1).random(steps + 1) < 0.1).tolist())
    usable = np.array([not {step, step + 1} & bad for step in range(steps)])
    expected = np.where(usable, np.diff(brightness), 0.0)
    groups = []

    def features(frames: np.ndarray) -> np.ndarray:
        return np.diff(frames[:, 0, 0].astype(float), axis=0)

    def densities(tail: np.ndarray, found: tuple, rows: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, Mixture]:
        assert (len(found), rows.shape) == (3, (offline.windows_in_group(hop), WINDOW))
        groups.append(len(found))
        known = np.concatenate([tail, *found])
        windows = np.where(mask, known[rows, 0], 0)
        whole = np.broadcast_to(windows.sum(1, keepdims=True), windows.shape)
        return known[-len(tail) :], Mixture(windows, whole, mask)

    sequence = Sequence(name="dots", count=steps + 1, read=frame_reader(brightness, bad))
    image = ImageConfig(height=1, width=1, channels=1)
    chunks = ahead.chunks(sequence, image, 4, hold=True, seconds=defaultdict(float))
    # What comes before the first frame must reach nothing.
    before = np.full((WINDOW, 1), np.nan)
    found, seen = offline.step_densities(features, densities, before, steps, chunks, window=WINDOW, hop=hop)
    np.testing.assert_array_equal(seen, usable)
    np.testing.assert_array_equal(found.logits, expected)
    np.testing.assert_array_equal(found.log_scale, usable)
    for start, first, last in window_plan(steps, WINDOW, hop):
        np.testing.assert_array_equal(found.mean[first:last], expected[start : start + WINDOW].sum())
    # Twelve pairs a group, the last one filled up: nothing is computed twice.
    assert len(groups) == -(-steps // 12)
