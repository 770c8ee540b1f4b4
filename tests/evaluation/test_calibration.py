"""Calibration on densities whose answer is known."""

import jax
import numpy as np
import pytest
from scipy import stats

from mdnvo_jax import mixture as density
from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation import bootstrap
from mdnvo_jax.evaluation.calibration import (
    RANKED,
    SIGMA_LEVELS,
    area_under_sparsification_error,
    calibrate,
    fit_sigma_scale,
    is_inside,
    join,
    pit_histogram,
    reliability,
    score,
    sparsification,
    spearman,
)
from mdnvo_jax.mixture import Mixture

STEPS = 4000
SCALES = np.array([0.02, 0.01, 0.1, 1e-3, 5e-3, 1e-3])


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def gaussian(steps=STEPS, widen=1.0, seed=0):
    """One Gaussian a step whose sigma varies tenfold, and truths drawn from it; `widen` is what it claims over that."""
    rng = np.random.default_rng(seed)
    mean = rng.standard_normal((steps, 6))
    sigma = SCALES * 10 ** rng.uniform(-0.5, 0.5, (steps, 6))
    truth = mean + sigma * rng.standard_normal((steps, 6))
    return Mixture(np.zeros((steps, 1)), mean[:, None], np.log(widen * sigma)[:, None]), truth


def bimodal(steps=STEPS, seed=0):
    """Two narrow modes far apart, weights 0.3 and 0.7, and truths drawn from them by dimension."""
    rng = np.random.default_rng(seed)
    weights = np.array([0.3, 0.7])
    mean = np.stack([-5 * SCALES, 5 * SCALES])
    pick = rng.random((steps, 6)) < weights[1]
    truth = np.where(pick, mean[1], mean[0]) + 0.5 * SCALES * rng.standard_normal((steps, 6))
    tiled = [
        np.tile(a, (steps,) + (1,) * a.ndim) for a in (np.log(weights), mean, np.log(0.5 * np.stack([SCALES] * 2)))
    ]
    return Mixture(*tiled), truth


def within_sampling(share, probability, count, deviations=4.5):
    """Whether a share of `count` independent events is what that probability gives."""
    return np.all(np.abs(share - probability) <= deviations * np.sqrt(probability * (1 - probability) / count))


class TestCalibrated:
    @pytest.mark.parametrize("make", [gaussian, bimodal])
    def test_intervals_hold_what_they_promise(self, make):
        scores = score(*make())
        for level in (*SIGMA_LEVELS, 0.1, 0.5):
            assert within_sampling(is_inside(scores.pit, level).mean(axis=0), level, STEPS)

    @pytest.mark.parametrize("make", [gaussian, bimodal])
    def test_pit_is_uniform(self, make):
        scores = score(*make())
        for column in scores.pit.T:
            assert stats.kstest(column, "uniform").pvalue > 1e-3
        assert within_sampling(pit_histogram(scores.pit), 0.1, STEPS)

    def test_nees_is_the_count_of_dimensions(self):
        scores = score(*gaussian())
        # Chi-squared of 6 degrees: mean 6, variance 12.
        assert abs(scores.nees.mean() - 6) < 4.5 * np.sqrt(12 / STEPS)
        assert stats.kstest(scores.nees, stats.chi2(6).cdf).pvalue > 1e-3

    def test_nll_and_crps_are_those_of_a_gaussian(self):
        mixture, truth = gaussian(steps=50)
        mean, sigma = mixture.mean[:, 0], np.exp(mixture.log_scale[:, 0])
        scores = score(mixture, truth)
        np.testing.assert_allclose(scores.nll, -stats.norm(mean, sigma).logpdf(truth).sum(axis=1), rtol=1e-10)
        z = (truth - mean) / sigma
        closed = sigma * (z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - 1 / np.sqrt(np.pi))
        np.testing.assert_allclose(scores.crps, closed, rtol=1e-9)
        np.testing.assert_allclose(scores.error, np.abs(truth - mean))
        np.testing.assert_allclose(scores.sigma, sigma)

    def test_sigma_ranks_errors_as_well_as_it_can(self):
        found = calibrate(score(*gaussian()), bootstrap.draw_blocks(STEPS, draws=20))
        # |N(0, 1)| scatters log |e| far more than a sigma that varies tenfold spreads it: correlation near 0.5.
        assert np.all((found.spearman.value > 0.4) & (found.spearman.value < 0.7))
        assert np.all(found.ause.value < 0.5)
        own = found.own_spearman
        assert np.all((own.low < found.spearman.value) & (found.spearman.value < own.high))
        # The mean of draws is known better than any one of them.
        assert np.all(own.high - own.low < 0.1) and np.all(np.abs(own.value - found.spearman.value) < 0.05)

    def test_a_sigma_that_hardly_varies_can_rank_little(self):
        mixture, truth = gaussian()
        level = np.log(SCALES) + 0.05 * (mixture.log_scale - np.log(SCALES))
        found = calibrate(score(mixture._replace(log_scale=level), truth), bootstrap.draw_blocks(STEPS, draws=2))
        assert np.all(np.abs(found.own_spearman.value) < 0.1)
        # Were the errors those of the wider densities, their ranks would still follow.
        assert np.all(found.spearman.value > 0.4)


class TestWrongByTwo:
    def test_over_confident(self):
        scores = score(*gaussian(widen=0.5))
        for sigmas, level in enumerate(SIGMA_LEVELS, start=1):
            actual = 2 * stats.norm.cdf(0.5 * stats.norm.ppf((1 + level) / 2)) - 1
            assert within_sampling(is_inside(scores.pit, level).mean(axis=0), actual, STEPS), sigmas
        assert scores.nees.mean() == pytest.approx(24, rel=0.05)
        histogram = pit_histogram(scores.pit)
        assert np.all(histogram[[0, -1]] > 0.15) and np.all(histogram[4:6] < 0.07)

    def test_under_confident(self):
        scores = score(*gaussian(widen=2.0))
        for level in SIGMA_LEVELS[:2]:
            actual = 2 * stats.norm.cdf(2 * stats.norm.ppf((1 + level) / 2)) - 1
            assert within_sampling(is_inside(scores.pit, level).mean(axis=0), actual, STEPS)
        assert scores.nees.mean() == pytest.approx(1.5, rel=0.05)
        assert np.all(pit_histogram(scores.pit)[4:6] > 0.15)

    def test_both_cost_likelihood(self):
        fit, narrow, wide = (score(*gaussian(widen=widen)).nll.mean() for widen in (1.0, 0.5, 2.0))
        # Expected: 6 (log 2 + 1/8 - 1/2) and 6 (2 - 1/2 - log 2).
        assert wide - fit == pytest.approx(6 * (np.log(2) - 0.375), abs=0.15)
        assert narrow - fit == pytest.approx(6 * (1.5 - np.log(2)), abs=0.3)

    def test_ranks_do_not_notice(self):
        draws = bootstrap.draw_blocks(STEPS, draws=2)
        fit, narrow = (calibrate(score(*gaussian(widen=widen)), draws) for widen in (1.0, 0.5))
        np.testing.assert_allclose(narrow.spearman.value, fit.spearman.value)
        np.testing.assert_allclose(narrow.ause.value, fit.ause.value)


class TestBimodal:
    def test_a_gaussian_stand_in_would_be_wrong(self):
        mixture, truth = bimodal()
        scores = score(mixture, truth)
        # Mean and sigma of the mixture: 2 and sqrt(0.25 + 21) in units of SCALES. No truth is 2 sigma from the mean.
        np.testing.assert_allclose(scores.sigma, np.tile(np.sqrt(0.25 + 21) * SCALES, (STEPS, 1)), rtol=1e-9)
        assert np.all(scores.error <= 2 * scores.sigma)
        assert within_sampling(is_inside(scores.pit, SIGMA_LEVELS[1]).mean(axis=0), SIGMA_LEVELS[1], STEPS)

    def test_its_strongest_component_alone_misses_the_other_mode(self):
        scores = score(*bimodal(), reported="strongest")
        share = is_inside(scores.pit, SIGMA_LEVELS[2]).mean(axis=0)
        assert within_sampling(share, 0.7 * SIGMA_LEVELS[2], STEPS)
        np.testing.assert_allclose(scores.sigma, np.tile(0.5 * SCALES, (STEPS, 1)), rtol=1e-9)

    def test_joint_covariance_enters_nees(self):
        # Two components far apart along (1, 1, ...): joint dimensions are nearly dependent.
        steps, rng = 3000, np.random.default_rng(1)
        mean = np.stack([-np.ones(6), np.ones(6)])
        mixture = Mixture(np.zeros((steps, 2)), np.tile(mean, (steps, 1, 1)), np.full((steps, 2, 6), np.log(0.3)))
        truth = mean[rng.integers(2, size=steps)] + 0.3 * rng.standard_normal((steps, 6))
        joint = score(mixture, truth, coupling="joint")
        assert joint.nees.mean() == pytest.approx(6, rel=0.03)
        # Without covariances the mean is 6 too, but for a spread that is the common mode's alone.
        independent = score(mixture, truth)
        assert independent.nees.mean() == pytest.approx(6, rel=0.03)
        assert not np.allclose(independent.nees, joint.nees, rtol=0.1)
        # Five choices of component out of six are known from the first: log 2 each.
        assert independent.nll.mean() - joint.nll.mean() == pytest.approx(5 * np.log(2), abs=0.05)


class TestRanking:
    def test_spearman_agrees_with_scipy(self):
        rng = np.random.default_rng(0)
        sigma, error = rng.random((200, 3)).round(1), rng.random((200, 3)).round(1)
        expected = [stats.spearmanr(sigma[:, i], error[:, i]).statistic for i in range(3)]
        np.testing.assert_allclose(spearman(sigma, error), expected, rtol=1e-12)

    def test_no_ranking_has_no_correlation(self):
        assert np.isnan(spearman(np.ones((5, 1)), np.arange(5.0)[:, None]))

    def test_perfect_and_reversed(self):
        error = np.arange(1.0, 11)[:, None]
        assert spearman(2 * error, error) == 1 and spearman(-error, error) == -1
        assert area_under_sparsification_error(2 * error, error) == 0
        assert area_under_sparsification_error(-error, error) > area_under_sparsification_error(np.ones((10, 1)), error)

    def test_sparsification_by_hand(self):
        removed, curve, oracle = sparsification(np.array([3.0, 1, 2, 4]), np.array([6.0, 2, 0, 4]))
        np.testing.assert_allclose(removed, [0, 0.25, 0.5, 0.75])
        # Mean 3; without sigma 4: (6, 2, 0), without 3: (2, 0), without 2: (2).
        np.testing.assert_allclose(curve, np.array([3, 8 / 3, 1, 2]) / 3)
        np.testing.assert_allclose(oracle, np.array([3, 2, 1, 0]) / 3)

    def test_equal_sigmas_are_chance(self):
        error = np.random.default_rng(0).random(50)
        _, curve, _ = sparsification(np.ones(50), error)
        np.testing.assert_allclose(curve, 1)
        # In two groups the order of frames within a group does not matter.
        groups = np.repeat([1.0, 2.0], 25)
        shuffled = np.concatenate([error[:25][::-1], error[25:][::-1]])
        np.testing.assert_allclose(sparsification(groups, error)[1], sparsification(groups, shuffled)[1])

    def test_no_error_at_all(self):
        _, curve, oracle = sparsification(np.arange(4.0), np.zeros(4))
        np.testing.assert_array_equal(curve, oracle)

    def test_norms_join_the_components(self):
        mixture, truth = gaussian(steps=300)
        scores = score(mixture, truth)
        found = calibrate(scores, bootstrap.draw_blocks(300, draws=5))
        norms = [np.linalg.norm(values[:, :3], axis=1) for values in (scores.sigma, scores.error)]
        expected = stats.spearmanr(*norms).statistic
        assert found.spearman.value[RANKED.index("translation")] == pytest.approx(expected)


class TestSigmaScale:
    @pytest.mark.parametrize("widen", [0.5, 1.0, 2.0])
    def test_finds_the_factor_that_is_missing(self, widen):
        mixture, truth = gaussian(widen=widen)
        factors = fit_sigma_scale(mixture, truth)
        # The scale of a Gaussian is known to 1 / sqrt(2 n).
        np.testing.assert_allclose(factors * widen, 1, atol=4.5 / np.sqrt(2 * STEPS))

    def test_is_the_closed_form_of_a_gaussian(self):
        mixture, truth = gaussian(widen=3.0)
        z = (truth - mixture.mean[:, 0]) / np.exp(mixture.log_scale[:, 0])
        np.testing.assert_allclose(fit_sigma_scale(mixture, truth), np.sqrt((z**2).mean(axis=0)), rtol=1e-4)

    def test_a_different_factor_for_each_component(self):
        mixture, truth = gaussian()
        factors = np.array([0.25, 0.5, 1, 2, 4, 8])
        claimed = mixture._replace(log_scale=mixture.log_scale + np.log(factors))
        np.testing.assert_allclose(fit_sigma_scale(claimed, truth) * factors, 1, atol=0.06)

    def test_applied_it_calibrates(self):
        mixture, truth = bimodal()
        narrowed = density.widen(mixture, np.full(6, 0.4))
        factors = fit_sigma_scale(narrowed, truth)
        np.testing.assert_allclose(factors, 2.5, rtol=0.02)
        scores = score(density.widen(narrowed, factors), truth)
        assert within_sampling(is_inside(scores.pit, 0.6827).mean(axis=0), 0.6827, STEPS)

    def test_the_mean_and_the_shape_stay(self):
        mixture, _ = bimodal(steps=3)
        scale = np.array([0.5, 1, 2, 3, 4, 5])
        widened = density.widen(mixture, scale)
        np.testing.assert_allclose(density.mean(widened), density.mean(mixture), rtol=1e-9)
        np.testing.assert_allclose(density.variance(widened), scale**2 * density.variance(mixture), rtol=1e-9)
        point = np.asarray(density.mean(mixture)) + scale * SCALES
        unscaled = np.asarray(density.mean(mixture)) + SCALES
        np.testing.assert_allclose(density.cdf(widened, point), density.cdf(mixture, unscaled), rtol=1e-9)

    def test_a_factor_is_positive(self):
        with pytest.raises(ValueError, match="factor"):
            density.widen(bimodal(steps=3)[0], np.array([1, 1, 1, 1, 1, 0.0]))

    def test_a_component_without_any_error_stops_at_the_least_factor(self):
        mixture, truth = gaussian(steps=100)
        exact = truth.copy()
        exact[:, 1] = mixture.mean[:, 0, 1]
        factors = fit_sigma_scale(mixture, exact)
        assert factors[1] == pytest.approx(1 / 64, rel=1e-3) and np.isfinite(factors).all()

    def test_without_steps(self):
        with pytest.raises(InputError, match="no validation steps"):
            fit_sigma_scale(Mixture(np.zeros((0, 1)), np.zeros((0, 1, 6)), np.zeros((0, 1, 6))), np.zeros((0, 6)))


def test_reliability_is_the_share_inside():
    pit = np.array([[0.5], [0.4], [0.95], [0.01]])
    np.testing.assert_allclose(reliability(pit, np.array([0.05, 0.25, 0.95, 0.99]))[:, 0], [0.25, 0.5, 0.75, 1.0])


def test_joined_scores_are_one_after_the_other():
    first, second = (score(*gaussian(steps=4, seed=seed)) for seed in (0, 1))
    together = join([first, second])
    np.testing.assert_array_equal(together.nll, [*first.nll, *second.nll])
    np.testing.assert_array_equal(together.take(np.array([5])).pit, second.pit[1:2])


def test_intervals_of_a_calibrated_density_hold_the_nominal_values():
    found = calibrate(score(*gaussian()), bootstrap.draw_blocks(STEPS, block=1, draws=100))
    assert found.nees.low < 6 < found.nees.high
    nominal = np.array(SIGMA_LEVELS)[:, None]
    inside = (found.coverage.low <= nominal) & (nominal <= found.coverage.high)
    # 17 of 18 are expected.
    assert inside.sum() >= 14
    assert found.coverage.value.shape == (3, 6) and found.crps.value.shape == (6,)
