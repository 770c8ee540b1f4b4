"""Python in a process of its own: for what a process costs at its start, or cannot change once it runs."""

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast


def start(arguments: Sequence[str], environment: Mapping[str, str] | None = None) -> subprocess.Popen[str]:
    """Start Python with this package as this process has it.

    Args:
      arguments: for the interpreter.
      environment: variables beside those of this process.
    """
    here = Path(__file__).parents[2]
    variables = {**os.environ, **(environment or {})}
    # The user's folder of compiled programs is neither used nor filled: runs that keep theirs name another one.
    variables.pop("JAX_COMPILATION_CACHE_DIR", None)
    command = [sys.executable, *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=here, env=variables)


def virtual_devices(count: int) -> dict[str, str]:
    """Return the variables with which a process has so many devices on this processor."""
    return {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={count}"}


def printed(process: subprocess.Popen[str]) -> str:
    """Return what a process of `start` has printed when it has ended.

    Raises:
      RuntimeError: it failed; with the end of what it said on stderr.
    """
    said, errors = process.communicate()
    if process.returncode:
        arguments = cast("list[str]", process.args)[1:]
        raise RuntimeError(f"python {' '.join(arguments)} failed: {errors[-2000:]}")
    return said


def run(arguments: Sequence[str], environment: Mapping[str, str] | None = None) -> str:
    """Run Python as `start` does, and return what it printed; see there, and `printed`."""
    return printed(start(arguments, environment))
