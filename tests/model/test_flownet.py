import subprocess
import sys
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnvo_jax.config import ImageConfig, ModelConfig
from mdnvo_jax.errors import InputError
from mdnvo_jax.model.conv import LAYERS
from mdnvo_jax.model.convolution import convolve
from mdnvo_jax.model.flownet import load_stack, read_flownet, write_stack
from mdnvo_jax.model.fold import fold_stack, folded_stack
from mdnvo_jax.model.network import build, template
from mdnvo_jax.model.normalise import normalise

COMMAND = Path(__file__).resolve().parents[2] / "bin" / "convert_flownet"
IMAGE = ImageConfig(height=33, width=65, channels=3, normalisation="flownet")


def zeros(image_config, width):
    """A network and variables that are all zero, whose LSTM is small."""
    model_config = ModelConfig(width=width, lstm_hidden=2, lstm_layers=1)
    network = build(image_config, model_config)
    return network, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), template(network, image_config, 1))


def features(network, variables, first, second):
    frames = [normalise(frames, network.image_config.normalisation) for frames in (first, second)]
    stack = fold_stack(variables["params"]["stack"], variables["batch_stats"]["stack"])
    return jax.jit(folded_stack)(stack, jnp.concatenate(frames, -1))


@pytest.mark.parametrize(
    ("checkpoint", "recorded"), [("flownets_legacy.pth.tar", "plain_eval"), ("flownets_bn_zip.pth", "bn_eval")]
)
def test_a_converted_checkpoint_computes_what_torch_does(golden, tmp_path, assert_close, checkpoint, recorded):
    """From frames in RGB to the last maps; torch was given BGR minus FlowNet's means, as the Caffe weights want it."""
    write_stack(tmp_path / "stack.npz", read_flownet(golden / checkpoint, order="bgr"))
    network, variables = zeros(IMAGE, 1 / 32)
    variables = load_stack(tmp_path / "stack.npz", variables)
    with np.load(golden / "torch_stack.npz") as arrays:
        found = features(network, variables, arrays["frames"][:, 0], arrays["frames"][:, 1])
        assert_close(found, arrays[recorded].reshape(len(found), -1), 1e-5)


@pytest.mark.parametrize("zipped", ["flownets_zip.pth", "flownets_bn_legacy.pth.tar"])
def test_both_layouts_of_both_networks(golden, zipped):
    stack = read_flownet(golden / zipped, order="rgb")
    assert set(stack) == {f"{layer.name}/{n}" for layer in LAYERS for n in ("kernel", "scale", "bias", "mean", "var")}
    assert stack["conv6/kernel"].shape == (3, 3, 8, 16)
    trivial = (stack["conv6/mean"] == 0).all() and (stack["conv6/var"] == 1).all()
    assert trivial == ("bn" not in zipped)


def first_response(stack, pairs):
    """conv1 and the mean of its BatchNorm, away from the border, where the padding is not of the frame's colour."""
    maps = convolve(jnp.asarray(pairs, jnp.float32), jnp.asarray(stack["conv1/kernel"]), 2, 3)
    return np.asarray(maps - stack["conv1/mean"])[:, 2:-2, 2:-2]


@pytest.mark.parametrize("order", ["rgb", "bgr"])
@pytest.mark.parametrize("means", [(0.411, 0.432, 0.450), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("channels", [3, 1])
def test_order_and_means_of_the_checkpoint_are_undone(golden, tmp_path, assert_close, order, means, channels):
    checkpoint = golden / "flownets_bn_zip.pth"
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, 21, 23, channels), dtype=np.uint8)

    stack = read_flownet(checkpoint, order=order, means=means)
    write_stack(tmp_path / "stack.npz", stack)
    _, variables = zeros(ImageConfig(height=21, width=23, channels=channels), 1 / 32)
    loaded = load_stack(tmp_path / "stack.npz", variables)
    arrays = {
        "conv1/kernel": loaded["params"]["stack"]["conv1"]["kernel"],
        "conv1/mean": loaded["batch_stats"]["stack"]["conv1"]["mean"],
    }
    found = first_response(arrays, jnp.concatenate(list(normalise(jnp.asarray(frames), "flownet")), -1)[None])

    # What torch would be fed; its own kernel and mean, unchanged, are those of order rgb and our means.
    colour = np.broadcast_to(frames, (2, 21, 23, 3)) / 255
    theirs = (colour[..., ::-1] if order == "bgr" else colour) - means
    original = read_flownet(checkpoint, order="rgb", means=(0.450, 0.432, 0.411))
    assert_close(found, first_response(original, np.concatenate(list(theirs), -1)[None]), 1e-5)


def test_only_the_stack_is_replaced(golden, tmp_path):
    write_stack(tmp_path / "stack.npz", read_flownet(golden / "flownets_bn_legacy.pth.tar", order="rgb"))
    _, variables = zeros(IMAGE, 1 / 64)
    before = jax.tree.map(np.asarray, variables)
    loaded = load_stack(tmp_path / "stack.npz", variables)
    assert jax.tree.structure(loaded) == jax.tree.structure(variables)
    assert jax.tree.map(jnp.shape, loaded) == jax.tree.map(jnp.shape, variables)
    for part in ("lstm", "head"):
        jax.tree.map(np.testing.assert_array_equal, loaded["params"][part], before["params"][part])
    jax.tree.map(np.testing.assert_array_equal, variables, before)
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(loaded["params"]["stack"]))


# A checkpoint of the public layout, written here, and what may be wrong with one.


def flownets_state(width=1 / 64, batch_norm=False, prefix=""):
    rng, inputs, state = np.random.default_rng(0), 6, {}
    for layer in LAYERS:
        outputs = round(layer.channels * width)
        shape = (outputs, inputs, layer.kernel, layer.kernel)
        state[f"{prefix}{layer.name}.0.weight"] = rng.normal(size=shape).astype(np.float32)
        names = ("1.weight", "1.bias", "1.running_mean", "1.running_var") if batch_norm else ("0.bias",)
        for name in names:
            state[f"{prefix}{layer.name}.{name}"] = rng.uniform(0.5, 1, outputs).astype(np.float32)
        inputs = outputs
    return state | {"deconv5.0.weight": np.ones((2, 3), np.float32)}


@pytest.mark.parametrize(("batch_norm", "zipped"), [(True, True), (False, False)])
def test_a_full_size_checkpoint(write_checkpoint, tmp_path, batch_norm, zipped):
    state = flownets_state(1.0, batch_norm, prefix="module.")
    path = write_checkpoint(tmp_path / "x.pth", {"arch": "flownets", "state_dict": state}, zipped=zipped)
    stack = read_flownet(path, order="rgb")
    weight = state["module.conv3_1.0.weight"]
    np.testing.assert_array_equal(stack["conv3_1/kernel"], weight.transpose(2, 3, 1, 0))
    bias = state["module.conv4.1.bias" if batch_norm else "module.conv4.0.bias"]
    np.testing.assert_array_equal(stack["conv4/bias"], bias)
    write_stack(tmp_path / "stack.npz", stack)
    _, variables = zeros(IMAGE, 1.0)
    load_stack(tmp_path / "stack.npz", variables)


def test_a_bare_state_dictionary_and_a_channels_last_one(write_checkpoint, tmp_path):
    state = flownets_state()
    expected = read_flownet(write_checkpoint(tmp_path / "a.pth", {"state_dict": state}), order="rgb")
    state = {name: np.asfortranarray(array) for name, array in state.items()}
    found = read_flownet(write_checkpoint(tmp_path / "b.pth", state), order="rgb")
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"conv5_1.0.weight": None}, r"no tensor conv5_1\.0\.weight: expected a FlowNetS .* found 18 tensors"),
        ({"conv2.0.bias": None}, r"no tensor conv2\.0\.bias"),
        ({"conv1.0.weight": np.zeros((1, 3, 7, 7), np.float32)}, r"conv1\.0\.weight of shape \(1, 3, 7, 7\): expected"),
        ({"conv2.0.weight": np.zeros((2, 1, 3, 3), np.float32)}, r"expected \(2, 1, 5, 5\)"),
        ({"conv6.0.bias": np.full(16, np.nan, np.float32)}, "not finite"),
        ({"conv1.0.weight": np.float64(1).reshape(())}, "expected"),
    ],
)
def test_another_network_is_refused(write_checkpoint, tmp_path, change, message):
    state = {name: array for name, array in (flownets_state() | change).items() if array is not None}
    with pytest.raises(InputError, match=message):
        read_flownet(write_checkpoint(tmp_path / "x.pth", {"state_dict": state}), order="rgb")


def test_no_state_dictionary(write_checkpoint, tmp_path):
    with pytest.raises(InputError, match="holds list: expected a state dictionary"):
        read_flownet(write_checkpoint(tmp_path / "x.pth", [1, 2]), order="rgb")
    with pytest.raises(InputError, match="found 0 tensors"):
        read_flownet(write_checkpoint(tmp_path / "x.pth", {"state_dict": {"a": 1}}), order="rgb")


# The npz, and the command.


def test_another_width_is_refused_with_the_right_one(golden, tmp_path):
    write_stack(tmp_path / "stack.npz", read_flownet(golden / "flownets_bn_zip.pth", order="rgb"))
    _, variables = zeros(IMAGE, 1 / 64)
    with pytest.raises(
        InputError, match=r"conv1/kernel of shape \(7, 7, 6, 2\), the model .* model\.width to 0\.03125"
    ):
        load_stack(tmp_path / "stack.npz", variables)


def test_another_npz_is_refused(golden, tmp_path):
    _, variables = zeros(IMAGE, 1 / 64)
    stack = read_flownet(golden / "flownets_zip.pth", order="rgb")
    path = tmp_path / "stack.npz"
    for arrays, message in (
        ({name: array for name, array in stack.items() if name != "conv3/var"}, "'conv3/var' is missing"),
        ({**stack, "extra": np.zeros(1)}, "'extra' is extra"),
        ({"a": np.array([{}], object)}, "no npz"),
    ):
        np.savez(path, **arrays)
        with pytest.raises(InputError, match=message):
            load_stack(path, variables)
    for data in (b"", b"\x80\x04.", b"PK\x03\x04", (golden / "flownets_zip.pth").read_bytes()):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"stack\.npz"):
            load_stack(path, variables)
    np.save(tmp_path / "x.npy", np.zeros(3))
    for other in (tmp_path / "x.npy", tmp_path / "absent.npz", tmp_path):
        with pytest.raises(InputError, match="expected"):
            load_stack(other, variables)


def command(*arguments):
    run = subprocess.run([sys.executable, COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=60)
    return run.returncode, run.stdout, run.stderr


def test_the_command_converts_and_never_overwrites(golden, tmp_path):
    output = tmp_path / "stack.npz"
    code, printed, error = command(golden / "flownets_zip.pth", output, "--order", "bgr", "--means", 0, 0, 0)
    assert (code, error) == (0, "")
    assert "4,092 numbers, for model.width 0.015625" in printed
    expected = read_flownet(golden / "flownets_zip.pth", order="bgr", means=(0, 0, 0))
    with np.load(output) as arrays:
        jax.tree.map(np.testing.assert_array_equal, dict(arrays), expected)
    assert list(tmp_path.iterdir()) == [output]

    output.write_text("precious")
    code, _, error = command(golden / "flownets_zip.pth", output)
    assert (code, output.read_text()) == (2, "precious")
    assert error == f"error: {output} exists already: choose another name, or overwrite with --force\n"
    # A checkpoint that fails leaves what was there.
    assert command(golden / "torch_lstm.npz", output, "--force")[0] == 2
    assert output.read_text() == "precious"
    assert command(golden / "flownets_zip.pth", output, "--force")[0] == 0
    assert zipfile.is_zipfile(output)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("absent.pth", "x.npz"), "cannot read absent.pth (No such file or directory)"),
        (("absent.pth", "x.pth"), "expected one ending in .npz"),
        (("absent.pth", "absent/x.npz"), "no folder absent"),
        (("absent.pth",), "the following arguments are required: output"),
    ],
)
def test_mistakes_give_one_line(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    code, printed, error = command(*arguments)
    assert (code, printed, error.count("\n")) == (2, "", 1)
    assert error.startswith("error: ")
    assert message in error
    assert not list(tmp_path.iterdir())
