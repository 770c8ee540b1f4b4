"""The highest point of a mixture density, and its strongest component, which may be elsewhere."""

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
from mixture_reference import BATCH, MIXTURES, PROPERTY, arrays, device, log_prob, mode, random_mixture, strongest

from mdnvo_jax.mixture import Mixture


@PROPERTY
@hypothesis.given(MIXTURES, arrays(2))
def test_mode_is_the_highest_point(mixture: Mixture, value: np.ndarray) -> None:
    top = mode(mixture)
    assert log_prob(mixture, top) >= log_prob(mixture, value) - 1e-4
    grid = np.linspace(-4, 4, 801, dtype=np.float32)
    points = jnp.stack([grid, grid], axis=-1)
    density = jax.vmap(lambda y: log_prob(Mixture(mixture.logits, mixture.mean[:, :1], mixture.log_scale[:, :1]), y))
    assert density(top[:1][None])[0] >= density(points[:, :1]).max() - 1e-4


def test_mode_of_joint_dimensions_is_of_the_vector(x64: None) -> None:
    """The strongest by dimension need not be the strongest together."""
    mixture = device(
        Mixture(np.log([0.4, 0.3, 0.3]), np.array([[9.0, 9.0], [0.0, -0.5], [0.3, 0.5]]), np.zeros((3, 2)))
    )
    joint = mode(mixture, coupling="joint")
    slope = jax.grad(lambda y: log_prob(mixture, y, coupling="joint"))(joint)
    np.testing.assert_allclose(slope, 0, atol=1e-9)
    axis = np.linspace(-2, 11, 261)
    points = jnp.stack(jnp.meshgrid(axis, axis), axis=-1)
    density = jax.vmap(jax.vmap(lambda y: log_prob(mixture, y, coupling="joint")))(points)
    assert log_prob(mixture, joint, coupling="joint") >= density.max()


def test_mode_leaves_a_strong_wide_component_for_a_narrow_one() -> None:
    """Weight is not height: 0.9 of the mass in a wide component is lower than 0.1 in one a hundred times narrower."""
    mixture = device(Mixture(np.log([0.9, 0.1]), np.array([[0.0], [5.0]]), np.log([[1.0], [0.01]])), "float32")
    np.testing.assert_allclose(mode(mixture), [5.0], atol=1e-4)
    assert strongest(mixture).mean[0, 0] == 0


def test_strongest_keeps_the_heaviest_component() -> None:
    mixture = device(random_mixture(), "float32")
    found = strongest(mixture)
    assert found.logits.shape == (*BATCH, 1)
    for index in np.ndindex(*BATCH):
        heaviest = int(np.argmax(mixture.logits[index]))
        np.testing.assert_array_equal(found.mean[index][0], mixture.mean[index][heaviest])
        np.testing.assert_array_equal(found.log_scale[index][0], mixture.log_scale[index][heaviest])
