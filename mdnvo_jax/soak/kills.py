"""Trainings that are killed at random moments, again and again: each must end as if it had never been."""

import random
import shutil
import signal
import subprocess
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from mdnvo_jax.soak import training
from mdnvo_jax.soak.tally import Tally
from mdnvo_jax.training import checkpoint

# Kills a training goes through before it is let end; more trainings, or more kills of one: both are worth trying.
_KILLS = 4
# How a training is ended, and how often of ten.
_WAYS = {"SIGKILL": 6, "SIGTERM": 2, "SIGINT": 1, "SIGINT twice": 1}
# Share of the kills that wait for a save to be under way.
_IN_SAVES = 0.5
# What orbax calls a step's folder until it is whole.
_UNFINISHED = "*orbax-checkpoint-tmp*"


def run(seconds: float, seed: int, config: Path, workdir: Path) -> Tally:
    """Kill trainings for some time.

    Args:
      seconds: no new training is begun after that.
      seed: of the moments.
      config: of `training.write_drive`.
      workdir: of the same training, not interrupted.
    """
    tally, draw, ways = Tally("kills"), random.Random(seed), Counter[str]()
    end = time.monotonic() + seconds
    expected = training.result(workdir)
    while time.monotonic() < end:
        with tempfile.TemporaryDirectory() as folder:
            kills, why = _chain(config, Path(folder) / "run", draw, expected, end)
            ways.update(kills)
            tally.tried += len(kills)
            if why:
                # Nobody knows which of them it was.
                tally.lost += [f"{why}, after {' '.join(kills)}"]
                shutil.copytree(folder, f"{workdir}-lost-{seed}-{tally.tried}", dirs_exist_ok=True)
    tally.note = ", ".join(f"{count} {way}" for way, count in sorted(ways.items()))
    return tally


def _chain(
    config: Path, workdir: Path, draw: random.Random, expected: dict[str, Any], end: float
) -> tuple[list[str], str]:
    """Return the kills that one training went through, and what was wrong with its end, if anything."""
    kills: list[str] = []
    while len(kills) < _KILLS and time.monotonic() < end:
        process = training.start(config, workdir)
        way = draw.choices(list(_WAYS), list(_WAYS.values()))[0]
        moment = _wait(process, workdir, draw)
        if process.poll() is None:
            _strike(process, way, draw)
        try:
            _, errors = process.communicate(timeout=training.TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            return [*kills, way], f"{way} {moment}: did not end"
        if process.returncode == 0:
            break
        kills.append(f"{way} {moment}")
        if process.returncode == 2 or ("saving a checkpoint" in errors and way != "SIGINT twice" and "Trace" in errors):
            return kills, f"exit {process.returncode}: {errors.strip().splitlines()[-1][:200]}"
    process = training.start(config, workdir)
    _, errors = process.communicate(timeout=training.TIMEOUT_S)
    if process.returncode != 0:
        return kills, f"resumed to exit {process.returncode}: {errors.strip().splitlines()[-1][:200]}"
    found = training.result(workdir)
    return kills, "" if found == expected else f"ends elsewhere: {_difference(found, expected)}"


def _wait(process: "subprocess.Popen[str]", workdir: Path, draw: random.Random) -> str:
    """Return, at a random moment, what is going on."""
    if draw.random() < _IN_SAVES:
        skipped = draw.randrange(3)
        seen: set[str] = set()
        while process.poll() is None:
            seen |= {path.name for path in (workdir / checkpoint.FOLDER).glob(_UNFINISHED)}
            if len(seen) > skipped:
                time.sleep(draw.uniform(0, 0.05))
                return "in a save"
            time.sleep(0.001)
        return "at the end"
    # Most of a run this short is its start.
    until = time.monotonic() + draw.uniform(0, 12)
    while process.poll() is None and time.monotonic() < until:
        time.sleep(0.01)
    return "at random"


def _strike(process: "subprocess.Popen[str]", way: str, draw: random.Random) -> None:
    """Send the signals of one way to end a process."""
    process.send_signal(signal.Signals[way.split()[0]])
    if way.endswith("twice"):
        time.sleep(draw.uniform(0.01, 0.3))
        if process.poll() is None:
            process.send_signal(signal.SIGINT)


def _difference(found: dict[str, Any], expected: dict[str, Any]) -> str:
    """Return which part of the result differs."""
    return ", ".join(name for name in expected if found[name] != expected[name])
