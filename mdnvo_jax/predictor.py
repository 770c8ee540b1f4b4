"""A trained model, and what it makes of frames: offline over windows, or streaming frame by frame."""

import dataclasses
import functools
import os
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mdnvo_jax import backend as backends
from mdnvo_jax import offline, recalibration, weights
from mdnvo_jax.backend import Backend, Precision
from mdnvo_jax.config import Config
from mdnvo_jax.data import ahead, checks
from mdnvo_jax.data.folder import as_sequence
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError
from mdnvo_jax.mixture import Mixture
from mdnvo_jax.model import fold
from mdnvo_jax.model.convolution import Products
from mdnvo_jax.model.fold import Folded
from mdnvo_jax.model.head import Labels
from mdnvo_jax.odometry import Estimate, Trajectory, check_scale_sigma, trajectory
from mdnvo_jax.streaming import Stream, StreamStep, stream
from mdnvo_jax.training import checkpoint
from mdnvo_jax.training.state import Model
from mdnvo_jax.watch import watched

Mode = Literal["offline", "streaming"]
# Frames whose results are not waited for while streaming from files.
_STEPS_AHEAD = 2


class Predictor(NamedTuple):
    """A trained model with its compiled functions.

    Attributes:
      config: the experiment it comes from; `config.image` says what frames are brought to.
      model: its parameters as prediction runs them, and the statistics of its labels. (As trained: `trained`.)
      features: (model, frames `[n+1, H, W, C]` uint8) -> those of the pairs of consecutive frames, `[n, S F]`, of
        one side or, where the network looks at pairs mirrored as well, of both.
      densities: (model, tail, features, rows, mask) -> (tail, mixtures in metres and radians); see
        `offline.step_densities`.
      stream_start: (model) -> the state of a stream.
      stream_step: (model, state, image, usable) -> (state, step); see `streaming.Stream`.
      source: the folder of the checkpoint.
      backend: what computes the features.
      precision: of the products in the convolutions.
      sigma_scale: factors by component that every sigma is multiplied by already, `[6]`; None where none were fitted.
      scale_sigma: relative standard deviation of the error of scale that the steps of a run share; 0 where none was
        fitted. It belongs to absolute poses, see `odometry.trajectory`; what is said of single steps is without it.
      correlation: of the errors of any two steps, by component, `[6]`; likewise. None where none was fitted.
      serial_correlation: of what is left of those of neighbouring steps, `[6]`; likewise.
      camera_height_m: height of the camera that translations are for, where `load` was told one.
    """

    config: Config
    model: Folded
    features: Callable[..., Any]
    densities: Callable[..., tuple[jax.Array, Mixture]]
    stream_start: Callable[..., Any]
    stream_step: Callable[..., Any]
    source: str
    backend: Backend
    precision: Precision
    sigma_scale: np.ndarray | None = None
    scale_sigma: float = 0.0
    correlation: np.ndarray | None = None
    serial_correlation: np.ndarray | None = None
    camera_height_m: float | None = None


def load(
    path: str | os.PathLike[str] | None = None,
    *,
    recalibrated: bool = True,
    camera_height_m: float | None = None,
    backend: Backend = "jax",
    precision: Precision = "float32",
) -> Predictor:
    """Return the model in a checkpoint: the best step of a training's --workdir, or the folder of one step.

    Args:
      path: the folder; None for the weights that ship with the package.
      recalibrated: use what `evaluate recalibrate` left with the checkpoint, if it has: factors for every sigma, and
        what steps are wrong by together.
      camera_height_m: of the camera's optical centre above the road; None: as in the training. See `at_camera_height`.
      backend: what computes the convolutions. "openvino" is for processors; where it is not installed JAX computes
        them, and a line on stderr says so. The LSTM and the head are JAX's always.
      precision: of the products in the convolutions; all else is float32. On a processor, "bfloat16" means something
        to OpenVINO alone.

    Raises:
      InputError: there is none, or it is damaged, or was trained without a known height of the camera.
    """
    model, config, folder = trained(path)
    found = recalibration.read(folder) if recalibrated else None
    return from_model(
        model,
        config,
        source=str(folder),
        backend=backend,
        precision=precision,
        sigma_scale=None if found is None else found.scale,
        scale_sigma=0.0 if found is None else found.scale_sigma,
        correlation=None if found is None else found.correlation,
        serial_correlation=None if found is None else found.serial_correlation,
        camera_height_m=camera_height_m,
    )


def trained(path: str | os.PathLike[str] | None = None) -> tuple[Model, Config, Path]:
    """Return the model in a checkpoint as it was trained, the experiment, and the folder of the step.

    Args:
      path: as for `load`.

    Raises:
      InputError: there is none, or it is damaged.
    """
    return checkpoint.trained(weights.folder() if path is None else path)


def at_camera_height(model: Model, config: Config, height_m: float) -> tuple[Model, Config]:
    """Return a model and its experiment in the metres of a camera at another height above the road.

    A camera sees the ground up to scale: at twice the height, twice the motion gives the same frames. So the density of
    a translation t becomes that of t h / h0, where h0 is `data.camera_height_m`; rotation stays as it is. The network's
    outputs are in units of the labels' deviation, so that scaling mean and deviation of the labels, and the floor of
    sigma, does all of it: in windows, in streams, for held steps and in what is exported.

    Args:
      model: as trained.
      config: the experiment; its `data.camera_height_m` says what the labels stand for.
      height_m: of the camera's optical centre above the road surface.

    Raises:
      InputError: `height_m` is no length, or the height that the model was trained for is not known.
    """
    if not (np.isfinite(height_m) and height_m > 0):
        raise InputError(f"the camera's height is {height_m}: expected metres above the road, such as 1.65")
    trained_for = config.data.camera_height_m
    if not trained_for:
        raise InputError(
            f"the camera's height is given, {height_m:g} m, but these weights were trained without a known one "
            "(data.camera_height_m is 0): leave the height out, and scale the trajectory by what you know"
        )
    ratio = height_m / trained_for
    factors = np.array([ratio] * 3 + [1.0] * 3, np.float32)
    labels = Labels(*(jnp.asarray(values) * factors for values in model.labels))
    floor_m = config.model.translation_floor_m * ratio
    config = dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, translation_floor_m=floor_m),
        data=dataclasses.replace(config.data, camera_height_m=height_m),
    )
    return model._replace(labels=labels), config


def from_model(
    model: Model,
    config: Config,
    *,
    source: str,
    backend: Backend = "jax",
    precision: Precision = "float32",
    sigma_scale: np.ndarray | None = None,
    scale_sigma: float = 0.0,
    correlation: np.ndarray | None = None,
    serial_correlation: np.ndarray | None = None,
    camera_height_m: float | None = None,
) -> Predictor:
    """Return a predictor of a model in memory; the arguments are those of `load` and `Predictor`."""
    if camera_height_m is not None:
        model, config = at_camera_height(model, config, camera_height_m)
    backend = backends.available(backend)
    stack = fold.fold_stack(model.params["stack"], model.batch_stats["stack"])
    scale = None if sigma_scale is None else jnp.asarray(sigma_scale, jnp.float32)
    products: Products = "mixed" if precision == "bfloat16" else "float32"

    def features(model: Folded, frames: jax.Array) -> jax.Array:
        return fold.pair_features(model, frames, config.image, config.model, products)

    def densities(
        model: Folded, tail: jax.Array, features: tuple[jax.Array, ...], rows: jax.Array, mask: jax.Array
    ) -> tuple[jax.Array, Mixture]:
        gates = jnp.concatenate([tail, fold.pair_gates(model, jnp.concatenate(features))])
        return gates[-len(tail) :], fold.window_densities(model, gates[rows], mask, config.model, scale)

    streaming = stream(config, config.data.window, scale, products)
    compute: tuple[Callable[..., Any], Callable[..., Any]] = jax.jit(features), jax.jit(streaming.step)
    if backend == "openvino":
        compute = _outside(backends.openvino_compiled(stack, config.image, precision), streaming, config)
    return Predictor(
        config=config,
        # Committed to one device, and so is what is computed from it: one kind of argument, one compilation.
        model=jax.device_put(
            Folded(stack, model.params["lstm"], model.params["head"], model.labels, model.residual_scale),
            jax.devices()[0],
        ),
        features=compute[0],
        densities=jax.jit(densities),
        stream_start=jax.jit(streaming.start),
        stream_step=compute[1],
        source=source,
        backend=backend,
        precision=precision,
        sigma_scale=sigma_scale,
        scale_sigma=scale_sigma,
        correlation=correlation,
        serial_correlation=serial_correlation,
        camera_height_m=camera_height_m,
    )


def _outside(
    stack: Callable[[Any], Any], streaming: Stream, config: Config
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return `Predictor.features` and `.stream_step` with a stack that is computed outside JAX."""
    pairs = jax.jit(lambda frames: fold.sides(fold.stacked_pairs(frames, config.image), config.image, config.model))
    pair, advance = jax.jit(streaming.pair), jax.jit(streaming.advance)

    def features(model: Folded, frames: Any) -> Any:
        return stack(pairs(frames)).reshape(len(frames) - 1, -1)

    def step(model: Folded, state: Any, image: Any, usable: Any) -> Any:
        frame, stacked = pair(state, image)
        return advance(model, state, frame, usable, stack(stacked))

    return features, step


def predict(
    predictor: Predictor,
    frames: str | os.PathLike[str] | Sequence | np.ndarray,
    *,
    mode: Mode = "offline",
    camera: tuple[float, float, float, float] | None = None,
    timestamps: np.ndarray | None = None,
    stride: int = 1,
    bad_frames: Literal["stop", "hold"] = "stop",
    estimate: Estimate = "mean",
    scale_sigma: float | None = None,
    hop: int | None = None,
    progress: Callable[[Iterator[Any], int], Iterator[Any]] | None = None,
) -> Trajectory:
    """Estimate the camera's motion through `frames`.

    Args:
      predictor: from `load`.
      frames: a folder, a glob, a video file, a `Sequence`, or an array `[N, H, W]` or `[N, H, W, C]` of uint8.
      mode: "offline" gives every step the window that sees most on both sides of it; "streaming" uses the past alone.
      camera: fx, fy, cx, cy of the frames in pixels. With it frames are brought to the camera of the training; where
        they show noticeably less than it sees, a line on stderr says so.
      timestamps: of the frames, `[N]` s, after striding.
      stride: every how many frames one is used.
      bad_frames: "stop" raises on a frame that cannot be read; "hold" repeats the last step, with the variance of the
        training's labels added to its own, and flags it.
      estimate: what is reported of a mixture, see `odometry.trajectory`.
      scale_sigma: relative standard deviation of the error of scale, for one who knows the mount better than
        `predictor.scale_sigma`, which it is by default; see `odometry.trajectory`.
      hop: steps between windows, up to a whole one, half of one by default; offline only.
      progress: wraps the iterator over chunks of frames to show how far it is; told the number of chunks.

    Returns:
      The trajectory; `.save(directory)` writes its files. Its flags say which steps were held, and what `watch` found
      of their frames and times.

    Raises:
      InputError: the frames are unusable.
    """
    sequence = as_sequence(frames, predictor.config.image.channels, stride=stride, timestamps=timestamps, camera=camera)
    if sequence.count < 2:
        raise InputError(f"{sequence.name}: found {sequence.count} frame, expected at least 2: a step needs a pair")
    scale_sigma = predictor.scale_sigma if scale_sigma is None else scale_sigma
    check_scale_sigma(scale_sigma)
    window = predictor.config.data.window
    hop = max(1, window // 2) if hop is None else hop
    if not 1 <= hop <= window:
        raise InputError(f"hop is {hop}: expected 1 to {window}, the steps in a window")
    for line in checks.before_prediction(sequence, predictor.config):
        print(f"warning: {line}", file=sys.stderr)
    size = offline.PAIRS if mode == "offline" else 1
    began = time.perf_counter()
    _warm_up(predictor, mode, size, hop)
    seconds: ahead.Seconds = defaultdict(float, start=time.perf_counter() - began)
    chunks = ahead.chunks(sequence, predictor.config.image, size, hold=bad_frames == "hold", seconds=seconds)
    flags: list[list[str]] = []
    chunks = watched(chunks, sequence.timestamps, flags)
    if progress is not None:
        chunks = progress(chunks, -(-(sequence.count - 1) // size))
    began = time.perf_counter()
    if mode == "offline":
        densities, usable = _offline(predictor, sequence.count - 1, chunks, hop)
        densities, held = offline.hold(densities, usable, predictor.model.labels), ~usable
    else:
        densities, held = _stream(predictor, chunks)
    seconds["network"] = time.perf_counter() - began - seconds["wait"]
    result = trajectory(
        densities,
        coupling=predictor.config.model.coupling,
        timestamps=sequence.timestamps,
        flags=["; ".join(["held"] * bool(bad) + words) for bad, words in zip(held, flags, strict=True)],
        estimate=estimate,
        scale_sigma=scale_sigma,
        correlation=predictor.correlation,
        serial_correlation=predictor.serial_correlation,
    )
    about = {
        **result.about,
        "source": sequence.name,
        "checkpoint": predictor.source,
        "mode": mode,
        "backend": predictor.backend,
        "precision": predictor.precision,
        "sigma_scale": "none" if predictor.sigma_scale is None else predictor.sigma_scale.tolist(),
        "camera": "given" if sequence.camera else "unknown: the whole frame is taken to be the training camera's",
        "camera_height_m": predictor.camera_height_m or _trained_height(predictor.config),
        "start_s": round(seconds.pop("start"), 3),
        "ms_per_frame": {stage: round(1e3 * total / sequence.count, 3) for stage, total in seconds.items()},
    }
    return dataclasses.replace(result, about=about)


def _trained_height(config: Config) -> str:
    """Return what the summary says of a height that nobody gave."""
    height_m = config.data.camera_height_m
    return f"not given: {height_m:g} as in the training" if height_m else "not given, and unknown in the training"


def _warm_up(predictor: Predictor, mode: Mode, size: int, hop: int) -> None:
    """Compile what `mode` runs, so that the time a frame takes does not depend on how many there are."""
    image = predictor.config.image
    blank = np.zeros((size + 1, image.height, image.width, image.channels), np.uint8)
    one = iter([ahead.Chunk(blank, np.ones(size + 1, bool), 1)])
    if mode == "offline":
        _offline(predictor, 1, one, hop)
    else:
        _stream(predictor, one)


def _offline(predictor: Predictor, count: int, chunks: Iterator[ahead.Chunk], hop: int) -> tuple[Mixture, np.ndarray]:
    """Return the density of every step and which were usable, from overlapping windows."""
    model = predictor.model
    tail = np.zeros((predictor.config.data.window, fold.gates_size(model, predictor.config.model)), np.float32)
    return offline.step_densities(
        functools.partial(predictor.features, model),
        functools.partial(predictor.densities, model),
        jax.device_put(tail, model.residual_scale.sharding),
        count,
        chunks,
        window=predictor.config.data.window,
        hop=hop,
    )


def _stream(predictor: Predictor, chunks: Iterator[ahead.Chunk]) -> tuple[Mixture, np.ndarray]:
    """Return the density of every step and which were held, frame by frame."""
    state = predictor.stream_start(predictor.model)
    under_way: deque[StreamStep] = deque()
    results, held = [], []

    def collect() -> None:
        step = under_way.popleft()
        results.append(jax.tree.map(np.asarray, step.mixture))
        held.append(bool(step.held))

    for index, chunk in enumerate(chunks):
        for frame, readable in zip(chunk.frames[index > 0 :], chunk.readable[index > 0 :], strict=True):
            state, step = predictor.stream_step(predictor.model, state, frame, readable)
        under_way.append(step)
        if len(under_way) > _STEPS_AHEAD:
            collect()
    while under_way:
        collect()
    return jax.tree.map(lambda *leaves: np.stack(leaves), *results), np.array(held)
