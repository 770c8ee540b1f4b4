"""What a network puts out, read as a mixture."""

import jax
import jax.numpy as jnp
import numpy as np

from mdnvo_jax import mixture as mx


def test_from_network_reads_logits_then_means_then_scales() -> None:
    outputs = jnp.arange(3 + 2 * 3 * 2, dtype=jnp.float32) + jnp.zeros((4, 1))
    found = mx.from_network(outputs, 3, dimensions=2, floor=1e-30)
    assert outputs.shape[-1] == mx.outputs_size(3, 2)
    assert mx.outputs_size(5) == 65
    np.testing.assert_array_equal(found.logits[0], [0, 1, 2])
    np.testing.assert_array_equal(found.mean[0], [[3, 4], [5, 6], [7, 8]])
    np.testing.assert_allclose(found.log_scale[0], [[9, 10], [11, 12], [13, 14]], rtol=1e-6)


def test_scale_is_the_floor_plus_an_exponential() -> None:
    floor = jnp.array([0.5, 2.0])
    outputs = jnp.concatenate([jnp.zeros((3, 3)), jnp.array([[-1e4, -1e4], [0.0, 1.0], [50.0, 50.0]])], axis=-1)
    log_scale = mx.from_network(outputs, 1, dimensions=2, floor=floor).log_scale[:, 0]
    np.testing.assert_allclose(jnp.exp(log_scale[0]), floor, rtol=1e-6)
    np.testing.assert_allclose(jnp.exp(log_scale[1]), [1.5, 2 + np.e], rtol=1e-6)
    np.testing.assert_allclose(log_scale[2], 50, rtol=1e-6)
    value = jnp.full((3, 2), 1e4)
    slope = jax.jit(jax.grad(lambda x: mx.nll(mx.from_network(x, 1, dimensions=2, floor=floor), value)))(outputs)
    assert jnp.isfinite(slope).all()
