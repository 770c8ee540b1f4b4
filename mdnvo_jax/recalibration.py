"""How wrong a model was on validation drives: factors for its sigmas, and what its steps are wrong by together.

Kept with the checkpoint whose weights they were fitted for.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mdnvo_jax import files
from mdnvo_jax.errors import InputError
from mdnvo_jax.odometry import COMPONENTS, are_correlations, is_scale_sigma

# In the folder of a step, so that it is copied and deleted with the weights and never meets others.
FILE = "sigma_scale.json"
# Raised when what is stored, or its meaning, changes. Version 1 has factors alone, 2 no serial correlation.
VERSION = 3
_READABLE = (1, 2, VERSION)


@dataclass(frozen=True)
class SigmaScale:
    """What was fitted.

    Attributes:
      scale: by component (tx, ty, tz, rx, ry, rz), `[6]`, positive.
      steps: how many they were fitted on.
      nll_before: mean over those steps, nats, m and rad.
      nll_after: the same with the factors applied.
      fitted_on: which data, in words and names.
      scale_sigma: relative standard deviation of the error of scale that a drive's steps share; 0 where none was found.
      correlation: of the errors of any two steps of a drive, without that of the scale, by component, `[6]`.
      drives: how many these two and the next were fitted on.
      serial_correlation: of what is left of the errors of neighbouring steps, likewise.
    """

    scale: np.ndarray
    steps: int
    nll_before: float
    nll_after: float
    fitted_on: Mapping[str, Any]
    scale_sigma: float = 0.0
    correlation: np.ndarray = field(default_factory=lambda: np.zeros(len(COMPONENTS)))
    drives: int = 0
    serial_correlation: np.ndarray = field(default_factory=lambda: np.zeros(len(COMPONENTS)))


def read(step_folder: str | Path) -> SigmaScale | None:
    """Return what was fitted for a checkpoint, None where nothing was.

    Raises:
      InputError: the file is damaged or of another version.
    """
    path = Path(step_folder) / FILE
    if not path.exists():
        return None
    mend = "fit again with `evaluate recalibrate --force`, or delete it"
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        if stored["version"] not in _READABLE:
            raise InputError(f"{path} has version {stored['version']}, expected {VERSION}: {mend}")
        if stored["version"] == 1:
            stored |= {"scale_sigma": 0.0, "correlation": [0.0] * len(COMPONENTS), "drives": 0}
        if stored["version"] <= 2:
            stored |= {"serial_correlation": [0.0] * len(COMPONENTS)}
        scale = np.array(stored["scale"], np.float64)
        found = SigmaScale(
            scale=scale,
            steps=int(stored["steps"]),
            nll_before=float(stored["nll_before"]),
            nll_after=float(stored["nll_after"]),
            fitted_on=dict(stored["fitted_on"]),
            scale_sigma=float(stored["scale_sigma"]),
            correlation=np.array(stored["correlation"], np.float64),
            serial_correlation=np.array(stored["serial_correlation"], np.float64),
            drives=int(stored["drives"]),
        )
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is damaged ({type(error).__name__}: {error}): {mend}") from error
    if scale.shape != (len(COMPONENTS),) or not (np.isfinite(scale) & (scale > 0)).all():
        raise InputError(f"{path}: scale {scale.tolist()}: expected six factors above 0: {mend}")
    if not is_scale_sigma(found.scale_sigma):
        raise InputError(f"{path}: scale_sigma {found.scale_sigma}: expected 0 or more: {mend}")
    for name in ("correlation", "serial_correlation"):
        value = getattr(found, name)
        if not are_correlations(value):
            raise InputError(f"{path}: {name} {value.tolist()}: expected six numbers from 0 to 1: {mend}")
    return found


def write(step_folder: str | Path, found: SigmaScale, **about: Any) -> Path:
    """Write what was fitted into the folder of a step, whole or not at all, and return the file's path."""
    path = Path(step_folder) / FILE
    data = {
        "version": VERSION,
        "components": COMPONENTS,
        "scale": found.scale.tolist(),
        "steps": found.steps,
        "nll_before": found.nll_before,
        "nll_after": found.nll_after,
        "scale_sigma": found.scale_sigma,
        "correlation": found.correlation.tolist(),
        "serial_correlation": found.serial_correlation.tolist(),
        "drives": found.drives,
        "fitted_on": dict(found.fitted_on),
        **about,
    }
    files.write_text(path, json.dumps(data, indent=2) + "\n")
    return path
