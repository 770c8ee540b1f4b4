"""Tables that say what they show: rows name split, alignment, delta and frames, headers name the statistic."""

import dataclasses
import itertools
import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
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
      over: what stands over it and its neighbours, such as a method. The best value is then sought in the row, among
        the columns of the same header, and not in the column.
    """

    key: str
    header: str
    digits: int = 3
    best: Literal["low", "high"] | float | None = None
    over: str = ""

    @property
    def full_header(self) -> str:
        """The header with what stands over it."""
        return f"{self.over} {self.header}".strip()


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
        "| " + " | ".join(_escaped(column.full_header) for column in table.columns) + " |",
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
    said, columns = _said_once(table)
    printed = []
    for over, group in itertools.groupby(columns, lambda column: column.over or column.key):
        inside = list(group)
        parts = [_printed(table, column, best) for column in inside]
        joined = ["  ".join(cells) for cells in zip(*parts, strict=True)]
        size = max(len(over), len(joined[0])) if inside[0].over else len(joined[0])
        above = [(over if inside[0].over else "").center(size)] if any(column.over for column in columns) else []
        printed.append([*above, *(cells.rjust(size) if inside[0].over else cells for cells in joined)])
    lines = [table.title, *([f"every row: {said}"] if said else [])]
    for block in _fitting(printed, width):
        lines += ["", *("  ".join(cells).rstrip() for cells in zip(*block, strict=True))]
    lines += [""] * bool(table.notes) + [f"- {note}" for note in table.notes]
    return "\n".join(lines) + "\n"


def as_html(table: Table) -> str:
    """Return `table` as a part of a page, the best values bold, intervals below their values."""
    best = _best(table)
    said, columns = _said_once(table)
    lines = ["<section>", f"<h3>{escape(table.title)}</h3>"]
    lines += [f"<p>Every row: {escape(said)}.</p>"] * bool(said)
    lines += ['<div class="wide"><table>', "<thead>"]
    if any(column.over for column in columns):
        spans = [(over, len(list(same))) for over, same in itertools.groupby(column.over for column in columns)]
        lines.append("<tr>" + "".join(f'<th class="over" colspan="{n}">{escape(over)}</th>' for over, n in spans))
    # Numbers are read from the right, and so is what stands above them.
    sides = ["text" if _is_text(table, column) else "number" for column in columns]
    heads = (f'<th class="{side}">{escape(c.header)}</th>' for side, c in zip(sides, columns, strict=True))
    lines += ["<tr>" + "".join(heads), "</thead>", "<tbody>"]
    for number, row in enumerate(table.rows):
        cells = []
        for side, column in zip(sides, columns, strict=True):
            value, bracket, interval = escape(_text(row.get(column.key), column)).partition(" [")
            value = f"<b>{value}</b>" if (number, column.key) in best else value
            below = f'<span class="interval">[{interval}</span>' if bracket and side == "number" else bracket + interval
            cells.append(f'<td class="{side}">{value}{below}</td>')
        lines.append("<tr>" + "".join(cells))
    lines += ["</tbody>", "</table></div>"]
    if table.notes:
        lines += ["<ul>", *(f"<li>{escape(note)}</li>" for note in table.notes), "</ul>"]
    return "\n".join([*lines, "</section>"])


def _said_once(table: Table) -> tuple[str, list[Column]]:
    """Return what every row says of itself, in words, and the columns that are left to print."""
    shared = {key: _shared(table, key) for key in table.context}
    said = ", ".join(f"{column.header} {shared[column.key]}" for column in table.columns if shared.get(column.key))
    return said, [column for column in table.columns if not shared.get(column.key)]


def _printed(table: Table, column: Column, best: set[tuple[int, str]]) -> list[str]:
    """Return header and cells of a column as text of equal lengths, the best values starred."""
    cells = [
        _text(row.get(column.key), column) + ("*" if (number, column.key) in best else "")
        for number, row in enumerate(table.rows)
    ]
    size = max(map(len, [column.header, *cells]))
    align = str.ljust if _is_text(table, column) else str.rjust
    return [align(cell, size) for cell in [column.header, *cells]]


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
        rivals = [other for other in table.columns if column.over and other.over and other.header == column.header]
        contests = (
            [[(number, other.key) for other in rivals] for number in range(len(table.rows))]
            if column.over
            else [[(number, column.key) for number in numbers] for numbers in groups.values()]
        )
        for contest in contests:
            badness = {
                place: _badness(cell.value, column)
                for place in contest
                if isinstance(cell := table.rows[place[0]].get(place[1]), Value) and math.isfinite(cell.value)
            }
            # What is alone has nothing to be better than.
            if column.best is None or len(badness if column.over else contest) < 2 or not badness:
                continue
            least = min(badness.values())
            found |= {place for place, value in badness.items() if value == least}
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
