import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnvo_jax import mixture
from mdnvo_jax.config import ImageConfig, ModelConfig
from mdnvo_jax.data import augment
from mdnvo_jax.geometry import mirror_step
from mdnvo_jax.model import fold
from mdnvo_jax.model.conv import BATCH_NORM_EPSILON, LAYERS, ConvStack
from mdnvo_jax.model.head import Labels, mixture_from_outputs
from mdnvo_jax.model.network import build, template

IMAGE = ImageConfig(height=33, width=65, channels=1, normalisation="local_contrast")
MODEL = ModelConfig(width=1 / 64, lstm_hidden=8, lstm_layers=2, components=2)
LABELS = Labels(np.arange(6.0), np.arange(1, 7) / 10)


def lively(shapes, seed=0, deviation=0.3):
    """Random variables of these shapes: no scale of one, no bias or mean of zero, variances from tiny to large."""
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        if path[-1].key == "var":
            return (10 ** rng.uniform(-3, 3, leaf.shape)).astype(np.float32)
        return rng.normal(scale=deviation, size=leaf.shape).astype(np.float32)

    return jax.tree.map_with_path(draw, shapes)


def stack_variables(seed=0, height=33, width=65, multiplier=1 / 64):
    init = functools.partial(ConvStack(multiplier, 0.1).init, train=False)
    shapes = jax.eval_shape(init, jax.random.key(0), jnp.zeros((1, height, width, 2)), jnp.ones(1, bool))
    return lively(shapes, seed)


def unfolded(variables, pairs):
    stack = ConvStack(variables["params"]["conv6"]["bias"].size / 1024, 0.1)
    maps = jax.jit(functools.partial(stack.apply, train=False))(variables, pairs, jnp.ones(len(pairs), bool))
    return np.asarray(maps).reshape(len(pairs), -1)


def folded(variables, pairs):
    return np.asarray(jax.jit(fold.folded_stack)(fold.fold_stack(variables["params"], variables["batch_stats"]), pairs))


def test_a_layer_by_hand():
    layers = {
        layer.name: {"kernel": np.full((1, 1, 1, 2), 3.0), "scale": np.array([2.0, -1.0]), "bias": np.array([5.0, 0.5])}
        for layer in LAYERS
    }
    statistics = {layer.name: {"mean": np.array([7.0, 1.0]), "var": np.array([4.0, 0.0])} for layer in LAYERS}
    found = fold.fold_stack(layers, statistics)
    assert len(found) == len(LAYERS)
    factor = np.array([2 / np.sqrt(4 + BATCH_NORM_EPSILON), -1 / np.sqrt(BATCH_NORM_EPSILON)])
    np.testing.assert_allclose(found[0].kernel[0, 0, 0], 3 * factor, rtol=1e-7)
    np.testing.assert_allclose(found[0].bias, np.array([5.0, 0.5]) - np.array([7.0, 1.0]) * factor, rtol=1e-7)
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {np.dtype("f4")}


@pytest.mark.parametrize(
    ("count", "height", "width"), [(2, 33, 65), (1, 1, 1), (3, 7, 70), (1, 64, 64), (2, 95, 3), (1, 66, 37)]
)
def test_the_folded_stack_is_the_stack(count, height, width):
    variables = stack_variables(seed=width)
    pairs = np.random.default_rng(height).normal(size=(count, height, width, 2)).astype(np.float32)
    expected = unfolded(variables, pairs)
    # Every layer rounds: relative to the largest feature, a few units in the last place each.
    np.testing.assert_allclose(folded(variables, pairs), expected, rtol=0, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("variance", [0.0, 1e-30, 1e12])
def test_channels_that_never_vary_and_that_vary_hugely(variance):
    variables = stack_variables()
    for layer in LAYERS:
        statistics = variables["batch_stats"][layer.name]
        # The first channel alone, so that neighbours meet ones of another order of magnitude.
        statistics["var"][0] = variance
        statistics["mean"][0] = np.sqrt(variance)
    pairs = np.random.default_rng(1).normal(size=(2, 33, 65, 2)).astype(np.float32)
    expected = unfolded(variables, pairs)
    assert np.isfinite(expected).all() and np.ptp(expected) > 0
    np.testing.assert_allclose(folded(variables, pairs), expected, rtol=0, atol=1e-5 * np.abs(expected).max())


def test_products_in_bfloat16_are_the_convolutions_own():
    """What they are worth is tested with the convolution; here, that they reach it."""
    variables = stack_variables()
    stack = fold.fold_stack(variables["params"], variables["batch_stats"])
    pairs = jnp.zeros((1, 33, 65, 2))
    for products, expected in (("float32", 0), ("mixed", len(LAYERS))):
        program = str(jax.make_jaxpr(functools.partial(fold.folded_stack, products=products))(stack, pairs))
        assert (program.count("bf16") > 0, program.count("platform_index")) == (expected > 0, expected)


@pytest.mark.parametrize(("bidirectional", "mirrored"), [(True, False), (False, False), (True, True)])
def test_the_parts_make_the_network(bidirectional, mirrored):
    model_config = dataclasses.replace(MODEL, bidirectional=bidirectional, mirrored=mirrored)
    network = build(IMAGE, model_config)
    variables = lively(template(network, IMAGE, 4))
    images = np.random.default_rng(0).integers(0, 256, (2, 5, 33, 65, 1), dtype=np.uint8)
    mask = np.array([[True] * 4, [True, False, True, False]])

    def density(images):
        return mixture_from_outputs(jax.jit(network.apply)(variables, images, mask), LABELS, model_config)

    expected = density(images)
    if mirrored:
        other = density(images[:, :, :, ::-1])
        assert np.abs(mirror_step(other.mean) - expected.mean).max() > 0.1, "a network that sees no difference"
        expected = mixture.pool([expected, other._replace(mean=mirror_step(other.mean))])
    scale = np.linspace(0.5, 2, 6)
    expected = mixture.widen(expected, scale)

    params, statistics = variables["params"], variables["batch_stats"]
    model = fold.Folded(
        fold.fold_stack(params["stack"], statistics["stack"]), params["lstm"], params["head"], LABELS, np.ones(6)
    )
    pair_features = jax.jit(fold.pair_features, static_argnums=(2, 3))
    features = [pair_features(model, window, IMAGE, model_config) for window in images]
    gates = jax.jit(fold.pair_gates)(model, jnp.stack(features))
    size = 32 * (1 + bidirectional) * (1 + mirrored)
    assert gates.shape == (2, 4, fold.gates_size(model, model_config)) == (2, 4, size)
    found = jax.jit(fold.window_densities, static_argnums=3)(model, gates, mask, model_config, scale)
    for part, whole in zip(found, expected, strict=True):
        np.testing.assert_allclose(part[mask], whole[mask], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("centre", [None, 32.0, 30.5, 25.25])
def test_a_mirrored_pair_is_what_the_mirrored_world_shows_the_same_camera(centre):
    """As training's frames are mirrored, which are bytes: to a level of 255."""
    camera = () if centre is None else (60.0, 60.0, centre, 16.0)
    image = dataclasses.replace(IMAGE, normalisation="standard", camera=camera)
    frames = np.random.default_rng(0).integers(0, 256, (3, 33, 65, 1), dtype=np.uint8)
    pairs = fold.stacked_pairs(frames, image)
    seen = fold.sides(pairs, image, dataclasses.replace(MODEL, mirrored=True))
    np.testing.assert_array_equal(seen[::2], pairs)
    expected = fold.stacked_pairs(np.stack([augment.mirror_frame(frame, camera or None) for frame in frames]), image)
    assert np.abs(np.asarray(seen[1::2] - expected)).max() < (1.01 / 255 if centre == 25.25 else 1e-7)
    assert fold.sides(pairs, image, MODEL) is pairs


def test_of_frames_that_are_not_rectified_the_middle_mirrors():
    image = dataclasses.replace(IMAGE, camera=(60.0, 60.0, 20.0, 16.0), rectify=False)
    pairs = jnp.arange(65.0)[None, None, :, None] * jnp.ones((1, 33, 1, 2))
    seen = fold.sides(pairs, image, dataclasses.replace(MODEL, mirrored=True))
    np.testing.assert_array_equal(seen[1], pairs[0, :, ::-1])


def test_frames_of_another_size_are_refused():
    with pytest.raises(ValueError, match=r"\(32, 65, 1\), expected \(33, 65, 1\)"):
        fold.stacked_pairs(jnp.zeros((2, 32, 65, 1), jnp.uint8), IMAGE)
    pairs = fold.stacked_pairs(
        jnp.arange(3, dtype=jnp.uint8)[:, None, None, None] * jnp.ones((1, 33, 65, 1), jnp.uint8),
        dataclasses.replace(IMAGE, normalisation="standard"),
    )
    np.testing.assert_allclose(pairs[:, 0, 0] * 255, [[0 - 127.5, 1 - 127.5], [1 - 127.5, 2 - 127.5]], rtol=1e-6)
