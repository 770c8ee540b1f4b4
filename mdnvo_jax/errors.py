"""What a user got wrong, said in one line, and how a command line ends because of it."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn


class InputError(ValueError):
    """Something the user gave is unusable. The message says what was found, what was expected and what to do."""


def exit_code(main: Callable[[Sequence[str]], None], arguments: Sequence[str] | None = None) -> int:
    """Run a command line and turn its outcome into a process exit code.

    Args:
      main: takes the arguments after the program's name, raises `InputError` where they are unusable.
      arguments: those arguments; `sys.argv[1:]` when None.

    Returns:
      0, or 2 after one line on stderr for an `InputError`, or 130 after an interrupt, as shells do.
    """
    try:
        main(sys.argv[1:] if arguments is None else arguments)
    except InputError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output (`| head`) went away: no mistake, and nothing left to say. Python would
        # complain once more when it flushes stdout at exit, so stdout is pointed at nothing first.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line, like those of every other mistake."""

    def error(self, message: str) -> NoReturn:
        """Raise the complaint as an `InputError`; `exit_code` prints it."""
        raise InputError(f"{message} (see --help)")
