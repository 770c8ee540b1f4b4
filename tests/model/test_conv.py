import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnvo_jax.model.conv import LAYERS, ConvBlock, ConvStack, Layer, batch_moments, layer_channels, map_size
from mdnvo_jax.model.convolution import convolve
from mdnvo_jax.model.flownet import load_stack, read_flownet, write_stack

LAYER = Layer("conv", 3, 2, 4)


@pytest.fixture(scope="module")
def rng():
    return np.random.default_rng(0)


def naive_convolution(x, kernel, stride, padding):
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding), (0, 0)))
    size = kernel.shape[0]
    rows, columns = ((x.shape[axis] - size) // stride + 1 for axis in (1, 2))
    out = np.zeros((x.shape[0], rows, columns, kernel.shape[3]))
    for row in range(rows):
        for column in range(columns):
            patch = x[:, row * stride : row * stride + size, column * stride : column * stride + size]
            out[:, row, column] = np.einsum("nhwc,hwcd->nd", patch, kernel)
    return out


@pytest.mark.parametrize(
    ("size", "stride", "height", "width"), [(7, 2, 9, 12), (5, 2, 8, 7), (3, 1, 4, 5), (3, 2, 1, 1)]
)
def test_convolve_is_the_definition(rng, size, stride, height, width):
    x, kernel = rng.normal(size=(2, height, width, 3)), rng.normal(size=(size, size, 3, 4))
    with jax.enable_x64(True):
        found = convolve(jnp.asarray(x), jnp.asarray(kernel), stride, (size - 1) // 2)
    np.testing.assert_allclose(found, naive_convolution(x, kernel, stride, (size - 1) // 2), rtol=1e-12, atol=1e-12)


def test_the_stack_is_that_of_flownet():
    assert [(layer.kernel, layer.stride, layer.channels) for layer in LAYERS] == [
        (7, 2, 64), (5, 2, 128), (5, 2, 256), (3, 1, 256), (3, 2, 512), (3, 1, 512), (3, 2, 512), (3, 1, 512),
        (3, 2, 1024),
    ]  # fmt: skip


def stack_shapes(multiplier, height=64, width=64, channels=6):
    stack = ConvStack(multiplier, 0.1)
    pairs, mask = jnp.zeros((1, height, width, channels)), jnp.ones(1, bool)
    run = functools.partial(stack.init_with_output, train=False)
    return jax.eval_shape(run, jax.random.key(0), pairs, mask)


def test_full_width_has_14_6_million_parameters():
    _, variables = stack_shapes(1.0)
    kernels = 6 * 64 * 49 + 64 * 128 * 25 + 128 * 256 * 25 + 9 * (256**2 + 256 * 512 + 3 * 512**2 + 512 * 1024)
    assert sum(leaf.size for leaf in jax.tree.leaves(variables["params"])) == kernels + 2 * 3776 == 14_616_320


@pytest.mark.parametrize("multiplier", [0.25, 1 / 48, 1e-3])
def test_width_multiplies_the_channels(multiplier):
    output, variables = stack_shapes(multiplier, channels=2)
    expected = [max(1, round(layer.channels * multiplier)) for layer in LAYERS]
    assert [variables["params"][layer.name]["kernel"].shape[-1] for layer in LAYERS] == expected
    assert output.shape == (1, 1, 1, expected[-1])
    assert layer_channels(LAYERS[0], 1e-9) == 1


@pytest.mark.parametrize(("height", "width"), [(184, 608), (376, 1241), (80, 256), (33, 65), (1, 2)])
def test_map_size_is_the_size_of_the_maps(height, width):
    output, _ = stack_shapes(1 / 64, height, width)
    assert map_size(height, width) == output.shape[1:3]


def test_kernels_are_xavier():
    variables = jax.jit(lambda key: ConvBlock(Layer("c", 5, 1, 40), 40, 0.0).init(
        key, jnp.zeros((1, 5, 5, 24)), jnp.ones(1, bool), train=False))(jax.random.key(0))  # fmt: skip
    kernel = np.asarray(variables["params"]["kernel"])
    variance = 2 / (25 * (24 + 40))
    assert kernel.var() == pytest.approx(variance, rel=0.03)
    assert np.abs(kernel).max() <= np.sqrt(3 * variance)
    assert abs(kernel.mean()) < 4 * np.sqrt(variance / kernel.size)
    for name, value in (("scale", 1), ("bias", 0)):
        assert (np.asarray(variables["params"][name]) == value).all()
    for name, value in (("mean", 0), ("var", 1)):
        assert (np.asarray(variables["batch_stats"][name]) == value).all()


def test_moments_leave_masked_maps_out(rng):
    x = rng.normal(3, 2, size=(4, 2, 3, 5)).astype(np.float32)
    mask = np.array([True, False, True, True])
    found = batch_moments(jnp.asarray(x), jnp.asarray(mask))
    np.testing.assert_allclose(found.mean, x[mask].mean((0, 1, 2)), rtol=1e-5)
    np.testing.assert_allclose(found.variance, x[mask].var((0, 1, 2)), rtol=1e-5)
    assert found.pixels == 18


def test_variance_keeps_its_digits_beside_a_large_mean(rng):
    x = rng.normal(1e4, 1, size=(4, 8, 8, 1)).astype(np.float32)
    found = batch_moments(jnp.asarray(x), jnp.ones(4, bool))
    np.testing.assert_allclose(found.variance, x.astype(np.float64).var((0, 1, 2)), rtol=1e-3)


# PyTorch's own layers with the same weights.


@pytest.fixture
def torch_stack(golden, tmp_path):
    """Recorded arrays, and the variables of FlowNetS-BN at 1/32 of its width."""
    write_stack(tmp_path / "stack.npz", read_flownet(golden / "flownets_bn_zip.pth", order="bgr"))
    _, shapes = stack_shapes(1 / 32)
    empty = {kind: {"stack": shapes[kind]} for kind in ("params", "batch_stats")}
    variables = load_stack(tmp_path / "stack.npz", empty)
    with np.load(golden / "torch_stack.npz") as recorded:
        # The weights are converted for frames in RGB minus the means in RGB.
        frames = recorded["frames"] / 255.0 - np.array([0.450, 0.432, 0.411])
        pairs = np.concatenate([frames[:, 0], frames[:, 1]], -1)
        return dict(recorded), pairs, {kind: variables[kind]["stack"] for kind in variables}


def run_train(variables, pairs, mask, cotangent):
    def loss(params, pairs):
        outputs, updated = ConvStack(1 / 32, 0.0).apply(
            {"params": params, "batch_stats": variables["batch_stats"]},
            pairs,
            mask,
            train=True,
            mutable=["batch_stats"],
        )
        return jnp.sum(outputs * cotangent), (outputs, updated["batch_stats"])

    return jax.jit(jax.grad(loss, argnums=(0, 1), has_aux=True))(variables["params"], pairs)


# In float64 the only difference left is that the recorded figures are float32; float32 adds its own rounding.
@pytest.mark.parametrize(("wide", "tolerance"), [(True, 2e-7), (False, 1e-5)])
def test_agrees_with_torch(torch_stack, assert_close, wide, tolerance):
    recorded, pairs, variables = torch_stack
    with jax.enable_x64(wide):
        dtype = np.float64 if wide else np.float32
        variables = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), dtype), variables)
        pairs, mask = jnp.asarray(pairs, dtype), jnp.ones(len(pairs), bool)

        if wide:  # test_flownet compares it in float32
            evaluate = jax.jit(functools.partial(ConvStack(1 / 32, 0.1).apply, train=False))
            assert_close(evaluate(variables, pairs, mask), recorded["bn_eval"], tolerance)

        (by_params, by_pairs), (outputs, after) = run_train(variables, pairs, mask, jnp.asarray(recorded["cotangent"]))
    assert_close(outputs, recorded["bn_train"], tolerance)
    # Recorded for BGR.
    assert_close(by_pairs[:1, ..., np.array([2, 1, 0, 5, 4, 3])], recorded["bn_train_grad_pair0"], tolerance)
    assert_close(by_params["conv3_1"]["kernel"], recorded["bn_train_grad_conv3_1_kernel"], tolerance)
    assert_close(by_params["conv2"]["scale"], recorded["bn_train_grad_conv2_scale"], tolerance)
    for layer in LAYERS:
        assert_close(after[layer.name]["mean"], recorded[f"after_{layer.name}_mean"], tolerance)
        assert_close(after[layer.name]["var"], recorded[f"after_{layer.name}_var"], tolerance)


# Masks, on one block: what it normalises with and what it remembers.


@pytest.fixture(scope="module")
def block(rng):
    x = rng.normal(size=(5, 6, 7, 3)).astype(np.float32)
    module = ConvBlock(LAYER, 4, 0.0)
    variables = module.init(jax.random.key(1), x, jnp.ones(5, bool), train=False)
    variables["batch_stats"] = {"mean": jnp.full(4, 0.3), "var": jnp.full(4, 2.0)}

    def train(x, mask):
        outputs, updated = module.apply(variables, x, mask, train=True, mutable=["batch_stats"])
        return outputs, updated["batch_stats"]

    train = jax.jit(train)
    evaluate = jax.jit(lambda x, mask: module.apply(variables, x, mask, train=False))
    return x, variables, train, evaluate


def test_masked_maps_change_neither_outputs_nor_statistics(block):
    x, _, train, evaluate = block
    mask = np.array([True, True, False, True, False])
    other = np.where(mask[:, None, None, None], x, 1e3)
    for run in (train, evaluate):
        first, second = run(x, mask), run(other, mask)
        if run is train:
            (first, first_after), (second, second_after) = first, second
            jax.tree.map(np.testing.assert_array_equal, first_after, second_after)
        np.testing.assert_array_equal(np.asarray(first)[mask], np.asarray(second)[mask])
    # The same as if they were not there at all.
    alone, alone_after = train(x[mask], np.ones(3, bool))
    outputs, after = train(other, mask)
    np.testing.assert_allclose(np.asarray(outputs)[mask], alone, rtol=1e-5, atol=1e-6)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5), after, alone_after)


def test_a_batch_that_is_all_masked_is_normalised_with_the_running_statistics(block):
    x, variables, train, evaluate = block
    nothing = np.zeros(5, bool)
    outputs, after = train(x, nothing)
    jax.tree.map(np.testing.assert_array_equal, after, variables["batch_stats"])
    np.testing.assert_allclose(outputs, evaluate(x, nothing), rtol=1e-6)
    gradient = jax.jit(jax.grad(lambda x: train.__wrapped__(x, nothing)[0].sum()))(x)
    assert np.isfinite(gradient).all()


def test_one_pixel_gives_finite_statistics(block):
    x, _, train, _ = block
    outputs, after = train(x[:1, :1, :1], np.ones(1, bool))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((outputs, after)))


def test_dropout_acts_in_training_only(block):
    x, variables, _, evaluate = block
    x, mask = np.tile(x, (20, 1, 1, 1)), np.ones(100, bool)
    module = ConvBlock(LAYER, 4, 0.1)
    np.testing.assert_array_equal(module.apply(variables, x, mask, train=False), evaluate(x, mask))
    kept, _ = ConvBlock(LAYER, 4, 0.0).apply(variables, x, mask, train=True, mutable=["batch_stats"])
    runs = [
        np.asarray(module.apply(variables, x, mask, train=True, mutable=["batch_stats"], rngs={"dropout": key})[0])
        for key in jax.random.split(jax.random.key(0))
    ]
    dropped = runs[0] == 0
    assert abs(dropped.mean() - 0.1) < 4 * np.sqrt(0.09 / dropped.size)
    np.testing.assert_allclose(runs[0][~dropped], np.asarray(kept)[~dropped] / 0.9, rtol=1e-5)
    assert (runs[1] != runs[0]).any()


def test_the_momentum_is_the_share_of_the_statistics_that_a_batch_leaves():
    pairs = np.random.default_rng(0).normal(size=(3, 16, 16, 2)).astype(np.float32)
    mask = np.ones(3, bool)
    kept = {}
    for momentum in (0.9, 0.99):
        stack = ConvStack(1 / 64, 0.0, momentum=momentum)
        variables = stack.init(jax.random.key(0), pairs, mask, train=False)
        _, updated = stack.apply(variables, pairs, mask, train=True, mutable=["batch_stats"])
        kept[momentum] = updated["batch_stats"]["conv1"]["mean"]
    # The mean starts at zero: what a batch adds is in proportion to one less the momentum.
    np.testing.assert_allclose(kept[0.9], 10 * kept[0.99], rtol=1e-5)


def test_devices_along_an_axis_have_the_moments_of_all(rng):
    x, mask = rng.normal(3, 2, (2, 5, 4, 3, 6)).astype(np.float32), rng.random((2, 5)) < 0.6
    of_each = jax.vmap(lambda x, mask: batch_moments(x, mask, "shares"), axis_name="shares")(x, mask)
    of_all = batch_moments(jnp.asarray(x.reshape(10, 4, 3, 6)), jnp.asarray(mask.reshape(10)))
    for each, whole in zip(of_each, of_all, strict=True):
        np.testing.assert_allclose(each, jnp.stack([whole, whole]), rtol=1e-5)


@pytest.fixture
def shallow_gradient(monkeypatch):
    """Return maps, new statistics and gradient of a stack of four layers, with the fields that are given."""
    rng = np.random.default_rng(3)
    monkeypatch.setattr("mdnvo_jax.model.conv.LAYERS", LAYERS[:4])
    pairs = jnp.asarray(rng.normal(size=(3, 24, 32, 2)), jnp.float32)
    mask = jnp.array([True, True, False])
    variables = ConvStack(1 / 16, 0.0).init(jax.random.key(0), pairs, mask, train=False)

    def run(**fields):
        stack = ConvStack(1 / 16, 0.2, **fields)

        def loss(params):
            given = {"params": params, "batch_stats": variables["batch_stats"]}
            rngs = {"dropout": jax.random.key(1)}
            maps, updated = stack.apply(
                given, pairs, mask, train=True, method="maps", mutable=["batch_stats"], rngs=rngs
            )
            return jnp.sum(maps[-1] ** 2), (maps, updated["batch_stats"])

        (_, found), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(variables["params"])
        return *found, gradient

    return run


def test_maps_that_are_computed_twice_change_nothing(shallow_gradient):
    found, expected = shallow_gradient(rematerialise=True), shallow_gradient()
    for (path, leaf), (_, other) in zip(*map(jax.tree.leaves_with_path, (found, expected)), strict=True):
        np.testing.assert_allclose(leaf, other, rtol=1e-4, atol=1e-4, err_msg=jax.tree_util.keystr(path))


def test_maps_in_bfloat16_are_near_and_all_else_is_float32(shallow_gradient):
    found, expected = shallow_gradient(activations="bfloat16"), shallow_gradient()
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {jnp.dtype("float32")}
    for (path, leaf), (_, other) in zip(*map(jax.tree.leaves_with_path, (found, expected)), strict=True):
        # Eight bits of a number; gradients add up many of either sign.
        away = np.linalg.norm(leaf - other) / np.linalg.norm(other)
        assert away < (0.1 if path[0].idx == 2 else 0.01), (jax.tree_util.keystr(path), away)
    # The maps themselves have no more digits than bfloat16 keeps.
    np.testing.assert_array_equal(found[0][0], found[0][0].astype(jnp.bfloat16).astype(jnp.float32))
