"""Pictures of calibration: does sigma follow the error, and do the intervals hold what they promise?"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from mdnvo_jax.evaluation import optional
from mdnvo_jax.evaluation.calibration import (
    StepScores,
    area_under_sparsification_error,
    pit_histogram,
    ranked,
    reliability,
    sparsification,
)
from mdnvo_jax.evaluation.plots import BLUE, COLOURS, GREEN, GREY, PANELS, SKY, STROKES, VERMILION, canvas, save

# Median of |e| / sigma of a Gaussian: where the medians lie if sigma is right.
_MEDIAN_OF_SIGMA = 0.6745
# What each picture shows.
SHOWS = {
    "sigma_error.png": "Sigma against absolute error",
    "reliability.png": "Reliability",
    "sparsification.png": "Sparsification",
    "pit.png": "Probability integral transform",
}
_SIGMA_BINS = 8
_LEVELS = np.linspace(0.02, 0.98, 49)


def plot_calibration(scores: StepScores, directory: str | os.PathLike[str], *, title: str) -> list[str]:
    """Write the four pictures of calibration into `directory` and return their names.

    Args:
      scores: of six components, m and rad.
      directory: an existing folder.
      title: says method, split and what sigma is.
    """
    drawn = {
        "sigma_error.png": plot_sigma_error,
        "reliability.png": plot_reliability,
        "sparsification.png": plot_sparsification,
        "pit.png": plot_pit,
    }
    for name, draw in drawn.items():
        draw(scores, Path(directory) / name, title=title)
    return list(drawn)


def plot_sigma_error(scores: StepScores, path: str | os.PathLike[str], *, title: str) -> None:
    """Draw |error| against sigma by component, with the median error of steps of like sigma."""
    figure, grid = canvas(11.0, 7.4, rows=2, columns=3)
    for component, (name, unit, factor) in enumerate(PANELS):
        axes = grid[component // 3, component % 3]
        sigma, error = factor * scores.sigma[:, component], factor * scores.error[:, component]
        axes.plot(sigma, error, linestyle="", marker=".", markersize=3, alpha=0.35, color=GREY, label="a step")
        bins = np.array_split(np.argsort(sigma, kind="stable"), min(_SIGMA_BINS, max(1, len(sigma) // 5)))
        middles = [(np.median(sigma[rows]), np.median(error[rows])) for rows in bins]
        axes.plot(*zip(*middles, strict=True), color=BLUE, marker="o", linewidth=1.6, label="median of like sigma")
        low, high = sigma.min() / 1.3, sigma.max() * 1.3
        ends = np.array([low, high])
        axes.plot(
            ends, _MEDIAN_OF_SIGMA * ends, "--", color="black", linewidth=1.3, label="where medians belong, 0.67 sigma"
        )
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlim(low, high)
        # Errors far below their sigma are many decades of nothing.
        axes.set_ylim(max(error.min(), 0.01 * low, 1e-12), 1.5 * max(error.max(), _MEDIAN_OF_SIGMA * high))
        _label_logarithmic(axes.xaxis, *axes.get_xlim())
        _label_logarithmic(axes.yaxis, *axes.get_ylim())
        axes.set_title(name, fontsize=10)
        axes.set_xlabel(f"sigma ({unit})")
        axes.set_ylabel(f"|error| ({unit})")
        axes.grid(alpha=0.3)
    figure.suptitle(f"Sigma against absolute error of a step\n{title}", fontsize=11)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    save(figure, path)


def plot_reliability(scores: StepScores, path: str | os.PathLike[str], *, title: str) -> None:
    """Draw the share of truths inside central intervals against their probability, translation beside rotation."""
    figure, grid = canvas(10.0, 5.5, columns=2)
    observed = reliability(scores.pit, _LEVELS)
    for part, axes in enumerate(grid):
        axes.plot([0, 1], [0, 1], color="black", linewidth=1.3, label="calibrated")
        for line in range(3):
            axes.plot(
                _LEVELS, observed[:, 3 * part + line], color=COLOURS[line], linestyle=STROKES[line], linewidth=1.8,
                label=PANELS[3 * part + line][0],
            )  # fmt: skip
        axes.text(0.03, 0.97, "intervals too wide", va="top", color=GREY, fontsize=9, transform=axes.transAxes)
        axes.text(0.97, 0.03, "intervals too narrow", ha="right", color=GREY, fontsize=9, transform=axes.transAxes)
        axes.set_box_aspect(1)
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1)
        axes.set_xlabel("probability of the central interval")
        axes.set_ylabel("share of truths inside")
        axes.set_title(("translation", "rotation")[part], fontsize=10)
        axes.legend(loc="center left", bbox_to_anchor=(0.0, 0.72), fontsize=9)
        axes.grid(alpha=0.3)
    figure.suptitle(f"Reliability, {len(scores.pit)} steps\n{title}", fontsize=11)
    save(figure, path)


def plot_sparsification(scores: StepScores, path: str | os.PathLike[str], *, title: str) -> None:
    """Draw the mean error that remains as the steps of largest sigma are removed, and what the best ranking leaves."""
    figure, grid = canvas(10.0, 4.8, columns=2)
    sigma, error = ranked(scores)
    areas = area_under_sparsification_error(sigma, error)
    # The last two columns are the norms of translation and rotation.
    for axes, column, name in zip(grid, (-2, -1), ("translation", "rotation"), strict=True):
        removed, curve, oracle = sparsification(sigma[:, column], error[:, column])
        axes.axhline(1, color=GREY, linestyle=":", linewidth=1.3, label="removed at random")
        axes.fill_between(removed, oracle, curve, color=SKY, alpha=0.3, linewidth=0)
        axes.plot(removed, curve, color=BLUE, linewidth=1.8, label=f"largest sigma first (AUSE {areas[column]:.3f})")
        axes.plot(removed, oracle, "--", color=VERMILION, linewidth=1.6, label="largest error first (oracle)")
        axes.set_xlim(0, 1)
        axes.set_ylim(0, None)
        axes.set_xlabel("share of steps removed")
        axes.set_ylabel(f"mean {name} error left / of all steps")
        axes.set_title(name, fontsize=10)
        axes.legend(loc="lower left", fontsize=9)
        axes.grid(alpha=0.3)
    figure.suptitle(f"Sparsification, {len(error)} steps\n{title}", fontsize=11)
    save(figure, path)


def plot_pit(scores: StepScores, path: str | os.PathLike[str], *, title: str) -> None:
    """Draw the histogram of the PIT by component: flat is calibrated, a bowl over-confident, a dome under-confident."""
    bins = 10 if len(scores.pit) >= 100 else 5
    shares = pit_histogram(scores.pit, bins)
    figure, grid = canvas(11.0, 6.4, rows=2, columns=3)
    # Of steps that know nothing of each other; neighbours do, so that this is the least that chance does.
    chance = 1.96 * np.sqrt((1 / bins) * (1 - 1 / bins) / len(scores.pit)) * bins
    for component, (name, _, _) in enumerate(PANELS):
        axes = grid[component // 3, component % 3]
        axes.axhspan(1 - chance, 1 + chance, color=GREEN, alpha=0.2, label="95 % by chance alone")
        axes.axhline(1, color=GREEN, linewidth=1.3, label="calibrated")
        centres = (np.arange(bins) + 0.5) / bins
        axes.bar(centres, bins * shares[:, component], 0.92 / bins, color=BLUE, alpha=0.75, label="steps", zorder=2)
        axes.set_xlim(0, 1)
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("CDF at the truth")
        axes.set_ylabel("density")
    figure.suptitle(f"Probability integral transform, {len(scores.pit)} steps\n{title}", fontsize=11)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    save(figure, path)


def _label_logarithmic(axis: Any, low: float, high: float) -> None:
    """Write plain numbers at a logarithmic axis, few enough not to overlap and never fewer than two."""
    ticker = optional.load("matplotlib.ticker")
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.log10(high) + 1)
    for steps in ((1,), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7)):
        ticks = np.outer(decades, steps).ravel()
        ticks = ticks[(ticks >= low) & (ticks <= high)]
        if len(ticks) > 2:
            break
    axis.set_major_locator(ticker.FixedLocator(ticks))
    axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(ticker.NullFormatter())
