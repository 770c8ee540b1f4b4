"""Visual odometry that knows how sure it is: MDN-VO in JAX.

The public names are imported when they are first used, so that `import mdnvo_jax.mixture` costs jax alone.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOME = {
    "Trajectory": "mdnvo_jax.odometry",
    "load": "mdnvo_jax.predictor",
    "predict": "mdnvo_jax.predictor",
}
__all__ = ["Trajectory", "__version__", "load", "predict"]

if TYPE_CHECKING:
    from mdnvo_jax.odometry import Trajectory
    from mdnvo_jax.predictor import load, predict


def __getattr__(name: str) -> Any:
    """Import a public name from the module that defines it."""
    if name not in _HOME:
        raise AttributeError(f"module 'mdnvo_jax' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


class _Package(ModuleType):
    """This package, in which the function `predict` keeps its place.

    Importing a submodule sets it as an attribute of its package, and the command line `mdnvo_jax.predict` has the name
    of the function. Whoever wants the command line imports from it: `from mdnvo_jax.predict import main`.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
