"""Compiled programs kept between runs, so that only the first run of a network on a machine waits for the compiler."""

import os
import tempfile
from pathlib import Path

# The variable by which JAX itself is told of a folder.
VARIABLE = "JAX_COMPILATION_CACHE_DIR"
# The many small programs of a run cost as much time as the two large ones, and few bytes: all are kept.
_LEAST_SECONDS = 0


def keep_compiled() -> Path | None:
    """Let JAX keep what it compiles in the user's cache folder, `mdnvo_jax/xla` in $XDG_CACHE_HOME or ~/.cache.

    For command lines: a library leaves this choice to the program it is part of. Where the variable
    JAX_COMPILATION_CACHE_DIR is set, that folder is used (none if it is empty). Old files are not deleted; all of them
    may be, at any time.

    Returns:
      The folder, or None where JAX decides or the folder cannot be written to, which is no error.
    """
    if VARIABLE in os.environ:
        return None
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "mdnvo_jax" / "xla"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return None

    import jax

    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _LEAST_SECONDS)
    return folder
