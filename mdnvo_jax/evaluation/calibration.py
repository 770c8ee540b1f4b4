"""Whether predicted densities mean what they say, judged from their CDF and not from a Gaussian stand-in.

Everything begins with `score`, one row of numbers a step; statistics over steps are functions of those rows, so that a
bootstrap can redraw them. Sigma is the standard deviation of the whole mixture (law of total variance), or of its
strongest component alone: `Reported` says which.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from mdnvo_jax import mixture as density
from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation import bootstrap, optional
from mdnvo_jax.mixture import Coupling, Mixture
from mdnvo_jax.odometry import COMPONENTS

Reported = Literal["mixture", "strongest"]
REPORTED: tuple[Reported, ...] = get_args(Reported)
# The six components, then the norms of the translation and of the rotation vector.
RANKED = (*COMPONENTS, "translation", "rotation")

# Probability that a Gaussian puts within 1, 2 and 3 sigma; the central intervals of the mixture hold as much.
SIGMA_LEVELS = (0.6827, 0.9545, 0.9973)
# Draws for statistics that need a sort; the others have `bootstrap.DRAWS`.
_RANKING_DRAWS = 200
# Errors of each step that are drawn from its own density.
_OWN_DRAWS = 50
# Steps that are scored at a time.
_CHUNK = 256
# Factors that `fit_sigma_scale` considers.
_LEAST_SCALE, _GREATEST_SCALE = 1 / 64, 64


@dataclass(frozen=True)
class StepScores:
    """What each of n steps says about a density over K components.

    Attributes:
      pit: probability integral transform, the CDF at the truth, `[n, K]`; uniform where the density is right.
      nll: negative log-density at the truth, nats, m and rad, `[n]`.
      crps: continuous ranked probability score, m or rad, `[n, K]`.
      error: absolute error of the centre, `[n, K]`, m or rad.
      sigma: standard deviation, `[n, K]`.
      nees: normalised estimation error squared, e^T P^-1 e, `[n]`; its mean is K where covariances are right.
      drawn: absolute errors as the density itself has them, m or rad: `_OWN_DRAWS` a step, `[n, D, K]`.
    """

    pit: np.ndarray
    nll: np.ndarray
    crps: np.ndarray
    error: np.ndarray
    sigma: np.ndarray
    nees: np.ndarray
    drawn: np.ndarray

    def take(self, indices: np.ndarray) -> "StepScores":
        """Return the rows `indices`."""
        return StepScores(*(getattr(self, name)[indices] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Estimated:
    """A statistic with its bootstrap interval; arrays of one shape, or numbers."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class Calibration:
    """Statistics over steps, with bootstrap intervals.

    Attributes:
      steps: how many.
      coverage: share of truths in the central interval of each of `SIGMA_LEVELS`, `[3, K]`.
      nll: mean, nats a step.
      crps: mean by component, `[K]`, m or rad.
      nees: mean; K is right, more is over-confident.
      spearman: rank correlation of sigma with the absolute error, by `RANKED`; NaN where sigma never varies.
      own_spearman: the same of errors drawn from the densities themselves: mean, and the interval of 95 % of draws. It
        is what `spearman` would be if they were right, and the lower the less sigma varies.
      ause: area under the sparsification error, by `RANKED`; 0 is the best ranking.
    """

    steps: int
    coverage: Estimated
    nll: Estimated
    crps: Estimated
    nees: Estimated
    spearman: Estimated
    own_spearman: Estimated
    ause: Estimated


def score(
    mixture: Mixture, truth: np.ndarray, *, coupling: Coupling = "independent", reported: Reported = "mixture"
) -> StepScores:
    """Score the density of every step against what happened.

    Args:
      mixture: batch shape `[n]`, K components, physical units.
      truth: `[n, K]`.
      coupling: how the density combines its dimensions; enters NLL and NEES.
      reported: score the whole mixture, or its strongest component alone.
    """
    if reported == "strongest":
        mixture = density.strongest(mixture)
    leaves = [np.asarray(leaf) for leaf in (*mixture, truth)]
    count = len(leaves[-1])
    # Rows beyond the last are copies of it, so that every chunk has one shape and is compiled for once.
    rows = np.minimum(np.arange(-(-count // _CHUNK) * _CHUNK), count - 1).reshape(-1, _CHUNK)
    keys = jax.random.split(jax.random.key(0), len(rows))
    chunks = [
        _measure(key, *(leaf[chunk] for leaf in leaves), coupling=coupling)
        for key, chunk in zip(keys, rows, strict=True)
    ]
    parts = (
        np.concatenate([np.asarray(part, np.float64) for part in found])[:count] for found in zip(*chunks, strict=True)
    )
    centre, covariance, pit, nll, crps, drawn = parts
    error = truth - centre
    return StepScores(
        pit=pit,
        nll=nll,
        crps=crps,
        error=np.abs(error),
        sigma=np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)),
        nees=np.einsum("nk,nk->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]),
        drawn=np.abs(drawn - centre[:, None]),
    )


@functools.partial(jax.jit, static_argnames="coupling")
def _measure(
    key: jax.Array, logits: jax.Array, mean: jax.Array, log_scale: jax.Array, truth: jax.Array, *, coupling: Coupling
) -> tuple[jax.Array, ...]:
    """Return mean, covariance, CDF, NLL, CRPS and draws `[n, D, K]` of steps."""
    mixture = Mixture(logits, mean, log_scale)
    return (
        density.mean(mixture),
        density.covariance(mixture, coupling=coupling),
        density.cdf(mixture, truth),
        density.nll(mixture, truth, coupling=coupling, reduction="none"),
        density.crps(mixture, truth),
        jnp.swapaxes(density.sample(mixture, key, (_OWN_DRAWS,), coupling=coupling), 0, 1),
    )


def join(parts: list[StepScores]) -> StepScores:
    """Return the rows of several sequences, one after the other."""
    return StepScores(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in StepScores.__dataclass_fields__)
    )


def calibrate(scores: StepScores, draws: bootstrap.Draws | None = None) -> Calibration:
    """Reduce scores to statistics.

    Args:
      scores: of n steps.
      draws: resamples of the steps; None draws blocks of consecutive ones.
    """
    draws = bootstrap.draw_blocks(len(scores.nll)) if draws is None else draws

    def mean(values: np.ndarray) -> Estimated:
        return Estimated(values.mean(axis=0), *bootstrap.mean_interval(values, draws))

    sigma, error = ranked(scores)

    def ranking(statistic: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Estimated:
        low, high = bootstrap.interval(lambda i: statistic(sigma[i], error[i]), draws.first(_RANKING_DRAWS))
        return Estimated(statistic(sigma, error), low, high)

    return Calibration(
        steps=len(scores.nll),
        coverage=mean(np.stack([is_inside(scores.pit, level) for level in SIGMA_LEVELS], axis=1).astype(np.float64)),
        nll=mean(scores.nll),
        crps=mean(scores.crps),
        nees=mean(scores.nees),
        spearman=ranking(spearman),
        own_spearman=_own_spearman(sigma, scores.drawn),
        ause=ranking(area_under_sparsification_error),
    )


def is_inside(pit: np.ndarray, probability: float) -> np.ndarray:
    """Whether the truth lies in the central interval of that probability, bool of the shape of `pit`.

    The interval leaves (1 - p) / 2 on either side, so the truth is in it where |2 PIT - 1| <= p.
    """
    return np.abs(2 * pit - 1) <= probability


def reliability(pit: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Share of truths inside the central interval of each of `levels`, by component, `[L, K]`."""
    return np.stack([is_inside(pit, level).mean(axis=0) for level in levels])


def pit_histogram(pit: np.ndarray, bins: int = 10) -> np.ndarray:
    """Share of PIT values in each of `bins` equal bins of 0 to 1, `[bins, K]`; 1 / bins is right."""
    edges = np.linspace(0, 1, bins + 1)
    return np.stack([np.histogram(column, edges)[0] for column in pit.T], axis=1) / len(pit)


def ranked(scores: StepScores) -> tuple[np.ndarray, np.ndarray]:
    """Return sigma and absolute error by component and of the two norms, each `[n, 8]`, as `RANKED` names them.

    The sigma of a norm is the root of the trace of its covariance.
    """
    return _with_norms(scores.sigma), _with_norms(scores.error)


def spearman(sigma: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Spearman's rank correlation of the columns of two `[n, C]` arrays, `[C]`; ties share their mean rank.

    NaN where a column does not vary: no ranking, no correlation.
    """
    stats = optional.load("scipy.stats")

    first, second = (stats.rankdata(values, axis=0) - (len(values) + 1) / 2 for values in (sigma, error))
    spread = np.sqrt((first**2).sum(axis=0) * (second**2).sum(axis=0))
    product = (first * second).sum(axis=0)
    return np.divide(product, spread, out=np.full(spread.shape, np.nan), where=spread > 0)


def _own_spearman(sigma: np.ndarray, drawn: np.ndarray) -> Estimated:
    """Return the correlations of sigma with each set of drawn errors `[n, D, K]`: mean and interval of 95 % of them."""
    found = np.stack([spearman(sigma, _with_norms(errors)) for errors in np.swapaxes(drawn, 0, 1)])
    return Estimated(found.mean(axis=0), *np.percentile(found, [2.5, 97.5], axis=0))


def sparsification(sigma: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean absolute error of the steps that remain as those of largest sigma are removed (Ilg et al., ECCV 2018).

    Steps of equal sigma are removed in random order, in expectation: a sigma that never varies gives a flat curve.

    Args:
      sigma: `[n]`.
      error: `[n]`, not negative.

    Returns:
      (fraction removed, remaining error, remaining error had the largest errors been removed), each `[n]`, from nothing
      removed to all but one step; errors are over the error of all steps, so that both curves begin at 1.
    """
    _, group = np.unique(sigma, return_inverse=True)
    sizes = np.bincount(group)
    expected = (np.bincount(group, error) / sizes)[group][np.argsort(group, kind="stable")]
    kept = np.arange(1, len(error) + 1)
    whole = error.mean() or 1.0
    curve, oracle = (np.cumsum(values) / kept / whole for values in (expected, np.sort(error)))
    return 1 - kept[::-1] / len(error), curve[::-1], oracle[::-1]


def area_under_sparsification_error(sigma: np.ndarray, error: np.ndarray) -> np.ndarray:
    """AUSE: mean distance of the sparsification curve from the oracle's, by column of `[n, C]` arrays, `[C]`.

    0 where sigma ranks the steps as their errors do. A sigma that never varies gives the figure of chance.
    """
    areas = []
    for column in range(sigma.shape[1]):
        _, curve, oracle = sparsification(sigma[:, column], error[:, column])
        areas.append((curve - oracle).mean())
    return np.array(areas)


def fit_sigma_scale(mixture: Mixture, truth: np.ndarray) -> np.ndarray:
    """Factor by component by which widths should be multiplied, `[K]`, by maximum likelihood. For validation data only.

    Minimises the mean NLL of each component's marginal after `mixture.widen`. The likelihood, not a quantile, is
    fitted: it needs no choice of level, and uses all of the density. Independent dimensions separate, so
    this is their joint optimum; for coupling "joint" it is that of the marginals. Factors lie within 1/64 and 64.

    Args:
      mixture: batch shape `[n]`, K components.
      truth: `[n, K]`.

    Raises:
      InputError: there are no steps.
    """
    optimize = optional.load("scipy.optimize")

    if len(truth) == 0:
        raise InputError("no validation steps to fit the sigma scale on: expected at least one sequence with poses")
    logits, means, log_scale = (np.asarray(field, np.float64) for field in mixture)
    log_weights = logits - np.logaddexp.reduce(logits, axis=-1, keepdims=True)
    centre = (np.exp(log_weights)[..., None] * means).sum(axis=1)
    grid = np.linspace(np.log(_LEAST_SCALE), np.log(_GREATEST_SCALE), 49)
    factors = []
    for component in range(truth.shape[1]):
        residual = truth[:, component] - centre[:, component]
        offset = means[..., component] - centre[:, None, component]
        terms = (residual, offset, log_scale[..., component], log_weights)
        # The grid first: the likelihood of a density with several modes may have several optima.
        nearest = int(np.argmin([_scaled_nll(point, *terms) for point in grid]))
        bounds = grid[max(nearest - 1, 0)], grid[min(nearest + 1, len(grid) - 1)]
        factors.append(np.exp(optimize.minimize_scalar(_scaled_nll, bounds=bounds, args=terms, method="bounded").x))
    return np.array(factors)


def _scaled_nll(
    log_factor: float, residual: np.ndarray, offset: np.ndarray, log_scale: np.ndarray, log_weights: np.ndarray
) -> float:
    """Return the mean NLL, less a constant, of residuals `[n]` under 1-D mixtures `[n, M]` widened about the mean."""
    standard = (residual[:, None] / np.exp(log_factor) - offset) / np.exp(log_scale)
    return float(log_factor - np.logaddexp.reduce(log_weights - 0.5 * standard**2 - log_scale, axis=1).mean())


def _with_norms(values: np.ndarray) -> np.ndarray:
    """Return `[n, 6]` with the norms of its first and last three columns appended; other widths as they are."""
    if values.shape[1] != len(COMPONENTS):
        return values
    norms = [np.linalg.norm(values[:, part], axis=1) for part in (slice(0, 3), slice(3, 6))]
    return np.column_stack([values, *norms])
