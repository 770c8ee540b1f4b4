import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from toy_windows import IMAGE, config_of, matrices, numbers, taken

from mdnvo_jax.config import DataConfig, ImageConfig, TrainingConfig
from mdnvo_jax.data import windows
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError


def assert_same(first, second):
    for a, b in zip(first, second, strict=True):
        for key in a:
            np.testing.assert_array_equal(a[key], b[key])


# Cutting


def test_windows_start_every_hop_frames_at_every_stride(toy):
    data = DataConfig(window=3, hop=2, strides=(1, 3))
    cut = windows.training_windows([toy(12), toy(6)], data)
    assert [w[1:] for w in cut if w.sequence == 0] == [(s, 1, 3) for s in (0, 2, 4, 6, 8)] + [(0, 3, 3), (2, 3, 3)]
    assert [w[1:] for w in cut if w.sequence == 1] == [(0, 1, 3), (2, 1, 3)]
    # The last window ends at the last frame: 12 frames hold a window of 11 steps, and no more.
    assert len(windows.training_windows([toy(12)], DataConfig(window=11))) == 1
    with pytest.raises(InputError, match=r"sequence toy has 12 frames: too few for a window of 12 steps"):
        windows.training_windows([toy(12)], DataConfig(window=12))


def test_a_short_sequence_gives_one_short_window_if_allowed(toy):
    assert windows.training_windows([toy(5)], DataConfig(window=6, shortest_window=2)) == [(0, 0, 1, 4)]
    with pytest.raises(InputError, match=r"too few"):
        windows.training_windows([toy(5)], DataConfig(window=6))


@pytest.mark.parametrize(
    "wrong", [{"hop": 0}, {"strides": ()}, {"strides": (0,)}, {"window": 0}, {"shortest_window": 7}, {"window": -1}]
)
def test_contradictory_configurations_are_refused(toy, wrong):
    with pytest.raises(InputError, match=r"expected 1 <= shortest_window <= window"):
        windows.training_windows([toy(20)], DataConfig(**wrong))


def test_validation_holds_every_step_once(toy):
    config = config_of(batch_size=3, window=4, validation_sequences=("a",), hop=1, mirror=1.0, photometric=1.0)
    sequences = [toy(11), toy(5, first=100, seed=1), toy(2, first=200, seed=2)]
    batches = list(windows.validation_batches(sequences, config))
    assert [batch["images"].shape for batch in batches] == [(3, 5, 8, 16, 1)] * 2
    assert batches[0]["steps"].dtype == np.float32 and batches[0]["mask"].dtype == bool
    steps = np.concatenate([batch["steps"][batch["mask"]] for batch in batches])
    np.testing.assert_allclose(steps, np.concatenate([s.steps() for s in sequences]), rtol=1e-6, atol=1e-9)
    frames = np.concatenate([numbers(batch) for batch in batches])
    np.testing.assert_array_equal(
        frames,
        [[0, 1, 2, 3, 4], [4, 5, 6, 7, 8], [8, 9, 10, 10, 10], range(100, 105), [200, 201, 201, 201, 201], [200] * 5],
    )
    mask = np.concatenate([batch["mask"] for batch in batches])
    np.testing.assert_array_equal(mask.sum(1), [4, 4, 2, 4, 1, 0])
    assert (np.concatenate([batch["steps"] for batch in batches])[~mask] == 0).all()


@given(
    counts=st.lists(st.integers(2, 40), min_size=1, max_size=4),
    window=st.integers(1, 9),
    stride=st.integers(1, 4),
    hop=st.integers(1, 5),
)
def test_windows_of_any_size_stay_in_their_sequence(counts, window, stride, hop):
    sequences = [Sequence(str(i), n, lambda index: np.zeros((1, 1, 1), np.uint8)) for i, n in enumerate(counts)]
    data = DataConfig(window=window, shortest_window=1, strides=(stride,), hop=hop)
    if min(counts) <= stride:
        with pytest.raises(InputError, match=r"too few"):
            windows.training_windows(sequences, data)
        return
    cut = windows.training_windows(sequences, data)
    assert all(w.start >= 0 and w.start + w.stride * w.steps < counts[w.sequence] and w.steps <= window for w in cut)
    assert {w.sequence for w in cut} == set(range(len(counts)))
    held = [
        (w.sequence, w.start + k * stride) for w in windows.validation_windows(sequences, data) for k in range(w.steps)
    ]
    expected = [(i, start) for i, n in enumerate(counts) for start in range(0, n - stride, stride)]
    assert held == expected


def test_validation_is_shared_among_processes(toy):
    config = config_of(batch_size=4, window=2)
    sequences = [toy(20)]
    whole = [numbers(batch) for batch in windows.validation_batches(sequences, config)]
    shares = [[numbers(b) for b in windows.validation_batches(sequences, config, rank=r, world=2)] for r in range(2)]
    for one, first, second in zip(whole, *shares, strict=True):
        np.testing.assert_array_equal(np.concatenate([first, second]), one)


def test_split_shares_no_frame(toy):
    sequences = [toy(40, name="a"), toy(11, name="b", first=100)]
    train, validation = windows.split(sequences, DataConfig(validation_tail=0.25))
    assert [(s.name, s.count) for s in train] == [("a", 30), ("b", 8)]
    assert [(s.name, s.count) for s in validation] == [("a", 10), ("b", 3)]
    seen = {int(s.read(i)[0, 0, 0]) for s in train for i in range(s.count)}
    held_out = {int(s.read(i)[0, 0, 0]) for s in validation for i in range(s.count)}
    assert not seen & held_out and len(seen | held_out) == 51
    np.testing.assert_array_equal(validation[1].poses, sequences[1].poses[8:])
    # The least tail has one step.
    assert windows.split([toy(20)], DataConfig(validation_tail=0.01))[1][0].count == 2
    with pytest.raises(InputError, match=r"sequence toy has 3 frames: too few"):
        windows.split([toy(3)], DataConfig())
    for tail in (0.0, 1.0):
        with pytest.raises(InputError, match=r"between 0 and 1"):
            windows.split(sequences, DataConfig(validation_tail=tail))


# Drawing


def test_an_epoch_holds_every_window_once_and_the_next_in_another_order(toy):
    config = config_of(batch_size=4, window=2, strides=(1, 2))
    sequence = toy(20)
    count = windows.batches_per_epoch([sequence], config)
    assert count == (18 + 16) // 4
    config = dataclasses.replace(config, training=TrainingConfig(batch_size=17))
    first, second = taken(windows.training_batches([sequence], config, seed=3), 4)[0::2]
    epochs = taken(windows.training_batches([sequence], config, seed=3), 4)
    for epoch in (epochs[:2], epochs[2:]):
        drawn = np.concatenate([numbers(batch) for batch in epoch])
        expected = [(s, s + d, s + 2 * d) for d in (1, 2) for s in range(20 - 2 * d)]
        assert sorted(map(tuple, drawn)) == sorted(expected)
    assert (numbers(first) != numbers(second)).any()


def test_labels_are_the_motion_between_the_frames(toy):
    config = config_of(window=3, strides=(1, 2), reverse=0.5, shortest_window=1)
    sequence = toy(30)
    seen = set()
    for batch in taken(windows.training_batches([sequence], config, seed=0), 12):
        assert batch["images"].shape == (4, 4, 8, 16, 1) and batch["steps"].dtype == np.float32
        for frames, steps, mask in zip(numbers(batch), batch["steps"], batch["mask"], strict=True):
            count = mask.sum()
            assert mask[:count].all() and (steps[count:] == 0).all() and (frames[count:] == frames[count]).all()
            seen.add((int(frames[1] - frames[0]), int(count)))
            poses = sequence.poses[frames[: count + 1]]
            expected = np.linalg.inv(poses[:-1]) @ poses[1:]
            np.testing.assert_allclose(matrices(steps[:count].astype(float)), expected, atol=1e-6)
    assert {stride for stride, _ in seen} == {-2, -1, 1, 2}
    assert {count for _, count in seen} == {1, 2, 3}


# Determinism, state, processes

BUSY = {"window": 3, "shortest_window": 2, "strides": (1, 2), "reverse": 0.5, "mirror": 0.5, "photometric": 1.0}


def test_batches_depend_on_the_seed_and_not_on_the_threads(toy):
    sequences = [toy(20), toy(9, first=100, seed=1)]
    runs = [
        taken(windows.training_batches(sequences, config_of(threads=threads, **BUSY), seed=seed), 20)
        for threads, seed in ((0, 7), (1, 7), (3, 7), (2, 8))
    ]
    assert_same(runs[0], runs[1])
    assert_same(runs[0], runs[2])
    assert any((a["images"] != b["images"]).any() for a, b in zip(runs[0], runs[3], strict=True))


@pytest.mark.parametrize("stop", [0, 3, 17])
def test_a_restored_iterator_continues_exactly(toy, stop):
    sequences, config = [toy(20)], config_of(**BUSY)
    assert windows.batches_per_epoch(sequences, config) < 17  # the last case is beyond the first epoch
    whole = taken(windows.training_batches(sequences, config, seed=1), stop + 5)
    iterator = windows.training_batches(sequences, config, seed=1)
    taken(iterator, stop)
    state = iterator.get_state()
    again = windows.training_batches(sequences, config, seed=1)
    again.set_state(state)
    assert_same(taken(again, 5), whole[stop:])


def test_processes_share_the_batches_of_one(toy):
    sequences, config = [toy(23)], config_of(batch_size=6, **BUSY)
    whole = taken(windows.training_batches(sequences, config, seed=2), 12)
    shares = [taken(windows.training_batches(sequences, config, seed=2, rank=r, world=3), 12) for r in range(3)]
    for batch, *parts in zip(whole, *shares, strict=True):
        for key, values in batch.items():
            np.testing.assert_array_equal(np.concatenate([part[key] for part in parts]), values)
    with pytest.raises(InputError, match=r"batch_size 6 is not divisible among 4 processes"):
        windows.training_batches(sequences, config, seed=2, rank=0, world=4)


@pytest.mark.parametrize(("before", "after"), [(1, 2), (2, 1), (3, 2)])
def test_other_processes_go_on_where_some_stopped(toy, before, after):
    sequences, config = [toy(23)], config_of(batch_size=6, **BUSY)
    whole = taken(windows.training_batches(sequences, config, seed=2), 9)
    stopped = windows.training_batches(sequences, config, seed=2, rank=0, world=before)
    taken(stopped, 5)
    parts = []
    for rank in range(after):
        share = windows.training_batches(sequences, config, seed=2, rank=rank, world=after)
        share.set_state(stopped.get_state())
        parts.append(taken(share, 4))
    for one, *rows in zip(whole[5:], *parts, strict=True):
        for key, values in one.items():
            np.testing.assert_array_equal(np.concatenate([row[key] for row in rows]), values)


def test_mistakes_are_named(toy):
    with pytest.raises(InputError, match=r"15 training windows do not fill a batch of 16"):
        windows.training_batches([toy(16)], config_of(batch_size=16, window=1), seed=0)
    with pytest.raises(InputError, match=r"sequence toy has no poses"):
        windows.training_batches([toy(16, poses=None)], config_of(), seed=0)
    with pytest.raises(InputError, match=r"sequence toy has no poses"):
        windows.validation_batches([toy(16, poses=None)], config_of())
    with pytest.raises(InputError, match=r"no sequence to validate on has a step"):
        windows.validation_batches([toy(1)], config_of())
    with pytest.raises(InputError, match=r"no sequences to train on"):
        windows.training_batches([], config_of(), seed=0)


def test_a_frame_that_cannot_be_read_is_still_named_behind_threads(toy):
    def read(index):
        raise InputError(f"frame {index} is broken")

    sequence = dataclasses.replace(toy(10), read=read)
    with pytest.raises(InputError, match=r"frame \d is broken"):
        next(iter(windows.validation_batches([sequence], config_of())))


# Standardisation and camera


@pytest.mark.parametrize(
    "data",
    [
        {"window": 3},
        {"window": 3, "hop": 3, "strides": (1, 3)},
        {"window": 4, "shortest_window": 2, "reverse": 0.3, "mirror": 0.4, "strides": (1, 2)},
    ],
)
def test_label_statistics_are_those_of_the_labels_drawn(toy, data):
    sequences = [toy(14), toy(6, seed=1)]
    mean, std = windows.label_statistics(sequences, DataConfig(**data))
    config = config_of(batch_size=1, threads=0, **data)
    epochs = 60 if "reverse" in data else 1
    count = epochs * len(windows.training_windows(sequences, config.data))
    labels = np.concatenate(
        [b["steps"][b["mask"]] for b in taken(windows.training_batches(sequences, config, seed=0), count)]
    )
    if epochs == 1:
        np.testing.assert_allclose(mean, labels.mean(0), atol=1e-6)
        np.testing.assert_allclose(std, labels.std(0), rtol=1e-5)
    else:
        np.testing.assert_allclose(mean, labels.mean(0), atol=0.05 * std.max())
        np.testing.assert_allclose(std, labels.std(0), rtol=0.05)


def test_label_statistics_have_a_floor(toy):
    still = toy(10, poses=np.tile(np.eye(4), (10, 1, 1)))
    mean, std = windows.label_statistics([still], DataConfig())
    np.testing.assert_array_equal(mean, np.zeros(6))
    np.testing.assert_array_equal(std, [1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4])


def test_the_virtual_camera_is_that_of_the_first_sequence_that_has_one(toy):
    sequences = [toy(4), toy(4, camera=(20.0, 10.0, 15.5, 7.5), size=(16, 32)), toy(4, camera=(1.0, 1.0, 1.0, 1.0))]
    assert windows.resolve_camera(sequences, IMAGE).camera == pytest.approx((10.0, 5.0, 7.5, 3.5))
    assert windows.resolve_camera(sequences[:1], IMAGE).camera == ()
    fixed = dataclasses.replace(IMAGE, camera=(1.0, 2.0, 3.0, 4.0))
    assert windows.resolve_camera(sequences, fixed) is fixed
    assert windows.resolve_camera(sequences, dataclasses.replace(IMAGE, rectify=False)).camera == ()


def test_real_windows(data_root):
    from mdnvo_jax.data.kitti import read_kitti

    sequence = read_kitti(data_root / "kitti", "01", camera_folder="image_0", channels=1)
    image = windows.resolve_camera([sequence], ImageConfig(height=80, width=256, channels=1))
    config = config_of(2, image, window=4, mirror=0.5, photometric=1.0)
    batch = next(windows.training_batches([sequence], config, seed=0))
    assert batch["images"].shape == (2, 5, 80, 256, 1) and 30 < batch["images"].std() < 120
    # Neighbouring frames look alike, more than frames of different windows.
    images = batch["images"].astype(float)
    near = np.abs(images[:, 1:] - images[:, :-1]).mean()
    assert near < 0.6 * np.abs(images[0] - images[1]).mean()
