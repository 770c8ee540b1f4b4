"""The module under test, as numpy arrays find it and as JAX compiles it."""

import functools
import inspect
from collections.abc import Callable
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from mdnvo_jax import geometry as geo


@functools.cache
def compiled(name: str) -> Callable[..., np.ndarray]:
    function = jax.jit(getattr(geo, name), static_argnames=["order"] if name == "propagate_covariance" else [])
    return lambda *arguments, **options: np.asarray(function(*arguments, **options))


@pytest.fixture(params=["numpy", "jax"])
def lib(request: pytest.FixtureRequest, x64: None) -> object:
    """The module as numpy arrays find it, then as JAX compiles it, both in float64."""
    if request.param == "numpy":
        return geo
    names = [name for name, member in vars(geo).items() if inspect.isfunction(member) and not name.startswith("_")]
    return SimpleNamespace(**{name: compiled(name) for name in names})
