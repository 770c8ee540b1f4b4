"""Errors that steps share against least squares by hand, and their spread over drives against what was drawn."""

import numpy as np
import pytest
from scipy import optimize, stats

from mdnvo_jax.evaluation.shared_errors import fit_correlations, fit_scale_sigma, scale_error

RNG = np.random.default_rng(0)


def random_covariances(count):
    roots = RNG.normal(size=(count, 6, 6)) * 0.05
    return roots @ roots.swapaxes(1, 2) + 1e-4 * np.eye(6)


def test_a_drive_that_is_too_short_by_a_tenth():
    steps = RNG.normal(size=(20, 6))
    truth = steps.copy()
    truth[:, :3] *= 1.1
    error, variance = scale_error(steps, random_covariances(20), truth)
    assert error == pytest.approx(0.1)
    assert 0 < variance < np.inf


def test_by_hand_on_a_straight_line():
    # Alike steps: the mean error over the distance, and the sum's sigma over the distance.
    steps = np.tile([0, 0, 2.0, 0, 0, 0], (4, 1))
    truth = steps + np.array([0.1, -0.1, 0.3, 0.1])[:, None] * np.eye(6)[2]
    error, variance = scale_error(steps, np.tile(0.2**2 * np.eye(6), (4, 1, 1)), truth)
    assert error == pytest.approx(0.4 / 8)
    assert np.sqrt(variance) == pytest.approx(0.2 * np.sqrt(4) / 8)


def test_it_is_weighted_least_squares():
    steps, truth, covariance = RNG.normal(size=(15, 6)), RNG.normal(size=(15, 6)), random_covariances(15)
    # Rows of a linear model of one unknown, made white by the root of the precision.
    roots = np.linalg.cholesky(np.linalg.inv(covariance[:, :3, :3])).swapaxes(1, 2)
    column = np.concatenate([root @ step[:3] for root, step in zip(roots, steps, strict=True)])
    target = np.concatenate([root @ (t - s)[:3] for root, s, t in zip(roots, steps, truth, strict=True)])
    expected = np.linalg.lstsq(column[:, None], target, rcond=None)[0][0]
    error, variance = scale_error(steps, covariance, truth)
    assert error == pytest.approx(expected)
    assert variance == pytest.approx(1 / (column @ column))


def test_its_variance_is_that_of_repeated_drives():
    steps = np.tile([0.1, 0, 1.5, 0, 0, 0], (30, 1))
    covariance = random_covariances(30)
    noise = np.stack([RNG.multivariate_normal(np.zeros(6), one, size=3000) for one in covariance], axis=1)
    found = np.array([scale_error(steps, covariance, steps + drawn) for drawn in noise])
    assert found[:, 0].mean() == pytest.approx(0, abs=4 * np.sqrt(found[0, 1] / 3000))
    assert found[:, 0].var() == pytest.approx(found[0, 1], rel=0.1)


def test_a_drive_that_stands_still_tells_nothing():
    still = np.zeros((5, 6))
    creeping = np.tile([0, 0, 0.03, 0, 0, 0], (5, 1))
    for said, true in ((still, still), (creeping, still), (still, creeping)):
        assert scale_error(said, random_covariances(5), true) == (0, np.inf)
    # Nor do the steps in which a drive waits.
    steps, covariance = RNG.normal(size=(10, 6)), random_covariances(15)
    waits = np.concatenate([steps, creeping]), covariance, np.concatenate([1.1 * steps, still])
    assert scale_error(*waits) == scale_error(steps, covariance[:10], 1.1 * steps)
    errors, variances = np.array([0.1, -0.1, 0.1, 0]), np.array([1e-6, 1e-6, 1e-6, np.inf])
    assert fit_scale_sigma(errors, variances) == pytest.approx(fit_scale_sigma(errors[:3], variances[:3]))
    assert fit_scale_sigma(np.zeros(2), np.full(2, np.inf)) == 0


def test_the_spread_of_exactly_known_errors_is_their_root_mean_square():
    errors = RNG.normal(0.05, 0.1, 12)
    assert fit_scale_sigma(errors, np.full(12, 1e-12)) == pytest.approx(np.sqrt(np.mean(errors**2)), rel=1e-4)


def test_of_equal_variances_it_is_the_surplus():
    errors = RNG.normal(0, 0.1, 12)
    expected = np.sqrt(np.mean(errors**2) - 0.05**2)
    assert fit_scale_sigma(errors, np.full(12, 0.05**2)) == pytest.approx(expected, rel=1e-4)
    # Errors no larger than their own sigmas say nothing of a common one.
    assert fit_scale_sigma(errors, np.full(12, 0.2**2)) == 0


def test_it_is_the_maximum_of_the_likelihood():
    errors, variances = RNG.normal(0, 0.1, 9), RNG.uniform(0.01, 0.15, 9) ** 2

    def nll(sigma):
        return -stats.norm.logpdf(errors, 0, np.sqrt(sigma**2 + variances)).sum()

    expected = optimize.brute(nll, [(0, 0.5)], Ns=2001)[0]
    assert fit_scale_sigma(errors, variances) == pytest.approx(expected, rel=1e-3)


def test_it_finds_what_was_drawn_from_drives_of_all_lengths():
    variances = np.exp(RNG.uniform(np.log(1e-5), np.log(1e-1), 4000))
    errors = RNG.normal(0, np.sqrt(0.07**2 + variances))
    assert fit_scale_sigma(errors, variances) == pytest.approx(0.07, rel=0.05)


def test_the_correlation_of_long_drives_is_the_mean_square_of_their_means():
    means = RNG.normal(0, [0.9, 0.5, 0.1], (500, 3))
    found, _ = fit_correlations(means, np.full(500, 10**9), np.full(3, 0.95))
    np.testing.assert_allclose(found, (means**2).mean(axis=0), atol=6e-4)


def test_correlations_are_found_from_drives_of_all_lengths():
    rho, serial = np.array([0.0, 0.05, 0.3, 0.8, 0.0, 0.1]), np.array([0.0, 0.0, 0.0, 0.0, 0.9, 0.7])
    counts, means, products, squares = RNG.integers(2, 200, 1500), [], np.zeros(6), np.zeros(6)
    for count in counts:
        wander = RNG.normal(size=(count, 6))
        for step in range(1, count):
            wander[step] = serial * wander[step - 1] + np.sqrt(1 - serial**2) * wander[step]
        errors = np.sqrt(rho) * RNG.normal(size=6) + np.sqrt(1 - rho) * wander
        means.append(errors.mean(axis=0))
        products, squares = products + (errors[1:] * errors[:-1]).sum(axis=0), squares + (errors[1:] ** 2).sum(axis=0)
    found = fit_correlations(np.array(means), counts, products / squares)
    assert np.all(np.abs(found[0] - rho) < 0.1 * rho + 0.01)
    # Of what is left by four fifths that are shared there is little to measure.
    np.testing.assert_allclose(np.delete(found[1], 3), np.delete(serial, 3), atol=0.05)


def test_means_of_independent_errors_have_no_correlation():
    counts = np.full(8, 50)
    found = fit_correlations(np.full((8, 2), 0.9 / np.sqrt(50)), counts, np.array([0.0, -0.2]))
    np.testing.assert_array_equal(found, np.zeros((2, 2)))
    # Never so much that a step has nothing of its own, and drives of one step tell nothing.
    assert fit_correlations(np.full((8, 1), 5.0), counts, np.ones(1))[0] == pytest.approx(0.999)
    assert fit_correlations(RNG.normal(size=(8, 1)), np.ones(8), np.zeros(1))[0] == 0


def test_what_neighbours_have_together_is_not_taken_for_what_all_steps_have():
    """Errors that last for ten steps widen the means of drives as independent ones do not, and yet average out."""
    serial, counts = 0.9, np.full(2000, 100)
    spread = 19 / 100 * (1 - 0.0947)
    means = RNG.normal(0, np.sqrt(spread), (2000, 1))
    assert fit_correlations(means, counts, np.array([serial]))[0][0] < 0.02
    assert fit_correlations(means, counts, np.array([0.2]))[0][0] > 0.15
