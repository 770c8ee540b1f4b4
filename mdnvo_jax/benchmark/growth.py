"""How a cost grows: the exponent of a power law, fitted to a few sizes."""

import math
from collections.abc import Sequence

import numpy as np

from mdnvo_jax.evaluation.tables import Value


def exponent(sizes: Sequence[float], seconds: Sequence[float]) -> Value:
    """Return b of the law seconds = a * size^b, by least squares on logarithms, with the standard error of b.

    Args:
      sizes: at least two, not all the same.
      seconds: for each of them.

    Returns:
      The exponent; its `spread` is the standard error, NaN for two sizes, which any line meets.
    """
    x, y = np.log(np.asarray(sizes, np.float64)), np.log(np.asarray(seconds, np.float64))
    centred = x - x.mean()
    slope = float(centred @ y / (centred @ centred))
    residual = y - y.mean() - slope * centred
    freedom = len(x) - 2
    error = math.sqrt(float(residual @ residual) / freedom / float(centred @ centred)) if freedom else math.nan
    return Value(slope, spread=error)
