"""Trainings by several processes, one of which is killed: the others end in time, and any number goes on from there."""

import random
import subprocess
import tempfile
import time
from pathlib import Path

from mdnvo_jax.soak import training
from mdnvo_jax.soak.tally import Tally
from mdnvo_jax.training import logs

# How many processes train, or go on; 1 is a training like any other.
_COUNTS = (1, 2, 4)
# Seconds after which all must have ended that lost one of them.
_WITHIN_S = 60
# Largest relative difference of a training's losses from those of one process: sums over a batch are taken in another
# order, and 66 steps of Adam on noise make more of it.
_TOLERANCE = 1e-3
_COMPARED = ("loss", "validation_loss")


def run(seconds: float, seed: int, config: Path, workdir: Path) -> Tally:
    """Kill a process of several, and let another number go on, for some time.

    Args:
      seconds: no new trial is begun after that.
      seed: of numbers and moments.
      config: of `training.write_drive`.
      workdir: of the same training by one process, not interrupted.
    """
    tally, draw = Tally("scale"), random.Random(seed)
    end = time.monotonic() + seconds
    expected = logs.read_rows(workdir / logs.CSV)
    slowest, furthest = 0.0, 0.0
    while time.monotonic() < end or not tally.tried:
        tally.tried += 1
        with tempfile.TemporaryDirectory() as folder:
            first, then = draw.choice(_COUNTS[1:]), draw.choice(_COUNTS)
            what = f"{first} processes, one killed, {then} went on"
            took, why = _lose_one(config, Path(folder) / "run", first, draw)
            slowest = max(slowest, took)
            why = why or _go_on(config, Path(folder) / "run", then)
            if not why:
                difference = _difference(logs.read_rows(Path(folder) / "run" / logs.CSV), expected)
                furthest = max(furthest, difference)
                why = f"losses differ by {difference:.1e} of theirs" if difference > _TOLERANCE else ""
            tally.lost += [f"{what}: {why}"] if why else []
    tally.note = f"ended at most {slowest:.1f} s after the kill, losses within {furthest:.1e} of one process's"
    return tally


def _lose_one(config: Path, workdir: Path, count: int, draw: random.Random) -> tuple[float, str]:
    """Kill one of `count` processes that train; return how long the others lived, and what was wrong, if anything."""
    processes = training.start_together(config, workdir, count)
    time.sleep(draw.uniform(5, 25))
    draw.choice(processes).kill()
    killed = time.monotonic()
    if not _ended(processes, _WITHIN_S):
        return _WITHIN_S, f"a process lived on for {_WITHIN_S} s after another was killed"
    return time.monotonic() - killed, ""


def _go_on(config: Path, workdir: Path, count: int) -> str:
    """Let `count` processes finish the training; return what was wrong, if anything."""
    processes = training.start_together(config, workdir, count)
    said = _ended(processes, training.TIMEOUT_S)
    if not said:
        return "did not come to an end"
    for process, errors in zip(processes, said, strict=True):
        if process.returncode:
            return f"exit {process.returncode}: {(errors.strip().splitlines() or [''])[-1][:200]}"
    return ""


def _ended(processes: "list[subprocess.Popen[str]]", within_s: float) -> list[str]:
    """Return what each process has said on stderr; nothing where one had to be killed, for it did not end in time."""
    try:
        return [process.communicate(timeout=within_s)[1] for process in processes]
    except subprocess.TimeoutExpired:
        for process in processes:
            process.kill()
            process.communicate()
        return []


def _difference(found: list[dict[str, str]], expected: list[dict[str, str]]) -> float:
    """Return the largest relative difference of what is compared; infinite where epochs are missing."""
    if [row["step"] for row in found] != [row["step"] for row in expected]:
        return float("inf")
    return max(
        abs(float(one[name]) / float(other[name]) - 1)
        for one, other in zip(found, expected, strict=True)
        for name in _COMPARED
    )
