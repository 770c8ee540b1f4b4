"""Random mixtures, the functions of mdnvo_jax.mixture compiled, and what they should give; no test itself."""

from collections.abc import Callable, Iterable, Iterator

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import integrate, optimize, special, stats

from mdnvo_jax import mixture as mx
from mdnvo_jax.mixture import Mixture

BATCH, COMPONENTS, DIMENSIONS = (2, 3), 4, 3
COUPLINGS = ("independent", "joint")


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


FLOATS = st.floats(-3, 3, width=32)


def arrays(*shape: int) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(np.float32, shape, elements=FLOATS)


MIXTURES = st.builds(Mixture, arrays(3), arrays(3, 2), arrays(3, 2))
PROPERTY = hypothesis.settings(max_examples=40, deadline=None, derandomize=True)

GOOD = device(random_mixture(), "float32")
GOOD_VALUE = jnp.asarray(random_value(), "float32")
