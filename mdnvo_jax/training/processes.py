"""Several processes, on one host or on many, that train together: how they join, agree, and notice that one is gone.

Each process runs the same program on its own devices and reads its own rows of every batch; what crosses between them
is inside compiled steps (see `parallel`) or below. One process, number 0, leads: it alone writes what is not a
checkpoint, and says what is to be said. They need a file system that all of them see.
"""

import argparse
import contextlib
import os
import socket
import sys
from collections.abc import Callable, Iterator

import jax
import numpy as np
from jax.experimental import multihost_utils

from mdnvo_jax.errors import InputError

# Bytes of a message that the leader sends to the others.
_MESSAGE = 2048
# What a process ends with that lost another one.
LOST = 3


def join(options: argparse.Namespace) -> None:
    """Find the other processes that the command line tells of, if any; before anything else is done with JAX.

    Raises:
      InputError: the options are incomplete, or the others cannot be found.
    """
    given = {f"--{name}": getattr(options, name) for name in ("coordinator", "processes", "process")}
    missing = [name for name, value in given.items() if value is None]
    if options.cluster and len(missing) < 3:
        raise InputError("--cluster finds the processes by itself: leave out --coordinator, --processes and --process")
    if not options.cluster and len(missing) == 3:
        return
    if not options.cluster and missing:
        raise InputError(f"{' and '.join(missing)} missing: --coordinator, --processes and --process belong together")
    if not options.cluster and not 0 <= options.process < options.processes:
        raise InputError(f"--process {options.process} of --processes {options.processes}: expected 0 to one less")
    try:
        jax.distributed.initialize(
            coordinator_address=options.coordinator,
            num_processes=options.processes,
            process_id=options.process,
            initialization_timeout=options.lost_after,
            heartbeat_timeout_seconds=options.lost_after,
        )
    except (RuntimeError, ValueError) as error:
        what = "no cluster that JAX knows" if options.cluster else f"the processes cannot meet at {options.coordinator}"
        raise InputError(f"{what}: {str(error).splitlines()[0]}") from error


def loopback() -> str:
    """Return an address at which processes of this host can meet: a port that is free now."""
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return f"localhost:{probe.getsockname()[1]}"


def leads() -> bool:
    """Return whether this process writes and speaks for all."""
    return jax.process_index() == 0


def by_leader(action: Callable[[], None]) -> None:
    """Let the leader do what one has to do for all, and wait until it is done.

    Raises:
      InputError: the leader could not; all processes raise what it raised.
    """
    if jax.process_count() == 1:
        action()
        return
    complaint = ""
    if leads():
        try:
            action()
        except InputError as error:
            complaint = str(error) or "refused"
    letters = np.zeros(_MESSAGE, np.uint8)
    text = complaint.encode()[:_MESSAGE]
    letters[: len(text)] = np.frombuffer(text, np.uint8)
    heard = np.asarray(multihost_utils.broadcast_one_to_all(letters))
    message = bytes(heard[: np.count_nonzero(heard)]).decode(errors="replace")
    if message:
        raise InputError(message)


def all_agree(here: bool) -> bool:
    """Return whether `here` is true in every process; all of them have to ask."""
    return here if jax.process_count() == 1 else bool(multihost_utils.process_allgather(np.asarray(here)).all())


@contextlib.contextmanager
def together() -> Iterator[None]:
    """End this process, with a message and the status `LOST`, when another one is gone and a step cannot be finished.

    At once and without clean-up: everything that would wait for the others would wait for ever.
    """
    try:
        yield
    except (jax.errors.JaxRuntimeError, ValueError) as error:
        # Either is what a broken connection is raised as.
        if jax.process_count() == 1 or isinstance(error, InputError):
            raise
        first = str(error).splitlines()[0][:200]
        print(
            f"error: process {jax.process_index()} lost another process: {first}: start all of them again with "
            "--resume, as many as you like",
            file=sys.stderr,
            flush=True,
        )
        sys.stdout.flush()
        os._exit(LOST)
