"""From mixtures over steps to a trajectory with covariance, and its files."""

import csv
import dataclasses
import io
import json
import os
import sys
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np

from mdnvo_jax import files, geometry, mixture
from mdnvo_jax.errors import InputError
from mdnvo_jax.mixture import Coupling, Mixture

Estimate = Literal["mean", "strongest"]
COMPONENTS = ("tx", "ty", "tz", "rx", "ry", "rz")
_UPPER = np.triu_indices(6)


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """Poses with confidence. Everything is float64 in metres, radians and seconds.

    Attributes:
      poses: `[N, 4, 4]`, `T_world_camera`; the first is the identity.
      covariance: `[N, 6, 6]`, of a right perturbation of each pose, `T = T_mean @ exp(xi)`; the first is zero. It holds
        what steps are wrong by, each by itself and all together.
      steps: `[N-1, 6]`, the relative poses as (tx, ty, tz, rx, ry, rz).
      step_covariance: `[N-1, 6, 6]`, covariance of those vectors: of a step by itself, whatever its errors come from.
      timestamps: `[N]` s; frame numbers where the source has none.
      flags: of each step, words joined by "; ", empty where nothing is to be said; see `watch`.
      mixture: the density of each step, `[N-1, M]` and `[N-1, M, 6]`.
      coupling: how that density combines its dimensions.
      scale_sigma: relative standard deviation of the error of scale that all steps share; see `trajectory`.
      correlation: of the errors of any two steps, by component, `[6]`; see `trajectory`.
      serial_correlation: of what is left of the errors of neighbouring steps, by component, `[6]`; likewise.
      about: what else belongs in summary.json.
    """

    poses: np.ndarray
    covariance: np.ndarray
    steps: np.ndarray
    step_covariance: np.ndarray
    timestamps: np.ndarray
    flags: Sequence[str]
    mixture: Mixture
    coupling: Coupling
    scale_sigma: float = 0.0
    correlation: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(6))
    serial_correlation: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(6))
    about: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of every step, `[N-1, 6]`."""
        return np.sqrt(np.diagonal(self.step_covariance, axis1=-2, axis2=-1))

    @property
    def distance_m(self) -> float:
        """Length of the path."""
        return float(np.linalg.norm(self.steps[:, :3], axis=-1).sum())

    def save(self, directory: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write every file that `python -m mdnvo_jax.predict` promises.

        Pictures need matplotlib; without it they are left out, with a line on stderr.

        Raises:
          InputError: `directory` holds files already and `force` is false.
        """
        directory = files.claim_output(directory, force=force)
        files.write_text(directory / "trajectory_kitti.txt", _kitti(self.poses))
        files.write_text(directory / "trajectory_tum.txt", _tum(self.poses, self.timestamps))
        files.write_text(directory / "steps.csv", _csv(_step_rows(self)))
        files.write_text(directory / "covariance.csv", _csv(_covariance_rows(self)))
        with files.whole_file(directory / "mixture.npz") as temporary:
            np.savez(temporary, **self.mixture._asdict())
        files.write_text(directory / "summary.json", json.dumps(_summary(self), indent=2) + "\n")
        try:
            from mdnvo_jax.evaluation import plots

            plots.plot_trajectory(self, directory / "trajectory.png")
            plots.plot_uncertainty(self, directory / "uncertainty.png")
        except InputError as error:
            print(f"no pictures: {error}", file=sys.stderr)


def trajectory(
    steps: Mixture,
    *,
    coupling: Coupling,
    timestamps: np.ndarray | None = None,
    flags: Sequence[str] | None = None,
    estimate: Estimate = "mean",
    order: Literal[1, 2] = 1,
    scale_sigma: float = 0.0,
    correlation: np.ndarray | None = None,
    serial_correlation: np.ndarray | None = None,
) -> Trajectory:
    """Integrate the densities of consecutive steps (equation 8) and propagate their covariance.

    Errors of steps average out along the path as far as they are independent. What all steps of a run are wrong by
    together, because the road, the lens or the mount is unlike the training's, does not, and what neighbouring steps
    are wrong by together, because they see the same frames and the same road, does so more slowly:

    - A scale that is off: true translations are (1 + e) times the given ones, e ~ N(0, scale_sigma^2).
    - Errors of component k of any two steps that have the correlation rho_k: of its variance sigma_k^2 the share rho_k
      is one error for the whole run, in units of sigma_k.
    - The rest, of which steps l apart have the correlation r_k^l: 0 is independent from step to step.

    They are in the covariance of poses (`geometry.scale_covariance`, `shared_covariance`, `serial_covariance`). The
    steps and their sigmas stay as they are: they are meant to hold for each step by itself, whatever its error comes
    from. So the scale's share in a single step is in a pose's covariance twice, once as if independent: of n steps
    alike that is at most one part in n of the scale's term.

    Args:
      steps: logits `[N-1, M]`, mean and log_scale `[N-1, M, 6]`, in metres and radians.
      coupling: of the density.
      timestamps: `[N]` s.
      flags: a word a step.
      estimate: "mean" and covariance of the whole mixture (law of total variance), or those of the "strongest"
        component.
      order: of the covariance propagation, 1 or 2; see `geometry.propagate_covariance`.
      scale_sigma: see above, 0 or more.
      correlation: rho of each component, `[6]`, from 0 to 1; None for 0.
      serial_correlation: r of each component, likewise.

    Raises:
      InputError: `scale_sigma` is no number of 0 or more.
      ValueError: a correlation is not of that shape or range.
    """
    check_scale_sigma(scale_sigma)
    correlation, serial_correlation = _six(correlation, "correlation"), _six(serial_correlation, "serial_correlation")
    leaves: list[Any] = [np.asarray(leaf, np.float64) for leaf in steps]
    steps = Mixture(*leaves)
    reported = mixture.strongest(steps) if estimate == "strongest" else steps
    vectors = np.asarray(mixture.mean(reported), np.float64)
    covariance = np.asarray(mixture.covariance(reported, coupling=coupling), np.float64)
    matrices = geometry.step_to_matrix(vectors)
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    alone = np.sqrt(1 - correlation)
    perturbation = geometry.step_covariance_to_perturbation(vectors, alone[:, None] * covariance * alone)
    to_perturbation = geometry.step_jacobian(vectors)
    # Errors of components that go together are made of six that do not, each as near to its component as can be.
    share, axes = np.linalg.eigh(covariance / (sigma[:, :, None] * sigma[:, None, :]))
    apart = (axes * np.sqrt(np.maximum(share, 0))[:, None, :]) @ np.swapaxes(axes, -1, -2)
    count = len(vectors) + 1
    poses = np.asarray(geometry.accumulate(matrices))
    propagated = np.asarray(geometry.propagate_covariance(matrices, perturbation, order=order))
    return Trajectory(
        poses=poses,
        covariance=propagated
        + geometry.scale_covariance(poses, scale_sigma)
        + geometry.shared_covariance(poses, to_perturbation * (np.sqrt(correlation) * sigma)[:, None, :])
        + geometry.serial_covariance(
            matrices, to_perturbation @ ((alone * sigma)[:, :, None] * apart), serial_correlation
        ),
        steps=vectors,
        step_covariance=covariance,
        timestamps=np.arange(count, dtype=np.float64) if timestamps is None else np.asarray(timestamps, np.float64),
        flags=[""] * (count - 1) if flags is None else list(flags),
        mixture=steps,
        coupling=coupling,
        scale_sigma=float(scale_sigma),
        correlation=correlation,
        serial_correlation=serial_correlation,
        about={"estimate": estimate, "timestamps": "frame numbers" if timestamps is None else "given"},
    )


def _six(correlation: np.ndarray | None, name: str) -> np.ndarray:
    correlation = np.zeros(6) if correlation is None else np.asarray(correlation, np.float64)
    if not are_correlations(correlation):
        raise ValueError(f"{name} is {correlation}: expected six numbers from 0 to 1")
    return correlation


def are_correlations(values: np.ndarray) -> bool:
    """Whether `values` can be correlations of steps, by component: `[6]`, each from 0 to 1."""
    return values.shape == (6,) and bool(((values >= 0) & (values <= 1)).all())


def is_scale_sigma(sigma: float) -> bool:
    """Whether `sigma` can be the standard deviation of a scale's error: a number of 0 or more."""
    return bool(np.isfinite(sigma) and sigma >= 0)


def check_scale_sigma(sigma: float) -> None:
    """Raise an InputError where the standard deviation of a scale's error is no number of 0 or more."""
    if not is_scale_sigma(sigma):
        raise InputError(f"the scale's sigma is {sigma}: expected a share such as 0.05, 0 or more")


def window_plan(count: int, window: int, hop: int) -> Iterator[tuple[int, int, int]]:
    """Say which window estimates which step: the one that sees most on both sides of it.

    Args:
      count: steps in the sequence, at least one.
      window: steps in a window.
      hop: steps between the starts of windows.

    Yields:
      (start, first, last): the window from step `start` gives the steps `first` to `last - 1`. The steps given are
      0 to `count - 1`, each once, in order.
    """
    final = max(count - window, 0)
    starts = [*range(0, final, hop), final]
    first = 0
    for start, after in zip(starts, [*starts[1:], None], strict=True):
        # Between the centres of this window and the next; a step as near to both goes to the later one.
        last = count if after is None else (start + after + window) // 2
        yield start, first, last
        first = last


def _kitti(poses: np.ndarray) -> str:
    """Return the 12 numbers of every pose, a line each."""
    return "".join(" ".join(f"{value:.9e}" for value in pose[:3].reshape(-1)) + "\n" for pose in poses)


def _tum(poses: np.ndarray, timestamps: np.ndarray) -> str:
    """Return `timestamp tx ty tz qx qy qz qw` of every pose, a line each."""
    quaternions = geometry.quaternion_from_matrix(poses[:, :3, :3])
    rows = zip(timestamps, poses[:, :3, 3], quaternions, strict=True)
    return "".join(
        f"{time:.9f} " + " ".join(f"{value:.9f}" for value in (*translation, *quaternion)) + "\n"
        for time, translation, quaternion in rows
    )


def _csv(rows: list[list[Any]]) -> str:
    """Return rows as comma-separated text."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _step_rows(path: Trajectory) -> list[list[Any]]:
    """Return the rows of steps.csv."""
    peak = mixture.log_prob(path.mixture, mixture.mode(path.mixture, coupling=path.coupling), coupling=path.coupling)
    header = ["frame", "timestamp", *COMPONENTS, *(f"sigma_{name}" for name in COMPONENTS), "log_density_peak", "flags"]
    rows = zip(path.timestamps[1:], path.steps, path.sigma, np.asarray(peak), path.flags, strict=True)
    return [
        header,
        *(
            [frame, f"{time:.9f}", *(f"{value:.9g}" for value in (*step, *sigma, density)), flag]
            for frame, (time, step, sigma, density, flag) in enumerate(rows, start=1)
        ),
    ]


def _covariance_rows(path: Trajectory) -> list[list[Any]]:
    """Return the rows of covariance.csv: of the absolute pose, then of the step that led to it (zero for the first)."""
    steps = np.concatenate([np.zeros((1, 6, 6)), path.step_covariance])
    names = [f"{COMPONENTS[row]}_{COMPONENTS[column]}" for row, column in zip(*_UPPER, strict=True)]
    header = ["frame", *(f"pose_{name}" for name in names), *(f"step_{name}" for name in names)]
    rows = [
        [frame, *(f"{value:.9g}" for value in (*pose[_UPPER], *step[_UPPER]))]
        for frame, (pose, step) in enumerate(zip(path.covariance, steps, strict=True))
    ]
    return [header, *rows]


def _summary(path: Trajectory) -> dict[str, Any]:
    """Return what summary.json holds."""
    end_sigma = np.sqrt(np.diagonal(path.covariance[-1]))
    return {
        "frames": len(path.poses),
        "distance_m": path.distance_m,
        "end_position_m": path.poses[-1, :3, 3].tolist(),
        "end_sigma": dict(zip(COMPONENTS, end_sigma.tolist(), strict=True)),
        "median_step_sigma": dict(zip(COMPONENTS, np.median(path.sigma, axis=0).tolist(), strict=True)),
        "flagged_steps": sum(bool(flag) for flag in path.flags),
        "coupling": path.coupling,
        "scale_sigma": path.scale_sigma,
        "step_correlation": dict(zip(COMPONENTS, path.correlation.tolist(), strict=True)),
        "serial_correlation": dict(zip(COMPONENTS, path.serial_correlation.tolist(), strict=True)),
        **path.about,
    }
