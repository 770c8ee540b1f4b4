"""Gradients of rotations and rigid motions: exact, at zero too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from geometry_values import AXES
from scipy.linalg import expm

from mdnvo_jax import geometry as geo


def is_finite(tree: object) -> bool:
    return all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("angle", [0, 1e-160, 1e-9, 1e-4, 0.2, 0.9999999, 1.0000001, 3.0])
def test_gradient_of_the_exponential_is_exact(angle: float, x64: None) -> None:
    """d/dr_i exp(r) = exp(r) hat(J_r(r) e_i), with J_r from scipy's matrix exponential, not from our series."""
    vector = angle * AXES[3]
    found = jax.jit(jax.jacfwd(geo.exp_so3))(jnp.asarray(vector))
    generator = np.asarray(geo.hat(vector))
    # J_r(r) = integral of exp(-s hat(r)) over s in [0, 1]: a block of a larger matrix exponential (Van Loan).
    right = expm(np.block([[-generator, np.eye(3)], [np.zeros((3, 6))]]))[:3, 3:]
    expected = np.einsum("ab,ibc->aci", expm(generator), geo.hat(right.T))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("angle", [0, 1e-160, 1e-9, 1e-4, 0.199, 0.201, 1.5, 3.0])
def test_gradient_of_the_logarithm_is_exact(angle: float, x64: None) -> None:
    """log(exp(r)) is r, so its Jacobian is the identity, through both functions' branches."""
    vector = jnp.asarray(angle * AXES[4])
    round_trip = jax.jit(jax.jacrev(lambda r: geo.log_so3(geo.exp_so3(r))))
    np.testing.assert_allclose(round_trip(vector), np.eye(3), atol=1e-11)


def test_gradients_are_finite_everywhere() -> None:
    """In float32, at zero, at pi, in between, of everything that is differentiable."""
    angles = np.array([0, 1e-30, 1e-10, 1e-4, 0.2, 1, 3.1415925, np.pi])
    rotations = (angles[:, None, None] * AXES).reshape(-1, 3)
    vectors = jnp.asarray(np.concatenate([np.ones_like(rotations), rotations], axis=-1), jnp.float32)

    def everything(step: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        T, rotation = geo.step_to_matrix(step), step[..., 3:]
        covariances = jnp.broadcast_to(jnp.eye(6) * 1e-3, (4, 6, 6))
        outputs = {
            "matrix_to_step": geo.matrix_to_step(T),
            "quaternion": geo.matrix_from_quaternion(geo.quaternion_from_matrix(T[..., :3, :3])),
            "exp_se3": geo.exp_se3(step),
            "log_se3": geo.log_se3(T),
            "adjoint": geo.adjoint(geo.inverse(T)),
            "reverse": geo.reverse_step(step),
            "jacobian": geo.right_jacobian_so3(rotation),
            "accumulate": geo.accumulate(T[-4:]),
            "covariance": geo.propagate_covariance(T[:4], covariances, order=2),
        }
        return sum(leaf.sum() for leaf in outputs.values()), outputs

    slope, outputs = jax.jit(jax.grad(everything, has_aux=True))(vectors)
    for name, output in outputs.items():
        assert is_finite(output), name
    assert is_finite(slope)


def test_gradient_at_pi_of_the_logarithm() -> None:
    """Of half turns given as matrices, whose quaternions have w = 0."""
    half_turns = 2 * AXES[:, :, None] * AXES[:, None, :] - np.eye(3)
    slopes = jax.jit(jax.vmap(jax.jacrev(geo.log_so3)))(jnp.asarray(half_turns, jnp.float32))
    assert is_finite(slopes)
