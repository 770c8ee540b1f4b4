"""The constant predictor: every step is the mean step of the training split, whatever the camera sees.

A method that does not beat it has learned nothing. With the standard deviation of the training split it is a density as
well, so calibration and likelihood have their floor too.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mdnvo_jax import geometry
from mdnvo_jax.mixture import Mixture

# Least standard deviation of translation (m) and rotation (rad): a dimension that never varies has none of its own.
FLOOR = np.array([1e-3] * 3 + [1e-4] * 3)


def step_statistics(paths: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the steps of training paths.

    Args:
      paths: `T_world_camera` of each sequence, `[N, 4, 4]`, N at least 2.

    Returns:
      (mean `[6]`, std `[6]`) over all steps (tx, ty, tz, rx, ry, rz), m and rad.
    """
    steps = np.concatenate([geometry.matrix_to_step(geometry.relative_steps(poses)) for poses in paths])
    return steps.mean(axis=0), steps.std(axis=0)


def constant_steps(mean_step: np.ndarray, count: int) -> np.ndarray:
    """Return `mean_step`, `[6]`, `count` times: `[count, 6]`."""
    return np.tile(np.asarray(mean_step, np.float64), (count, 1))


def constant_poses(mean_step: np.ndarray, count: int) -> np.ndarray:
    """Return the trajectory of `count` equal steps, `[count + 1, 4, 4]`, from the identity."""
    return np.asarray(geometry.accumulate(geometry.step_to_matrix(constant_steps(mean_step, count))))


def constant_mixture(mean_step: np.ndarray, std: np.ndarray, count: int) -> Mixture:
    """Return the density of `count` equal steps: one Gaussian with the training split's mean and deviation.

    Args:
      mean_step: `[6]`, m and rad.
      std: `[6]`; raised to `FLOOR` where it is less.
      count: steps.

    Returns:
      A `Mixture` with batch shape `[count]` and M = 1, float64 numpy arrays.
    """
    leaves: list[Any] = [constant_steps(row, count)[:, None] for row in (mean_step, np.log(np.maximum(std, FLOOR)))]
    return Mixture(*[np.zeros((count, 1)), *leaves])
