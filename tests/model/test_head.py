import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnvo_jax import mixture
from mdnvo_jax.config import ModelConfig
from mdnvo_jax.model.head import Labels, mixture_from_outputs, raw_size, regression_loss

MIXTURE = ModelConfig(components=2)
REGRESSION = ModelConfig(head="regression")
LABELS = Labels(
    mean=np.array([0.01, -0.02, 0.9, 1e-4, 2e-4, -3e-4], np.float32),
    std=np.array([0.05, 0.03, 0.4, 2e-3, 2e-2, 1e-3], np.float32),
)
FLOOR = np.array([1e-3] * 3 + [1e-4] * 3)


def test_raw_size():
    assert raw_size(MIXTURE) == 2 + 2 * 2 * 6
    assert raw_size(REGRESSION) == 6


def test_means_and_scales_come_out_in_metres_and_radians():
    rng = np.random.default_rng(0)
    raw = rng.normal(size=(3, 4, 26)).astype(np.float32)
    found = mixture_from_outputs(raw, LABELS, MIXTURE)
    np.testing.assert_array_equal(found.logits, raw[..., :2])
    means, scales = (raw[..., start : start + 12].reshape(3, 4, 2, 6) for start in (2, 14))
    np.testing.assert_allclose(found.mean, means * LABELS.std + LABELS.mean, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(np.exp(found.log_scale), np.exp(scales) * LABELS.std + FLOOR, rtol=1e-5)


@pytest.mark.parametrize("floors", [(1e-3, 1e-4), (0.2, 0.03)])
def test_the_floor_is_physical(floors):
    config = dataclasses.replace(MIXTURE, translation_floor_m=floors[0], rotation_floor_rad=floors[1])
    found = mixture_from_outputs(jnp.full(26, -1e4), LABELS, config)
    np.testing.assert_allclose(np.exp(found.log_scale), [[floors[0]] * 3 + [floors[1]] * 3] * 2, rtol=1e-5)


def test_the_density_carries_the_jacobian():
    raw = np.random.default_rng(1).normal(size=26).astype(np.float32)
    step = np.array([0.02, 0.01, 1.1, 0.0, 0.01, 0.0], np.float32)
    physical = mixture.log_prob(mixture_from_outputs(raw, LABELS, MIXTURE), step)
    standardised = mixture.from_network(raw, 2, floor=FLOOR / LABELS.std)
    expected = mixture.log_prob(standardised, (step - LABELS.mean) / LABELS.std) - np.log(LABELS.std).sum()
    np.testing.assert_allclose(physical, expected, rtol=1e-5)


def test_regression_is_one_gaussian_as_wide_as_its_residuals():
    raw = np.random.default_rng(2).normal(size=(5, 6)).astype(np.float32)
    residual_scale = np.array([0.5, 0.5, 0.5, 2.0, 2.0, 1e-6])
    found = mixture_from_outputs(raw, LABELS, REGRESSION, residual_scale)
    assert found.logits.shape == (5, 1)
    assert found.log_scale.shape == found.mean.shape == (5, 1, 6)
    np.testing.assert_allclose(mixture.mean(found), raw * LABELS.std + LABELS.mean, rtol=1e-6)
    # The last is below the floor of 1e-4 rad.
    expected = np.array([0.025, 0.015, 0.2, 4e-3, 4e-2, 1e-4])
    np.testing.assert_allclose(mixture.variance(found), np.tile(expected**2, (5, 1)), rtol=1e-5)


def test_regression_has_no_scale_of_its_own():
    with pytest.raises(ValueError, match="residual_scale"):
        mixture_from_outputs(jnp.zeros(6), LABELS, REGRESSION)


def test_regression_loss_is_that_of_deepvo():
    labels = Labels(np.zeros(6), np.array([1.0, 1.0, 2.0, 0.1, 0.1, 0.1]))
    outputs = jnp.array([[[1.0, 2.0, 3.0, 1.0, 2.0, 3.0], [9.0] * 6], [[0.0] * 6, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]])
    steps = jnp.array([[[0.0] * 6, [0.0] * 6], [[0.0] * 6, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]])
    mask = jnp.array([[True, False], [True, True]])
    # First step: 1 + 4 + 36 and 100 (0.01 + 0.04 + 0.09); third: 0; fourth: (2 - 1)^2.
    np.testing.assert_allclose(regression_loss(outputs, steps, labels, mask, 100.0), (41 + 14 + 0 + 1) / 3, rtol=1e-6)


def test_regression_loss_of_nothing_is_zero_with_a_zero_gradient():
    outputs, steps, mask = jnp.ones((2, 3, 6)), jnp.zeros((2, 3, 6)), jnp.zeros((2, 3), bool)
    value, gradient = jax.value_and_grad(regression_loss)(outputs, steps, LABELS, mask, 100.0)
    assert value == 0
    assert (np.asarray(gradient) == 0).all()


def test_regression_loss_checks_shapes():
    with pytest.raises(ValueError, match="expected both"):
        regression_loss(jnp.ones((2, 3, 26)), jnp.zeros((2, 3, 6)), LABELS, jnp.ones((2, 3), bool), 1.0)
