"""Drift of whole runs: closed forms, and a covariance that is right by construction."""

import numpy as np
import pytest

from mdnvo_jax import geometry, odometry
from mdnvo_jax.baselines.constant import constant_mixture
from mdnvo_jax.evaluation import drift
from mdnvo_jax.mixture import Mixture


def run(steps, sigma):
    """A run that predicts `steps`, `[n, 6]`, each with the standard deviations `sigma`, `[6]`."""
    scale = np.tile(np.log(sigma), (len(steps), 1))
    return odometry.trajectory(Mixture(np.zeros((len(steps), 1)), steps[:, None], scale[:, None]), coupling="joint")


def world(steps, first=None):
    poses = np.asarray(geometry.accumulate(geometry.step_to_matrix(steps)))
    return poses if first is None else first @ poses


STRAIGHT = np.tile([0.0, 0, 1.0, 0, 0, 0], (50, 1))
SIGMA = np.array([0.02, 0.02, 0.05, 0.001, 0.001, 0.001])


def test_a_run_that_is_ten_percent_too_long():
    elsewhere = np.asarray(geometry.step_to_matrix(np.array([5.0, 1, -2, 0.1, 2, 0.3])))
    found = drift.drift(run(1.1 * STRAIGHT, SIGMA), world(STRAIGHT, elsewhere))
    assert found.path_m == pytest.approx(50) and found.speed_bias == pytest.approx(0.1)
    assert found.end_m == pytest.approx(5) and found.end_deg == pytest.approx(0, abs=1e-5)
    assert np.isnan(found.standing_m) and found.standing == 0


def test_end_sigma_and_nees_are_those_of_independent_steps():
    steps = STRAIGHT[:1] * 1.1
    found = drift.drift(run(steps, SIGMA), world(STRAIGHT[:1]))
    # One step, no rotation: its covariance is that of the pose.
    assert found.end_sigma_m == pytest.approx(np.sqrt((SIGMA[:3] ** 2).sum()))
    assert found.end_nees == pytest.approx((0.1 / 0.05) ** 2)


def test_nees_is_six_on_average_where_covariances_are_right():
    rng = np.random.default_rng(0)
    truth = np.tile([0.0, 0, 1.0, 0, 0.02, 0], (60, 1))
    values = [drift.drift(run(truth + SIGMA * rng.standard_normal((60, 6)), SIGMA), world(truth)).end_nees
              for _ in range(300)]  # fmt: skip
    # The mean of 300 draws of chi-square with 6 degrees of freedom is off by less than 0.2 in two thirds of cases.
    assert np.mean(values) == pytest.approx(6, abs=0.6)
    assert np.mean(np.array(values) < drift.END_BOUND) == pytest.approx(drift.END_LEVEL, abs=0.04)


def test_standing_still_counts_the_frames_that_do_not_move():
    truth = STRAIGHT.copy()
    truth[10:20, 2] = 0
    predicted = truth.copy()
    predicted[10:20, 0], predicted[10:20, 2] = 0.03, 0.04
    found = drift.drift(run(predicted, SIGMA), world(truth))
    assert found.standing == 10 and found.standing_m == pytest.approx(0.05)
    still = drift.drift(run(0 * STRAIGHT, SIGMA), world(0 * STRAIGHT))
    assert np.isnan(still.speed_bias) and still.standing == 50 and still.end_m == 0


def test_the_table_says_what_it_shows():
    rows = [
        ("model", "00", 51, drift.drift(run(1.1 * STRAIGHT, SIGMA), world(STRAIGHT))),
        ("constant predictor", "00", 51, drift.drift(
            odometry.trajectory(constant_mixture(STRAIGHT[0], SIGMA, 50), coupling="independent"), world(STRAIGHT))),
    ]  # fmt: skip
    model, constant = drift.drift_table(rows).rows
    assert model["bias"].value == pytest.approx(10) and model["percent"].value == pytest.approx(10)
    assert model["frames"] == "51 of 51" and constant["end"].value == pytest.approx(0, abs=1e-9)
