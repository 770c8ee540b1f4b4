"""The mixture density against scipy, against its own definitions, and at its extremes."""

import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import partial

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import integrate, optimize, special, stats

from mdnvo_jax import mixture as mx
from mdnvo_jax.mixture import Mixture

BATCH, COMPONENTS, DIMENSIONS = (2, 3), 4, 3
COUPLINGS = ("independent", "joint")


@pytest.fixture
def x64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def random_mixture(seed: int = 0, batch: tuple[int, ...] = BATCH, components: int = COMPONENTS) -> Mixture:
    """Parameters in float64 numpy: overlapping components whose scales differ by up to e^3."""
    rng = np.random.default_rng(seed)
    shape = (*batch, components, DIMENSIONS)
    return Mixture(rng.normal(size=shape[:-1]), rng.normal(size=shape) * 2, rng.uniform(-2, 1, size=shape))


def random_value(seed: int = 1, batch: tuple[int, ...] = BATCH) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(*batch, DIMENSIONS)) * 2


def device(mixture: Mixture, dtype: str | None = None) -> Mixture:
    return Mixture(*(jnp.asarray(field, dtype) for field in mixture))


def weights(mixture: Mixture) -> np.ndarray:
    return special.softmax(mixture.logits, axis=-1)[..., None]


# Compiled once a shape: most of the time of these tests would go into compiling operation by operation.
affine, cdf, crps, interval, mean, quantile, strongest, variance = map(
    jax.jit, (mx.affine, mx.cdf, mx.crps, mx.interval, mx.mean, mx.quantile, mx.strongest, mx.variance)
)
add_noise, pool, widen = jax.jit(mx.add_noise), jax.jit(mx.pool), jax.jit(mx.widen)
covariance, log_prob, mode = (
    jax.jit(function, static_argnames="coupling") for function in (mx.covariance, mx.log_prob, mx.mode)
)
nll = jax.jit(mx.nll, static_argnames=("coupling", "reduction"))
sample = jax.jit(mx.sample, static_argnames=("shape", "coupling"))


# What every function should give, from scipy and the definitions, in float64.


def reference_log_prob(mixture: Mixture, value: np.ndarray, coupling: str) -> np.ndarray:
    log_normal = stats.norm.logpdf(value[..., None, :], mixture.mean, np.exp(mixture.log_scale))
    log_weight = special.log_softmax(mixture.logits, axis=-1)
    if coupling == "joint":
        return special.logsumexp(log_weight + log_normal.sum(-1), axis=-1)
    return special.logsumexp(log_weight[..., None] + log_normal, axis=-2).sum(-1)


def reference_mean(mixture: Mixture) -> np.ndarray:
    return (weights(mixture) * mixture.mean).sum(-2)


def reference_variance(mixture: Mixture) -> np.ndarray:
    second = (weights(mixture) * (mixture.mean**2 + np.exp(2 * mixture.log_scale))).sum(-2)
    return second - reference_mean(mixture) ** 2


def reference_covariance(mixture: Mixture) -> np.ndarray:
    centre, scale = mixture.mean, np.exp(mixture.log_scale)
    second = np.einsum("...i,...ik,...il->...kl", weights(mixture)[..., 0], centre, centre)
    second += np.einsum("...i,...ik,kl->...kl", weights(mixture)[..., 0], scale**2, np.eye(DIMENSIONS))
    first = reference_mean(mixture)
    return second - first[..., :, None] * first[..., None, :]


def reference_cdf(mixture: Mixture, value: np.ndarray) -> np.ndarray:
    components = stats.norm.cdf(value[..., None, :], mixture.mean, np.exp(mixture.log_scale))
    return (weights(mixture) * components).sum(-2)


def one_dimensional(mixture: Mixture) -> Iterator[tuple[tuple[int, ...], np.ndarray, np.ndarray, np.ndarray]]:
    """Index, weights, means and scales of every one-dimensional mixture in the batch."""
    for *batch, k in np.ndindex(*mixture.mean.shape[:-2], mixture.mean.shape[-1]):
        inner = (*batch, slice(None), k)
        yield (*batch, k), weights(mixture)[(*batch, slice(None), 0)], mixture.mean[inner], mixture.log_scale[inner]


def reference_quantile(mixture: Mixture, probability: float) -> np.ndarray:
    out = np.empty((*mixture.mean.shape[:-2], mixture.mean.shape[-1]))
    for index, weight, centre, log_scale in one_dimensional(mixture):
        # In the smaller of the tails, where float64 has the digits.
        tail, side = (probability, 1) if probability <= 0.5 else (1 - probability, -1)
        scale = np.exp(log_scale)
        ends = side * centre + scale * stats.norm.ppf(tail)

        def excess(x: float, arguments=(weight, side * centre, scale, tail)) -> float:
            weight, centre, scale, tail = arguments
            return float(np.log(weight @ stats.norm.cdf(x, centre, scale)) - np.log(tail))

        out[index] = side * optimize.brentq(excess, ends.min() - 1e-9, ends.max() + 1e-9, xtol=1e-14, rtol=1e-15)
    return out


def reference_crps(mixture: Mixture, value: np.ndarray) -> np.ndarray:
    """The integral that defines the score."""
    out = np.empty_like(value)
    for index, weight, centre, log_scale in one_dimensional(mixture):
        scale, y = np.exp(log_scale), value[index]

        def below(x: float, w=weight, m=centre, s=scale) -> float:
            return float(w @ stats.norm.cdf(x, m, s)) ** 2

        def above(x: float, w=weight, m=centre, s=scale) -> float:
            return float(w @ stats.norm.sf(x, m, s)) ** 2

        start, stop = min(y, (centre - 12 * scale).min()), max(y, (centre + 12 * scale).max())
        knots = np.unique(np.concatenate([centre, centre - 3 * scale, centre + 3 * scale]))
        exact = {"epsabs": 1e-13, "epsrel": 1e-13, "limit": 400}
        left = integrate.quad(below, start, y, points=knots[(knots > start) & (knots < y)], **exact)[0]
        right = integrate.quad(above, y, stop, points=knots[(knots > y) & (knots < stop)], **exact)[0]
        out[index] = left + right
    return out


PROBABILITIES = (1e-6, 0.025, 0.5, 0.9)
KEY = jax.random.key(0, impl="rbg")
# Every public function of a density, as a function of (mixture, value); the batch has two axes.
PUBLIC: dict[str, Callable[[Mixture, jax.Array], object]] = {
    "log_prob": mx.log_prob,
    "log_prob joint": lambda m, y: mx.log_prob(m, y, coupling="joint"),
    "nll": mx.nll,
    "nll sequence": lambda m, y: mx.nll(m, y, reduction="sequence"),
    "mean": lambda m, _: mx.mean(m),
    "variance": lambda m, _: mx.variance(m),
    "covariance": lambda m, _: mx.covariance(m),
    "covariance joint": lambda m, _: mx.covariance(m, coupling="joint"),
    "strongest": lambda m, _: mx.strongest(m),
    "mode": lambda m, _: mx.mode(m),
    "mode joint": lambda m, _: mx.mode(m, coupling="joint"),
    "cdf": mx.cdf,
    "quantile": lambda m, _: mx.quantile(m, np.reshape(PROBABILITIES, (-1, 1, 1, 1))),
    "interval": lambda m, _: mx.interval(m, 0.5),
    "sample": lambda m, _: mx.sample(m, KEY, (5,)),
    "sample joint": lambda m, _: mx.sample(m, KEY, (5,), coupling="joint"),
    "affine": lambda m, _: mx.affine(m, np.full(m.mean.shape[-1], 1e3), np.ones(m.mean.shape[-1]))[1:],
    "widen": lambda m, _: mx.widen(m, np.full(m.mean.shape[-1], 1e3))[1:],
    "add_noise": lambda m, _: mx.add_noise(m, np.full(m.mean.shape[-1], 1e3))[1:],
    "crps": mx.crps,
}


def several(names: Iterable[str]) -> Callable[[Mixture, jax.Array], dict[str, object]]:
    return lambda mixture, value: {name: PUBLIC[name](mixture, value) for name in names}


everything = jax.jit(several(PUBLIC))


REFERENCES: dict[str, Callable[[Mixture, np.ndarray], np.ndarray]] = {
    "log_prob": lambda m, y: reference_log_prob(m, y, "independent"),
    "log_prob joint": lambda m, y: reference_log_prob(m, y, "joint"),
    "mean": lambda m, _: reference_mean(m),
    "variance": lambda m, _: reference_variance(m),
    "covariance": lambda m, _: reference_variance(m)[..., None] * np.eye(DIMENSIONS),
    "covariance joint": lambda m, _: reference_covariance(m),
    "cdf": reference_cdf,
    "crps": reference_crps,
    "quantile": lambda m, _: np.stack([reference_quantile(m, p) for p in PROBABILITIES]),
    "interval": lambda m, _: np.stack([reference_quantile(m, 0.25), reference_quantile(m, 0.75)]),
}


def test_agrees_with_scipy_in_float64(x64: None) -> None:
    mixture, value = random_mixture(), random_value()
    found = everything(device(mixture), jnp.asarray(value))
    assert all(leaf.dtype == jnp.float64 for leaf in jax.tree.leaves(found))
    for name, reference in REFERENCES.items():
        # A covariance may come out near zero by cancellation, hence a little absolute slack beside the relative.
        np.testing.assert_allclose(found[name], reference(mixture, value), rtol=1e-10, atol=1e-12, err_msg=name)


def test_agrees_with_scipy_in_float32() -> None:
    # The reference is of the rounded parameters: rounding them is the caller's doing.
    mixture = Mixture(*(field.astype(np.float32).astype(np.float64) for field in random_mixture()))
    value = random_value().astype(np.float32).astype(np.float64)
    found = everything(device(mixture), jnp.asarray(value))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(found))
    for name, reference in REFERENCES.items():
        np.testing.assert_allclose(found[name], reference(mixture, value), rtol=1e-5, atol=2e-6, err_msg=name)


def test_lower_tail_of_the_cdf_keeps_its_digits(x64: None) -> None:
    mixture = random_mixture()
    value = np.min(mixture.mean - 20 * np.exp(mixture.log_scale), axis=-2)
    np.testing.assert_allclose(cdf(device(mixture), value), reference_cdf(mixture, value), rtol=1e-10, atol=0)


def test_one_component_is_a_gaussian(x64: None) -> None:
    mixture = device(Mixture(np.array([3.0]), np.array([[1.0, -2.0]]), np.log([[0.5, 2.0]])))
    assert log_prob(mixture, [1.5, 0.0]) == pytest.approx(
        stats.norm.logpdf(1.5, 1, 0.5) + stats.norm.logpdf(0, -2, 2), rel=1e-12
    )
    np.testing.assert_allclose(mean(mixture), [1, -2])
    np.testing.assert_allclose(mode(mixture), [1, -2])
    np.testing.assert_allclose(variance(mixture), [0.25, 4])
    low, high = interval(mixture, 0.9973)
    half = stats.norm.isf((1 - 0.9973) / 2)
    np.testing.assert_allclose(low, [1 - 0.5 * half, -2 - 2 * half], rtol=1e-12)
    np.testing.assert_allclose(high, [1 + 0.5 * half, -2 + 2 * half], rtol=1e-12)
    # Gneiting and Raftery (2007), equation 21: sigma (z (2 Phi(z) - 1) + 2 phi(z) - 1 / sqrt(pi)).
    z = 0.7
    expected = 2 * (z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - 1 / np.sqrt(np.pi))
    assert crps(mixture, [1.0, -2.0 + 2.0 * z])[1] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("function", [log_prob, covariance, mode], ids=lambda f: f.__name__)
def test_couplings_agree_with_one_component(function: Callable, x64: None) -> None:
    mixture = device(random_mixture(components=1))
    arguments = (random_value(),) if function is log_prob else ()
    independent, joint = (function(mixture, *arguments, coupling=coupling) for coupling in COUPLINGS)
    np.testing.assert_allclose(independent, joint, rtol=1e-12)


def test_couplings_share_marginals_and_differ_together(x64: None) -> None:
    """Two components on a diagonal: joint puts no mass on the other diagonal, independent as much as on this one."""
    mixture = device(Mixture(np.zeros(2), np.array([[-5.0, -5.0], [5.0, 5.0]]), np.zeros((2, 2))))
    on, off = jnp.array([5.0, 5.0]), jnp.array([5.0, -5.0])
    np.testing.assert_allclose(log_prob(mixture, on), log_prob(mixture, off), rtol=1e-12)
    assert log_prob(mixture, on, coupling="joint") > log_prob(mixture, off, coupling="joint") + 40
    assert covariance(mixture)[0, 1] == 0
    np.testing.assert_allclose(covariance(mixture, coupling="joint"), [[26, 25], [25, 26]], rtol=1e-12)


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_density_integrates_to_one(coupling: str, x64: None) -> None:
    rng = np.random.default_rng(3)
    mixture = device(Mixture(rng.normal(size=3), rng.normal(size=(3, 2)), rng.uniform(-1, 0, size=(3, 2))))
    axis = np.linspace(-9, 9, 400)
    points = jnp.stack(jnp.meshgrid(axis, axis), axis=-1)
    density = jnp.exp(jax.vmap(jax.vmap(lambda y: log_prob(mixture, y, coupling=coupling)))(points))
    assert float(density.sum()) * (axis[1] - axis[0]) ** 2 == pytest.approx(1, abs=1e-9)


# The loss.


def test_reductions(x64: None) -> None:
    mixture, value = device(random_mixture()), random_value()
    log_likelihood = reference_log_prob(mixture, value, "independent")
    np.testing.assert_allclose(nll(mixture, value, reduction="none"), -log_likelihood, rtol=1e-12)
    np.testing.assert_allclose(nll(mixture, value), -log_likelihood.mean(), rtol=1e-12)
    # Equations 6 and 7, as printed.
    windows = -np.log(np.exp(log_likelihood).mean(-1))
    np.testing.assert_allclose(nll(mixture, value, reduction="sequence"), windows.mean(), rtol=1e-12)
    joint = reference_log_prob(mixture, value, "joint")
    np.testing.assert_allclose(nll(mixture, value, coupling="joint"), -joint.mean(), rtol=1e-12)


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.parametrize("reduction", ["mean", "sequence", "none"])
def test_masked_steps_count_for_nothing(reduction: str, coupling: str, x64: None) -> None:
    """Whatever a masked step holds, NaN included, the loss is that of the steps that are left, and so is its slope."""
    mixture, value = random_mixture(), random_value()
    mask = np.array([[True, False, True], [False, False, False]])
    dirty = Mixture(*(np.where(mask.reshape(mask.shape + (1,) * (f.ndim - 2)), f, np.nan) for f in mixture))
    dirty_value = np.where(mask[..., None], value, np.inf)

    def loss(mixture: Mixture, value: jax.Array) -> jax.Array:
        return nll(mixture, value, mask=mask, reduction=reduction, coupling=coupling).sum()

    def loss_of_the_rest(mixture: Mixture, value: jax.Array) -> jax.Array:
        kept = Mixture(*(field[0, ::2] for field in mixture))
        return nll(kept, value[0, ::2], reduction=reduction, coupling=coupling).sum()

    found, found_slope = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))(device(dirty), jnp.asarray(dirty_value))
    expected, slope = jax.jit(jax.value_and_grad(loss_of_the_rest, argnums=(0, 1)))(device(mixture), jnp.asarray(value))
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), found_slope, slope)


@pytest.mark.parametrize("reduction", ["mean", "sequence", "none"])
def test_all_masked_is_zero_with_zero_gradient(reduction: str) -> None:
    mixture = Mixture(*(jnp.full(f.shape, jnp.nan) for f in random_mixture()))

    @jax.jit
    def loss(mixture: Mixture) -> jax.Array:
        mask = jnp.zeros(BATCH, bool)
        return nll(mixture, random_value(), mask=mask, reduction=reduction).sum()

    value, slope = jax.value_and_grad(loss)(mixture)
    assert value == 0
    assert all((field == 0).all() for field in slope)


def test_sequence_of_tiny_likelihoods() -> None:
    """Log-likelihoods near -1e8, whose exponentials are zero in any precision."""
    mixture = Mixture(jnp.zeros((1, 4, 1)), jnp.zeros((1, 4, 1, 1)), jnp.zeros((1, 4, 1, 1)))
    value = jnp.full((1, 4, 1), 1.4142136e4)
    found, slope = jax.jit(jax.value_and_grad(lambda m: nll(m, value, reduction="sequence")))(mixture)
    np.testing.assert_allclose(found, 1e8, rtol=1e-5)
    np.testing.assert_allclose(slope.mean, np.full((1, 4, 1, 1), -1.4142136e4 / 4), rtol=1e-5)


# Extremes: value and gradient of everything, in float32. Six cases, one a row.

EXTREMES = Mixture(
    logits=np.array(
        [[0, 1e4, -1e4], [0, -np.inf, -np.inf], [0, -np.inf, 1], [0, 0, 0], [-1e4, 0, 0], [0, 0, -np.inf]], np.float32
    ),
    mean=np.array(
        [
            [[0, 0], [1, 1], [2, 2]],
            # The two of weight zero are where the value is.
            [[0, 0], [1e4, 1e4], [1e4, 1e4]],
            [[-1e4, 1e4], [0, 0], [1e4, -1e4]],
            # Far apart and equally likely: quantiles fall into the gaps.
            [[-1e4, -1e4], [0, 0], [1e4, 1e4]],
            # At the floor of the scale, 1e4 sigma from the value.
            [[0, 0], [0, 0], [1e-8, 0]],
            [[-1e4, 1e4], [1e4, -1e4], [0, 0]],
        ],
        np.float32,
    ),
    log_scale=np.log(np.array([1, 1, 1, 1, 1e-8, 1], np.float32))[:, None, None] * np.ones((1, 3, 2), np.float32),
)
EXTREME_VALUES = np.array([[1e4, -1e4], [1e4, 1e4], [0, 0], [1e4, -1e4], [1e-4, -1e-4], [0, 1e4]], np.float32)


# M = 1 has less to go wrong: only what treats components against each other.
@pytest.mark.parametrize(
    ("components", "names"),
    [(3, tuple(PUBLIC)), (1, ("nll sequence", "covariance joint", "strongest", "mode", "quantile", "sample", "crps"))],
    ids=["3", "1"],
)
def test_extremes_have_finite_values_and_gradients(components: int, names: tuple[str, ...]) -> None:
    logits, centre, log_scale = (field[:, :components] for field in EXTREMES)
    log_scale = np.broadcast_to(log_scale, centre.shape)
    mixture = Mixture(*(field.reshape(*BATCH, *field.shape[1:]) for field in (logits, centre, log_scale)))
    value = EXTREME_VALUES.reshape(*BATCH, 2)

    def total(names: Iterable[str], *arguments: object) -> tuple[jax.Array, dict[str, object]]:
        outputs = several(names)(*arguments)
        return sum(leaf.sum() for leaf in jax.tree.leaves(outputs)), outputs

    def slope(names: Iterable[str]) -> tuple[object, dict[str, object]]:
        return jax.jit(jax.grad(partial(total, names), argnums=(0, 1), has_aux=True))(mixture, value)

    slopes, outputs = slope(names)
    for name, output in outputs.items():
        assert is_finite(output), name
    # What is not finite in one gradient is not in their sum; only then is it worth the time to ask which.
    assert is_finite(slopes), [name for name in names if not is_finite(slope([name])[0])]


def is_finite(tree: object) -> bool:
    return all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))


def test_slope_of_a_quantile_between_spikes_is_finite() -> None:
    """Scales below the spacing of float32 at the means: the density at the nearest number may be zero."""
    rng = np.random.default_rng(0)
    spikes = Mixture(rng.normal(size=(200, 2)), rng.uniform(50, 150, (200, 2, 1)), np.log(np.full((200, 2, 1), 1e-7)))
    probability = np.array([0.1, 0.3, 0.5, 0.7, 0.9])[:, None, None]
    slope = jax.jit(jax.grad(lambda m: mx.quantile(m, probability).sum()))(device(spikes, "float32"))
    assert is_finite(slope)


def test_a_component_of_weight_zero_is_as_good_as_absent() -> None:
    mixture, value = random_mixture(), random_value()
    never = device(mixture._replace(logits=np.where(np.arange(COMPONENTS) == 1, -np.inf, mixture.logits)))
    without = Mixture(*(np.delete(field, 1, axis=len(BATCH)) for field in mixture))
    found = everything(never, jnp.asarray(value))
    for name, reference in REFERENCES.items():
        np.testing.assert_allclose(found[name], reference(without, value), rtol=2e-5, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(found["mode"], mode(device(without)), rtol=1e-5, atol=1e-5)
    slope = jax.jit(jax.grad(lambda m: sum(mx.nll(m, value, coupling=coupling) for coupling in COUPLINGS)))(never)
    assert (slope.logits[..., 1] == 0).all()
    assert (slope.mean[..., 1, :] == 0).all()


def test_gradients_against_finite_differences(x64: None) -> None:
    """Along a random direction, where it is not just arithmetic; reverse mode is the transpose of what is tested."""
    function = several(("nll sequence", "covariance joint", "mode", "cdf", "quantile", "crps"))
    mixture, value = device(random_mixture()), jnp.asarray(random_value())
    direction = (device(random_mixture(8)), jnp.asarray(random_value(9)))
    _, slopes = jax.jit(lambda *point: jax.jvp(function, point, direction))(mixture, value)
    step = 1e-5

    def moved(step: float) -> dict[str, object]:
        return everything(*jax.tree.map(lambda x, d: x + step * d, (mixture, value), direction))

    ahead, behind = moved(step), moved(-step)
    for name in slopes:
        leaves = map(jax.tree.leaves, (slopes[name], ahead[name], behind[name]))
        for slope, up, down in zip(*leaves, strict=True):
            np.testing.assert_allclose(slope, (up - down) / (2 * step), rtol=1e-6, atol=1e-6, err_msg=name)


def plain_joint(mixture: Mixture, value: jax.Array) -> jax.Array:
    """The definition, differentiated by JAX alone."""
    squares = ((value[..., None, :] - mixture.mean) / jnp.exp(mixture.log_scale)) ** 2
    log_normal = -0.5 * (squares + np.log(2 * np.pi)) - mixture.log_scale
    return jax.nn.logsumexp(jax.nn.log_softmax(mixture.logits) + log_normal.sum(-1), axis=-1)


def test_slopes_of_the_joint_density_are_those_of_its_definition(x64: None) -> None:
    """In both modes, once and twice, under vmap."""
    mixture, value = device(random_mixture()), jnp.asarray(random_value())
    direction = (device(random_mixture(8)), jnp.asarray(random_value(9)))

    def slopes(density: Callable) -> list[jax.Array]:
        def total(*point: object) -> jax.Array:
            return jnp.sin(density(*point)).sum()

        reverse = jax.grad(total, argnums=(0, 1))
        forward_of_reverse = jax.jvp(reverse, (mixture, value), direction)
        mapped = jax.vmap(jax.vmap(jax.grad(density, argnums=(0, 1))))(mixture, value)
        return jax.tree.leaves((jax.jvp(density, (mixture, value), direction), forward_of_reverse, mapped))

    found = jax.jit(lambda: slopes(partial(mx.log_prob, coupling="joint")))()
    for ours, exact in zip(found, jax.jit(lambda: slopes(plain_joint))(), strict=True):
        np.testing.assert_allclose(ours, exact, rtol=1e-10, atol=1e-12)


def test_slope_beyond_the_largest_square_is_finite() -> None:
    """1e25 sigma from a component: the square of the residual is infinite, the weight of the component zero."""
    mixture = Mixture(jnp.zeros(2), jnp.array([[0.0, 0.0], [1e25, 0.0]]), jnp.zeros((2, 2)))
    value = jnp.array([0.5, 0.0])
    found = jax.jit(jax.grad(lambda m, y: mx.nll(m, y, coupling="joint"), argnums=(0, 1)))(mixture, value)
    np.testing.assert_allclose(found[0].mean, [[-0.5, 0], [0, 0]])
    np.testing.assert_allclose(found[0].log_scale, [[0.75, 1], [0, 0]])
    np.testing.assert_allclose(found[1], [0.5, 0])


@pytest.mark.parametrize("platform", ["cpu", "cuda", "tpu"])
def test_only_a_processor_adds_up_dimensions_by_a_product(platform: str) -> None:
    """A TPU would round it, or make NaN of an infinite term; nor is there a product in the gradient."""
    loss = jax.jit(jax.value_and_grad(partial(mx.nll, coupling="joint"), argnums=(0, 1)))
    lowered = loss.trace(GOOD, GOOD_VALUE).lower(lowering_platforms=(platform,))
    assert ("dot_general" in lowered.as_text()) == (platform == "cpu")


@pytest.mark.parametrize("compiled", [True, False], ids=["jit", "eager"])
def test_an_infinite_residual_has_density_zero(compiled: bool) -> None:
    density = partial(mx.log_prob, coupling="joint")
    density = jax.jit(density) if compiled else density
    far = GOOD_VALUE.at[0, 0, 0].set(jnp.inf).at[1, 2, 1].set(-jnp.inf)
    expected = np.asarray(log_prob(GOOD, GOOD_VALUE, coupling="joint")).copy()
    expected[0, 0] = expected[1, 2] = -np.inf
    np.testing.assert_allclose(density(GOOD, far), expected, rtol=1e-6)


def test_slope_of_the_quantile_is_one_over_the_density(x64: None) -> None:
    mixture = device(random_mixture(batch=(), components=3))
    for probability in (0.01, 0.8):
        point, slope = jax.jvp(lambda p: quantile(mixture, p), (probability,), (1.0,))
        marginals = Mixture(jnp.zeros((DIMENSIONS, 3)) + mixture.logits, *(f.T[..., None] for f in mixture[1:]))
        np.testing.assert_allclose(slope, jnp.exp(-log_prob(marginals, point[:, None])), rtol=1e-9)


# Distribution functions.


def test_quantile_in_float32_is_accurate_relative_to_sigma() -> None:
    probability = np.linspace(0.001, 0.999, 999, dtype=np.float32)
    standard = Mixture(jnp.zeros(1), jnp.zeros((1, 1)), jnp.zeros((1, 1)))
    found = quantile(standard, probability[:, None])[:, 0]
    np.testing.assert_allclose(found, stats.norm.ppf(probability.astype(np.float64)), rtol=0, atol=1e-6)
    # Components at the same mean, so that the spacing of float32 around the quantile is not what is measured.
    pair = Mixture(np.array([0.5, -0.3]), np.zeros((2, 3)), np.log([[1, 2, 0.3], [1.5, 0.7, 0.3]]))
    for p in (1e-5, 0.2, 0.7):
        p = float(np.float32(p))
        np.testing.assert_allclose(
            quantile(device(pair, "float32"), p), reference_quantile(pair, p), rtol=1e-6, atol=1e-6
        )


def test_quantile_at_and_beyond_the_ends() -> None:
    mixture = device(random_mixture(batch=()))
    points, slope_of = jax.vjp(lambda m: quantile(m, np.array([0, 1, -0.1, 1.1, np.nan])[:, None]), mixture)
    np.testing.assert_array_equal(points, np.array([-np.inf, np.inf, np.nan, np.nan, np.nan])[:, None] * np.ones(3))
    (slope,) = slope_of(jnp.ones_like(points))
    assert all((field == 0).all() for field in slope)
    low, high = interval(mixture, 1.0)
    assert (low == -jnp.inf).all()
    assert (high == jnp.inf).all()


def test_probability_broadcasts_as_documented() -> None:
    mixture = device(random_mixture())
    both = quantile(mixture, jnp.array([0.1, 0.6]).reshape(2, 1, 1, 1))
    assert both.shape == (2, *BATCH, DIMENSIONS)
    by_dimension = quantile(mixture, jnp.array([0.1, 0.6, 0.1]))
    np.testing.assert_allclose(by_dimension[..., 1], both[1, ..., 1], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(by_dimension[..., 2], both[0, ..., 2], rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match="shapes"):
        quantile(mixture, jnp.full(5, 0.5))


def test_cdf_is_never_above_one() -> None:
    """Though weights add up to more in float32, a little, for a good part of these mixtures."""
    rng = np.random.default_rng(0)
    mixture = Mixture(rng.normal(size=(1000, 7)), np.zeros((1000, 7, 1)), np.zeros((1000, 7, 1)))
    assert (cdf(device(mixture, "float32"), jnp.full((1000, 1), 50.0)) == 1).all()


FLOATS = st.floats(-3, 3, width=32)


def arrays(*shape: int) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(np.float32, shape, elements=FLOATS)


MIXTURES = st.builds(Mixture, arrays(3), arrays(3, 2), arrays(3, 2))
PROPERTY = hypothesis.settings(max_examples=40, deadline=None, derandomize=True)


@PROPERTY
@hypothesis.given(MIXTURES, arrays(2), st.floats(0.001, 10))
def test_cdf_is_monotone_and_within_bounds(mixture: Mixture, value: np.ndarray, step: float) -> None:
    here, there = cdf(mixture, value), cdf(mixture, value + np.float32(step))
    assert (here >= 0).all()
    assert (there <= 1).all()
    assert (there >= here - 2e-7).all()


@PROPERTY
@hypothesis.given(MIXTURES, st.floats(1e-4, 1 - 1e-4))
def test_quantile_inverts_cdf(mixture: Mixture, probability: float) -> None:
    with jax.enable_x64(True):
        double = device(mixture, "float64")
        np.testing.assert_allclose(cdf(double, quantile(double, probability)), probability, rtol=1e-11)


@PROPERTY
@hypothesis.given(MIXTURES, arrays(2), st.permutations(range(3)))
def test_order_of_components_does_not_matter(mixture: Mixture, value: np.ndarray, order: list[int]) -> None:
    permuted = Mixture(*(field[order] for field in mixture))
    for function in (log_prob, lambda m, y: log_prob(m, y, coupling="joint"), crps, cdf):
        np.testing.assert_allclose(function(mixture, value), function(permuted, value), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(mean(mixture), mean(permuted), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(variance(mixture), variance(permuted), rtol=1e-5)


@PROPERTY
@hypothesis.given(MIXTURES, arrays(2), hnp.arrays(np.float32, 2, elements=st.floats(0.0625, 16, width=32)), arrays(2))
def test_affine_changes_units(mixture: Mixture, value: np.ndarray, scale: np.ndarray, shift: np.ndarray) -> None:
    with jax.enable_x64(True):
        original = device(mixture, "float64")
        scale, shift, value = (array.astype(np.float64) for array in (scale, shift, value))
        moved, moved_value = affine(original, scale, shift), value * scale + shift
        close = {"rtol": 1e-9, "atol": 1e-9}
        for coupling in COUPLINGS:
            found = log_prob(moved, moved_value, coupling=coupling)
            expected = log_prob(original, value, coupling=coupling) - np.log(scale).sum()
            np.testing.assert_allclose(found, expected, **close)
        np.testing.assert_allclose(mean(moved), mean(original) * scale + shift, **close)
        np.testing.assert_allclose(variance(moved), variance(original) * scale**2, **close)
        np.testing.assert_allclose(cdf(moved, moved_value), cdf(original, value), **close)
        np.testing.assert_allclose(crps(moved, moved_value), crps(original, value) * scale, **close)
        np.testing.assert_allclose(quantile(moved, 0.2), quantile(original, 0.2) * scale + shift, **close)


def test_widening_multiplies_the_deviation_about_the_mean(x64: None) -> None:
    """By hand: weights 1/4 and 3/4 at -1 and 1 with sigma 1 and 2 have mean 1/2 and variance 3.25 + 0.75 = 4."""
    two = Mixture(np.log([0.25, 0.75]), np.array([[-1.0], [1.0]]), np.log([[1.0], [2.0]]))
    found = widen(two, np.array([3.0]))
    np.testing.assert_allclose(mean(found), [0.5], rtol=1e-12)
    np.testing.assert_allclose(variance(found), [36.0], rtol=1e-12)
    np.testing.assert_array_equal(found.logits, two.logits)
    np.testing.assert_allclose(found.mean, [[0.5 - 4.5], [0.5 + 1.5]], rtol=1e-12)
    np.testing.assert_allclose(np.exp(found.log_scale), [[3.0], [6.0]], rtol=1e-12)


def test_noise_adds_its_variance_to_every_component(x64: None) -> None:
    """By hand: 3, 4 make 5, and 12, 5 make 13; the density is the integral of the product of the two."""
    two = Mixture(np.log([0.25, 0.75]), np.array([[-1.0, 0.0], [1.0, 2.0]]), np.log([[3.0, 12.0], [3.0, 12.0]]))
    sigma, value = np.array([4.0, 5.0]), np.array([0.5, -3.0])
    found = add_noise(two, sigma)
    np.testing.assert_allclose(np.exp(found.log_scale), [[5.0, 13.0]] * 2, rtol=1e-12)
    np.testing.assert_array_equal(found.mean, two.mean)
    np.testing.assert_array_equal(found.logits, two.logits)
    noise = np.linspace(-10, 10, 401) * sigma[:, None]
    weight = np.exp(-((noise / sigma[:, None]) ** 2) / 2) * 0.05 / np.sqrt(2 * np.pi)
    grid = value - np.stack(np.meshgrid(*noise, indexing="ij"), -1)
    for coupling in COUPLINGS:
        density = np.exp(jax.vmap(jax.vmap(lambda y, c=coupling: mx.log_prob(two, y, coupling=c)))(grid))
        expected = np.einsum("i,j,ij->", *weight, density)
        np.testing.assert_allclose(np.exp(log_prob(found, value, coupling=coupling)), expected, rtol=1e-9)


def test_no_noise_changes_no_bit_and_any_has_finite_gradients() -> None:
    mixture = device(random_mixture(), "float32")
    nothing = jnp.zeros(DIMENSIONS)
    for before, after in zip(mixture, add_noise(mixture, nothing), strict=True):
        np.testing.assert_array_equal(after, before)

    def total(log_scale: jax.Array, sigma: jax.Array) -> jax.Array:
        return mx.add_noise(mixture._replace(log_scale=log_scale), sigma).log_scale.sum()

    for sigma in (nothing, jnp.full(DIMENSIONS, 1e-30), jnp.full(DIMENSIONS, 1e30), jnp.array([0.0, 1.0, 0.0])):
        by_log_scale, by_sigma = jax.grad(total, argnums=(0, 1))(mixture.log_scale, sigma)
        assert np.isfinite(by_log_scale).all() and np.isfinite(by_sigma).all()
    by_log_scale, by_sigma = jax.grad(total, argnums=(0, 1))(mixture.log_scale, nothing)
    np.testing.assert_array_equal(by_log_scale, 1)
    np.testing.assert_array_equal(by_sigma, 0)


def test_widening_is_by_dimension_and_keeps_the_shape(x64: None) -> None:
    mixture, value, factor = random_mixture(), random_value(), np.array([0.25, 1.0, 8.0])
    original, found = device(mixture), widen(device(mixture), factor)
    centre = reference_mean(mixture)
    moved_value = centre + factor * (value - centre)
    np.testing.assert_allclose(mean(found), centre, rtol=1e-12)
    for coupling in COUPLINGS:
        scaled = covariance(original, coupling=coupling) * np.outer(factor, factor)
        np.testing.assert_allclose(covariance(found, coupling=coupling), scaled, rtol=1e-10, atol=1e-10)
        # The density of what is wider is lower by the Jacobian.
        expected = log_prob(original, value, coupling=coupling) - np.log(factor).sum()
        np.testing.assert_allclose(log_prob(found, moved_value, coupling=coupling), expected, rtol=1e-10)
    np.testing.assert_allclose(cdf(found, moved_value), cdf(original, value), rtol=1e-10)


def test_a_pool_has_the_mean_of_the_densities(x64: None) -> None:
    """By hand, then whatever the numbers of components: 0 and 2 with sigma 1 have mean 1 and variance 1 + 1 = 2."""
    one = Mixture(np.array([7.0]), np.array([[0.0]]), np.array([[0.0]]))
    both = pool([one, one._replace(logits=np.array([-3.0]), mean=np.array([[2.0]]))])
    np.testing.assert_allclose(mean(both), [1.0], rtol=1e-12)
    np.testing.assert_allclose(variance(both), [2.0], rtol=1e-12)

    parts, value = [random_mixture(seed, components=seed + 1) for seed in range(3)], random_value()
    found = pool(parts)
    assert found.logits.shape == (*BATCH, 1 + 2 + 3)
    densities = np.exp([log_prob(device(part), value, coupling="joint") for part in parts])
    np.testing.assert_allclose(np.exp(log_prob(found, value, coupling="joint")), densities.mean(0), rtol=1e-12)
    for function in (mean, lambda part: cdf(part, value)):
        np.testing.assert_allclose(function(found), np.mean([function(part) for part in parts], axis=0), rtol=1e-12)
    spread = np.var([mean(part) for part in parts], axis=0)
    np.testing.assert_allclose(variance(found), np.mean([variance(part) for part in parts], 0) + spread, rtol=1e-12)
    np.testing.assert_allclose(log_prob(pool(parts[2:]), value), log_prob(parts[2], value), rtol=1e-12)


def test_a_pool_of_extremes_is_finite_and_so_are_its_gradients() -> None:
    def total(logits: jax.Array) -> jax.Array:
        parts = [Mixture(row, jnp.array([[0.0], [1e4]]), jnp.array([[-9.0], [9.0]])) for row in logits]
        return mx.log_prob(mx.pool(parts), jnp.array([3.0]))

    logits = jnp.array([[0.0, -jnp.inf], [1e4, -1e4], [-1e30, 1e30]])
    value, gradient = jax.value_and_grad(total)(logits)
    assert np.isfinite(value) and np.isfinite(gradient).all()
    # The last part is all in its second component, which alone reaches 3; it is a third of the whole.
    expected = stats.norm.logpdf(3, 1e4, np.exp(9)) - np.log(3)
    np.testing.assert_allclose(value, expected, rtol=1e-5)


@PROPERTY
@hypothesis.given(MIXTURES, arrays(2))
def test_mode_is_the_highest_point(mixture: Mixture, value: np.ndarray) -> None:
    top = mode(mixture)
    assert log_prob(mixture, top) >= log_prob(mixture, value) - 1e-4
    grid = np.linspace(-4, 4, 801, dtype=np.float32)
    points = jnp.stack([grid, grid], axis=-1)
    density = jax.vmap(lambda y: log_prob(Mixture(mixture.logits, mixture.mean[:, :1], mixture.log_scale[:, :1]), y))
    assert density(top[:1][None])[0] >= density(points[:, :1]).max() - 1e-4


def test_mode_of_joint_dimensions_is_of_the_vector(x64: None) -> None:
    """The strongest by dimension need not be the strongest together."""
    mixture = device(
        Mixture(np.log([0.4, 0.3, 0.3]), np.array([[9.0, 9.0], [0.0, -0.5], [0.3, 0.5]]), np.zeros((3, 2)))
    )
    joint = mode(mixture, coupling="joint")
    slope = jax.grad(lambda y: log_prob(mixture, y, coupling="joint"))(joint)
    np.testing.assert_allclose(slope, 0, atol=1e-9)
    axis = np.linspace(-2, 11, 261)
    points = jnp.stack(jnp.meshgrid(axis, axis), axis=-1)
    density = jax.vmap(jax.vmap(lambda y: log_prob(mixture, y, coupling="joint")))(points)
    assert log_prob(mixture, joint, coupling="joint") >= density.max()


def test_mode_leaves_a_strong_wide_component_for_a_narrow_one() -> None:
    """Weight is not height: 0.9 of the mass in a wide component is lower than 0.1 in one a hundred times narrower."""
    mixture = device(Mixture(np.log([0.9, 0.1]), np.array([[0.0], [5.0]]), np.log([[1.0], [0.01]])), "float32")
    np.testing.assert_allclose(mode(mixture), [5.0], atol=1e-4)
    assert strongest(mixture).mean[0, 0] == 0


def test_interval_holds_its_coverage_with_equal_tails(x64: None) -> None:
    mixture = device(random_mixture())
    low, high = interval(mixture, 0.8)
    np.testing.assert_allclose(cdf(mixture, low), 0.1, rtol=1e-11)
    np.testing.assert_allclose(cdf(mixture, high), 0.9, rtol=1e-11)


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_samples_have_the_moments_and_the_distribution(coupling: str) -> None:
    mixture = device(random_mixture(seed=5), "float32")
    count = 40_000
    drawn = jax.jit(lambda m: sample(m, jax.random.key(1), (2, count // 2), coupling=coupling))(mixture)
    assert drawn.shape == (2, count // 2, *BATCH, DIMENSIONS)
    drawn = np.asarray(drawn, np.float64).reshape(count, *BATCH, DIMENSIONS)
    deviation = np.sqrt(variance(mixture))
    # Five standard errors of a mean; a covariance's error is bounded by that of heavier tails.
    np.testing.assert_array_less(np.abs(drawn.mean(0) - mean(mixture)), 5 * deviation / np.sqrt(count))
    for index in np.ndindex(*BATCH):
        found = np.cov(drawn[(slice(None), *index)].T)
        scale = deviation[index][:, None] * deviation[index]
        np.testing.assert_allclose(found / scale, covariance(mixture, coupling=coupling)[index] / scale, atol=0.05)
    point = quantile(mixture, 0.3)
    np.testing.assert_allclose((drawn < point).mean(0), 0.3, atol=5 * np.sqrt(0.3 * 0.7 / count))


def test_samples_do_not_reuse_randomness() -> None:
    mixture = device(random_mixture(seed=5), "float32")
    a, b = (sample(mixture, jax.random.key(seed)) for seed in (0, 1))
    assert (a != b).all()
    # Equal parameters in every batch entry still give different draws.
    same = Mixture(jnp.zeros((4, 1)), jnp.zeros((4, 1, 1)), jnp.zeros((4, 1, 1)))
    assert len(set(sample(same, jax.random.key(0)).ravel().tolist())) == 4


def test_choice_and_noise_are_independent() -> None:
    far = Mixture(jnp.zeros(2), jnp.array([[-100.0], [100.0]]), jnp.zeros((2, 1)))
    drawn = np.asarray(jax.jit(jax.vmap(lambda key: mx.sample(far, key)))(jax.random.split(jax.random.key(0), 4000)))
    side = np.sign(drawn)
    assert abs((side * (drawn - 100 * side)).mean()) < 5 / np.sqrt(4000)


def test_strongest_keeps_the_heaviest_component() -> None:
    mixture = device(random_mixture(), "float32")
    found = strongest(mixture)
    assert found.logits.shape == (*BATCH, 1)
    for index in np.ndindex(*BATCH):
        heaviest = int(np.argmax(mixture.logits[index]))
        np.testing.assert_array_equal(found.mean[index][0], mixture.mean[index][heaviest])
        np.testing.assert_array_equal(found.log_scale[index][0], mixture.log_scale[index][heaviest])


# Network outputs.


def test_from_network_reads_logits_then_means_then_scales() -> None:
    outputs = jnp.arange(3 + 2 * 3 * 2, dtype=jnp.float32) + jnp.zeros((4, 1))
    found = mx.from_network(outputs, 3, dimensions=2, floor=1e-30)
    assert outputs.shape[-1] == mx.outputs_size(3, 2)
    assert mx.outputs_size(5) == 65
    np.testing.assert_array_equal(found.logits[0], [0, 1, 2])
    np.testing.assert_array_equal(found.mean[0], [[3, 4], [5, 6], [7, 8]])
    np.testing.assert_allclose(found.log_scale[0], [[9, 10], [11, 12], [13, 14]], rtol=1e-6)


def test_scale_is_the_floor_plus_an_exponential() -> None:
    floor = jnp.array([0.5, 2.0])
    outputs = jnp.concatenate([jnp.zeros((3, 3)), jnp.array([[-1e4, -1e4], [0.0, 1.0], [50.0, 50.0]])], axis=-1)
    log_scale = mx.from_network(outputs, 1, dimensions=2, floor=floor).log_scale[:, 0]
    np.testing.assert_allclose(jnp.exp(log_scale[0]), floor, rtol=1e-6)
    np.testing.assert_allclose(jnp.exp(log_scale[1]), [1.5, 2 + np.e], rtol=1e-6)
    np.testing.assert_allclose(log_scale[2], 50, rtol=1e-6)
    value = jnp.full((3, 2), 1e4)
    slope = jax.jit(jax.grad(lambda x: mx.nll(mx.from_network(x, 1, dimensions=2, floor=floor), value)))(outputs)
    assert jnp.isfinite(slope).all()


# Types, transformations, mistakes, cost.


def test_short_floats_are_computed_in_float32() -> None:
    for dtype in ("bfloat16", "float16"):
        mixture, value = device(random_mixture(), dtype), jnp.asarray(random_value(), dtype)
        for leaf in jax.tree.leaves(jax.eval_shape(everything, mixture, value)):
            assert leaf.dtype == jnp.float32
        exact = log_prob(device(mixture, "float32"), value.astype("float32"))
        np.testing.assert_allclose(log_prob(mixture, value), exact, rtol=1e-6)
        outputs = jnp.ones(mx.outputs_size(2, 1), dtype)
        assert mx.from_network(outputs, 2, dimensions=1, floor=0.1).log_scale.dtype == jnp.float32


def test_vmap_equals_the_batch() -> None:
    mixture, value = device(random_mixture()), jnp.asarray(random_value())
    names = ("nll", "covariance joint", "mode joint", "interval", "crps")

    @jax.jit
    def mapped(mixture: Mixture, value: jax.Array) -> dict[str, object]:
        return {name: jax.vmap(PUBLIC[name])(mixture, value) for name in names}

    found, whole = mapped(mixture, value), everything(mixture, value)
    np.testing.assert_allclose(found.pop("nll").mean(), whole["nll"], rtol=1e-5)
    for name, output in found.items():
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), output, whole[name])


GOOD = device(random_mixture(), "float32")
GOOD_VALUE = jnp.asarray(random_value(), "float32")
MISTAKES: dict[str, tuple[Callable[[], object], str]] = {
    "value without batch": (lambda: mx.log_prob(GOOD, GOOD_VALUE[0, 0]), r"\(3,\); expected \(2, 3, 3\)"),
    "value with axis of one": (lambda: mx.log_prob(GOOD, GOOD_VALUE[:, :1]), r"\(2, 1, 3\); expected \(2, 3, 3\)"),
    "value with more batch": (lambda: mx.log_prob(GOOD, GOOD_VALUE[None]), "expected"),
    "scalar value": (lambda: mx.cdf(GOOD, 0.0), r"\(\); expected \(2, 3, 3\)"),
    "value of one dimension": (lambda: mx.crps(GOOD, GOOD_VALUE[..., :1]), "expected"),
    "nll value": (lambda: mx.nll(GOOD, GOOD_VALUE[0]), "expected"),
    "scale of another shape": (lambda: mx.mean(GOOD._replace(log_scale=GOOD.log_scale[..., :1])), "expected"),
    "logits of another batch": (lambda: mx.variance(GOOD._replace(logits=GOOD.logits[0])), "expected"),
    "logits of another M": (lambda: mx.mode(GOOD._replace(logits=GOOD.logits[..., :1])), "expected"),
    "scalar fields": (lambda: mx.mean(Mixture(*map(jnp.asarray, (0.0, 0.0, 0.0)))), "expected"),
    "coupling": (lambda: mx.log_prob(GOOD, GOOD_VALUE, coupling="both"), "'both'; expected 'independent'"),
    "coupling of covariance": (lambda: mx.covariance(GOOD, coupling=""), "expected 'independent'"),
    "coupling of sample": (lambda: mx.sample(GOOD, KEY, coupling=""), "expected 'independent'"),
    "coupling of mode": (lambda: mx.mode(GOOD, coupling=""), "expected 'independent'"),
    "reduction": (lambda: mx.nll(GOOD, GOOD_VALUE, reduction="sum"), "'sum'; expected 'mean', 'sequence' or 'none'"),
    "mask of another shape": (lambda: mx.nll(GOOD, GOOD_VALUE, mask=jnp.ones(3, bool)), r"\(3,\); expected bool"),
    "mask of numbers": (lambda: mx.nll(GOOD, GOOD_VALUE, mask=jnp.ones(BATCH)), "float32.*expected bool"),
    "sequence of a single step": (
        lambda: mx.nll(Mixture(*(f[0, 0] for f in GOOD)), GOOD_VALUE[0, 0], reduction="sequence"),
        "single step; expected",
    ),
    "affine shape": (lambda: mx.affine(GOOD, jnp.ones(1), jnp.zeros(3)), r"\(1,\) and \(3,\); expected \(3,\)"),
    "affine sign": (lambda: mx.affine(GOOD, jnp.array([1.0, 0, 1]), jnp.zeros(3)), "expected positive"),
    "widen shape": (lambda: mx.widen(GOOD, jnp.ones(2)), r"factor has shape \(2,\); expected \(3,\)"),
    "widen scalar": (lambda: mx.widen(GOOD, 2.0), r"factor has shape \(\); expected \(3,\)"),
    "widen batch": (lambda: mx.widen(GOOD, jnp.ones((2, 3, 3))), r"\(2, 3, 3\); expected \(3,\)"),
    "widen sign": (lambda: mx.widen(GOOD, jnp.array([1.0, -1, 1])), "factor is .*expected positive"),
    "noise shape": (lambda: mx.add_noise(GOOD, 0.1), r"sigma has shape \(\); expected \(3,\)"),
    "noise sign": (lambda: mx.add_noise(GOOD, jnp.array([1.0, -1, 0])), "sigma is .*expected numbers of 0 or more"),
    "noise of no number": (lambda: mx.add_noise(GOOD, jnp.array([1.0, jnp.nan, 0])), "expected numbers of 0 or more"),
    "pool of nothing": (lambda: mx.pool([]), r"\[\]; expected one or more"),
    "pool of two batches": (
        lambda: mx.pool([GOOD, Mixture(*(field[0] for field in GOOD))]),
        r"\[\(\(2, 3\), 3\), \(\(3,\), 3\)\]; expected one or more, all of one",
    ),
    "outputs of another size": (
        lambda: mx.from_network(jnp.ones(12), 1, floor=1.0),
        r"\(12,\); expected \[\.\.\., 13\]",
    ),
    "scalar outputs": (lambda: mx.from_network(1.0, 1, floor=1.0), "expected"),
    "floor shape": (
        lambda: mx.from_network(jnp.ones(13), 1, floor=jnp.ones(2)),
        r"\(2,\); expected a number or \(6,\)",
    ),
    "floor of zero": (lambda: mx.from_network(jnp.ones(13), 1, floor=0.0), "expected positive"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named(name: str) -> None:
    call, message = MISTAKES[name]
    with pytest.raises(ValueError, match=message):
        call()


def test_importing_costs_jax_alone() -> None:
    """The packages loaded are those that JAX and the parts of it that are used load."""
    print_packages = "import sys; print(*{name.split('.')[0] for name in sys.modules})"
    ours, jax_alone = (
        set(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True).stdout.split())
        for code in (
            f"import mdnvo_jax.mixture; {print_packages}",
            f"import math, typing, jax, jax.numpy, jax.scipy.special, jax.typing; {print_packages}",
        )
    )
    assert ours - jax_alone == {"mdnvo_jax"}
    assert not ours & {"flax", "cv2", "grain", "matplotlib", "optax", "orbax"}
