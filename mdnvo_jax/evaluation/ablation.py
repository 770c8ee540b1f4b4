"""One choice changed at a time, everything else equal, several seeds each: what `bin/ablate` does."""

import argparse
import csv
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mdnvo_jax import files
from mdnvo_jax.errors import InputError, Parser
from mdnvo_jax.evaluation.tables import Column, Row, Table, Value, as_markdown

BASE = "as in the config"
# Options of `python -m mdnvo_jax.train` by what they change. Windows of one step see nothing of the time about them;
# their batches hold as many pairs as the others'.
VARIANTS: Mapping[str, Sequence[str]] = {
    BASE: (),
    "regression (DeepVO's head and loss)": ("--model.head", "regression", "--training.beta", "0"),
    "1 component": ("--model.components", "1"),
    "5 components": ("--model.components", "5"),
    "10 components": ("--model.components", "10"),
    "coupling joint": ("--model.coupling", "joint"),
    "plain NLL, mean over steps": ("--training.beta", "0"),
    "plain NLL, the paper's mean over a sequence": ("--training.beta", "0", "--training.reduction", "sequence"),
    "causal LSTM": ("--model.bidirectional", "false"),
    "no context in time": ("--data.window", "1", "--training.batch_size", "96"),
    "window of 4 steps": ("--data.window", "4", "--training.batch_size", "24"),
    "window of 24 steps": ("--data.window", "24", "--training.batch_size", "4"),
    "no optical flow": ("--model.flow_weight", "0"),
    "a camera that sways and pans": ("--data.sway", "0.4"),
    "no dropout in the LSTM": ("--model.lstm_dropout", "0"),
}
# What is compared: the columns of metrics.csv, their headers, and digits.
_MEASURED = (
    ("validation_translation_rmse_m", "trans. RMSE (m)", 4),
    ("validation_rotation_rmse_deg", "rot. RMSE (deg)", 4),
    ("validation_loss", "NLL (nats)", 3),
)
# Student's t for a two-sided interval of 95 %, by degrees of freedom.
_STUDENT = {1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776, 5: 2.571, 6: 2.447, 7: 2.365, 8: 2.306, 9: 2.262}


def main(arguments: Sequence[str]) -> None:
    """Train what is missing of every variant and seed, and write the table.

    Raises:
      InputError: an option is unusable, or a training failed.
    """
    options = _options(arguments)
    output = Path(options.output)
    found: dict[str, list[dict[str, float]]] = {}
    # A seed of all variants before the next seed: what is there when one stops early can be compared.
    for seed in options.seeds:
        for name in options.variants:
            row = _last_row(options, name, seed)
            found.setdefault(name, []).append(row)
            print(f"seed {seed}, {name}: {row['validation_translation_rmse_m']:.4f} m", flush=True)
    text = as_markdown(table(found, options.seeds))
    files.write_text(output / "table.md", text)
    print(text)


def table(found: Mapping[str, Sequence[Mapping[str, float]]], seeds: Sequence[int]) -> Table:
    """Return a row a variant: means over seeds, and differences from the first variant, seed by seed, with intervals.

    Args:
      found: the last row of metrics.csv of each seed, by variant.
      seeds: one a row.
    """
    columns = [Column("name", "variant")]
    for key, header, digits in _MEASURED:
        columns += [Column(key, header, digits), Column(f"{key}_more", "more than the first [95 %]", digits)]
    names = list(found)
    rows: list[Row] = []
    for name in names:
        cells: dict[str, Value | str] = {"name": name}
        for key, _, _ in _MEASURED:
            if key == "validation_loss" and "regression" in name:
                continue  # DeepVO's squared error
            values = np.array([row[key] for row in found[name]])
            cells[key] = Value(float(values.mean()))
            if name != names[0]:
                cells[f"{key}_more"] = interval(values - np.array([row[key] for row in found[names[0]]]))
        rows.append(cells)
    notes = [
        f"Validation worlds, last epoch, means over the seeds {' '.join(map(str, seeds))}; differences are taken seed "
        "by seed, their intervals are Student's. An interval that holds 0 says that the difference may be chance."
    ]
    return Table("One choice changed at a time", columns, rows, notes=notes)


def interval(values: np.ndarray) -> Value:
    """Return the mean of `values` with Student's 95 % interval; none for a single value."""
    count = len(values)
    mean = float(values.mean())
    if count < 2:
        return Value(mean)
    half = _STUDENT[count - 1] * float(values.std(ddof=1)) / count**0.5
    return Value(mean, mean - half, mean + half)


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = Parser(prog="bin/ablate", description="Compare choices at equal budget over several seeds.")
    parser.add_argument("config", nargs="?", default="configs/ablation.py", metavar="CONFIG", help="what is varied")
    parser.add_argument("--cache", required=True, metavar="DIR", help="of bin/prepare_kitti --dataset synthetic")
    parser.add_argument("--output", required=True, metavar="DIR", help="a --workdir a training; what is done is kept")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], metavar="N", help="(default: 0 1 2)")
    parser.add_argument(
        "--variants", nargs="+", metavar="NAME", default=list(VARIANTS), help="the others are compared with the first"
    )
    options = parser.parse_args(arguments)
    for name in options.variants:
        if name not in VARIANTS:
            raise InputError(f"no variant {name!r}: expected some of {', '.join(map(repr, VARIANTS))}")
    if not 1 <= len(options.seeds) <= 1 + max(_STUDENT):
        raise InputError(f"{len(options.seeds)} seeds: expected 1 to {1 + max(_STUDENT)}")
    return options


def _last_row(options: argparse.Namespace, name: str, seed: int) -> dict[str, float]:
    """Return the metrics after the last epoch of one training, which is run or gone on with where it is not done."""
    workdir = Path(options.output) / f"{list(VARIANTS).index(name):02d}-{seed}"
    if not (workdir / "done").is_file():
        command = [sys.executable, "-m", "mdnvo_jax.train", options.config, "--workdir", str(workdir)]
        command += ["--data.cache", options.cache, "--training.seed", str(seed), *VARIANTS[name]]
        if any((workdir / "checkpoints").glob("[0-9]*")):
            command.append("--resume")
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise InputError(f"the training of {name!r}, seed {seed}, failed: {last}")
        files.write_text(workdir / "done", "")
    with (workdir / "metrics.csv").open() as lines:
        last_row = list(csv.DictReader(lines))[-1]
    return {key: float(value) for key, value in last_row.items()}
