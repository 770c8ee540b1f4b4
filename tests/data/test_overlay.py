"""What moves with the camera: it hides a part of all frames alike, and the optical flow there is not known."""

import dataclasses
import itertools

import numpy as np
from toy_windows import IMAGE, config_of, taken

from mdnvo_jax.config import ModelConfig
from mdnvo_jax.data import windows
from mdnvo_jax.data.overlay import cover_flow, cover_frames

FRAMES = np.random.default_rng(0).integers(0, 256, (3, 48, 192, 1), dtype=np.uint8)


def drawn(frames=FRAMES, count=200):
    """Return (frames, cover) of as many seeds, as (hoods, captions): a hood covers whole columns below its edge."""
    both = [cover_frames(frames, np.random.default_rng(seed)) for seed in range(count)]
    hoods = [(found, cover) for found, cover in both if (np.diff(cover, axis=0) >= 0).all()]
    captions = [(found, cover) for found, cover in both if (np.diff(cover, axis=0) < 0).any()]
    return hoods, captions


def test_frames_are_as_they_were_where_nothing_covers_them():
    for found, cover in itertools.chain(*drawn()):
        assert found.dtype == np.uint8 and cover.min() >= 0 and cover.max() <= 1
        np.testing.assert_array_equal(found[:, cover == 0], FRAMES[:, cover == 0])


def test_hoods_rise_to_a_quarter_of_the_frame_and_captions_lie_anywhere():
    hoods, captions = drawn()
    assert 30 <= len(captions) <= 70
    height = [cover.sum(0).max() for _, cover in hoods]
    assert max(height) <= 12 and min(height) < 1 and 4 < np.median(height) < 8
    assert all(cover[:35].max() == 0 for _, cover in hoods)
    rows = np.concatenate([np.flatnonzero(cover.any(1)) for _, cover in captions])
    assert np.histogram(rows, 4, (0, 48))[0].min() > 30


def test_what_covers_does_not_move_but_for_what_it_mirrors():
    """Where all frames are grey, what covers them is the same in all; on a hood, texture comes through at 0 to 60 %."""
    level = np.broadcast_to(np.uint8([[[[60]]], [[[60]]], [[[60]]]]), FRAMES.shape)
    for found, _ in itertools.chain(*drawn(level)):
        np.testing.assert_array_equal(found, found[:1].repeat(3, 0))
    hoods, captions = drawn()
    for found, cover in captions:
        assert set(np.unique(found[:, cover == 1])) <= {0, 255}
    shares = []
    for found, cover in hoods:
        full = cover == 1
        if full.sum() > 200:
            # Noise of deviation 74 is mirrored by the share a.
            shares.append((found[0, full].astype(float) - found[1, full]).std() / np.sqrt(2) / 73.9)
    assert min(shares) < 0.06 and 0.45 < max(shares) < 0.65


def test_a_hood_mirrors_what_is_above_its_edge_upside_down():
    frames = np.zeros((2, 48, 192, 1), np.uint8)
    frames[:, 30:34] = 255
    seen = 0
    for found, cover in drawn(frames)[0]:
        edge = 48 - np.rint(cover[:, 96].sum()).astype(int)
        column = found[0, :, 96, 0].astype(float)
        rows = 2 * edge - 1 - np.arange(30, 34)
        rows = rows[(rows < 48) & (cover[np.minimum(rows, 47), 96] == 1)]
        dark = [row for row in range(edge + 1, min(rows, default=48)) if cover[row, 96] == 1]
        if len(rows) and dark and column[rows].min() - column[dark].max() > 20:
            seen += 1
    assert seen > 10


def test_flow_is_not_known_where_the_hood_is():
    flow = np.random.default_rng(1).normal(size=(2, 6, 24, 2)).astype(np.float32)
    cover = np.zeros((48, 192))
    cover[39:] = 0.7
    found = cover_flow(flow, cover)
    assert found.dtype == np.float32 and np.isnan(found[:, 5]).all()
    np.testing.assert_array_equal(found[:, :5], flow[:, :5])


def test_as_many_windows_as_asked_for_are_covered_and_keep_their_labels(toy):
    pixels = np.random.default_rng(0).integers(0, 256, (40, 8, 16, 1), dtype=np.uint8)
    flow = np.ones((40, 1, 2, 2), np.float32)
    camera = (9.0, 9.0, 7.5, 3.5)
    sequence = dataclasses.replace(toy(40), read=lambda i: pixels[i], flow=lambda i: flow[i], camera=camera)
    image = dataclasses.replace(IMAGE, camera=camera)
    config = config_of(image=image, batch_size=30, window=4, overlaid=0.5)
    config = dataclasses.replace(config, model=ModelConfig(flow_weight=1.0))
    plain = dataclasses.replace(config, data=dataclasses.replace(config.data, overlaid=0.0))
    batch, before = (taken(windows.training_batches([sequence], c, seed=0), 1)[0] for c in (config, plain))
    np.testing.assert_array_equal(batch["steps"], before["steps"])
    changed = (batch["images"] != before["images"]).any(axis=(1, 2, 3, 4))
    assert 7 <= changed.sum() <= 22
    # Captions may lie on a cell of the map.
    assert np.isnan(batch["flow"][~changed]).sum() == 0
