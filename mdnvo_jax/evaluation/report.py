"""What one evaluation found, and the files it leaves: table.md, results.json and pictures."""

import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from mdnvo_jax import files
from mdnvo_jax.evaluation import calibration_plots, plots, tables
from mdnvo_jax.evaluation.calibration import StepScores
from mdnvo_jax.evaluation.tables import Table
from mdnvo_jax.odometry import Trajectory


@dataclass(frozen=True)
class PathPicture:
    """A picture of trajectories from above.

    Attributes:
      file: its name.
      title: says split and alignment.
      paths: method to `[n, 4, 4]`, in the world of `reference`.
      reference: ground truth, `[N, 4, 4]`.
    """

    file: str
    title: str
    paths: Mapping[str, np.ndarray]
    reference: np.ndarray


@dataclass(frozen=True)
class CalibrationPictures:
    """The four pictures of calibration of one method.

    Attributes:
      folder: where they go, below the output folder; empty for the output folder itself.
      title: says method, split and what sigma is.
      scores: of every step.
    """

    folder: str
    title: str
    scores: StepScores


@dataclass(frozen=True)
class UncertaintyPicture:
    """A picture of the six components of every step with their bands.

    Attributes:
      file: its name.
      title: says method and split.
      trajectory: predicted.
      truth: true steps, `[N-1, 6]`, m and rad.
    """

    file: str
    title: str
    trajectory: Trajectory
    truth: np.ndarray


@dataclass(frozen=True)
class Report:
    """What one evaluation found.

    Attributes:
      tables: to print; the files hold them all.
      details: tables for the files alone.
      results: statistics in full, for results.json.
      pictures: of trajectories, to draw.
      calibration: to draw.
      uncertainty: to draw.
    """

    tables: Sequence[Table]
    details: Sequence[Table]
    results: Mapping[str, Any]
    pictures: Sequence[PathPicture]
    calibration: Sequence[CalibrationPictures] = field(default_factory=tuple)
    uncertainty: Sequence[UncertaintyPicture] = field(default_factory=tuple)


def write(report: Report, directory: Path) -> list[str]:
    """Write everything into `directory`, an existing folder, and return the names of the files."""
    every = [*report.tables, *report.details]
    files.write_text(directory / "table.md", "\n".join(tables.as_markdown(table) for table in every))
    written = ["table.md", "results.json"]
    for picture in report.pictures:
        plots.plot_paths(picture.paths, directory / picture.file, title=picture.title, reference=picture.reference)
        written.append(picture.file)
    for bands in report.uncertainty:
        plots.plot_uncertainty(bands.trajectory, directory / bands.file, truth=bands.truth, title=bands.title)
        written.append(bands.file)
    for group in report.calibration:
        folder = directory / group.folder
        folder.mkdir(exist_ok=True)
        names = calibration_plots.plot_calibration(group.scores, folder, title=group.title)
        written += [str(Path(group.folder) / name) for name in names]
    data = {
        "command": shlex.join(sys.orig_argv),
        "versions": {name: metadata.version(name) for name in ("mdnvo_jax", "evo", "numpy", "scipy", "matplotlib")},
        "results": report.results,
        "tables": [tables.as_data(table) for table in every],
    }
    # Last, so that a complete results.json says that everything else is there as well.
    text = json.dumps(tables.finite(data), indent=2, allow_nan=False) + "\n"
    files.write_text(directory / "results.json", text)
    return written


def as_text(report: Report) -> str:
    """Return what the terminal shows."""
    return "\n".join(tables.as_text(table) for table in report.tables)
