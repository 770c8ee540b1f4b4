"""Packages that only evaluation and pictures need, imported when they are first used."""

import importlib
from typing import Any

from mdnvo_jax.errors import InputError


def load(module: str) -> Any:
    """Import a module of evo, scipy or matplotlib.

    Raises:
      InputError: it is not installed; the message gives the pip line.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        missing = (error.name or module).partition(".")[0]
        raise InputError(f"{missing} is not installed; this needs it: pip install 'mdnvo_jax[eval]'") from error
