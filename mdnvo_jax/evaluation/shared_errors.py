"""What the steps of a drive are wrong by together, and what that makes expect of other drives."""

import numpy as np

from mdnvo_jax.evaluation import optional
from mdnvo_jax.evaluation.drift import STANDING_M

# Relative standard deviations that `fit_scale_sigma` considers, beside none at all.
_LEAST_SIGMA, _GREATEST_SIGMA = 1e-4, 4.0


def scale_error(steps: np.ndarray, covariance: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Relative error of scale of one drive, by weighted least squares, and its variance.

    Of predicted translations p_k and true ones t_k = (1 + e) p_k + n_k with independent n_k ~ N(0, C_k),

        e = sum_k p_k^T C_k^-1 (t_k - p_k) / sum_k p_k^T C_k^-1 p_k,   variance 1 / sum_k p_k^T C_k^-1 p_k.

    The sums leave out steps that truly stand (below `drift.STANDING_M`): where a car stands and is said to creep, all
    of the creep is wrong, and no scale would mend it. Errors of steps that are alike for a while count as scale as far
    as they do not average out over the drive.

    Args:
      steps: predicted, `[n, 6]`, or their translations `[n, 3]`, m.
      covariance: of those, `[n, 6, 6]` or `[n, 3, 3]`.
      truth: of the shape of `steps`.

    Returns:
      (error, variance); (0, infinity) for a drive that stands still, or is predicted to, which tells nothing.
    """
    moves = np.linalg.norm(truth[:, :3], axis=1) >= STANDING_M
    predicted, residual = steps[moves, :3], (truth - steps)[moves, :3]
    weighted = np.linalg.solve(covariance[moves, :3, :3], predicted[..., None])[..., 0]
    precision = float((weighted * predicted).sum())
    if precision == 0:
        return 0.0, float("inf")
    return float((weighted * residual).sum()) / precision, 1 / precision


def fit_scale_sigma(errors: np.ndarray, variances: np.ndarray) -> float:
    """Standard deviation s of the scale's error over drives, by maximum likelihood of e_i ~ N(0, s^2 + v_i).

    About zero and not about the mean: what all drives are wrong by is wrong in the next one, too. Drives weigh by what
    they tell, those with an infinite variance nothing; 0 where the variances alone explain the errors, or
    nothing is told. Below 4.

    Args:
      errors: of the drives, `[n]`.
      variances: of those, `[n]`, above 0; see `scale_error`.
    """
    optimize = optional.load("scipy.optimize")
    told = np.isfinite(variances)
    errors, variances = errors[told], variances[told]
    if len(errors) == 0:
        return 0.0

    def nll(log_sigma: float) -> float:
        total = np.exp(2 * log_sigma) + variances
        return float((np.log(total) + errors**2 / total).sum() / 2)

    # The grid first: there may be several optima.
    grid = np.linspace(np.log(_LEAST_SIGMA), np.log(_GREATEST_SIGMA), 49)
    nearest = int(np.argmin([nll(point) for point in grid]))
    bounds = grid[max(nearest - 1, 0)], grid[min(nearest + 1, len(grid) - 1)]
    best = optimize.minimize_scalar(nll, bounds=bounds, method="bounded").x
    return float(np.exp(best)) if nll(best) < nll(-np.inf) else 0.0


def fit_correlations(means: np.ndarray, counts: np.ndarray, neighbours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How alike the errors of the steps of a drive are, by component, `[K]` each, by maximum likelihood.

    Of standardised errors z with E[z^2] = 1, those of two steps l apart have the correlation rho + (1 - rho) r^l: rho
    is of any two, r of what is left of neighbours. That of neighbours is measured, c = rho + (1 - rho) r, which leaves
    rho, to a thousandth, no more than c. The mean of the n steps of a drive then has the variance

        rho + (1 - rho) (1 + 2 sum_{l < n} (1 - l / n) r^l) / n,

    and z_i ~ N(0, that of n_i) over the drives i.

    Args:
      means: of the standardised errors of each drive, `[D, K]`.
      counts: steps in each drive, `[D]`.
      neighbours: c, `[K]`; below 0 counts as 0, and 0.999 is the most.

    Returns:
      (rho, r).
    """
    together = np.clip(neighbours, 0, 0.999)
    rho = np.arange(1000)[:, None] / 1000
    left = np.maximum(together - rho, 0) / (1 - rho)
    power, number = left[:, None, :], counts[:, None]
    # The sum in closed form: n (1 + r) / (1 - r) - 2 r (1 - r^n) / (1 - r)^2, over n.
    spread = (1 + power) / (1 - power) - 2 * power * (1 - power**number) / (number * (1 - power) ** 2)
    variance = rho[:, None] + (1 - rho[:, None]) * spread / number
    nll = (np.log(variance) + means**2 / variance).sum(axis=1)
    best = np.where(rho <= together, nll, np.inf).argmin(axis=0)
    return rho[best, 0], left[best, np.arange(left.shape[1])]
