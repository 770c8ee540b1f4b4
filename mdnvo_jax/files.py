"""Output folders that are never overwritten silently, and files that are whole or absent."""

import contextlib
import glob
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mdnvo_jax.errors import InputError

try:
    import fcntl
except ImportError:  # not POSIX
    fcntl = None  # type: ignore[assignment]

# Larger numbers in a file are no metres, pixels or seconds; their squares would not be finite.
LARGEST_NUMBER = 1e100


@contextlib.contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path`; it takes the place of `path` when the block ends without an error.

    The temporary name keeps the suffix of `path`, since writers (matplotlib, numpy, OpenCV) choose the format by it.
    """
    path = Path(path)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    # Held until the process ends, however it ends: see `remove_remnants`.
    with os.fdopen(descriptor, "rb") as file:
        _lock(file)
        if fcntl is None:
            file.close()  # Windows replaces no file that is open
        try:
            yield Path(temporary)
            # mkstemp makes files private; give the result the permissions that an ordinary new file would have.
            mask = os.umask(0)
            os.umask(mask)
            Path(temporary).chmod(0o666 & ~mask)
            Path(temporary).replace(path)
        finally:
            Path(temporary).unlink(missing_ok=True)


def remove_remnants(path: str | os.PathLike[str]) -> None:
    """Remove what killed processes left of `path` in `whole_file`; what a living process writes stays."""
    path = Path(path)
    for remnant in path.parent.glob(f".{glob.escape(path.stem)}-????????{glob.escape(path.suffix)}"):
        # Another process may be faster.
        with contextlib.suppress(FileNotFoundError), remnant.open("rb") as file:
            if _lock(file):
                remnant.unlink()


def _lock(file: BinaryIO) -> bool:
    """Return whether `file` could be locked, or whether nobody can lock files on this system."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass  # a file system without locks
    return True


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` to `path` as UTF-8, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def claim_output(directory: str | os.PathLike[str], *, force: bool) -> Path:
    """Make `directory` and return it.

    Raises:
      InputError: it holds files already and `force` is false, or it is a file, or it cannot be made.
    """
    directory = Path(directory)
    if directory.exists() and not directory.is_dir():
        raise InputError(f"{directory} is a file; expected a folder to write into: choose another")
    if directory.is_dir() and any(directory.iterdir()) and not force:
        raise InputError(f"{directory} holds files already: choose another folder, or overwrite with --force")
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {directory} ({error.strerror}): choose another") from error
    return directory
