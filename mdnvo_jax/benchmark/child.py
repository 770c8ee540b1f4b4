"""Python in a process of its own: for what a process costs at its start, or cannot change once it runs."""

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path


def run(arguments: Sequence[str], environment: Mapping[str, str] | None = None) -> str:
    """Run Python with this package as this process has it, and return what it printed.

    Args:
      arguments: for the interpreter.
      environment: variables beside those of this process.

    Raises:
      RuntimeError: it failed; with the end of what it said on stderr.
    """
    here = Path(__file__).parents[2]
    variables = {**os.environ, **(environment or {})}
    # The user's folder of compiled programs is neither used nor filled: runs that keep theirs name another one.
    variables.pop("JAX_COMPILATION_CACHE_DIR", None)
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, cwd=here, env=variables)
    if done.returncode:
        raise RuntimeError(f"python {' '.join(arguments)} failed: {done.stderr[-2000:]}")
    return done.stdout
