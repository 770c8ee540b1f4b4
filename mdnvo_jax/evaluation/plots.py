"""Pictures of trajectories and of their uncertainty. Needs matplotlib alone; no display, and no state of pyplot's.

Colours are Okabe and Ito's, which people with any colour vision tell apart; the truth is black.
"""

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnvo_jax import files, geometry
from mdnvo_jax.evaluation import optional

if TYPE_CHECKING:
    from mdnvo_jax.odometry import Trajectory

BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, GREY = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8A8A8A",
)  # fmt: skip
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
# Lines differ in stroke too, for print in grey.
STROKES = ("-", "--", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (7, 2)))
# What the six components of a step are called and shown in: name, unit, factor from m or rad.
PANELS = (
    ("x, right", "m", 1.0),
    ("y, down", "m", 1.0),
    ("z, forward", "m", 1.0),
    ("about x, pitch", "deg", 180 / np.pi),
    ("about y, yaw", "deg", 180 / np.pi),
    ("about z, roll", "deg", 180 / np.pi),
)
_DPI = 120
# Semi-axes of an ellipse that holds 95 % of a Gaussian in the plane, in standard deviations: sqrt(-2 ln 0.05).
_ELLIPSE_SIGMAS = float(np.sqrt(-2 * np.log(0.05)))
_ELLIPSES = 24
_SIGMAS = 3


def plot_paths(
    paths: Mapping[str, np.ndarray], path: str | os.PathLike[str], *, title: str, reference: np.ndarray | None = None
) -> None:
    """Draw trajectories from above: x to the right, z forward, of the first camera of the reference.

    Args:
      paths: name to `T_world_camera`, `[n, 4, 4]`, in one world.
      path: the picture to write.
      title: says split and alignment.
      reference: ground truth, `[N, 4, 4]`, in that world.
    """
    first = next(iter(paths.values())) if reference is None else reference
    into_first = np.linalg.inv(first[0])
    figure, axes = _map([into_first @ poses for poses in (first, *paths.values())])
    if reference is not None:
        across, ahead = _from_above(into_first @ reference)
        axes.plot(across, ahead, color="black", linewidth=2.2, label="ground truth", zorder=2)
    for number, (name, poses) in enumerate(paths.items()):
        across, ahead = _from_above(into_first @ poses)
        colour, stroke = COLOURS[number % len(COLOURS)], STROKES[number % len(STROKES)]
        axes.plot(across, ahead, color=colour, linestyle=stroke, linewidth=1.6, label=name, zorder=3)
    _mark_start(axes, *(values[0] for values in _from_above(into_first @ first)))
    _finish_map(axes, title)
    _legend_below(figure, axes)
    save(figure, path)


def plot_trajectory(trajectory: "Trajectory", path: str | os.PathLike[str]) -> None:
    """Draw a predicted path from above with ellipses that hold the position with 95 % probability, to first order.

    Args:
      trajectory: of `odometry`.
      path: the picture to write.
    """
    patches = optional.load("matplotlib.patches")
    poses = trajectory.poses
    figure, axes = _map([poses])
    across, ahead = _from_above(poses)
    # A right perturbation lives in the axes of the camera; its translation turns into the world with the camera.
    rotation = poses[:, :3, :3]
    position = (rotation @ trajectory.covariance[:, :3, :3] @ rotation.swapaxes(1, 2))[:, ::2, ::2]
    shown = np.unique(np.linspace(0, len(poses) - 1, _ELLIPSES + 1).round().astype(int))[1:]
    label = "95 % confidence"
    for frame in shown:
        variances, directions = np.linalg.eigh(position[frame])
        width, height = 2 * _ELLIPSE_SIGMAS * np.sqrt(np.maximum(variances, 0))
        angle = np.degrees(np.arctan2(directions[1, 0], directions[0, 0]))
        axes.add_artist(
            patches.Ellipse(
                (across[frame], ahead[frame]), width, height, angle=angle,
                facecolor=(*_rgb(SKY), 0.16), edgecolor=(*_rgb(BLUE), 0.55), linewidth=0.8, label=label, zorder=1,
            )
        )  # fmt: skip
        label = "_nolegend_"
    axes.plot(across, ahead, color=BLUE, linewidth=2.0, label="predicted path", zorder=3)
    _mark_start(axes, across[0], ahead[0])
    reach = _ELLIPSE_SIGMAS * np.sqrt(np.diagonal(position[shown], axis1=1, axis2=2))
    _limit(axes, np.stack([across, ahead], axis=1), np.stack([across, ahead], axis=1)[shown], reach)
    length_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    _finish_map(axes, f"Predicted path from above, {len(poses)} frames, {length_m:.1f} m (no alignment)")
    _legend_below(figure, axes)
    save(figure, path)


def plot_uncertainty(
    trajectory: "Trajectory", path: str | os.PathLike[str], *, truth: np.ndarray | None = None, title: str = ""
) -> None:
    """Draw the six components of every step with their 3-sigma bands, and the truth where it is known.

    Args:
      trajectory: of `odometry`.
      path: the picture to write.
      truth: true steps, `[N-1, 6]`, m and rad.
      title: what to say above instead of the usual.
    """
    figure, grid = canvas(11.0, 7.2, rows=3, columns=2)
    steps = trajectory.steps
    sigma = np.sqrt(np.diagonal(trajectory.step_covariance, axis1=1, axis2=2))
    flagged = np.array([bool(flag) for flag in trajectory.flags], bool)
    legend: dict[str, Any] = {}
    for component, (name, unit, factor) in enumerate(PANELS):
        # Translation in the left column, rotation in the right one.
        axes = grid[component % 3, component // 3]
        middle, reach = factor * steps[:, component], _SIGMAS * factor * sigma[:, component]
        true = None if truth is None else factor * truth[:, component]
        legend.update(_draw_steps(axes, middle, reach, true, flagged))
        axes.set_ylabel(f"{name} ({unit})")
        if component % 3 == 2:
            axes.set_xlabel("frame")
    figure.suptitle(title or f"Predicted steps with 3-sigma bands, {len(steps) + 1} frames (no alignment)")
    figure.legend(list(legend.values()), list(legend), loc="outside lower center", ncols=len(legend), fontsize=9)
    save(figure, path)


def plot_scene(trajectory: "Trajectory", reference: np.ndarray, path: str | os.PathLike[str], *, title: str) -> None:
    """Draw the paper's figure of uncertainty: the path, and x, y and yaw of every step with their 3-sigma bands.

    Of a car's axes, x ahead and y to the left, as nuScenes has them: the camera's z and -x; yaw is about -y.

    Args:
      trajectory: of `odometry`.
      reference: true poses, `[N, 4, 4]`; the prediction is put on the first of them.
      path: the picture to write.
      title: says scene and method.
    """
    figure, grid = canvas(11.0, 8.0, rows=2, columns=2)
    into_first = np.linalg.inv(reference[0])
    across, ahead = _from_above(into_first @ reference)
    grid[0, 0].plot(across, ahead, color="black", linewidth=2.2)
    grid[0, 0].plot(*_from_above(trajectory.poses), color=BLUE, linewidth=1.6)
    _mark_start(grid[0, 0], across[0], ahead[0])
    _finish_map(grid[0, 0], "Path from above, no alignment but of the first pose")
    truth = np.asarray(geometry.matrix_to_step(geometry.relative_steps(reference)))
    flagged = np.array([bool(flag) for flag in trajectory.flags], bool)
    legend: dict[str, Any] = {}
    panels = (("x, ahead", 2, 1.0, "m"), ("y, left", 0, -1.0, "m"), ("yaw, to the left", 4, -180 / np.pi, "deg"))
    for axes, (name, component, factor, unit) in zip((grid[0, 1], grid[1, 0], grid[1, 1]), panels, strict=True):
        middle, true = (factor * steps[:, component] for steps in (trajectory.steps, truth))
        reach = _SIGMAS * abs(factor) * trajectory.sigma[:, component]
        legend.update(_draw_steps(axes, middle, reach, true, flagged))
        axes.set_title(name, fontsize=11)
        axes.set_ylabel(f"of a step ({unit})")
        axes.set_xlabel("frame")
    figure.suptitle(title)
    figure.legend(list(legend.values()), list(legend), loc="outside lower center", ncols=len(legend), fontsize=9)
    save(figure, path)


def _draw_steps(
    axes: Any, middle: np.ndarray, reach: np.ndarray, true: np.ndarray | None, flagged: np.ndarray
) -> dict[str, Any]:
    """Draw one component of every step, `[n]`, with its band and its truth, and return what the legend is to name."""
    frames = np.arange(1, len(middle) + 1)
    # A drawing of one step needs markers: a line through one point is invisible.
    stroke: dict[str, Any] = {"marker": "." if len(middle) <= 60 else None, "markersize": 4}
    stroke["linewidth"] = 1.3 if len(middle) <= 300 else 0.7
    # Half a frame on either side, so that a single step has a band as well.
    band = axes.fill_between(
        np.concatenate([[0.5], frames, [len(middle) + 0.5]]),
        *(np.pad(middle + sign * reach, 1, mode="edge") for sign in (-1, 1)),
        color=SKY, alpha=0.35, linewidth=0,
    )  # fmt: skip
    (line,) = axes.plot(frames, middle, color=BLUE, **stroke)
    drawn = {"prediction": line, "3-sigma band": band}
    if true is not None:
        (drawn["ground truth"],) = axes.plot(frames, true, color="black", **stroke)
        outside = np.abs(true - middle) > reach
        if outside.any():
            (drawn["ground truth outside"],) = axes.plot(
                frames[outside], true[outside], linestyle="", marker="x", color=VERMILION, markersize=5
            )
    if flagged.any():
        (drawn["flagged"],) = axes.plot(
            frames[flagged], middle[flagged], linestyle="", marker="^", color=VERMILION, markersize=6
        )
    _bound(axes, middle, reach)
    axes.grid(alpha=0.3)
    axes.margins(x=0.01)
    axes.xaxis.get_major_locator().set_params(integer=True)
    return drawn


def canvas(width: float, height: float, *, rows: int = 1, columns: int = 1) -> tuple[Any, Any]:
    """Return a new figure of that size in inches, and its axes: one, or an array `[rows, columns]`."""
    figure = optional.load("matplotlib.figure").Figure(figsize=(width, height), layout="constrained")
    optional.load("matplotlib.backends.backend_agg").FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns)


def save(figure: Any, path: str | os.PathLike[str]) -> None:
    """Write `figure` to `path`, whole or not at all; the suffix chooses the format."""
    with files.whole_file(path) as temporary:
        figure.savefig(temporary, dpi=_DPI)


def _map(paths: list[np.ndarray]) -> tuple[Any, Any]:
    """Return a figure and its axes, in a format that suits what `paths` cover seen from above."""
    points = np.concatenate([poses[:, :3:2, 3] for poses in paths])
    width, height = np.maximum(np.ptp(points, axis=0), 1e-6)
    tall = float(np.clip(height / width, 0.35, 1.4))
    across = 8.0 / max(1.0, tall)
    return canvas(across + 0.6, across * tall + 0.8)


def _from_above(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x and z of the camera centres of `[n, 4, 4]`."""
    return poses[:, 0, 3], poses[:, 2, 3]


def _mark_start(axes: Any, across: float, ahead: float) -> None:
    """Mark where the path begins."""
    axes.plot(
        [across], [ahead], linestyle="", marker="o", markersize=9, markerfacecolor="white", markeredgecolor="black",
        markeredgewidth=1.8, label="start", zorder=5,
    )  # fmt: skip


def _legend_below(figure: Any, axes: Any) -> None:
    """Say below the map what is what: a path may end anywhere on it."""
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", fontsize=9)


def _finish_map(axes: Any, title: str) -> None:
    """Label a view from above and give it equal axes."""
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x, right (m)")
    axes.set_ylabel("z, forward (m)")
    axes.set_title(title, fontsize=11)
    axes.grid(alpha=0.3)


def _limit(axes: Any, points: np.ndarray, centres: np.ndarray, reach: np.ndarray) -> None:
    """Show all of the path, and of the ellipses as much as leaves the path half of the picture."""
    low, high = points.min(axis=0), points.max(axis=0)
    allowance = max(float((high - low).max()), 1e-3) / 2
    low = np.clip((centres - reach).min(axis=0), low - allowance, low)
    high = np.clip((centres + reach).max(axis=0), high, high + allowance)
    # Data that takes room but is not drawn: fixed limits and equal axes would contradict each other.
    axes.update_datalim(np.stack([low, high]))
    axes.autoscale_view()


def _bound(axes: Any, middle: np.ndarray, reach: np.ndarray) -> None:
    """Keep a few very uncertain steps, such as held frames, from flattening all others."""
    usual = np.quantile(reach, 0.9)
    if reach.max() > 5 * usual:
        axes.set_ylim(middle.min() - 3 * usual, middle.max() + 3 * usual)


def _rgb(colour: str) -> tuple[float, float, float]:
    """Return red, green, blue from 0 to 1 of "#RRGGBB"."""
    red, green, blue = (int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue
