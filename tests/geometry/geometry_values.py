"""Rotation vectors, steps and derivatives that tests of rigid motions share; no test itself."""

from collections.abc import Callable

import numpy as np

from mdnvo_jax import geometry as geo

# Rotation vectors where formulas change branch, lose digits, or divide zero by zero.
AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 2, 3], [3, -2, 1], [-1, -1, -1], [1, 1, -5]], np.float64)
AXES /= np.linalg.norm(AXES, axis=-1, keepdims=True)
ANGLES = np.array([0, 1e-300, 1e-160, 1e-12, 1e-6, 1e-3, 0.1, 0.199, 0.201, 0.999, 1.001, 2, 3, np.pi - 1e-3])
NEAR_PI = np.pi - np.array([1e-6, 1e-8, 1e-12, 0])
VECTORS = (ANGLES[:, None, None] * AXES).reshape(-1, 3)


def steps(count: int, seed: int = 0, size: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 6)) * size


def ad(xi: np.ndarray) -> np.ndarray:
    phi, rho = geo.hat(xi[3:]), geo.hat(xi[:3])
    return np.block([[phi, rho], [np.zeros((3, 3)), phi]])


def numerical_jacobian(function: Callable, at: np.ndarray, step: float = 1e-5) -> np.ndarray:
    columns = [(function(at + step * e) - function(at - step * e)) / (2 * step) for e in np.eye(at.shape[-1])]
    return np.stack(columns, axis=-1)
