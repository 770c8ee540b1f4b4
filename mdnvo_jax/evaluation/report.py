"""What one evaluation found, and the files it leaves: table.md, report.html, results.json and pictures."""

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
from mdnvo_jax.evaluation import calibration_plots, page, plots, tables
from mdnvo_jax.evaluation.calibration import StepScores
from mdnvo_jax.evaluation.page import Picture
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
class ScenePicture:
    """The path of one sequence, and x, y and yaw of its steps with their bands.

    Attributes:
      file: its name.
      title: says scene and method.
      trajectory: predicted.
      reference: true poses, `[N, 4, 4]`.
    """

    file: str
    title: str
    trajectory: Trajectory
    reference: np.ndarray


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
      scenes: to draw.
    """

    tables: Sequence[Table]
    details: Sequence[Table]
    results: Mapping[str, Any]
    pictures: Sequence[PathPicture]
    calibration: Sequence[CalibrationPictures] = field(default_factory=tuple)
    uncertainty: Sequence[UncertaintyPicture] = field(default_factory=tuple)
    scenes: Sequence[ScenePicture] = field(default_factory=tuple)


def write(report: Report, directory: Path) -> list[str]:
    """Write everything into `directory`, an existing folder, and return the names of the files."""
    every = [*report.tables, *report.details]
    files.write_text(directory / "table.md", "\n".join(tables.as_markdown(table) for table in every))
    pictures = _draw(report, directory)
    command = shlex.join(sys.orig_argv)
    versions = {name: metadata.version(name) for name in ("mdnvo_jax", "evo", "numpy", "scipy", "matplotlib")}
    about = {"Command": command, "Versions": ", ".join(f"{name} {version}" for name, version in versions.items())}
    title = f"Evaluation: {directory.resolve().name}"
    files.write_text(directory / "report.html", page.as_page(title, about, report.tables, report.details, pictures))
    data = {
        "command": command,
        "versions": versions,
        "results": report.results,
        "tables": [tables.as_data(table) for table in every],
    }
    # Last, so that a complete results.json says that everything else is there as well.
    text = json.dumps(tables.finite(data), indent=2, allow_nan=False) + "\n"
    files.write_text(directory / "results.json", text)
    names = [str(picture.path.relative_to(directory)) for picture in pictures]
    return ["table.md", "report.html", "results.json", *names]


def _draw(report: Report, directory: Path) -> list[Picture]:
    """Draw every picture into `directory`."""
    drawn = []
    for picture in report.pictures:
        plots.plot_paths(picture.paths, directory / picture.file, title=picture.title, reference=picture.reference)
        drawn.append(Picture(directory / picture.file, picture.title))
    for bands in report.uncertainty:
        plots.plot_uncertainty(bands.trajectory, directory / bands.file, truth=bands.truth, title=bands.title)
        drawn.append(Picture(directory / bands.file, bands.title))
    for scene in report.scenes:
        plots.plot_scene(scene.trajectory, scene.reference, directory / scene.file, title=scene.title)
        drawn.append(Picture(directory / scene.file, scene.title))
    for group in report.calibration:
        folder = directory / group.folder
        folder.mkdir(exist_ok=True)
        names = calibration_plots.plot_calibration(group.scores, folder, title=group.title)
        drawn += [Picture(folder / name, f"{calibration_plots.SHOWS[name]}: {group.title}") for name in names]
    return drawn


def as_text(report: Report) -> str:
    """Return what the terminal shows."""
    return "\n".join(tables.as_text(table) for table in report.tables)
