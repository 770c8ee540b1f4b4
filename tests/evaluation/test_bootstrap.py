import numpy as np
import pytest

from mdnvo_jax.evaluation import bootstrap


def autoregressive(count, correlation, rng):
    """A series of mean 0 whose neighbours resemble each other."""
    values = rng.standard_normal(count) * np.sqrt(1 - correlation**2)
    for i in range(1, count):
        values[i] += correlation * values[i - 1]
    return values


def test_blocks_are_consecutive_and_of_full_size():
    draws = bootstrap.draw_blocks(100, block=12, draws=50)
    assert len(draws.indices) == 50 and all(indices.shape == (100,) for indices in draws.indices)
    assert draws.units == 9
    for indices in draws.indices:
        jumps = np.flatnonzero(np.diff(indices) % 100 != 1) + 1
        assert set(jumps) <= set(range(12, 100, 12))


def test_every_item_is_drawn_equally_often():
    draws = np.concatenate(bootstrap.draw_blocks(40, block=5, draws=4000).indices)
    counts = np.bincount(draws, minlength=40) / 4000
    # Ends too: a block wraps around. A count of 40 draws has a deviation of at most sqrt(8 * 5) of 4000 sums.
    np.testing.assert_allclose(counts, 1, atol=0.12)


def test_blocks_shrink_with_the_sequence():
    (indices,) = bootstrap.draw_blocks(50, block=100, draws=1).indices
    assert np.flatnonzero(np.diff(indices) % 50 != 1).size >= 5
    assert [len(drawn) for drawn in bootstrap.draw_blocks(1, draws=2).indices] == [1, 1]


def test_the_seed_decides():
    first, second, other = (bootstrap.draw_blocks(30, draws=3, seed=seed).indices for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)


def test_whole_sequences():
    lengths = [3, 1, 4]
    sequences = [[0, 1, 2], [3], [4, 5, 6, 7]]
    for indices in bootstrap.draw_sequences(lengths, draws=30).indices:
        rest = indices.tolist()
        while rest:
            (found,) = [sequence for sequence in sequences if rest[: len(sequence)] == sequence]
            rest = rest[len(found) :]


def test_sequences_from_five_on():
    few, many = bootstrap.draw([10] * 4, draws=20), bootstrap.draw([10] * 5, draws=20)
    assert {len(indices) for indices in few.indices} == {40}
    np.testing.assert_array_equal(many.indices, bootstrap.draw_sequences([10] * 5, draws=20).indices)
    assert "blocks of 30 frames" in bootstrap.describe(30)


def test_independent_items_give_the_textbook_interval():
    values = np.random.default_rng(0).standard_normal(1000)
    low, high = bootstrap.number_interval(lambda i: values[i].mean(), bootstrap.draw_blocks(1000, block=1))
    error = values.std() / np.sqrt(1000)
    assert low == pytest.approx(values.mean() - 1.96 * error, abs=0.2 * error)
    assert high == pytest.approx(values.mean() + 1.96 * error, abs=0.2 * error)


def test_blocks_know_that_neighbours_are_alike():
    rng = np.random.default_rng(1)
    hits = {1: 0, 60: 0}
    for _ in range(100):
        values = autoregressive(1200, 0.9, rng)
        for block in hits:
            draws = bootstrap.draw_blocks(1200, block=block, draws=200)
            low, high = bootstrap.number_interval(lambda i, values=values: values[i].mean(), draws)
            hits[block] += low <= 0 <= high
    # 95 nominal; blocks come near, single frames are far too sure of themselves.
    assert hits[60] >= 82
    assert hits[1] <= 55


def test_few_units_are_as_wide_as_students_t():
    rng = np.random.default_rng(2)
    hits = 0
    for _ in range(200):
        values = rng.standard_normal(5)
        low, high = bootstrap.number_interval(
            lambda i, values=values: values[i].mean(), bootstrap.draw([1] * 5, draws=400)
        )
        hits += low <= 0 <= high
    # 190 nominal; plain percentiles would hold 0 about 165 times.
    assert hits >= 179


def test_means_take_a_shorter_way_to_the_same_interval():
    values = np.random.default_rng(0).random((30, 2, 3))
    for draws in (bootstrap.draw_blocks(30, draws=50), bootstrap.draw_sequences([10, 3, 17], draws=50)):
        expected = bootstrap.interval(lambda i: values[i].mean(axis=0), draws)
        np.testing.assert_allclose(bootstrap.mean_interval(values, draws), expected, rtol=1e-12)


def test_one_unit_has_no_interval():
    low, high = bootstrap.number_interval(lambda i: 1.0, bootstrap.draw_blocks(1, draws=3))
    assert np.isnan(low) and np.isnan(high)


def test_arrays_and_nan():
    draws = bootstrap.Draws([np.array([0]), np.array([1]), np.array([2])], units=1000)
    low, high = bootstrap.interval(lambda i: np.array([i[0], np.nan, np.nan if i[0] else 7.0]), draws)
    np.testing.assert_allclose(low, [0.05, np.nan, 7], rtol=0.01)
    np.testing.assert_allclose(high, [1.95, np.nan, 7], rtol=0.01)
