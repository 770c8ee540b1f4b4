"""The streaming step as files that run without this package: what `bin/export` writes."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mdnvo_jax
from mdnvo_jax import backend, files, leaves
from mdnvo_jax.errors import InputError
from mdnvo_jax.export_example import EXAMPLE
from mdnvo_jax.mixture import Mixture
from mdnvo_jax.odometry import COMPONENTS
from mdnvo_jax.predictor import Predictor
from mdnvo_jax.streaming import StreamState, stream

PLATFORMS = ("cpu", "cuda", "tpu")
STEP, WEIGHTS, START, ABOUT, PROGRAM = "step.jax", "weights.npz", "start.npz", "about.json", "run.py"
STACK = "stack.xml"


def write(predictor: Predictor, directory: Path, *, openvino: bool = False) -> list[Path]:
    """Write the streaming step of a model into an empty folder, and return the paths.

    - `step.jax`: a `jax.export` artifact of (weights, state, image, usable) -> (state, step) for the processor, CUDA
      and TPU, over any number of cameras B: the first axis of state, image `[B, H, W, C]` uint8 and usable `[B]` bool.
    - `weights.npz`, `start.npz`: the first two arguments, dictionaries; the state is that of one camera, without B.
    - `about.json`: shapes, units, the order of the components, camera, normalisation.
    - `run.py`: a program that uses them.
    - `stack.xml`, `stack.bin`: the convolutions alone for OpenVINO, if `openvino`.

    Args:
      predictor: of backend "jax" and precision "float32".
      directory: the folder.
      openvino: whether to write the last two.

    Raises:
      InputError: a package is missing.
    """
    try:
        import flatbuffers  # noqa: F401 - jax.export needs it, and says so less clearly
    except ImportError as error:
        raise InputError("flatbuffers is not installed: pip install 'mdnvo_jax[export]'") from error

    network = backend.openvino_stack(predictor.model.stack, predictor.config.image) if openvino else None
    weights, start = leaves.by_name(predictor.model), predictor.stream_start(predictor.model)._asdict()
    exported = _exported(predictor, weights, start)
    results = jax.tree.unflatten(exported.out_tree, exported.out_avals)[1]
    with files.whole_file(directory / STEP) as temporary:
        temporary.write_bytes(exported.serialize())
    for name, arrays in ((WEIGHTS, weights), (START, start)):
        with files.whole_file(directory / name) as temporary:
            stored: dict[str, Any] = {key: np.asarray(value) for key, value in arrays.items()}
            np.savez(temporary, **stored)
    files.write_text(directory / ABOUT, json.dumps(_about(predictor, start, results), indent=2) + "\n")
    files.write_text(directory / PROGRAM, EXAMPLE)
    paths = [directory / name for name in (STEP, WEIGHTS, START, ABOUT, PROGRAM)]
    return paths if network is None else paths + backend.save(network, directory / STACK)


def _exported(predictor: Predictor, weights: dict[str, jax.Array], start: dict[str, jax.Array]) -> Any:
    """Return the exported step. Arguments and results are dictionaries, which need no class of ours to be read back."""
    from jax import export

    config = predictor.config
    scale = None if predictor.sigma_scale is None else jnp.asarray(predictor.sigma_scale, jnp.float32)
    advance = stream(config, config.data.window, scale).step
    structure = jax.tree.structure(predictor.model)

    def step(weights: dict[str, Any], state: dict[str, Any], image: Any, usable: Any) -> tuple[Any, Any]:
        model = jax.tree.unflatten(structure, [weights[name] for name in names])
        following, found = advance(model, StreamState(**state), image, usable)
        results = found._asdict()
        density: Mixture = results.pop("mixture")
        return following._asdict(), results | {f"mixture_{name}": leaf for name, leaf in density._asdict().items()}

    names = list(weights)
    image = jax.ShapeDtypeStruct(start["image"].shape, jnp.uint8)
    (cameras,) = export.symbolic_shape("cameras")

    def batched(leaf: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((cameras, *leaf.shape), leaf.dtype)

    shapes = {name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for name, leaf in weights.items()}
    over_cameras = jax.jit(jax.vmap(step, in_axes=(None, 0, 0, 0)))
    return export.export(over_cameras, platforms=PLATFORMS)(
        shapes, jax.tree.map(batched, start), batched(image), batched(start["usable"])
    )


def _about(predictor: Predictor, start: dict[str, jax.Array], results: dict[str, Any]) -> dict[str, Any]:
    """Return what a reader of the files has to know."""
    config = predictor.config
    image = config.image

    def described(leaf: Any) -> dict[str, Any]:
        return {"shape": [size if isinstance(size, int) else "B" for size in leaf.shape], "type": str(leaf.dtype)}

    return {
        "what": "step(weights, state, image, usable) -> (state, result); B cameras at a time, each with its own state",
        "image": {
            "shape": [image.height, image.width, image.channels],
            "type": "uint8, RGB or grey",
            "camera": list(image.camera) or "the whole frame, resized",
            "camera_is": "fx, fy, cx, cy in pixels, centres of pixels at whole numbers: bring your frames to it",
            "normalisation": f"{image.normalisation}, done by the step",
        },
        "usable": "bool: false for a frame that could not be read; its pixels are ignored",
        "components": list(COMPONENTS),
        "units": "metres for tx, ty, tz; radians for rx, ry, rz, a rotation vector",
        "step": "pose of a frame in the camera axes of the frame before it: x right, y down, z forward",
        "mixture": f"coupling {config.model.coupling}; weights softmax(logits), standard deviations exp(log_scale)",
        "state": {name: described(leaf) for name, leaf in start.items()},
        "result": {name: described(leaf) for name, leaf in results.items()},
        "stack": f"{STACK}, if there: normalised pairs of frames [N, H, W, 2C] float32 -> features [N, F], no LSTM",
        "mirrored": config.model.mirrored,
        "mirrored_is": "whether the step looks at each pair left and right exchanged, too; a stack run alone does not",
        "camera_height_m": config.data.camera_height_m or "unknown",
        "window": config.data.window,
        "platforms": list(PLATFORMS),
        "sigma_scale": None if predictor.sigma_scale is None else predictor.sigma_scale.tolist(),
        "scale_sigma": predictor.scale_sigma,
        "scale_sigma_is": "relative, 1 sigma, of all translations of a run together: belongs to poses, not to steps",
        "step_correlation": None if predictor.correlation is None else predictor.correlation.tolist(),
        "step_correlation_is": "of the errors of any two steps of a run, by component; for covariances of poses, too",
        "serial_correlation": None if predictor.serial_correlation is None else predictor.serial_correlation.tolist(),
        "serial_correlation_is": "of what is left of the errors of neighbouring steps, to the power of their distance",
        "checkpoint": predictor.source,
        "versions": {"mdnvo_jax": mdnvo_jax.__version__, "jax": jax.__version__},
    }
