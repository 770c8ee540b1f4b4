import json
import math

import pytest

from mdnvo_jax.evaluation.tables import Column, Table, Value, as_data, as_markdown, as_text, finite

COLUMNS = (
    Column("name", "estimate"),
    Column("split", "split"),
    Column("rmse", "RMSE (m)", 2, "low"),
    Column("rank", "Spearman", 2, "high"),
    Column("inside", "in 1 sigma (68 %)", 0, 68.0),
    Column("free", "free", 1),
)


def row(name, rmse, rank, inside, split="10", **more):
    return {
        "name": name,
        "split": split,
        "rmse": rmse if isinstance(rmse, Value) else Value(rmse),
        "rank": Value(rank),
        "inside": Value(inside),
        "free": Value(1.0),
        **more,
    }


TABLE = Table(
    "Errors",
    COLUMNS,
    [
        row("one", Value(0.123, 0.1, 0.2), 0.5, 60.0),
        row("two|b", Value(0.2, spread=0.05), 0.7, 70.0),
        row("three", math.nan, math.nan, 90.0),
    ],
    context=("split",),
    notes=("a note",),
)


def test_markdown():
    assert as_markdown(TABLE).splitlines() == [
        "### Errors",
        "",
        "| estimate | split | RMSE (m) | Spearman | in 1 sigma (68 %) | free |",
        "|---|---|---:|---:|---:|---:|",
        "| one | 10 | **0.12 [0.10, 0.20]** | 0.50 | 60 | 1.0 |",
        "| two\\|b | 10 | 0.20 ± 0.05 | **0.70** | **70** | 1.0 |",
        "| three | 10 | - | - | 90 | 1.0 |",
        "",
        "- a note",
    ]


def test_text_says_once_what_every_row_shares():
    assert as_text(TABLE).splitlines() == [
        "Errors",
        "every row: split 10",
        "",
        "estimate            RMSE (m)  Spearman  in 1 sigma (68 %)  free",
        "one       0.12 [0.10, 0.20]*      0.50                 60   1.0",
        "two|b            0.20 ± 0.05     0.70*                70*   1.0",
        "three                      -         -                 90   1.0",
        "",
        "- a note",
    ]


def test_a_narrow_terminal_gets_the_columns_below_each_other():
    lines = as_text(TABLE, width=50).splitlines()
    assert max(map(len, lines)) <= 50
    assert sum(line.startswith("estimate") for line in lines) == 2
    assert sum(line.startswith("two|b") for line in lines) == 2


@pytest.mark.parametrize("width", [1, 5])
def test_a_terminal_narrower_than_a_column_still_gets_everything(width):
    assert as_text(TABLE, width=width).count("Spearman") == 1


def test_rows_that_differ_say_so_themselves():
    table = Table("T", COLUMNS, [row("a", 1.0, 1.0, 1.0), row("b", 2.0, 2.0, 2.0, split="05")], context=("split",))
    assert "every row" not in as_text(table)


def test_best_is_sought_within_the_group():
    rows = [row("a", 1.0, 0.1, 1.0), row("b", 2.0, 0.2, 1.0), row("a", 5.0, 0.9, 1.0, split="05")]
    markdown = as_markdown(Table("T", COLUMNS, rows, group="split"))
    assert "**1.00**" in markdown and "**0.20**" in markdown
    # Alone in its split, the third has nothing to be better than.
    assert "**5.00**" not in markdown and "**0.90**" not in markdown


def test_what_prints_the_same_is_as_good():
    rows = [row("a", 0.1201, 0.5, 1.0), row("b", 0.1199, 0.5, 1.0), row("c", 0.3, 0.4, 1.0)]
    assert as_markdown(Table("T", COLUMNS, rows)).count("**0.12**") == 2


def test_nearest_to_nominal_is_best_on_either_side():
    rows = [row("a", 1.0, 1.0, 60.0), row("b", 1.0, 1.0, 75.0), row("c", 1.0, 1.0, 99.0)]
    assert "**75**" in as_markdown(Table("T", COLUMNS, rows))


def test_data_are_whole_numbers_of_json():
    data = json.loads(json.dumps(finite(as_data(TABLE)), allow_nan=False))
    assert data["rows"][0]["rmse"] == {"value": 0.123, "low": 0.1, "high": 0.2}
    assert data["rows"][1]["rank"] == 0.7
    assert data["rows"][2]["rmse"] is None
    assert data["columns"]["rmse"] == "RMSE (m)" and data["notes"] == ["a note"]
