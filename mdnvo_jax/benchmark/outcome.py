"""What a section is told, and what it gives back."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mdnvo_jax.benchmark.timing import ratio, spread
from mdnvo_jax.evaluation.tables import Table, Value


@dataclasses.dataclass(frozen=True)
class Settings:
    """How to measure.

    Attributes:
      folder: for temporary files.
      threads: that every contender may use.
      short: toy sizes and hardly any repeats: shows that everything runs, not how fast.
      repeats: rounds of every comparison; 0 leaves it to the section.
      data: folder of pictures to take frames from; empty: frames that the benchmark draws itself.
    """

    folder: Path
    threads: int
    short: bool = False
    repeats: int = 0
    data: str = ""

    def rounds(self, usual: int) -> int:
        """Return how many rounds a comparison takes that usually takes `usual`."""
        return self.repeats or (1 if self.short else usual)


@dataclasses.dataclass
class Outcome:
    """What a section found.

    Attributes:
      tables: to print.
      targets: key of `targets.TARGETS` -> (at which size, what was measured).
      lines: sentences about what was left out, and why.
      seconds: every single time, by what and contender: all figures can be computed anew from them.
      agreement: how well peers agreed with us, as a share, by what was compared.
    """

    tables: list[Table] = dataclasses.field(default_factory=list)
    targets: dict[str, list[tuple[str, Value]]] = dataclasses.field(default_factory=dict)
    lines: list[str] = dataclasses.field(default_factory=list)
    seconds: dict[str, dict[str, list[float]]] = dataclasses.field(default_factory=dict)
    agreement: dict[str, float] = dataclasses.field(default_factory=dict)

    def line(self, text: str) -> None:
        """Add a sentence, once."""
        if text not in self.lines:
            self.lines.append(text)

    def left_out(self, size: str, name: str, took_s: float, other: str, other_s: float) -> None:
        """Say that a contender was too slow to be run again: what it took, and what another one did."""
        self.line(
            f"{size}: {name} took {took_s:.1f} s in its first run, and {other} {other_s:.1f} s: it was left out of the "
            "rounds"
        )

    def target(self, key: str, where: str, value: Value) -> None:
        """Add what was measured for a target."""
        self.targets.setdefault(key, []).append((where, value))

    def times(self, what: str, seconds: Mapping[str, Sequence[float]]) -> None:
        """Keep single times."""
        self.seconds.setdefault(what, {}).update({name: list(values) for name, values in seconds.items()})


def compared(name: str, seconds: Mapping[str, Sequence[float]], ours: str) -> dict[str, Any]:
    """Return the cells of a row that tell the time of the contender `name`, and the ratio to that of `ours`."""
    return {
        "contender": name,
        "ms": spread(seconds[name], 1e3),
        "ratio": ratio(seconds[name], seconds[ours]),
        "n": str(len(seconds[name])),
    }
