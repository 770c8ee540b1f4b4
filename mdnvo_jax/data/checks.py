"""What is odd about the data of a training, or of a prediction beside it: said, and left as it is."""

import contextlib
from collections.abc import Sequence as Many
from typing import NamedTuple

import numpy as np

from mdnvo_jax.config import Config, DataConfig, ImageConfig
from mdnvo_jax.data import images
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError

# Steps on either side that one is compared with.
_NEIGHBOURS = 2
# A jump is so many times the spread of such differences in its sequence, and at least this much: m, rad.
_TIMES_SPREAD = 12.0
_LEAST_M = 0.5
_LEAST_RAD = np.deg2rad(3.0)
# Standard deviation of a Gaussian over its median absolute deviation.
_DEVIATION = 1.4826
# Frame rates whose ratio is beyond this, or below its inverse, are told apart.
_SAME_RATE = 1.4
# From this share of the network's input on, what a lens does not see is said. KITTI's cameras leave 4.5 % at most of
# each other.
_UNCOVERED = 0.05


class Jump(NamedTuple):
    """A step that is far from those about it: its number in the sequence, and by how much, m and rad."""

    step: int
    metres: float
    radians: float


def jumps(steps: np.ndarray) -> list[Jump]:
    """Return the steps `[N, 6]` that no vehicle makes: far from the median of those before and after them.

    A jump of poses by GPS or by a loop closure, a dropped frame, or a wrong row in a file all look like this. "Far" is
    12 times the spread of such differences in the sequence (by the median absolute deviation), and at least 0.5 m or 3
    degrees.
    """
    count = len(steps)
    if count < 2 * _NEIGHBOURS + 1:
        return []
    padded = np.pad(steps, ((_NEIGHBOURS, _NEIGHBOURS), (0, 0)), mode="reflect")
    offsets = [shift for shift in range(2 * _NEIGHBOURS + 1) if shift != _NEIGHBOURS]
    about = np.median([padded[shift : shift + count] for shift in offsets], axis=0)
    away = np.stack([np.linalg.norm((steps - about)[:, part], axis=1) for part in (slice(3), slice(3, 6))])
    spread = _DEVIATION * np.median(away, axis=1)
    limit = np.maximum(_TIMES_SPREAD * spread, [_LEAST_M, _LEAST_RAD])
    found = np.flatnonzero((away > limit[:, None]).any(axis=0))
    return [Jump(int(step), *map(float, away[:, step])) for step in found]


def of_labels(sequences: Many[Sequence]) -> list[str]:
    """Return a line for each sequence whose poses jump, which its training would learn from."""
    lines = []
    for sequence in sequences:
        found = jumps(sequence.steps())
        if found:
            worst = max(found, key=lambda jump: max(jump.metres / _LEAST_M, jump.radians / _LEAST_RAD))
            lines.append(
                f"sequence {sequence.name}: {len(found)} of {sequence.count - 1} steps jump, the worst by "
                f"{worst.metres:.2f} m and {np.rad2deg(worst.radians):.1f} degrees from those about it, to "
                f"{sequence.label(worst.step + 1)}: look at its poses; it is trained on as it is"
            )
    return lines


def interval_s(sequences: Many[Sequence]) -> float:
    """Return the median time between two frames of sequences that tell it; 0 where none does."""
    found = [np.diff(sequence.timestamps) for sequence in sequences if sequence.timestamps is not None]
    found = [times for times in found if len(times)]
    return float(np.median(np.concatenate(found))) if found else 0.0


def trained_s(config: DataConfig) -> float:
    """Return the shortest time of a step that a training saw; 0 where it is not known."""
    return config.interval_s * min(config.strides)


def of_rate(sequence: Sequence, step_s: float) -> str:
    """Return a line where the frames come at another rate than those of the training did; empty where they do not.

    Args:
      sequence: to predict.
      step_s: of the training, see `trained_s`; 0 where it is not known.
    """
    here_s = interval_s([sequence])
    if step_s <= 0 or here_s <= 0 or 1 / _SAME_RATE <= here_s / step_s <= _SAME_RATE:
        return ""
    stride = round(step_s / here_s)
    advice = f": use every {stride}. frame (stride {stride})" if stride > 1 else ""
    return (
        f"{sequence.name}: {1 / here_s:.3g} frames a second where the training had {1 / step_s:.3g}: steps are "
        f"{'shorter' if here_s < step_s else 'longer'} than those it learnt from{advice}"
    )


def of_view(sequence: Sequence, image_config: ImageConfig) -> str:
    """Return a line where frames do not show much of the training's view; empty where they do, or nobody knows."""
    if sequence.camera is None:
        return ""
    size = _frame_size(sequence)
    share = images.uncovered(size, sequence.camera, image_config) if size else 0.0
    if share < _UNCOVERED:
        return ""
    return (
        f"{sequence.name} does not show {100 * share:.0f} % of what the training's camera sees: the edge of the frames "
        "is repeated there, and the trajectory may be worse for it"
    )


def before_prediction(sequence: Sequence, config: Config) -> list[str]:
    """Return what is to be said of a sequence that a network of the experiment `config` is to see."""
    lines = of_view(sequence, config.image), of_rate(sequence, trained_s(config.data))
    return [line for line in lines if line]


def _frame_size(sequence: Sequence) -> tuple[int, int] | None:
    """Return height and width of the first frame that can be read."""
    for index in range(sequence.count):
        with contextlib.suppress(InputError):
            height, width = sequence.read(index).shape[:2]
            return height, width
    return None
