"""Rigid motions in numpy and in JAX, and mistakes that are named."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from geometry_values import steps

from mdnvo_jax import geometry as geo


def test_numpy_in_numpy_out_and_the_rest_in_jax() -> None:
    single = np.ones(6, np.float32)
    assert isinstance(geo.step_to_matrix(single), np.ndarray)
    assert geo.step_to_matrix(single).dtype == np.float64
    assert geo.step_to_matrix(jnp.asarray(single)).dtype == jnp.float32
    assert geo.step_to_matrix(jnp.asarray(single, jnp.bfloat16)).dtype == jnp.float32
    mixed = geo.compose(np.eye(4), jnp.eye(4))
    assert isinstance(mixed, jax.Array)
    given = geo.step_to_matrix(steps(3))
    before = given.copy()
    geo.accumulate(given)
    np.testing.assert_array_equal(given, before)


def test_vmap_equals_the_batch() -> None:
    step = jnp.asarray(steps(4))
    mapped = jax.jit(jax.vmap(lambda s: geo.log_se3(geo.step_to_matrix(s))))(step)
    np.testing.assert_allclose(mapped, geo.log_se3(geo.step_to_matrix(steps(4))), atol=1e-5)


T2, C2 = np.tile(np.eye(4), (2, 1, 1)), np.tile(np.eye(6), (2, 1, 1))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: geo.step_to_matrix(np.ones(7)), r"\(7,\); expected \[\.\.\., 6\]"),
        (lambda: geo.exp_so3(np.float64(1)), r"\(\); expected \[\.\.\., 3\]"),
        (lambda: geo.matrix_to_step(np.eye(3)), r"\(3, 3\); expected \[\.\.\., 4, 4\]"),
        (lambda: geo.accumulate(np.eye(4)), r"\(4, 4\); expected \[\.\.\., N, 4, 4\]"),
        (lambda: geo.accumulate(T2, np.eye(3)), r"\(3, 3\); expected \[\.\.\., 4, 4\]"),
        (lambda: geo.propagate_covariance(T2, C2[:1]), "expected one a step"),
        (lambda: geo.propagate_covariance(T2, C2, order=3), "order is 3; expected 1 or 2"),
        (lambda: geo.step_covariance_to_perturbation(np.ones(6), np.ones(6)), r"expected \[\.\.\., 6, 6\]"),
    ],
)
def test_mistakes_are_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
