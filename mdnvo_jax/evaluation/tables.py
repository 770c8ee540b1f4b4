"""Tables that say what they show: rows name split, alignment, delta and frames, headers name the statistic."""

import dataclasses
import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

_UNLIMITED = 100_000


@dataclass(frozen=True)
class Value:
    """A number of a table, with the interval it may as well lie in and the spread of what it is the mean of."""

    value: float
    low: float = math.nan
    high: float = math.nan
    spread: float = math.nan


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes:
      key: its name in rows and JSON.
      header: what is printed above it, with the unit.
      digits: digits after the point.
      best: which value is printed bold: the lowest, the highest, the one nearest to a number, or none.
    """

    key: str
    header: str
    digits: int = 3
    best: Literal["low", "high"] | float | None = None


Cell = Value | str
Row = Mapping[str, Cell]


@dataclass(frozen=True)
class Table:
    """A table; a cell that is missing, or not a number, prints as "-".

    Attributes:
      title: what it shows.
      columns: in the order of printing.
      rows: by the keys of `columns`.
      context: keys of the columns of text that say what a row is about; `as_text` prints those that are the same in
        every row once, above the table.
      group: key of a column; the best value is sought among the rows that agree in it. Empty: among all.
      notes: sentences below the table.
    """

    title: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    context: Sequence[str] = ()
    group: str = ""
    notes: Sequence[str] = field(default_factory=tuple)


def as_markdown(table: Table) -> str:
    """Return `table` in markdown, the best values bold."""
    best = _best(table)
    lines = [
        f"### {table.title}",
        "",
        "| " + " | ".join(_escaped(column.header) for column in table.columns) + " |",
        "|" + "|".join("---" if _is_text(table, column) else "---:" for column in table.columns) + "|",
    ]
    for number, row in enumerate(table.rows):
        cells = []
        for column in table.columns:
            text = _escaped(_text(row.get(column.key), column))
            cells.append(f"**{text}**" if (number, column.key) in best else text)
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", *(f"- {_escaped(note)}" for note in table.notes), *([""] if table.notes else [])]
    return "\n".join(lines)


def as_text(table: Table, width: int | None = None) -> str:
    """Return `table` as aligned plain text for a terminal, the best values starred.

    Args:
      table: to print.
      width: of the terminal, in characters; a table that is wider goes on below, rows named again. None asks the
        terminal, and takes as much as it needs where there is none.
    """
    width = shutil.get_terminal_size((_UNLIMITED, 24)).columns if width is None else width
    best = _best(table)
    shared = {key: _shared(table, key) for key in table.context}
    said = ", ".join(f"{column.header} {shared[column.key]}" for column in table.columns if shared.get(column.key))
    printed = []
    for column in table.columns:
        if not shared.get(column.key):
            cells = [
                _text(row.get(column.key), column) + ("*" if (number, column.key) in best else "")
                for number, row in enumerate(table.rows)
            ]
            size = max(map(len, [column.header, *cells]))
            align = str.ljust if _is_text(table, column) else str.rjust
            printed.append([align(cell, size) for cell in [column.header, *cells]])
    lines = [table.title, *([f"every row: {said}"] if said else [])]
    for block in _fitting(printed, width):
        lines += ["", *("  ".join(cells).rstrip() for cells in zip(*block, strict=True))]
    lines += [""] * bool(table.notes) + [f"- {note}" for note in table.notes]
    return "\n".join(lines) + "\n"


def _fitting(columns: list[list[str]], width: int) -> list[list[list[str]]]:
    """Return columns of equally long cells in blocks that fit into `width`, the first column in each of them."""
    first, *rest = columns
    blocks = [[first]]
    for column in rest:
        if len(blocks[-1]) > 1 and sum(len(cells[0]) + 2 for cells in blocks[-1]) + len(column[0]) > width:
            blocks.append([first])
        blocks[-1].append(column)
    return blocks


def as_data(table: Table) -> dict[str, Any]:
    """Return `table` as what JSON holds: numbers in full, None where there is none."""
    rows = [{column.key: _datum(row.get(column.key)) for column in table.columns} for row in table.rows]
    return {
        "title": table.title,
        "columns": {column.key: column.header for column in table.columns},
        "rows": rows,
        "notes": list(table.notes),
    }


def finite(data: Any) -> Any:
    """Return nested `data` with every number that JSON does not know (NaN, infinity) as None."""
    if dataclasses.is_dataclass(data) and not isinstance(data, type):
        data = dataclasses.asdict(data)
    if isinstance(data, Mapping):
        return {str(key): finite(value) for key, value in data.items()}
    if hasattr(data, "tolist"):
        data = data.tolist()
    if isinstance(data, list | tuple):
        return [finite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


def _datum(cell: Cell | None) -> Any:
    """Return a cell for JSON: text, or a number with what is known about it."""
    if isinstance(cell, Value):
        known = {name: number for name, number in dataclasses.asdict(cell).items() if math.isfinite(number)}
        return known.get("value") if len(known) < 2 else known
    return cell


def _text(cell: Cell | None, column: Column) -> str:
    """Return a cell as printed: 0.137 ± 0.056 [0.120, 0.150]."""
    if cell is None or cell == "":
        return "-"
    if isinstance(cell, str):
        return cell
    if not math.isfinite(cell.value):
        return "-"
    text = f"{cell.value:.{column.digits}f}"
    if math.isfinite(cell.spread):
        text += f" ± {cell.spread:.{column.digits}f}"
    if math.isfinite(cell.low) and math.isfinite(cell.high):
        text += f" [{cell.low:.{column.digits}f}, {cell.high:.{column.digits}f}]"
    return text


def _is_text(table: Table, column: Column) -> bool:
    """Return whether no row has a number in `column`."""
    return not any(isinstance(row.get(column.key), Value) for row in table.rows)


def _shared(table: Table, key: str) -> str:
    """Return the text that every row has at `key`, or nothing."""
    texts = {str(row.get(key, "")) for row in table.rows}
    return texts.pop() if len(texts) == 1 else ""


def _best(table: Table) -> set[tuple[int, str]]:
    """Return (row, column key) of the best values; ties, to the digits printed, are all best."""
    found = set()
    groups: dict[object, list[int]] = {}
    for number, row in enumerate(table.rows):
        groups.setdefault(row.get(table.group), []).append(number)
    for column in table.columns:
        for numbers in groups.values():
            badness = {
                number: _badness(cell.value, column)
                for number in numbers
                if isinstance(cell := table.rows[number].get(column.key), Value) and math.isfinite(cell.value)
            }
            # A single row has nothing to be better than.
            if column.best is None or len(numbers) < 2 or not badness:
                continue
            least = min(badness.values())
            found |= {(number, column.key) for number, value in badness.items() if value == least}
    return found


def _badness(value: float, column: Column) -> float:
    """Return how bad a value is, rounded as it is printed."""
    printed = round(value, column.digits)
    if isinstance(column.best, int | float):
        return round(abs(printed - column.best), column.digits)
    return -printed if column.best == "high" else printed


def _escaped(text: str) -> str:
    """Return `text` with what markdown would take for the edge of a cell escaped."""
    return text.replace("|", "\\|")
