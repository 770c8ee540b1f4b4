"""The convolution stack outside JAX: OpenVINO, for processors.

The network is built from the folded weights with OpenVINO's own operators rather than converted from a jaxpr: nine
convolutions are shorter than a conversion's conditions, and the channel-first layout it wants is said directly.
"""

import sys
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mdnvo_jax.config import ImageConfig
from mdnvo_jax.errors import InputError
from mdnvo_jax.model.conv import LAYERS, LEAKY_SLOPE
from mdnvo_jax.model.fold import FoldedLayer

if TYPE_CHECKING:
    import openvino

Backend = Literal["jax", "openvino"]
Precision = Literal["float32", "bfloat16"]

INSTALL = "pip install 'mdnvo_jax[openvino]'"


def available(backend: Backend) -> Backend:
    """Return `backend`, or "jax" with a line on stderr where the package it needs is missing."""
    if backend == "jax" or find_spec("openvino"):
        return backend
    print(f"openvino is not installed ({INSTALL}): the convolutions run in JAX", file=sys.stderr)
    return "jax"


def openvino_compiled(
    stack: Sequence[FoldedLayer], image_config: ImageConfig, precision: Precision
) -> Callable[[Any], np.ndarray]:
    """Return normalised pairs `[N, H, W, 2C]` -> features `[N, F]`: `fold.folded_stack`, computed by OpenVINO.

    Args:
      stack: of `fold.fold_stack`.
      image_config: of the network.
      precision: of the products. OpenVINO takes bfloat16 as a wish: it computes in float32 where the processor has
        no instructions for it.
    """
    openvino = _import_openvino()
    options = {
        "INFERENCE_PRECISION_HINT": {"float32": "f32", "bfloat16": "bf16"}[precision],
        "PERFORMANCE_HINT": "LATENCY",
    }
    request = openvino.Core().compile_model(openvino_stack(stack, image_config), "CPU", options).create_infer_request()
    return lambda pairs: request.infer([np.asarray(pairs)], share_inputs=True)[0]


def openvino_stack(stack: Sequence[FoldedLayer], image_config: ImageConfig) -> "openvino.Model":
    """Return the folded stack as a model of OpenVINO: normalised pairs `[N, H, W, 2C]` -> features `[N, F]`.

    Raises:
      InputError: openvino is not installed.
    """
    openvino = _import_openvino()
    ops = openvino.opset13
    pairs = ops.parameter([-1, image_config.height, image_config.width, 2 * image_config.channels], np.float32, "pairs")
    pairs.output(0).set_names({"pairs"})
    # The layouts outside are those of JAX; OpenVINO merges these transposes with its own reordering.
    maps = ops.transpose(pairs, np.array([0, 3, 1, 2]))
    slope = ops.constant(np.array([LEAKY_SLOPE], np.float32))
    for layer, (kernel, bias) in zip(LAYERS, stack, strict=True):
        weights = np.ascontiguousarray(np.transpose(np.asarray(kernel, np.float32), (3, 2, 0, 1)))
        padding = [layer.padding] * 2
        maps = ops.convolution(maps, ops.constant(weights), [layer.stride] * 2, padding, padding, [1, 1])
        maps = ops.add(maps, ops.constant(np.asarray(bias, np.float32).reshape(1, -1, 1, 1)))
        maps = ops.prelu(maps, slope)
    features = ops.reshape(ops.transpose(maps, np.array([0, 2, 3, 1])), np.array([0, -1]), special_zero=True)
    features.output(0).set_names({"features"})
    return openvino.Model([features], [pairs], "stack")


def save(model: "openvino.Model", path: Path) -> list[Path]:
    """Write a model of OpenVINO to `path`, .xml, and its weights beside it, .bin, in float32; return both paths."""
    _import_openvino().save_model(model, path, compress_to_fp16=False)
    return [path, path.with_suffix(".bin")]


def _import_openvino() -> Any:
    """Return the module openvino, imported without its report.

    When it is imported it tells Google Analytics so, through a fork of the process, unless `openvino_telemetry` cannot
    be imported. A library should not report on its users, and a fork may hang a process that runs JAX.

    Raises:
      InputError: it is not installed.
    """
    telemetry = "openvino_telemetry"
    unseen = telemetry not in sys.modules
    if unseen:
        sys.modules[telemetry] = None  # type: ignore[assignment]
    try:
        import openvino
        import openvino.opset13
    except ImportError as error:
        raise InputError(f"openvino is not installed: {INSTALL}") from error
    finally:
        if unseen:
            del sys.modules[telemetry]
    return openvino
