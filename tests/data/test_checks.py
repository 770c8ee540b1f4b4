"""What is odd about data is said: labels that jump, and frames at another rate than the training's."""

import dataclasses
import re

import numpy as np
import pytest

from mdnvo_jax import geometry
from mdnvo_jax.config import DataConfig
from mdnvo_jax.data import checks


def drive(count: int = 200, seed: int = 0) -> np.ndarray:
    """Steps of a car that speeds up, brakes and turns smoothly, with the noise of a good reference."""
    time, generator = np.arange(count) / 10, np.random.default_rng(seed)
    steps = generator.normal(0, [0.01] * 3 + [0.001] * 3, (count, 6))
    steps[:, 2] += 1 + 0.8 * np.sin(0.3 * time)
    steps[:, 4] += 0.06 * np.sin(0.7 * time) ** 5
    return steps


def poses(steps: np.ndarray) -> np.ndarray:
    return np.asarray(geometry.accumulate(geometry.step_to_matrix(steps)))


@pytest.mark.parametrize("seed", range(5))
def test_a_smooth_drive_has_no_jump(seed: int) -> None:
    assert checks.jumps(drive(seed=seed)) == []
    # Nor has a car that stands and starts, nor a few frames.
    standing = drive(seed=seed)
    standing *= np.clip((np.abs(np.arange(200) - 80) - 20) / 15, 0, 1)[:, None]
    assert checks.jumps(standing) == []
    assert checks.jumps(drive(4)) == []


def test_steps_that_no_car_makes_are_found() -> None:
    steps = drive()
    steps[20, 0] += 3
    steps[120, 4] += np.deg2rad(20)
    steps[199, 2] = -4
    found = checks.jumps(steps)
    assert [jump.step for jump in found] == [20, 120, 199]
    assert found[0].metres == pytest.approx(3, abs=0.1) and found[1].radians == pytest.approx(np.deg2rad(20), abs=0.02)


def test_a_line_names_the_sequence_and_its_worst_frame(toy) -> None:
    steps = drive(29)
    steps[11, 1] += 2
    steps[17, 1] += 6
    jumping = dataclasses.replace(toy(30, name="05"), poses=poses(steps))
    (line,) = checks.of_labels([dataclasses.replace(toy(30, name="04"), poses=poses(drive(29))), jumping])
    assert line.startswith("sequence 05: 2 of 29 steps jump, the worst by 5.99 m and 0.1 degrees")
    assert "to frame 18 of sequence 05" in line


@pytest.mark.parametrize(
    ("interval", "said"),
    [
        (0.1, ""),
        (0.075, ""),
        (0.13, ""),
        (1 / 30, "30 frames a second where the training had 10: steps are shorter .* use every 3. frame"),
        (0.5, "2 frames a second where the training had 10: steps are longer than those it learnt from$"),
    ],
)
def test_another_rate_of_frames_is_said(toy, interval: float, said: str) -> None:
    times = interval * np.arange(20)
    # One gap is no other rate.
    times[10:] += 3
    line = checks.of_rate(dataclasses.replace(toy(20), timestamps=times), 0.1)
    assert bool(line) == bool(said)
    if said:
        assert re.search(said, line)


def test_where_no_rate_is_known_nothing_is_said(toy) -> None:
    untimed = dataclasses.replace(toy(20), timestamps=None)
    assert checks.interval_s([untimed]) == 0
    assert checks.of_rate(untimed, 0.1) == checks.of_rate(toy(20), 0.0) == ""
    assert checks.trained_s(DataConfig(interval_s=0.08, strides=(2, 3))) == pytest.approx(0.16)
    assert checks.trained_s(DataConfig()) == 0
