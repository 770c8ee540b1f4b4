"""What a whole run adds up to: how far off its end is, whether its covariance says so, and whether speed is biased."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mdnvo_jax import geometry
from mdnvo_jax.evaluation.tables import Column, Row, Table, Value
from mdnvo_jax.odometry import Trajectory

# A true step shorter than this stands still: a tenth of walking pace at ten frames a second, m.
STANDING_M = 0.02
# Share of its draws that a chi-square distribution of 6 degrees of freedom has below, and the value there.
END_LEVEL, END_BOUND = 0.95, 12.592


@dataclass(frozen=True)
class Drift:
    """The drift of one run.

    Attributes:
      path_m: length of the true path.
      speed_bias: length of the predicted steps over that of the true ones, less one; NaN where nothing moves.
      end_m: distance of the predicted end from the true one, the first poses being one.
      end_deg: angle between their rotations.
      end_sigma_m: root of the trace of the covariance of the end's position.
      end_nees: e^T P^-1 e of the end, e = log(T_predicted^-1 T_true) in SE(3); 6 on average where covariances are
        right. NaN where P is singular.
      standing_m: mean length of the predicted steps where the true one is below `STANDING_M`; NaN where there is none.
      standing: how many those are.
    """

    path_m: float
    speed_bias: float
    end_m: float
    end_deg: float
    end_sigma_m: float
    end_nees: float
    standing_m: float
    standing: int


def drift(path: Trajectory, truth: np.ndarray) -> Drift:
    """Measure the drift of a run; `truth` is `T_world_camera` of the same frames, `[N, 4, 4]`, in any world."""
    true_steps = geometry.relative_steps(truth)
    true_m = np.linalg.norm(true_steps[:, :3, 3], axis=-1)
    predicted_m = np.linalg.norm(path.steps[:, :3], axis=-1)
    end = geometry.inverse(truth[0]) @ truth[-1]
    error = geometry.log_se3(geometry.inverse(path.poses[-1]) @ end)
    covariance = path.covariance[-1]
    standing = true_m < STANDING_M
    regular = np.linalg.matrix_rank(covariance, hermitian=True) == 6
    return Drift(
        path_m=float(true_m.sum()),
        speed_bias=float(predicted_m.sum() / true_m.sum() - 1) if not standing.all() else float("nan"),
        end_m=float(np.linalg.norm(path.poses[-1, :3, 3] - end[:3, 3])),
        end_deg=float(np.rad2deg(np.linalg.norm(error[3:]))),
        end_sigma_m=float(np.sqrt(np.trace(covariance[:3, :3]))),
        end_nees=float(error @ np.linalg.solve(covariance, error)) if regular else float("nan"),
        standing_m=float(predicted_m[standing].mean()) if standing.any() else float("nan"),
        standing=int(standing.sum()),
    )


def drift_table(rows: Sequence[tuple[str, str, int, Drift]]) -> Table:
    """Return a row for each (name, split, frames, drift)."""
    columns = (
        Column("name", "estimate"),
        Column("split", "split"),
        Column("frames", "frames"),
        Column("path", "true path (m)", 1),
        Column("bias", "speed bias (%)", 2, 0.0),
        Column("end", "end off by (m)", 2, "low"),
        Column("percent", "of the path (%)", 2, "low"),
        Column("end_deg", "(deg)", 2, "low"),
        Column("sigma", "end sigma (m)", 2),
        Column("nees", "end NEES (6 is right)", 1, 6.0),
        Column("standing", "standing still: m a frame", 4, "low"),
        Column("steps", "standing steps"),
    )
    body: list[Row] = [
        {
            "name": name,
            "split": split,
            "frames": f"{frames} of {frames}",
            "path": Value(found.path_m),
            "bias": Value(100 * found.speed_bias),
            "end": Value(found.end_m),
            "percent": Value(100 * found.end_m / found.path_m if found.path_m else float("nan")),
            "end_deg": Value(found.end_deg),
            "sigma": Value(found.end_sigma_m),
            "nees": Value(found.end_nees),
            "standing": Value(found.standing_m),
            "steps": str(found.standing),
        }
        for name, split, frames, found in rows
    ]
    notes = (
        "No alignment but of the first pose. Speed bias: length of the predicted over the true steps, less one.",
        f"End NEES: of the last pose; {100 * END_LEVEL:.0f} % of right ones are below {END_BOUND:.1f}.",
        f"Standing still: mean length of the predicted step where the true one is below {STANDING_M:g} m.",
    )
    return Table("Drift of whole runs", columns, body, ("split", "frames"), group="split", notes=notes)


def means_table(
    summaries: Sequence[Mapping[str, Any]],
    calibrations: Sequence[Mapping[str, Any]],
    drifts: Sequence[tuple[str, str, int, Drift]],
) -> Table:
    """Return the means over sequences, each of which counts the same whatever its length, a row a method.

    Args:
      summaries: of `scoring.summarise`, one a method and sequence.
      calibrations: of `calibration_tables.calibration_data`, likewise.
      drifts: rows of `drift_table`, likewise.
    """
    columns = (
        Column("name", "estimate"),
        Column("frames", "frames"),
        Column("sequences", "sequences"),
        Column("rmse", "RPE trans. RMSE (m)", 4, "low"),
        Column("rotation", "RPE rot. mean (deg)", 4, "low"),
        Column("t_rel", "t_rel mean (%), where there is one", 2, "low"),
        Column("bias", "largest speed bias (%)", 2, "low"),
        Column("inside", "in 3 sigma, least of six (%)", 1, "high"),
        Column("spearman_t", "Spearman trans.", 3, "high"),
        Column("spearman_r", "Spearman rot.", 3, "high"),
        Column("own_t", "of its own draws, trans.", 3),
        Column("nees", "end NEES (6 is right)", 1, 6.0),
    )
    rows: list[Row] = []
    for name in dict.fromkeys(name for name, *_ in drifts):
        paths = [summary for summary in summaries if summary["name"] == name]
        scores = [found for found in calibrations if found["name"] == name and found["sigma"] == "whole mixture"]
        runs = [found for of, _, _, found in drifts if of == name]
        inside = [[share.value for share in found["coverage"]["3 sigma"].values()] for found in scores]
        rows.append(
            {
                "name": name,
                "frames": " ".join(str(frames) for of, _, frames, _ in drifts if of == name),
                "sequences": " ".join(split for of, split, _, _ in drifts if of == name),
                "rmse": Value(float(np.mean([path["rpe_translation_m"]["rmse"].value for path in paths]))),
                "rotation": Value(float(np.mean([path["rpe_rotation_deg"]["mean"].value for path in paths]))),
                "t_rel": Value(_mean_of_known([path["t_rel_percent"].value for path in paths])),
                "bias": Value(100 * max(abs(run.speed_bias) for run in runs)),
                "inside": Value(100 * float(np.mean(inside, axis=0).min())),
                "spearman_t": Value(_mean_of_known([found["spearman"]["translation"].value for found in scores])),
                "spearman_r": Value(_mean_of_known([found["spearman"]["rotation"].value for found in scores])),
                "own_t": Value(_mean_of_known([found["own_spearman"]["translation"].value for found in scores])),
                "nees": Value(_mean_of_known([run.end_nees for run in runs])),
            }
        )
    notes = ("Means of the figures above, but for the largest speed bias, which is that of a single sequence.",)
    return Table("Means over sequences", columns, rows, ("sequences", "frames"), notes=notes)


def _mean_of_known(values: Sequence[float]) -> float:
    """Return the mean of those that are numbers."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")
