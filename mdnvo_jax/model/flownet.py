"""FlowNetS weights as the start of the convolution stack: from a PyTorch checkpoint, through an npz, into variables.

The public checkpoints are those of the PyTorch port of FlowNet (ClementPinard/FlowNetPytorch): FlowNetS, whose
convolutions have a bias and no BatchNorm, FlowNetS-BN, the other way round, and FlowNetS as converted from Caffe. Three
things differ between them and this network.

Colour. The Caffe weights read BGR, those trained in PyTorch RGB. `order` says which; the input channels of conv1 are
put in RGB order, as our frames are.

Mean. The port subtracts 0.411, 0.432, 0.450 from the channels in the order it reads them: FlowNet's means for BGR. Its
own weights were trained on RGB with that same list (noticed, and put right for later trainings, in its issue 80). We
subtract 0.450, 0.432, 0.411 from RGB. The difference is a constant colour, whose response in conv1 is taken out of
conv1's BatchNorm mean: the same outputs but for the outermost pixels, where the zero padding stands for another colour.
Weights that want no mean subtracted are converted with means 0 0 0.

BatchNorm. Our blocks have one, without a bias in the convolution. A FlowNetS block gets a BatchNorm that does nothing
but add its bias: mean 0, variance 1, scale sqrt(1 + epsilon), shift = bias. In evaluation the stack is FlowNetS
exactly. In training a BatchNorm normalises by the batch, so that FlowNetS-BN is the checkpoint whose function survives.

An npz holds, for each layer, `NAME/kernel` `[k, k, C, D]`, and `NAME/scale`, `/bias`, `/mean`, `/var`, each `[D]`.
"""

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from mdnvo_jax.errors import InputError
from mdnvo_jax.files import whole_file
from mdnvo_jax.model.conv import BATCH_NORM_EPSILON, LAYERS, layer_channels
from mdnvo_jax.model.normalise import FLOWNET_MEAN_GREY, FLOWNET_MEAN_RGB
from mdnvo_jax.model.torch_file import Tensor, TensorFile, open_tensors

Order = Literal["rgb", "bgr"]

# What the port subtracts, in the order its network reads the channels.
PORT_MEANS = (0.411, 0.432, 0.450)

_PARAMETERS = ("kernel", "scale", "bias")
_STATISTICS = ("mean", "var")


def read_flownet(path: str | Path, *, order: Order, means: Sequence[float] = PORT_MEANS) -> dict[str, np.ndarray]:
    """Return the stack's arrays, as an npz holds them, from a FlowNetS or FlowNetS-BN checkpoint of PyTorch.

    The width of the stack is that of the file's conv1.

    Args:
      path: a file of `torch.save`: a state dictionary, or a dictionary that has one under "state_dict". Names are those
        of the port: `conv1.0.weight`, and `conv1.0.bias` or `conv1.1.weight`, ..., perhaps behind `module.`.
      order: of the colours that the checkpoint's network reads.
      means: what is subtracted from its input in [0, 1], in that order.

    Raises:
      InputError: the file cannot be read, or is not of that layout.
    """
    state = _state(path)
    first = state.content.get("conv1.0.weight")
    multiplier = first.shape[0] / LAYERS[0].channels if first and first.shape else 1.0
    stack: dict[str, np.ndarray] = {}
    inputs = 6  # two frames of three colours
    for layer in LAYERS:
        outputs = layer_channels(layer, multiplier)
        weight = _take(path, state, f"{layer.name}.0.weight", (outputs, inputs, layer.kernel, layer.kernel))
        arrays = {"kernel": weight.transpose(2, 3, 1, 0)}
        if f"{layer.name}.1.weight" in state.content:
            for name, torch_name in zip(
                ("scale", "bias", "mean", "var"), ("weight", "bias", "running_mean", "running_var"), strict=True
            ):
                arrays[name] = _take(path, state, f"{layer.name}.1.{torch_name}", (outputs,))
        else:
            arrays["scale"] = np.full(outputs, np.sqrt(1 + BATCH_NORM_EPSILON), np.float32)
            arrays["bias"] = _take(path, state, f"{layer.name}.0.bias", (outputs,))
            arrays["mean"], arrays["var"] = np.zeros(outputs, np.float32), np.ones(outputs, np.float32)
        stack.update({f"{layer.name}/{name}": array for name, array in arrays.items()})
        inputs = outputs

    if order == "bgr":
        stack["conv1/kernel"] = stack["conv1/kernel"][:, :, [2, 1, 0, 5, 4, 3]]
        means = means[::-1]
    surplus = np.asarray(FLOWNET_MEAN_RGB) - np.asarray(means)
    stack["conv1/mean"] = stack["conv1/mean"] - _response(stack["conv1/kernel"], surplus)
    return {name: np.ascontiguousarray(array, np.float32) for name, array in stack.items()}


def _response(kernel: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Return the response `[D]` of `kernel` `[k, k, 2 * C, D]` to a pair of frames of constant `colour` `[C]`."""
    return np.einsum("hwcd,c->d", kernel.astype(np.float64), np.tile(colour, 2)).astype(np.float32)


def _state(path: str | Path) -> TensorFile:
    """Return the file with its state dictionary, tensors by name, as content."""
    content, read = open_tensors(path)
    if isinstance(content, dict) and isinstance(content.get("state_dict"), dict):
        content = content["state_dict"]
    if not isinstance(content, dict):
        raise InputError(f"{path} holds {type(content).__name__}: expected a state dictionary of FlowNetS")
    tensors = {str(name).removeprefix("module."): value for name, value in content.items() if isinstance(value, Tensor)}
    return TensorFile(tensors, read)


def _take(path: str | Path, state: TensorFile, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return the tensor `name` of the expected `shape` as float32."""
    if name not in state.content:
        names = ", ".join(sorted(state.content)[:3])
        raise InputError(
            f"{path} has no tensor {name}: expected a FlowNetS or FlowNetS-BN checkpoint of the PyTorch port "
            f"(conv1.0.weight ...), found {len(state.content)} tensors ({names} ...)"
        )
    if state.content[name].shape != shape:
        found = state.content[name].shape
        raise InputError(f"{path} has {name} of shape {found}: expected {shape}, as FlowNetS of that width has")
    array = state.read(state.content[name]).astype(np.float32)
    if not np.isfinite(array).all():
        raise InputError(f"{path} has values in {name} that are not finite: expected a trained checkpoint")
    return array


def write_stack(path: str | Path, stack: Mapping[str, np.ndarray]) -> None:
    """Write the arrays of a stack as an npz, whole or not at all."""
    with whole_file(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **stack)


def load_stack(path: str | Path, variables: dict[str, Any]) -> dict[str, Any]:
    """Return `variables` with the parameters and statistics of the convolution stack taken from an npz.

    A network of grey frames gets conv1 summed over the colours, which is the response to a grey frame in colour. The
    rest of the network stays as it is. The weights expect frames normalised as "flownet".

    Args:
      path: of `bin/convert_flownet`.
      variables: of `network.initialise`, `{"params": ..., "batch_stats": ...}`.

    Raises:
      InputError: the npz is unreadable, or made for another width.
    """
    stack = _read_stack(path)
    params, statistics = dict(variables["params"]["stack"]), dict(variables["batch_stats"]["stack"])
    kernel = stack["conv1/kernel"]
    if params["conv1"]["kernel"].shape[2] == 2 and kernel.shape[2] == 6:
        surplus = FLOWNET_MEAN_GREY - np.asarray(FLOWNET_MEAN_RGB)
        stack["conv1/mean"] = stack["conv1/mean"] - _response(kernel, surplus)
        stack["conv1/kernel"] = np.stack([kernel[:, :, :3].sum(2), kernel[:, :, 3:].sum(2)], axis=2)
    for layer in LAYERS:
        params[layer.name] = _fill(path, stack, layer.name, _PARAMETERS, params[layer.name])
        statistics[layer.name] = _fill(path, stack, layer.name, _STATISTICS, statistics[layer.name])
    return {
        **variables,
        "params": {**variables["params"], "stack": params},
        "batch_stats": {**variables["batch_stats"], "stack": statistics},
    }


def _read_stack(path: str | Path) -> dict[str, np.ndarray]:
    """Return the arrays of an npz that `write_stack` wrote."""
    try:
        with Path(path).open("rb") as file:
            if not zipfile.is_zipfile(file):
                raise ValueError("not an archive")
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                stack = {name: arrays[name] for name in arrays}
    except OSError as error:
        raise InputError(f"cannot read {path} ({error.strerror}): expected an npz of bin/convert_flownet") from error
    except (ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is no npz ({error}): expected one of bin/convert_flownet") from error
    expected = {f"{layer.name}/{name}" for layer in LAYERS for name in _PARAMETERS + _STATISTICS}
    if set(stack) != expected:
        wrong = min(set(stack) ^ expected)
        raise InputError(
            f"{path} is no stack of bin/convert_flownet: {wrong!r} is {'extra' if wrong in stack else 'missing'}"
        )
    return stack


def _fill(
    path: str | Path, stack: Mapping[str, np.ndarray], layer: str, names: Sequence[str], present: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the arrays `names` of a layer in place of those `present`."""
    filled = {}
    for name in names:
        found, expected = stack[f"{layer}/{name}"], present[name]
        if found.shape != expected.shape:
            width = stack["conv1/bias"].size / LAYERS[0].channels
            raise InputError(
                f"{path} has {layer}/{name} of shape {found.shape}, the model {expected.shape}: "
                f"set model.width to {width:g}, and image.channels to 1 or 3"
            )
        filled[name] = jnp.asarray(found, expected.dtype)
    return filled
