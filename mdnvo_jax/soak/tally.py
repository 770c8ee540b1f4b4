"""What came of the trials of one part."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field


@dataclass
class Tally:
    """Counts, and what belongs beside them.

    Attributes:
      name: of the part.
      tried: trials that were made.
      lost: what went wrong, a line each.
      note: figures that were measured on the way.
    """

    name: str
    tried: int = 0
    lost: list[str] = field(default_factory=list)
    note: str = ""


def as_line(tally: Tally) -> str:
    """Return a tally as one line of JSON."""
    return json.dumps(asdict(tally))


def from_line(line: str) -> Tally:
    """Return the tally that `as_line` wrote."""
    return Tally(**json.loads(line))


def table(tallies: Sequence[Tally]) -> str:
    """Return a table with a row a part, and below it what was lost."""
    rows = [("part", "tried", "survived", "lost", "measured")]
    rows += [(t.name, str(t.tried), str(t.tried - len(t.lost)), str(len(t.lost)), t.note) for t in tallies]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    lines.insert(1, "|---|---|---|---|---|")
    return "\n".join([*lines, *(f"lost, {tally.name}: {what}" for tally in tallies for what in tally.lost)])
