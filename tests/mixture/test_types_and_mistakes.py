"""Types, transformations, mistakes and cost of the mixture density."""

import subprocess
import sys
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mixture_reference import (
    BATCH,
    GOOD,
    GOOD_VALUE,
    KEY,
    PUBLIC,
    device,
    everything,
    log_prob,
    random_mixture,
    random_value,
)

from mdnvo_jax import mixture as mx
from mdnvo_jax.mixture import Mixture


def test_short_floats_are_computed_in_float32() -> None:
    for dtype in ("bfloat16", "float16"):
        mixture, value = device(random_mixture(), dtype), jnp.asarray(random_value(), dtype)
        for leaf in jax.tree.leaves(jax.eval_shape(everything, mixture, value)):
            assert leaf.dtype == jnp.float32
        exact = log_prob(device(mixture, "float32"), value.astype("float32"))
        np.testing.assert_allclose(log_prob(mixture, value), exact, rtol=1e-6)
        outputs = jnp.ones(mx.outputs_size(2, 1), dtype)
        assert mx.from_network(outputs, 2, dimensions=1, floor=0.1).log_scale.dtype == jnp.float32


def test_vmap_equals_the_batch() -> None:
    mixture, value = device(random_mixture()), jnp.asarray(random_value())
    names = ("nll", "covariance joint", "mode joint", "interval", "crps")

    @jax.jit
    def mapped(mixture: Mixture, value: jax.Array) -> dict[str, object]:
        return {name: jax.vmap(PUBLIC[name])(mixture, value) for name in names}

    found, whole = mapped(mixture, value), everything(mixture, value)
    np.testing.assert_allclose(found.pop("nll").mean(), whole["nll"], rtol=1e-5)
    for name, output in found.items():
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), output, whole[name])


MISTAKES: dict[str, tuple[Callable[[], object], str]] = {
    "value without batch": (lambda: mx.log_prob(GOOD, GOOD_VALUE[0, 0]), r"\(3,\); expected \(2, 3, 3\)"),
    "value with axis of one": (lambda: mx.log_prob(GOOD, GOOD_VALUE[:, :1]), r"\(2, 1, 3\); expected \(2, 3, 3\)"),
    "value with more batch": (lambda: mx.log_prob(GOOD, GOOD_VALUE[None]), "expected"),
    "scalar value": (lambda: mx.cdf(GOOD, 0.0), r"\(\); expected \(2, 3, 3\)"),
    "value of one dimension": (lambda: mx.crps(GOOD, GOOD_VALUE[..., :1]), "expected"),
    "nll value": (lambda: mx.nll(GOOD, GOOD_VALUE[0]), "expected"),
    "scale of another shape": (lambda: mx.mean(GOOD._replace(log_scale=GOOD.log_scale[..., :1])), "expected"),
    "logits of another batch": (lambda: mx.variance(GOOD._replace(logits=GOOD.logits[0])), "expected"),
    "logits of another M": (lambda: mx.mode(GOOD._replace(logits=GOOD.logits[..., :1])), "expected"),
    "scalar fields": (lambda: mx.mean(Mixture(*map(jnp.asarray, (0.0, 0.0, 0.0)))), "expected"),
    "coupling": (lambda: mx.log_prob(GOOD, GOOD_VALUE, coupling="both"), "'both'; expected 'independent'"),
    "coupling of covariance": (lambda: mx.covariance(GOOD, coupling=""), "expected 'independent'"),
    "coupling of sample": (lambda: mx.sample(GOOD, KEY, coupling=""), "expected 'independent'"),
    "coupling of mode": (lambda: mx.mode(GOOD, coupling=""), "expected 'independent'"),
    "reduction": (lambda: mx.nll(GOOD, GOOD_VALUE, reduction="sum"), "'sum'; expected 'mean', 'sequence' or 'none'"),
    "mask of another shape": (lambda: mx.nll(GOOD, GOOD_VALUE, mask=jnp.ones(3, bool)), r"\(3,\); expected bool"),
    "mask of numbers": (lambda: mx.nll(GOOD, GOOD_VALUE, mask=jnp.ones(BATCH)), "float32.*expected bool"),
    "sequence of a single step": (
        lambda: mx.nll(Mixture(*(f[0, 0] for f in GOOD)), GOOD_VALUE[0, 0], reduction="sequence"),
        "single step; expected",
    ),
    "affine shape": (lambda: mx.affine(GOOD, jnp.ones(1), jnp.zeros(3)), r"\(1,\) and \(3,\); expected \(3,\)"),
    "affine sign": (lambda: mx.affine(GOOD, jnp.array([1.0, 0, 1]), jnp.zeros(3)), "expected positive"),
    "widen shape": (lambda: mx.widen(GOOD, jnp.ones(2)), r"factor has shape \(2,\); expected \(3,\)"),
    "widen scalar": (lambda: mx.widen(GOOD, 2.0), r"factor has shape \(\); expected \(3,\)"),
    "widen batch": (lambda: mx.widen(GOOD, jnp.ones((2, 3, 3))), r"\(2, 3, 3\); expected \(3,\)"),
    "widen sign": (lambda: mx.widen(GOOD, jnp.array([1.0, -1, 1])), "factor is .*expected positive"),
    "noise shape": (lambda: mx.add_noise(GOOD, 0.1), r"sigma has shape \(\); expected \(3,\)"),
    "noise sign": (lambda: mx.add_noise(GOOD, jnp.array([1.0, -1, 0])), "sigma is .*expected numbers of 0 or more"),
    "noise of no number": (lambda: mx.add_noise(GOOD, jnp.array([1.0, jnp.nan, 0])), "expected numbers of 0 or more"),
    "pool of nothing": (lambda: mx.pool([]), r"\[\]; expected one or more"),
    "pool of two batches": (
        lambda: mx.pool([GOOD, Mixture(*(field[0] for field in GOOD))]),
        r"\[\(\(2, 3\), 3\), \(\(3,\), 3\)\]; expected one or more, all of one",
    ),
    "outputs of another size": (
        lambda: mx.from_network(jnp.ones(12), 1, floor=1.0),
        r"\(12,\); expected \[\.\.\., 13\]",
    ),
    "scalar outputs": (lambda: mx.from_network(1.0, 1, floor=1.0), "expected"),
    "floor shape": (
        lambda: mx.from_network(jnp.ones(13), 1, floor=jnp.ones(2)),
        r"\(2,\); expected a number or \(6,\)",
    ),
    "floor of zero": (lambda: mx.from_network(jnp.ones(13), 1, floor=0.0), "expected positive"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named(name: str) -> None:
    call, message = MISTAKES[name]
    with pytest.raises(ValueError, match=message):
        call()


def test_importing_costs_jax_alone() -> None:
    """The packages loaded are those that JAX and the parts of it that are used load."""
    print_packages = "import sys; print(*{name.split('.')[0] for name in sys.modules})"
    ours, jax_alone = (
        set(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True).stdout.split())
        for code in (
            f"import mdnvo_jax.mixture; {print_packages}",
            f"import math, typing, jax, jax.numpy, jax.scipy.special, jax.typing; {print_packages}",
        )
    )
    assert ours - jax_alone == {"mdnvo_jax"}
    assert not ours & {"flax", "cv2", "grain", "matplotlib", "optax", "orbax"}
