import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mdnvo_jax.model.normalise import normalise

contrast = jax.jit(lambda images: normalise(images, "local_contrast"))


def smooth_texture(height, width, seed=0):
    """A frame with texture and shading, far from black and white."""
    rng = np.random.default_rng(seed)
    shading = 90 + 40 * np.sin(np.arange(width) / 17) * np.cos(np.arange(height) / 11)[:, None]
    return (shading + rng.normal(0, 20, (height, width))).clip(10, 200)[..., None]


def test_standard():
    images = jnp.array([0, 255, 51], jnp.uint8).reshape(1, 3, 1)
    found = normalise(images, "standard")
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found.ravel(), [-0.5, 0.5, -0.3], atol=1e-7)


def test_flownet_subtracts_its_mean_colour():
    found = normalise(jnp.full((2, 4, 5, 3), 255, jnp.uint8), "flownet")
    np.testing.assert_allclose(found, np.broadcast_to([0.550, 0.568, 0.589], found.shape), atol=1e-6)
    # A grey frame stands for one with that grey in all colours; luma of the mean colour.
    grey = normalise(jnp.zeros((4, 5, 1), jnp.uint8), "flownet")
    np.testing.assert_allclose(grey, -(0.299 * 0.450 + 0.587 * 0.432 + 0.114 * 0.411), atol=1e-6)


def naive_contrast(image):
    """Local contrast of `[H, W]` by the definition: pad with the edge, weigh a window at every pixel."""
    sigma = max(1.0, image.shape[0] / 16)
    reach = int(np.ceil(3 * sigma))
    line = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * sigma**2))
    window = np.outer(line, line) / line.sum() ** 2

    def mean(x):
        padded = np.pad(x, reach, mode="edge")
        views = np.lib.stride_tricks.sliding_window_view(padded, window.shape)
        return np.einsum("hwij,ij->hw", views, window)

    root = np.sqrt(image / 255)
    centred = root - mean(root)
    return np.clip(centred / (np.sqrt(mean(centred**2)) + 0.01), -4, 4)


@pytest.mark.parametrize(("height", "width"), [(24, 37), (48, 20), (1, 5)])
def test_local_contrast_is_the_definition(height, width):
    images = np.random.default_rng(0).integers(0, 256, (2, height, width, 3), dtype=np.uint8)
    found = contrast(images)
    for image, result in zip(images, np.asarray(found), strict=True):
        for channel in range(3):
            np.testing.assert_allclose(result[..., channel], naive_contrast(image[..., channel]), atol=2e-5)


@pytest.mark.parametrize("level", [0, 1, 117, 255])
def test_flat_frames_have_no_contrast(level):
    found = contrast(jnp.full((2, 33, 47, 3), level, jnp.uint8))
    np.testing.assert_allclose(found, 0, atol=1e-4)


def test_local_contrast_forgets_exposure_and_shading():
    texture = smooth_texture(64, 96)
    dim, bright = (contrast(np.round(texture * gain).astype(np.uint8)) for gain in (0.5, 1.2))
    assert np.abs(dim - bright).mean() < 0.1 * np.abs(dim).mean()
    gradient = np.round(texture * np.linspace(0.5, 1.2, 96)[:, None]).astype(np.uint8)
    correlation = np.corrcoef(np.ravel(contrast(gradient)), np.ravel(bright))[0, 1]
    assert correlation > 0.95
    assert np.corrcoef(gradient.ravel(), texture.ravel())[0, 1] < 0.85


def test_local_contrast_is_the_same_at_another_resolution():
    small = smooth_texture(32, 48)
    coarse = np.asarray(contrast(np.round(small).astype(np.uint8)))
    fine = np.asarray(contrast(np.round(small.repeat(3, 0).repeat(3, 1)).astype(np.uint8)))
    assert np.abs(fine[1::3, 1::3] - coarse).mean() < 0.1 * np.abs(coarse).mean()


@given(hnp.arrays(np.uint8, (8, 9, 1)), st.sampled_from(["standard", "local_contrast", "flownet"]))
@settings(max_examples=40, deadline=None)
def test_any_frame_gives_finite_numbers_of_its_own_shape(image, how):
    found = np.asarray(contrast(image) if how == "local_contrast" else normalise(image, how))
    assert found.shape == image.shape
    assert np.abs(found).max() <= 4


def test_frames_are_normalised_one_by_one():
    images = np.random.default_rng(0).integers(0, 256, (2, 3, 8, 9, 3), dtype=np.uint8)
    np.testing.assert_allclose(contrast(images)[1, 2], contrast(images[1, 2]), atol=1e-5)


@pytest.mark.parametrize(
    ("images", "how", "message"),
    [
        (np.zeros((4, 5, 3), np.float32), "standard", "expected uint8"),
        (np.zeros((4, 5, 2), np.uint8), "standard", "C = 1 or 3"),
        (np.zeros((4, 5, 3), np.uint8), "contrast", "found normalisation 'contrast'"),
    ],
)
def test_mistakes_are_named(images, how, message):
    with pytest.raises(ValueError, match=message):
        normalise(images, how)
