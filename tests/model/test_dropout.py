import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from mdnvo_jax.model.dropout import counter_bits, drop

SHAPE = (64, 32, 32, 16)


@pytest.fixture(scope="module")
def bits():
    return np.asarray(jax.jit(counter_bits, static_argnums=1)(jax.random.key(0), SHAPE))


def test_the_bits_are_uniform(bits):
    """Every byte of the words by a chi-squared test with 255 degrees of freedom, and every bit by its mean."""
    for byte in range(4):
        counts = np.bincount(((bits >> np.uint32(8 * byte)) & 255).ravel(), minlength=256)
        assert 1e-4 < stats.chisquare(counts).pvalue < 1 - 1e-4
    means = np.array([((bits >> np.uint32(bit)) & 1).mean() for bit in range(32)])
    assert np.abs(means - 0.5).max() < 5 * 0.5 / np.sqrt(bits.size)


@pytest.mark.parametrize("lag", [1, 2, 3, 16, 512, 16384, 4096 + 1])
def test_neighbours_are_independent(bits, lag):
    """Runs of an element with the one `lag` further on: the four outcomes of two drops at rate 0.1."""
    dropped = (bits < 0.1 * 2**32).ravel()
    pairs = np.bincount(2 * dropped[:-lag] + dropped[lag:], minlength=4)
    expected = np.outer([0.9, 0.1], [0.9, 0.1]).ravel() * pairs.sum()
    # Neighbouring pairs share elements: the statistic's tails are a little heavier than a chi-squared's.
    assert stats.chi2(3).sf(((pairs - expected) ** 2 / expected).sum()) > 1e-4


@pytest.mark.parametrize("other", [jax.random.fold_in(jax.random.key(0), 1), jax.random.key(1), jax.random.PRNGKey(2)])
def test_keys_give_unrelated_bits(bits, other):
    words = np.asarray(counter_bits(other, SHAPE))
    differing = np.bitwise_count(words ^ bits).mean()
    assert abs(differing - 16) < 5 * np.sqrt(8 / bits.size), "half of 32 bits differ"


def test_the_mask_depends_on_the_key_and_the_place_alone(bits):
    assert (np.asarray(counter_bits(jax.random.key(0), (8, *SHAPE[1:]))) == bits[:8]).all()


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.5, 0.999])
def test_drops_at_its_rate_and_keeps_the_mean(rate):
    x = jnp.full(SHAPE, 3.0)
    found = np.asarray(drop(x, rate, jax.random.key(4)))
    kept = found != 0
    assert abs(kept.mean() - (1 - rate)) <= 5 * np.sqrt(rate * (1 - rate) / x.size)
    np.testing.assert_allclose(found[kept], 3.0 / (1 - rate), rtol=1e-6)


def test_gradient_passes_where_kept():
    x = jnp.ones((4, 50))
    value, pull = jax.vjp(lambda x: drop(x, 0.3, jax.random.key(0)), x)
    assert (pull(jnp.ones_like(value))[0] == value).all()


@pytest.mark.parametrize("rate", [-0.1, 1.0, float("nan")])
def test_refuses_a_rate_that_is_none(rate):
    with pytest.raises(ValueError, match="rate of dropout"):
        drop(jnp.ones(3), rate, jax.random.key(0))
