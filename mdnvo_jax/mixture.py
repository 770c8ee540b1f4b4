"""The density of a pose step: a mixture of diagonal Gaussians, and all that is asked of one.

Imports jax alone. Equation numbers are those of the MDN-VO paper (Kaygusuz, Mendez, Bowden, 2021). Pure functions of a
`Mixture`, under jit, vmap and grad alike, with any leading batch axes `...`; bfloat16 and float16 are computed in
float32, shapes are checked and not broadcast. A component of weight zero (a logit of -inf), residuals of 1e4 sigma
and gaps of 1e4 between logits give finite values and gradients.

`coupling` says how the K dimensions share the M components:

- "independent", the paper's equations 3 to 5: each dimension is its own one-dimensional mixture, and a step's
  likelihood is their product; they share the weights, not the choice of component.
- "joint", the textbook density (Bishop, 1994): one choice of component for all dimensions of a step.

Both have the same marginals, so `mean`, `variance`, `cdf`, `quantile`, `interval` and `crps` do not ask.

>>> import jax.numpy as jnp
>>> from mdnvo_jax import mixture
>>> two = mixture.Mixture(jnp.log(jnp.array([0.25, 0.75])), jnp.array([[-1.0], [1.0]]), jnp.zeros((2, 1)))
>>> round(float(mixture.mean(two)[0]), 4), round(float(mixture.variance(two)[0]), 4)
(0.5, 1.75)
>>> round(float(mixture.nll(two, jnp.array([0.0]))), 4)
1.4189
>>> [round(float(end[0]), 2) for end in mixture.interval(two, 0.9)]
[-1.86, 2.5]
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike

Coupling = Literal["independent", "joint"]
Reduction = Literal["mean", "sequence", "none"]


class Mixture(NamedTuple):
    """M Gaussian components in K dimensions, with standard deviations by dimension. A pytree.

    Attributes:
      logits: unnormalised log-weights `[..., M]`; -inf is a weight of zero.
      mean: component means `[..., M, K]`.
      log_scale: natural logarithms of the standard deviations `[..., M, K]`.
    """

    logits: Array
    mean: Array
    log_scale: Array


def log_prob(mixture: Mixture, value: ArrayLike, *, coupling: Coupling = "independent") -> Array:
    """Log-density of `value`, `[...]`, equations 3 to 5: sum_k log sum_i alpha_i N(y_k; mu_ik, sigma_ik).

    With `coupling="joint"`: log sum_i alpha_i prod_k N(y_k; mu_ik, sigma_ik). The exponent printed in equation 4 lacks
    the square on sigma, a misprint (the function would not integrate to one); here it is sigma^2.

    Args:
      mixture: the density.
      value: the points `[..., K]`; the batch shape is exactly that of the mixture.
      coupling: how dimensions share components.

    Raises:
      ValueError: shapes disagree, or `coupling` is unknown.
    """
    mixture, value = _checked_with(mixture, value)
    log_terms = _log_terms(mixture, value, coupling)
    if coupling == "joint":
        # On a processor XLA copies arrays whose last axis is one long.
        return jax.nn.logsumexp(log_terms[..., 0], axis=-1)
    return jax.nn.logsumexp(log_terms, axis=-2).sum(-1)


def nll(
    mixture: Mixture,
    value: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    coupling: Coupling = "independent",
    reduction: Reduction = "mean",
) -> Array:
    """Negative log-likelihood of `value`: the training loss.

    Args:
      mixture: the density of every step.
      value: what was observed `[..., T, K]`.
      mask: bool `[..., T]`, true where a step counts; None counts all. What is masked may hold anything, even NaN.
      coupling: as in `log_prob`.
      reduction: "none" gives `[..., T]`, zero where masked. "mean" is the mean over the steps that count. "sequence" is
        equations 6 and 7: -log((1 / T') sum_t L_t) over the T' steps that count along the last batch axis, then the
        mean over the windows that have any. Nothing to average gives 0 with gradient 0.

    Raises:
      ValueError: shapes disagree, the mask is not bool, there is no axis T for "sequence", or a choice is unknown.
    """
    mixture, value = _checked_with(mixture, value)
    if reduction not in ("mean", "sequence", "none"):
        raise ValueError(f"reduction is {reduction!r}; expected 'mean', 'sequence' or 'none'")
    batch = mixture.logits.shape[:-1]
    counts = jnp.ones(batch, bool) if mask is None else jnp.asarray(mask)
    if counts.dtype != bool or counts.shape != batch:
        raise ValueError(f"mask is {counts.dtype} {counts.shape}; expected bool {batch}, a flag a step of the mixture")
    # Masked before the arithmetic as well as after: the gradient of a NaN that is only discarded later is NaN.
    logits, value = (jnp.where(counts[..., None], array, 0) for array in (mixture.logits, value))
    centre, log_scale = (jnp.where(counts[..., None, None], array, 0) for array in (mixture.mean, mixture.log_scale))
    log_likelihood = log_prob(Mixture(logits, centre, log_scale), value, coupling=coupling)
    if reduction == "sequence" and not batch:
        raise ValueError("reduction 'sequence' found a single step; expected values of shape [..., T, K]")
    if reduction == "sequence":
        steps = counts.sum(-1, dtype=log_likelihood.dtype)
        # An empty window comes out at -inf here, and drops below.
        log_likelihood = jax.nn.logsumexp(jnp.where(counts, log_likelihood, -jnp.inf), axis=-1)
        log_likelihood -= jnp.log(jnp.maximum(steps, 1))
        counts = steps > 0
    losses = jnp.where(counts, -log_likelihood, 0)
    return losses if reduction == "none" else losses.sum() / jnp.maximum(counts.sum(), 1)


def mean(mixture: Mixture) -> Array:
    """Mean of the whole mixture, sum_i alpha_i mu_i, `[..., K]`."""
    mixture = _checked(mixture)
    return (_weights(mixture) * mixture.mean).sum(-2)


def variance(mixture: Mixture) -> Array:
    """Variance by dimension, law of total variance: sum_i alpha_i (sigma_ik^2 + (mu_ik - mean_k)^2), `[..., K]`."""
    mixture = _checked(mixture)
    deviation = mixture.mean - mean(mixture)[..., None, :]
    return (_weights(mixture) * (jnp.exp(2 * mixture.log_scale) + deviation**2)).sum(-2)


def covariance(mixture: Mixture, *, coupling: Coupling = "independent") -> Array:
    """Covariance, `[..., K, K]`: sum_i alpha_i (diag(sigma_i^2) + (mu_i - mean)(mu_i - mean)^T).

    Independent dimensions have none between them: of theirs, only the diagonal, `variance`, is left.
    """
    _check_coupling(coupling)
    mixture = _checked(mixture)
    weights, deviation = _weights(mixture), mixture.mean - mean(mixture)[..., None, :]
    identity = jnp.eye(mixture.mean.shape[-1], dtype=mixture.mean.dtype)
    within = (weights * jnp.exp(2 * mixture.log_scale)).sum(-2)[..., None] * identity
    # Sums of products, not a matmul, which accelerators may round to bfloat16.
    full = within + (weights[..., None] * deviation[..., :, None] * deviation[..., None, :]).sum(-3)
    return full if coupling == "joint" else full * identity


def strongest(mixture: Mixture) -> Mixture:
    """The component of largest weight (the first of equals) as a mixture of M = 1 with weight one."""
    mixture = _checked(mixture)
    index = jnp.argmax(mixture.logits, axis=-1)[..., None, None]
    chosen = [jnp.take_along_axis(field, index, axis=-2) for field in (mixture.mean, mixture.log_scale)]
    return Mixture(jnp.zeros_like(mixture.logits[..., :1]), *chosen)


def mode(mixture: Mixture, *, coupling: Coupling = "independent", steps: int = 64) -> Array:
    """The point of highest density, `[..., K]`: by dimension where they are independent, else of the whole vector.

    Climbs from every component mean by a fixed number of mean-shift (EM) steps, none of which lowers the density:
    y_k <- sum_i w_ik mu_ik / sum_i w_ik, w_ik = P(i | y) / sigma_ik^2. Then takes the highest of the M points. Slow
    only where two components just merge, and there the density is flat. Carreira-Perpiñán, IEEE TPAMI 22(11), 2000.
    """
    mixture = _checked(mixture)
    starts = Mixture(mixture.logits[..., None, :], mixture.mean[..., None, :, :], mixture.log_scale[..., None, :, :])

    def climb(_: int, points: Array) -> Array:
        log_pull = _log_terms(starts, points, coupling) - 2 * starts.log_scale
        return (jax.nn.softmax(log_pull, axis=-2) * starts.mean).sum(-2)

    points = jax.lax.fori_loop(0, steps, climb, mixture.mean)
    heights = jax.nn.logsumexp(_log_terms(starts, points, coupling), axis=-2)
    best = jnp.argmax(heights, axis=-2, keepdims=True)
    return jnp.take_along_axis(points, best, axis=-2)[..., 0, :]


def cdf(mixture: Mixture, value: ArrayLike) -> Array:
    """Probability, by dimension, of less than `value`: sum_i alpha_i Phi((y_k - mu_ik) / sigma_ik).

    Within [0, 1], and of full relative precision in the lower tail. `value` and what it raises as in `log_prob`.
    """
    mixture, value = _checked_with(mixture, value)
    residual, weights = _residual(mixture, value), _weights(mixture)
    below, above = (weights * ndtr(residual)).sum(-2), (weights * ndtr(-residual)).sum(-2)
    # The two sum to one but for rounding; dividing keeps a probability from exceeding one.
    return below / (below + above)


def quantile(mixture: Mixture, probability: ArrayLike) -> Array:
    """The inverse of `cdf`, by dimension, `[..., K]`: 64 bisections between the components' extreme quantiles.

    The gradient is that of the implicit function, dq = (dp - dF) / density(q). It is unbounded where components lie so
    far apart that the density underflows; there the density is floored (1e-19 in float32) to keep it finite.

    Args:
      mixture: the density.
      probability: a number, or an array that broadcasts against `[..., K]` by NumPy's rules; for P quantiles of
        everything give it axes in front, `[P, 1, ..., 1]`. 0 and 1 give -inf and inf, outside them NaN.

    >>> normal = Mixture(jnp.zeros(1), jnp.zeros((1, 1)), jnp.zeros((1, 1)))
    >>> [round(float(quantile(normal, p)[0]), 2) for p in (0.0, 0.5, 0.975)]
    [-inf, 0.0, 1.96]
    """
    mixture = _checked(mixture)
    probability = _float(probability, mixture.mean)
    tail = jnp.where(probability <= 0.5, probability, 1 - probability)
    return _tail_quantile(mixture, tail, jnp.where(probability <= 0.5, 1, -1))


def interval(mixture: Mixture, coverage: ArrayLike) -> tuple[Array, Array]:
    """Central interval (low, high), `[..., K]` each; `coverage` broadcasts like the probability of `quantile`."""
    mixture = _checked(mixture)
    tail = (1 - _float(coverage, mixture.mean)) / 2
    return _tail_quantile(mixture, tail, jnp.array(1)), _tail_quantile(mixture, tail, jnp.array(-1))


def sample(mixture: Mixture, key: Array, shape: tuple[int, ...] = (), *, coupling: Coupling = "independent") -> Array:
    """Draw `[*shape, ..., K]`. Differentiable in mean and log_scale (reparameterised), not in the logits."""
    _check_coupling(coupling)
    mixture = _checked(mixture)
    *batch, _, dimensions = mixture.mean.shape
    choice_key, noise_key = jax.random.split(key)
    index_shape = (*shape, *batch, dimensions if coupling == "independent" else 1)
    index = jax.random.categorical(choice_key, mixture.logits[..., None, :], shape=index_shape)
    in_front = (None,) * len(shape)
    centre, log_scale = (
        jnp.take_along_axis(field[in_front], index[..., None, :], axis=-2)[..., 0, :]
        for field in (mixture.mean, mixture.log_scale)
    )
    return centre + jnp.exp(log_scale) * jax.random.normal(noise_key, centre.shape, centre.dtype)


def affine(mixture: Mixture, scale: ArrayLike, shift: ArrayLike) -> Mixture:
    """Distribution of `scale * y + shift` where y follows `mixture`, such as from standardised into physical units.

    Both are `[K]`, the scale positive; ValueError where not. Densities include the Jacobian: log_prob of the image is
    that of the point minus sum_k log(scale_k).
    """
    mixture, scale, shift = _checked(mixture), _float(scale), _float(shift)
    dimensions = mixture.mean.shape[-1]
    if scale.shape != (dimensions,) or shift.shape != (dimensions,):
        raise ValueError(f"scale and shift have shapes {scale.shape} and {shift.shape}; expected ({dimensions},) each")
    _check_positive(scale, "scale")
    return Mixture(mixture.logits, mixture.mean * scale + shift, mixture.log_scale + jnp.log(scale))


def widen(mixture: Mixture, factor: ArrayLike) -> Mixture:
    """Distribution of `mean + factor * (y - mean)`: `mixture` about its own mean, `factor` `[K]` times as wide.

    Means of components move with their widths, so that the mean and the shape stay and every standard deviation and
    interval is multiplied. ValueError where `factor` is not `[K]`, or not positive.
    """
    mixture, factor = _checked(mixture), _float(factor)
    expected = mixture.mean.shape[-1:]
    if factor.shape != expected:
        raise ValueError(f"factor has shape {factor.shape}; expected {expected}, K of the mixture")
    _check_positive(factor, "factor")
    centre = mean(mixture)[..., None, :]
    return Mixture(mixture.logits, centre + factor * (mixture.mean - centre), mixture.log_scale + jnp.log(factor))


def add_noise(mixture: Mixture, sigma: ArrayLike) -> Mixture:
    """Distribution of `y + n` where n ~ N(0, diag(sigma^2)) is independent of y, such as a measurement of y.

    The convolution of the two densities: every component keeps weight and mean, and has the variance of both. `sigma`
    is `[K]`; ValueError where it is not, or is not a number of 0 or more.
    """
    mixture, sigma = _checked(mixture), _float(sigma)
    expected = mixture.mean.shape[-1:]
    if sigma.shape != expected:
        raise ValueError(f"sigma has shape {sigma.shape}; expected {expected}, K of the mixture")
    _check_positive(sigma, "sigma", or_zero=True)
    # log sqrt(a^2 + b^2), whose gradient by b is 0, and not NaN, where b is 0.
    noisy = jnp.logaddexp(2 * mixture.log_scale, 2 * jnp.log(jnp.where(sigma == 0, 1, sigma))) / 2
    return Mixture(mixture.logits, mixture.mean, jnp.where(sigma == 0, mixture.log_scale, noisy))


def pool(mixtures: Sequence[Mixture]) -> Mixture:
    """Equal parts of several densities of the same batch shape and K: sum_j p_j(y) / J, the linear opinion pool.

    All their components, so that the whole has the mean of the means, and the mean of the variances plus the variance
    of the means: what the densities disagree about counts as uncertainty (Lakshminarayanan, Pritzel and Blundell, NIPS
    2017). With `coupling="independent"` it is so dimension by dimension. ValueError where shapes disagree, or there are
    none.
    """
    checked = [_checked(mixture) for mixture in mixtures]
    shapes = {(mixture.logits.shape[:-1], mixture.mean.shape[-1]) for mixture in checked}
    if len(shapes) != 1:
        raise ValueError(f"densities of batch shape and K {sorted(shapes)}; expected one or more, all of one")
    return Mixture(
        jnp.concatenate([jax.nn.log_softmax(mixture.logits, axis=-1) for mixture in checked], axis=-1),
        jnp.concatenate([mixture.mean for mixture in checked], axis=-2),
        jnp.concatenate([mixture.log_scale for mixture in checked], axis=-2),
    )


def crps(mixture: Mixture, value: ArrayLike) -> Array:
    """Continuous ranked probability score, by dimension: E|X - y| - E|X - X'| / 2, in the units of the dimension.

    The integral of (F(x) - 1{y <= x})^2; less is better, and of a point forecast it is the absolute error. Closed form
    for Gaussian mixtures: Grimit, Gneiting, Berrocal and Johnson, Q. J. R. Meteorol. Soc. 132, 2006. `value` and what
    it raises as in `log_prob`.
    """
    mixture, value = _checked_with(mixture, value)
    weights = _weights(mixture)
    error = (weights * _absolute_moment(value[..., None, :] - mixture.mean, mixture.log_scale)).sum(-2)
    difference = mixture.mean[..., :, None, :] - mixture.mean[..., None, :, :]
    # log sqrt(sigma_i^2 + sigma_j^2)
    log_scale = jnp.logaddexp(2 * mixture.log_scale[..., :, None, :], 2 * mixture.log_scale[..., None, :, :]) / 2
    pairs = weights[..., :, None, :] * weights[..., None, :, :]
    return error - (pairs * _absolute_moment(difference, log_scale)).sum((-3, -2)) / 2


def from_network(outputs: ArrayLike, components: int, *, dimensions: int = 6, floor: ArrayLike) -> Mixture:
    """Read outputs of a network as a `Mixture` whose standard deviations cannot collapse.

    Args:
      outputs: `[..., M + 2 * M * K]`, in this order: logits, means (component by component), raw log-scales (likewise).
      components: M.
      dimensions: K.
      floor: least standard deviation, a positive number or `[K]`, in the units of the outputs. The log-scale is
        log(exp(raw) + floor): smooth, above the floor for any raw value.

    Raises:
      ValueError: shapes disagree, or (outside jit) the floor is not positive.

    >>> narrow = from_network([0.0, 1.5, -1e4], components=1, dimensions=1, floor=1.0)
    >>> narrow.mean.tolist(), narrow.log_scale.tolist()
    ([[1.5]], [[0.0]])
    """
    outputs, size = _float(outputs), outputs_size(components, dimensions)
    floor = _float(floor, outputs)
    if outputs.shape[-1:] != (size,):
        raise ValueError(f"outputs have shape {outputs.shape}; expected [..., {size}], M + 2 * M * K")
    if floor.shape not in ((), (dimensions,)):
        raise ValueError(f"floor has shape {floor.shape}; expected a number or ({dimensions},)")
    _check_positive(floor, "floor")
    matrices = outputs[..., components:].reshape(*outputs.shape[:-1], 2, components, dimensions)
    log_scale = jnp.logaddexp(matrices[..., 1, :, :], jnp.log(floor))
    return Mixture(outputs[..., :components], matrices[..., 0, :, :], log_scale)


def outputs_size(components: int, dimensions: int = 6) -> int:
    """Numbers a network gives for a mixture: M + 2 * M * K."""
    return components + 2 * components * dimensions


def _float(array: ArrayLike, *partners: Array) -> Array:
    array = jnp.asarray(array)
    return array.astype(jnp.result_type(array, *partners, jnp.float32))


def _checked(mixture: Mixture) -> Mixture:
    fields = [jnp.asarray(field) for field in mixture]
    mixture = Mixture(*(_float(field, *fields) for field in fields))
    logits, centre, log_scale = map(jnp.shape, mixture)
    if not logits or centre[:-1] != logits or log_scale != centre:
        raise ValueError(f"mixture has shapes {logits}, {centre}, {log_scale}; expected [..., M], [..., M, K] twice")
    return mixture


def _checked_with(mixture: Mixture, value: ArrayLike) -> tuple[Mixture, Array]:
    mixture, value = _checked(mixture), _float(value)
    expected = (*mixture.logits.shape[:-1], mixture.mean.shape[-1])
    if value.shape != expected:
        raise ValueError(f"value has shape {value.shape}; expected {expected}, batch axes and K of the mixture")
    return mixture, value


def _check_coupling(coupling: str) -> None:
    if coupling not in ("independent", "joint"):
        raise ValueError(f"coupling is {coupling!r}; expected 'independent' or 'joint'")


def _check_positive(array: Array, name: str, *, or_zero: bool = False) -> None:
    with jax.ensure_compile_time_eval():
        is_right = ((array >= 0) if or_zero else (array > 0)).all()
    if not isinstance(is_right, jax.core.Tracer) and not is_right:
        raise ValueError(f"{name} is {array}; expected {'numbers of 0 or more' if or_zero else 'positive numbers'}")


def _weights(mixture: Mixture) -> Array:
    return jax.nn.softmax(mixture.logits, axis=-1)[..., None]


def _log_weights(mixture: Mixture) -> Array:
    return jax.nn.log_softmax(mixture.logits, axis=-1)[..., None]


def _residual(mixture: Mixture, value: Array) -> Array:
    return (value[..., None, :] - mixture.mean) * jnp.exp(-mixture.log_scale)


def _log_terms(mixture: Mixture, value: Array, coupling: str) -> Array:
    """log(alpha_i N_i(value)): `[..., M, K]` where dimensions are independent, `[..., M, 1]` where they are joint."""
    _check_coupling(coupling)
    log_normal = _log_normal(_residual(mixture, value), mixture.log_scale)
    return _log_weights(mixture) + (_sum_dimensions(log_normal)[..., None] if coupling == "joint" else log_normal)


def _sum_dimensions(terms: Array) -> Array:
    """Sum over the last axis; on a processor as a product with ones, which XLA computes in half the time.

    Not elsewhere: a TPU rounds the factors of a product, and its exact product makes NaN of an infinite factor.
    """

    def product(terms: Array) -> Array:
        return jnp.dot(terms, jnp.ones(terms.shape[-1], terms.dtype), precision="highest")

    return jax.lax.platform_dependent(terms, cpu=product, default=lambda terms: terms.sum(-1))


def _log_normal(residual: Array, log_scale: Array) -> Array:
    return -0.5 * (residual * residual + math.log(2 * math.pi)) - log_scale


def _absolute_moment(centre: Array, log_scale: Array) -> Array:
    """E|X| of a Gaussian: 2 sigma phi(mu / sigma) + mu (2 Phi(mu / sigma) - 1)."""
    residual = centre * jnp.exp(-log_scale)
    density = jnp.exp(log_scale - residual * residual / 2) * math.sqrt(2 / math.pi)
    return density + centre * jax.lax.erf(residual * math.sqrt(0.5))


def _tail_quantile(mixture: Mixture, tail: Array, side: Array) -> Array:
    """The point with probability `tail` <= 1/2 below it (`side` 1) or above it (`side` -1)."""
    tail, side = jnp.atleast_1d(tail, side)
    inside = tail >= jnp.finfo(tail.dtype).tiny
    # An upper tail is the lower tail of the mirror image, where small probabilities keep their digits.
    centre = mixture.mean * side[..., None, :]
    point = _lower_quantile(_log_weights(mixture), centre, mixture.log_scale, jnp.where(inside, tail, 0.5))
    return side * jnp.where(inside, point, jnp.where(tail >= 0, -jnp.inf, jnp.nan))


@jax.custom_jvp
def _lower_quantile(log_weight: Array, centre: Array, log_scale: Array, tail: Array) -> Array:
    """Where the CDF of components `[..., M, K]`, weights `[..., M, 1]`, reaches `tail` `[..., K]` in (0, 1/2]."""
    weights, scale = jnp.exp(log_weight), jnp.exp(log_scale)
    # At the least of the components' own quantiles the CDF is at most `tail`, at the greatest no less.
    ends = centre + scale * ndtri(tail)[..., None, :]

    def halve(_: int, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = low + (high - low) / 2
        is_below = (weights * ndtr((middle[..., None, :] - centre) / scale)).sum(-2) < tail
        return jnp.where(is_below, middle, low), jnp.where(is_below, high, middle)

    # 64 halvings take a bracket of 1e4 sigma to 1e-15 sigma.
    low, high = jax.lax.fori_loop(0, 64, halve, (ends.min(-2), ends.max(-2)))
    return low + (high - low) / 2


@_lower_quantile.defjvp
def _lower_quantile_jvp(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    point = _lower_quantile(*primals)
    log_weight, centre, log_scale, _ = primals
    d_log_weight, d_centre, d_log_scale, d_tail = tangents
    from_centre = point[..., None, :] - centre
    residual = from_centre * jnp.exp(-log_scale)
    log_terms = log_weight + _log_normal(residual, log_scale)
    density = jnp.maximum(jnp.exp(jax.nn.logsumexp(log_terms, axis=-2)), math.sqrt(jnp.finfo(point.dtype).tiny))
    moved = (jax.nn.softmax(log_terms, axis=-2) * (d_centre + from_centre * d_log_scale)).sum(-2)
    gained = (jnp.exp(log_weight) * ndtr(residual) * d_log_weight).sum(-2)
    return point, moved + (d_tail - gained) / density
