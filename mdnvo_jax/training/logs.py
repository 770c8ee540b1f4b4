"""What a training tells: a progress bar, metrics.csv, TensorBoard events."""

import contextlib
import csv
import io
import math
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import rich.console
import rich.progress
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto import event_pb2, summary_pb2

from mdnvo_jax import files
from mdnvo_jax.training import processes

CSV = "metrics.csv"
# Seconds between two times that TensorBoard's file is brought to the disk.
_FLUSH_S = 10


class Logs:
    """The logs of one training, in its workdir; rows after `step` from an earlier run are dropped.

    Of several processes one writes.
    """

    def __init__(self, workdir: Path, step: int, *, writes: bool = True) -> None:
        self._csv = workdir / CSV
        self._writes = writes
        self._rows = read_rows(self._csv, step) if writes else []
        self._tensorboard = workdir / "tensorboard"
        self._next_step = step + 1
        self._events: EventsWriter | None = None
        self._flushed_s = 0.0

    def scalars(self, step: int, values: dict[str, float]) -> None:
        """Write scalars to TensorBoard.

        Here and now, not in a thread: one that dies of a full disk would leave the training waiting for it.

        Raises:
          OSError: they cannot be written; the next ones will be in a new file.
        """
        if not self._writes:
            return
        try:
            if self._events is None:
                self._tensorboard.mkdir(exist_ok=True)
                self._events = EventsWriter(str(self._tensorboard / "events"))
                # Steps from here on that an earlier run has written are forgotten.
                begun = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
                self._events.write_event(
                    event_pb2.Event(wall_time=time.time(), step=self._next_step, session_log=begun)
                )
            found = [summary_pb2.Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
            summary = summary_pb2.Summary(value=found)
            self._events.write_event(event_pb2.Event(wall_time=time.time(), step=step, summary=summary))
            self._next_step = step + 1
            if time.monotonic() - self._flushed_s > _FLUSH_S:
                self._events.flush()
                self._flushed_s = time.monotonic()
        except OSError:
            self._events = None
            raise

    def epoch(self, row: dict[str, float]) -> None:
        """Add a row to metrics.csv, which is rewritten whole, and its values to TensorBoard."""
        if not self._writes:
            return
        self._rows.append({name: _number(value) for name, value in row.items()})
        text = io.StringIO()
        # Rows of an older release may have fewer columns.
        columns = dict.fromkeys(name for row in reversed(self._rows) for name in row)
        writer = csv.DictWriter(text, list(columns), restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._rows)
        files.write_text(self._csv, text.getvalue())
        self.scalars(int(row["step"]), {f"epoch/{name}": value for name, value in row.items() if name != "step"})

    def close(self) -> None:
        """Finish the events file."""
        if self._events is not None:
            with contextlib.suppress(OSError):
                self._events.close()


def read_rows(path: Path, last_step: float = math.inf) -> list[dict[str, str]]:
    """Return the rows of a metrics file up to a step, none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as stream:
        return [row for row in csv.DictReader(stream) if int(row["step"]) <= last_step]


def _number(value: float) -> str:
    """Return a number as text that reads back to the same float32."""
    return str(value) if isinstance(value, int) else f"{value:.9g}"


def environment() -> dict[str, Any]:
    """Return the command, the versions and the machine, as they belong beside a result."""
    return {
        "command": shlex.join(sys.orig_argv),
        "git": _git_hash(),
        "versions": versions(),
        "platform": platform.platform(),
        "devices": [str(device) for device in jax.devices()],
        "processors": os.cpu_count(),
    }


def versions(*others: str) -> dict[str, str]:
    """Return the versions of Python, of the packages that results depend on, and of `others`."""
    names = (
        "mdnvo_jax",
        "jax",
        "jaxlib",
        "flax",
        "optax",
        "orbax-checkpoint",
        "grain",
        "numpy",
        "opencv-python-headless",
        *others,
    )
    return {"python": platform.python_version(), **{name: _version(name) for name in names}}


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def _git_hash() -> str | None:
    """Return the commit of the checkout this package runs from, None where it is installed or git is missing."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


class EpochProgress:
    """A bar over the steps of an epoch with rate, time to go and loss, on stderr; silent where that is no terminal."""

    def __init__(self, title: str, total: int, start: int) -> None:
        console = rich.console.Console(stderr=True)
        self._bar = rich.progress.Progress(
            "{task.description}",
            rich.progress.BarColumn(),
            rich.progress.MofNCompleteColumn(),
            "{task.fields[rate]}",
            rich.progress.TimeRemainingColumn(),
            "{task.fields[note]}",
            console=console,
            disable=not (console.is_terminal and processes.leads()),
        )
        self._task = self._bar.add_task(title, total=total, completed=start, rate="", note="")

    def __enter__(self) -> "EpochProgress":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def advance(self, loss: float) -> None:
        """Count one step and show its loss."""
        speed = self._bar.tasks[0].speed
        rate = f"{speed:.2f} steps/s" if speed else ""
        self._bar.update(self._task, advance=1, rate=rate, note="" if math.isnan(loss) else f"loss {loss:.4g}")


def track(items: Iterable[Any], title: str, total: int) -> Iterator[Any]:
    """Yield `items` beneath a progress bar on stderr, silent where that is no terminal."""
    console = rich.console.Console(stderr=True)
    return iter(
        rich.progress.track(items, title, total=total, console=console, transient=True, disable=not console.is_terminal)
    )
