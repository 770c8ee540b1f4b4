"""Before two programs are timed against each other they must be shown to compute the same."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

# Values that are compared at a time, in float64: the arrays may take gigabytes.
_CHUNK = 1 << 20


class DisagreementError(AssertionError):
    """A peer does not compute what we compute: its time would mean nothing."""


def relative_difference(*pairs: tuple[ArrayLike, ArrayLike]) -> float:
    """Return |ours - theirs| / |theirs| in the Euclidean norm over all elements of all pairs (ours, theirs).

    Raises:
      DisagreementError: the shapes of a pair differ.
    """
    difference = norm = 0.0
    for ours, theirs in pairs:
        if np.shape(ours) != np.shape(theirs):
            raise DisagreementError(f"found {np.shape(ours)} and {np.shape(theirs)}: expected one shape")
        a, b = np.ravel(ours), np.ravel(theirs)
        for start in range(0, a.size, _CHUNK):
            mine, other = (values[start : start + _CHUNK].astype(np.float64) for values in (a, b))
            difference += float(np.sum((mine - other) ** 2))
            norm += float(np.sum(other**2))
    return math.sqrt(difference / norm) if norm else math.sqrt(difference)


def agree(what: str, ours: ArrayLike, theirs: ArrayLike, tolerance: float) -> float:
    """Return the relative difference of two results that are to be the same.

    Raises:
      DisagreementError: it is not at most `tolerance`, or their shapes differ.
    """
    return agree_all(what, [(ours, theirs)], tolerance)


def agree_all(what: str, pairs: Sequence[tuple[ArrayLike, ArrayLike]], tolerance: float) -> float:
    """Return the relative difference of many results taken as one; otherwise as `agree`."""
    found = relative_difference(*pairs)
    # Not `found > tolerance`: a NaN must not pass.
    if not found <= tolerance:
        raise DisagreementError(f"{what}: ours and the peer's differ by {found:.2e} of the norm, allowed {tolerance:g}")
    return found
