"""The fast gradients of the convolution against XLA's own, whatever shape, stride and padding."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mdnvo_jax.model import convolution
from mdnvo_jax.model.convolution import convolve


def reference(x, kernel, stride, padding):
    sides = [(padding, padding)] * 2
    return jax.lax.conv_general_dilated(x, kernel, (stride,) * 2, sides, dimension_numbers=("NHWC", "HWIO", "NHWC"))


def gradients(function, x, kernel, seed=3):
    """The value of `function`, and the gradients of a random weighting of it."""
    value, pull = jax.vjp(function, x, kernel)
    weights = np.random.default_rng(seed).normal(size=value.shape)
    return value, *pull(jnp.asarray(weights, value.dtype))


def operands(size, height, width, channels, outputs, images=2, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(images, height, width, channels)), rng.normal(size=(size, size, channels, outputs))


@given(
    size=st.integers(1, 5),
    stride=st.integers(1, 3),
    padding=st.integers(0, 3),
    height=st.integers(1, 12),
    width=st.integers(1, 12),
    band_values=st.sampled_from([2**21, 1200]),
)
@example(size=5, stride=2, padding=2, height=12, width=11, band_values=1200)  # two bands of three rows
@settings(max_examples=6)
def test_gradients_are_those_of_lax_for_any_shape(size, stride, padding, height, width, band_values):
    if min(height, width) + 2 * padding < size:
        return  # no output pixel
    with pytest.MonkeyPatch.context() as patch, jax.enable_x64(True):
        patch.setattr(convolution, "_COLUMNS_FROM_PIXELS", 0)
        patch.setattr(convolution, "_COLUMNS_VALUES", band_values)  # the small one cuts an image into bands of rows
        x, kernel = (jnp.asarray(array) for array in operands(size, height, width, 2, 3))
        found, expected = jax.jit(
            lambda x, kernel: [
                gradients(functools.partial(function, stride=stride, padding=padding), x, kernel)
                for function in (convolve, reference)
            ]
        )(x, kernel)
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("size", "stride", "height", "width"), [(7, 2, 33, 40), (3, 1, 18, 17), (3, 2, 9, 10)])
def test_float32_gradients_are_exact_to_rounding(size, stride, height, width):
    x, kernel = (np.float32(array) for array in operands(size, height, width, 6, 8))
    run = jax.jit(functools.partial(gradients, lambda x, kernel: convolve(x, kernel, stride, size // 2)))
    with jax.enable_x64(True):
        exact = gradients(lambda x, kernel: reference(x, kernel, stride, size // 2), *map(np.float64, (x, kernel)))
    for ours, theirs in zip(map(np.asarray, run(x, kernel)), map(np.asarray, exact), strict=True):
        assert ours.dtype == np.float32
        assert np.linalg.norm(ours - theirs) < 1e-6 * np.linalg.norm(theirs)


@pytest.mark.parametrize("matrix_units", [False, True])
def test_mixed_products_round_where_there_are_units_for_it(monkeypatch, matrix_units):
    monkeypatch.setattr(convolution, "has_matrix_units", lambda: matrix_units)
    x, kernel = (np.float32(array) for array in operands(5, 40, 36, 3, 8))
    mixed = jax.jit(functools.partial(gradients, lambda x, kernel: convolve(x, kernel, 2, 2, "mixed")))(x, kernel)
    exact = gradients(lambda x, kernel: reference(x, kernel, 2, 2), x, kernel)
    errors = [np.linalg.norm(ours - theirs) / np.linalg.norm(theirs) for ours, theirs in zip(mixed, exact, strict=True)]
    assert errors[0] < 1e-6, "forward, a processor computes in float32"
    assert errors[1] < 1e-6, "so does it the input's gradient"
    # bfloat16 keeps 8 bits: each factor is off by at most 2^-9, half of that on average, with either sign.
    assert 1e-4 < errors[2] < 4e-3 if matrix_units else errors[2] < 1e-6


@pytest.mark.parametrize("products", ["float32", "mixed"])
def test_other_platforms_get_the_plain_form(products):
    """What is lowered for a TPU has a convolution for each gradient and no columns."""
    x, kernel = (np.float32(array) for array in operands(5, 40, 36, 3, 8))
    run = jax.jit(functools.partial(gradients, lambda x, kernel: convolve(x, kernel, 2, 2, products)))
    text = {
        platform: run.trace(x, kernel).lower(lowering_platforms=(platform,)).as_text() for platform in ("cpu", "tpu")
    }
    assert "stablehlo.concatenate" in text["cpu"]
    assert "stablehlo.concatenate" not in text["tpu"]
    assert text["tpu"].count("stablehlo.convolution") == 3
    assert ("bf16" in text["tpu"]) == (products == "mixed")
    assert "bf16" not in text["cpu"] or convolution.has_matrix_units()


def test_mixed_products_elsewhere_round_every_factor():
    """The form for GPU and TPU, computed here."""
    x, kernel = (np.float32(array) for array in operands(3, 6, 7, 3, 4))
    rounded = convolution._plain(x, kernel, stride=1, padding=1, rounding=jnp.bfloat16)
    factors = [np.float32(array.astype(jnp.bfloat16)) for array in (x, kernel)]
    assert rounded.dtype == np.float32
    np.testing.assert_allclose(rounded, reference(*factors, 1, 1), rtol=1e-5, atol=1e-5)


def test_an_unused_gradient_of_the_input_is_not_computed():
    """The first layer's input are images: nobody asks for their gradient."""
    x, kernel = (np.float32(array) for array in operands(5, 40, 36, 3, 8))
    loss = jax.jit(jax.grad(lambda kernel, x: jnp.sum(convolve(x, kernel, 2, 2) ** 2)))
    assert loss.lower(kernel, x).compile().as_text().count("convolution(") == 1, "the forward one"
