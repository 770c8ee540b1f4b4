import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnvo_jax.config import ImageConfig, ModelConfig
from mdnvo_jax.model.network import build, feature_size, initialise, template

IMAGE = ImageConfig(height=33, width=65, channels=1, normalisation="local_contrast")
MODEL = ModelConfig(width=1 / 64, lstm_hidden=8, lstm_layers=2, components=2, conv_dropout=0.1, lstm_dropout=0.2)
BATCH, STEPS = 2, 4


@pytest.fixture(scope="module")
def network():
    return build(IMAGE, MODEL)


@pytest.fixture(scope="module")
def variables(network):
    return initialise(network, jax.random.key(0), IMAGE, STEPS)


@pytest.fixture(scope="module")
def evaluate(network, variables):
    return jax.jit(functools.partial(network.apply, variables))


@pytest.fixture(scope="module")
def train(network):
    """Gradient of the sum of squares of the valid steps' outputs, those outputs, and the statistics afterwards."""

    def run(variables, images, mask, key):
        def loss(params):
            outputs, updated = network.apply(
                {**variables, "params": params},
                images,
                mask,
                train=True,
                rngs={"dropout": key},
                mutable=["batch_stats"],
            )
            return jnp.sum(jnp.square(outputs), where=mask[..., None]), (outputs, updated["batch_stats"])

        return jax.grad(loss, has_aux=True)(variables["params"])

    return jax.jit(run)


@pytest.fixture
def images():
    return np.random.default_rng(0).integers(0, 256, (BATCH, STEPS + 1, 33, 65, 1), dtype=np.uint8)


ALL = np.ones((BATCH, STEPS), bool)


def test_shapes(evaluate, images, network, variables):
    assert evaluate(images, ALL).shape == (BATCH, STEPS, 2 + 2 * 2 * 6)
    # 33 x 65 becomes 1 x 2 in six halvings, at 16 channels.
    assert feature_size(IMAGE, MODEL) == 32
    assert variables["params"]["lstm"]["layer0"]["forward"]["input_kernel"].shape == (32, 32)
    assert variables["params"]["head"]["kernel"].shape == (16, 26)
    shapes = template(network, IMAGE, 1)
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), shapes) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), variables
    )
    assert {leaf.dtype for leaf in jax.tree.leaves(variables)} == {np.dtype("f4")}


def test_the_network_of_the_config_has_the_size_it_has():
    shapes = template(build(ImageConfig(), ModelConfig()), ImageConfig(), 6)["params"]
    count = {part: sum(leaf.size for leaf in jax.tree.leaves(shapes[part])) for part in shapes}
    assert feature_size(ImageConfig(), ModelConfig()) == 3 * 10 * 1024
    assert count == {
        "stack": 14_616_320,
        "lstm": 2 * 4000 * (30720 + 1000 + 1) + 2 * 4000 * (2000 + 1000 + 1),
        "head": 2001 * 39,
    }


def test_deepvo_is_a_config():
    config = dataclasses.replace(MODEL, head="regression", bidirectional=False)
    shapes = template(build(IMAGE, config), IMAGE, STEPS)["params"]
    assert shapes["head"]["kernel"].shape == (8, 6)
    assert list(shapes["lstm"]["layer0"]) == ["forward"]


def test_initialisation_is_a_function_of_the_key(network, variables):
    again = initialise(network, jax.random.key(0), IMAGE, 1)
    jax.tree.map(np.testing.assert_array_equal, again, variables)
    other = initialise(network, jax.random.key(1), IMAGE, STEPS)
    assert (other["params"]["head"]["kernel"] != variables["params"]["head"]["kernel"]).any()
    shapes = template(network, IMAGE, STEPS)
    assert jax.tree.map(jnp.shape, shapes) == jax.tree.map(jnp.shape, variables)


def test_colour_and_other_normalisations(images):
    for how in ("standard", "flownet"):
        image_config = dataclasses.replace(IMAGE, channels=3, normalisation=how)
        network = build(image_config, MODEL)
        shapes = template(network, image_config, STEPS)
        assert shapes["params"]["stack"]["conv1"]["kernel"].shape == (7, 7, 6, 1)
        output = jax.eval_shape(network.apply, shapes, images.repeat(3, -1), ALL)
        assert output.shape == (BATCH, STEPS, 26)


def test_valid_steps_know_nothing_of_masked_ones(evaluate, train, variables, images):
    mask = np.array([[True] * 4, [True, True, False, False]])
    other = images.copy()
    other[1, 3:] = 255 - other[1, 3:]
    assert (other != images).any()
    np.testing.assert_array_equal(np.asarray(evaluate(images, mask))[mask], np.asarray(evaluate(other, mask))[mask])
    results = []
    for frames in (images, other):
        gradient, (outputs, after) = train(variables, frames, mask, jax.random.key(0))
        results.append((gradient, np.asarray(outputs)[mask], after))
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), *results)


def test_padding_to_a_longer_window_changes_nothing(evaluate, images):
    longer = np.concatenate([images, images[:, :2]], 1)
    mask = np.concatenate([ALL, np.zeros((BATCH, 2), bool)], 1)
    np.testing.assert_allclose(evaluate(longer, mask)[:, :STEPS], evaluate(images, ALL), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("bidirectional", [True, False])
def test_only_a_bidirectional_network_looks_ahead(network, variables, images, bidirectional):
    if bidirectional:
        params = variables
    else:
        config = dataclasses.replace(MODEL, bidirectional=False)
        network = build(IMAGE, config)
        params = initialise(network, jax.random.key(0), IMAGE, STEPS)
    changed = images.copy()
    changed[:, 3:] = 255 - changed[:, 3:]
    run = jax.jit(functools.partial(network.apply, params))
    differs = (np.abs(run(images, ALL) - run(changed, ALL)) > 1e-6).any((0, 2))
    # Frame 3 is the second of step 2.
    assert differs.tolist() == ([True] * 4 if bidirectional else [False, False, True, True])


def test_training_moves_statistics_drops_units_and_has_finite_gradients(train, variables, images):
    key = jax.random.key(0)
    gradient, (outputs, after) = train(variables, images, ALL, key)
    assert all(np.isfinite(leaf).all() and np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradient))
    moved = jax.tree.map(lambda old, new: (old != new).all(), variables["batch_stats"], after)
    assert all(jax.tree.leaves(moved))
    _, (again, _) = train(variables, images, ALL, key)
    np.testing.assert_array_equal(again, outputs)
    _, (other, _) = train(variables, images, ALL, jax.random.key(1))
    assert (np.asarray(other) != outputs).any()


@pytest.mark.parametrize("part", ["conv_dropout", "lstm_dropout"])
def test_both_parts_drop_units(variables, images, part):
    rates = {"conv_dropout": 0.0, "lstm_dropout": 0.0} | {part: 0.5}
    network = build(IMAGE, dataclasses.replace(MODEL, **rates))

    def run(key):
        rngs = {"dropout": key}
        return network.apply(variables, images, ALL, train=True, rngs=rngs, mutable=["batch_stats"])[0]

    run = jax.jit(run)
    assert (run(jax.random.key(0)) != run(jax.random.key(1))).any()


def test_a_batch_of_padding_alone_does_no_harm(train, variables, images):
    gradient, (outputs, after) = train(variables, images, np.zeros_like(ALL), jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, after, variables["batch_stats"])
    assert np.isfinite(outputs).all()
    assert all((np.asarray(leaf) == 0).all() for leaf in jax.tree.leaves(gradient))


def test_extreme_frames_are_finite(evaluate):
    black = np.zeros((BATCH, STEPS + 1, 33, 65, 1), np.uint8)
    flicker = black.copy()
    flicker[:, ::2] = 255
    for frames in (black, flicker):
        assert np.isfinite(evaluate(frames, ALL)).all()


@pytest.mark.parametrize(
    ("shape", "mask", "message"),
    [((2, 5, 33, 65, 1), (2, 5), "expected a mask of"), ((2, 5, 32, 65, 1), (2, 4), "expected .33, 65, 1.")],
)
def test_mistaken_shapes_are_named(network, variables, shape, mask, message):
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(network.apply, variables, np.zeros(shape, np.uint8), np.ones(mask, bool))
