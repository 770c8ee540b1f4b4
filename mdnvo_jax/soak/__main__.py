"""The command line bin/soak: kills, corruption, fuzz, stream and scale within a time budget; see --help."""

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mdnvo_jax.errors import InputError, Parser, exit_code

if TYPE_CHECKING:
    from mdnvo_jax.soak.tally import Tally

# Shares of the time that the parts get; a training takes longest to come to its end.
SHARES = {"kills": 0.4, "corruption": 0.15, "fuzz": 0.15, "stream": 0.15, "scale": 0.15}
# A part may finish what it has begun.
_GRACE_S = 900
_TESTS = Path(__file__).parents[2] / "tests" / "data" / "hostile"
# Examples of each of its properties.
_EXAMPLES = 300


def main(arguments: Sequence[str]) -> None:
    """Run the trials that the command line asks for and print their table.

    Raises:
      SystemExit: with 1, where anything was lost.
    """
    parser = Parser("bin/soak", description="Kill, damage, fuzz, stream and scale for some time; print one table.")
    parser.add_argument("--minutes", type=float, default=60, help="in all, but for what was begun before [60]")
    parser.add_argument("--seed", type=int, default=int(time.time()) % 1_000_000, help="of every draw [by the clock]")
    parser.add_argument("--parts", nargs="+", choices=list(SHARES), default=list(SHARES), help="only these [all]")
    parser.add_argument("--part", choices=list(SHARES), help="one part in this process, as JSON; used by ourselves")
    parser.add_argument("--folder", type=Path, help="with --part: the folder of the reference training")
    options = parser.parse_args(arguments)
    if not options.minutes > 0:
        raise InputError(f"--minutes is {options.minutes}: expected more than 0")

    from mdnvo_jax.soak import tally

    if options.part:
        print(tally.as_line(_part(options.part, 60 * options.minutes, options.seed, options.folder)))
        return
    found = soak(60 * options.minutes, options.seed, options.parts)
    print(f"seed {options.seed}, {options.minutes:g} minutes")
    print(tally.table(found))
    if any(part.lost for part in found):
        raise SystemExit(1)


def soak(seconds: float, seed: int, parts: Sequence[str]) -> "list[Tally]":
    """Return the tallies of `parts`, each run in a process of its own, one after another."""
    from mdnvo_jax.soak import tally, training

    found = []
    with tempfile.TemporaryDirectory(prefix="mdnvo-soak-") as name:
        folder = Path(name)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "cache"))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        began = time.monotonic()
        process = training.start(training.write_drive(folder / "drive"), folder / "run")
        _, errors = process.communicate()
        if process.returncode:
            raise RuntimeError(f"the reference training failed: {errors}")
        seconds -= time.monotonic() - began
        for part in parts:
            share = max(seconds, 1) * SHARES[part] / sum(SHARES[other] for other in parts)
            command = [sys.executable, "-m", "mdnvo_jax.soak", "--part", part, "--folder", str(folder)]
            command += ["--minutes", str(share / 60), "--seed", str(seed)]
            try:
                child = subprocess.run(command, capture_output=True, text=True, timeout=share + _GRACE_S)
            except subprocess.TimeoutExpired:
                found.append(tally.Tally(part, 1, [f"did not end within {share + _GRACE_S:.0f} s"]))
                continue
            if child.returncode:
                last = (child.stderr.strip().splitlines() or [""])[-1]
                found.append(tally.Tally(part, 1, [f"the process ended with {child.returncode}: {last[:200]}"]))
            else:
                found.append(tally.from_line(child.stdout.splitlines()[-1]))
            print(f"{part}: {found[-1].tried} tried, {len(found[-1].lost)} lost", file=sys.stderr, flush=True)
    return found


def _part(part: str, seconds: float, seed: int, folder: Path) -> "Tally":
    """Return the tally of one part."""
    from mdnvo_jax.soak import damage, kills, scale, stream

    if part == "kills":
        return kills.run(seconds, seed, folder / "drive" / "config.py", folder / "run")
    if part == "scale":
        return scale.run(seconds, seed, folder / "drive" / "config.py", folder / "run")
    if part == "corruption":
        return damage.run(seconds, seed, folder / "run")
    return stream.run(seconds, seed, folder / "run") if part == "stream" else fuzz(seconds, seed)


def fuzz(seconds: float, seed: int) -> "Tally":
    """Return the tally of the tests of hostile files, run with ever other seeds and many examples.

    They are in the checkout, not in the package, and need its extra `test`.
    """
    from mdnvo_jax.soak.tally import Tally

    found = Tally("fuzz")
    end = time.monotonic() + seconds
    rounds = 0
    while time.monotonic() < end or not rounds:
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n0", str(_TESTS)]
        environment = {**os.environ, "MDNVO_FUZZ_EXAMPLES": str(_EXAMPLES)}
        child = subprocess.run(
            [*command, f"--hypothesis-seed={seed + rounds}"],
            capture_output=True,
            text=True,
            env=environment,
            cwd=_TESTS.parents[2],
        )
        rounds += 1
        counts = {word: int(count) for count, word in re.findall(r"(\d+) (passed|failed|error)", child.stdout)}
        found.tried += sum(counts.values())
        lost = re.findall(r"^(?:FAILED|ERROR) (\S+)", child.stdout, re.MULTILINE)
        found.lost += [f"{name} with --hypothesis-seed={seed + rounds - 1}" for name in lost]
        if child.returncode and not lost:
            found.lost.append(f"pytest ended with {child.returncode}: {child.stdout[-200:]}")
            break
    found.note = f"{rounds} rounds of all tests, {_EXAMPLES} examples of each property"
    return found


if __name__ == "__main__":
    raise SystemExit(exit_code(main))
