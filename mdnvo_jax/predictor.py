"""A trained model, and what it makes of frames: offline over windows, or streaming frame by frame."""

import dataclasses
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mdnvo_jax import mixture, recalibration
from mdnvo_jax.config import Config
from mdnvo_jax.data.folder import read_frames
from mdnvo_jax.data.images import prepare
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError
from mdnvo_jax.mixture import Mixture
from mdnvo_jax.model.head import Labels, mixture_from_outputs
from mdnvo_jax.model.network import build
from mdnvo_jax.odometry import Estimate, Trajectory, trajectory, window_plan
from mdnvo_jax.streaming import held_step, stream
from mdnvo_jax.training import checkpoint
from mdnvo_jax.training.state import Model, state_template

# Pairs that go through the convolutions at a time, and windows through the LSTM.
_PAIRS = 8
_WINDOWS = 8

Mode = Literal["offline", "streaming"]
# Spent so far, by stage.
Seconds = defaultdict[str, float]


class Predictor(NamedTuple):
    """A trained model with its compiled functions.

    Attributes:
      config: the experiment it comes from; `config.image` says what frames are brought to.
      model: its parameters and the statistics of its labels.
      features: (model, first, second `[n, H, W, C]` uint8) -> `[n, F]`.
      densities: (model, features `[n, window, F]`, mask `[n, window]`) -> mixtures in metres and radians.
      stream_start: (model) -> the state of a stream.
      stream_step: (model, state, image, usable) -> (state, step); see `mdnvo_jax.streaming`.
      source: the folder of the checkpoint.
      sigma_scale: factors by component that every sigma is multiplied by already, `[6]`; None where none were fitted.
    """

    config: Config
    model: Model
    features: Callable[..., jax.Array]
    densities: Callable[..., Mixture]
    stream_start: Callable[..., Any]
    stream_step: Callable[..., Any]
    source: str
    sigma_scale: np.ndarray | None = None


def load(path: str | os.PathLike[str], *, recalibrated: bool = True) -> Predictor:
    """Return the model in a checkpoint: the best step of a training's --workdir, or the folder of one step.

    Args:
      path: the folder.
      recalibrated: multiply every sigma by what `evaluate recalibrate` left with the checkpoint, if it has.

    Raises:
      InputError: there is none, or it is damaged.
    """
    folder = checkpoint.locate(path)
    config = checkpoint.read_config(folder)
    network = build(config.image, config.model)
    template = state_template(network, config).model
    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    model = checkpoint.read_model(folder, checkpoint.abstract(template, here))
    found = recalibration.read(folder) if recalibrated else None
    sigma_scale = None if found is None else jnp.asarray(found.scale, jnp.float32)

    def features(model: Model, first: jax.Array, second: jax.Array) -> jax.Array:
        variables = {"params": model.params, "batch_stats": model.batch_stats}
        return network.apply(variables, first, second, method="pair_features")

    def densities(model: Model, features: jax.Array, mask: jax.Array) -> Mixture:
        variables = {"params": model.params, "batch_stats": model.batch_stats}
        outputs = network.apply(variables, features, mask, method="outputs_from_features")
        return mixture_from_outputs(outputs, model.labels, config.model, model.residual_scale, sigma_scale)

    start, step = stream(network, config, config.data.window, sigma_scale)
    return Predictor(
        config=config,
        model=model,
        features=jax.jit(features),
        densities=jax.jit(densities),
        stream_start=start,
        stream_step=jax.jit(step),
        source=str(folder),
        sigma_scale=None if found is None else found.scale,
    )


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
    hop: int | None = None,
    progress: Callable[[Iterator[Any], int], Iterator[Any]] | None = None,
) -> Trajectory:
    """Estimate the camera's motion through `frames`.

    Args:
      predictor: from `load`.
      frames: a folder, a glob, a video file, a `Sequence`, or an array `[N, H, W]` or `[N, H, W, C]` of uint8.
      mode: "offline" gives every step the window that sees most on both sides of it; "streaming" uses the past alone.
      camera: fx, fy, cx, cy of the frames in pixels. With it frames are brought to the camera of the training.
      timestamps: of the frames, `[N]` s, after striding.
      stride: every how many frames one is used.
      bad_frames: "stop" raises on a frame that cannot be read; "hold" repeats the last step, with the variance of the
        training's labels added to its own, and flags it.
      estimate: what is reported of a mixture, see `odometry.trajectory`.
      hop: steps between windows, half a window by default; offline only.
      progress: wraps the iterator over chunks of frames to show how far it is; told the number of chunks.

    Returns:
      The trajectory; `.save(directory)` writes its files.

    Raises:
      InputError: the frames are unusable.
    """
    sequence = _as_sequence(frames, predictor.config.image.channels, stride, timestamps, camera)
    if sequence.count < 2:
        raise InputError(f"{sequence.name}: found {sequence.count} frame, expected at least 2: a step needs a pair")
    began = time.perf_counter()
    _warm_up(predictor, mode)
    seconds: Seconds = defaultdict(float, start=time.perf_counter() - began)
    run = _offline if mode == "offline" else _stream
    chunks = _chunks(predictor, sequence, 1 if mode == "streaming" else _PAIRS, bad_frames == "hold", seconds)
    if progress is not None:
        chunks = progress(chunks, -(-(sequence.count - 1) // (1 if mode == "streaming" else _PAIRS)))
    densities, held = run(predictor, sequence.count - 1, chunks, hop, seconds)
    result = trajectory(
        densities,
        coupling=predictor.config.model.coupling,
        timestamps=sequence.timestamps,
        flags=["held" if flag else "" for flag in held],
        estimate=estimate,
    )
    about = {
        **result.about,
        "source": sequence.name,
        "checkpoint": predictor.source,
        "mode": mode,
        "sigma_scale": "none" if predictor.sigma_scale is None else predictor.sigma_scale.tolist(),
        "camera": "given" if sequence.camera else "unknown: the whole frame is taken to be the training camera's",
        "start_s": round(seconds.pop("start"), 3),
        "ms_per_frame": {stage: round(1e3 * total / sequence.count, 3) for stage, total in seconds.items()},
    }
    return dataclasses.replace(result, about=about)


def _warm_up(predictor: Predictor, mode: Mode) -> None:
    """Compile what `mode` runs, so that the time a frame takes does not depend on how many there are."""
    image = predictor.config.image
    blank = np.zeros((_PAIRS, image.height, image.width, image.channels), np.uint8)
    if mode == "streaming":
        state = predictor.stream_start(predictor.model)
        jax.block_until_ready(predictor.stream_step(predictor.model, state, blank[0], jnp.array(False)))
        return
    features = predictor.features(predictor.model, blank, blank)
    windows = np.zeros((_WINDOWS, predictor.config.data.window, features.shape[1]), features.dtype)
    jax.block_until_ready(predictor.densities(predictor.model, windows, np.zeros(windows.shape[:2], bool)))


def _as_sequence(
    frames: str | os.PathLike[str] | Sequence | np.ndarray,
    channels: int,
    stride: int,
    timestamps: np.ndarray | None,
    camera: tuple[float, float, float, float] | None,
) -> Sequence:
    """Return whatever frames were given as a sequence."""
    if isinstance(frames, (str, Path, os.PathLike)):
        found = read_frames(os.fspath(frames), channels, stride=stride, camera=camera)
        return found if timestamps is None else dataclasses.replace(found, timestamps=timestamps)
    if isinstance(frames, Sequence):
        return frames if camera is None else dataclasses.replace(frames, camera=camera)
    images = np.asarray(frames)
    if images.ndim not in (3, 4) or images.dtype != np.uint8:
        raise InputError(f"frames are {images.dtype} {images.shape}: expected uint8 [N, H, W] or [N, H, W, C]")
    images = images.reshape(*images.shape[:3], -1)[::stride]
    if images.shape[-1] != channels:
        raise InputError(f"frames have {images.shape[-1]} channels: the model expects {channels}")
    return Sequence(
        name="array", count=len(images), read=images.__getitem__, timestamps=timestamps, poses=None, camera=camera
    )


class _Chunk(NamedTuple):
    """Consecutive frames `[n+1, H, W, C]`, blank where `readable` is false; the first ends the chunk before.

    `pairs` of the n pairs are real, the rest pads the chunk to its fixed size.
    """

    frames: np.ndarray
    readable: np.ndarray
    pairs: int

    @property
    def usable(self) -> np.ndarray:
        """Which of the real pairs have two readable frames."""
        return (self.readable[1:] & self.readable[:-1])[: self.pairs]


def _chunks(predictor: Predictor, sequence: Sequence, size: int, hold: bool, seconds: Seconds) -> Iterator[_Chunk]:
    """Yield the pairs of a sequence in order, read one chunk ahead on a thread of its own."""
    image = predictor.config.image

    def frame(index: int) -> np.ndarray | None:
        try:
            return prepare(sequence.read(index), sequence.camera, image)
        except InputError:
            if not hold:
                raise
            return None

    def chunk(start: int, before: np.ndarray | None) -> tuple[_Chunk, np.ndarray | None]:
        began = time.perf_counter()
        count = min(size, sequence.count - 1 - start)
        frames = [before, *(frame(index) for index in range(start + 1, start + 1 + count)), *[None] * (size - count)]
        blank = np.zeros((image.height, image.width, image.channels), np.uint8)
        filled = np.stack([blank if item is None else item for item in frames])
        readable = np.array([item is not None for item in frames])
        seconds["read"] += time.perf_counter() - began
        return _Chunk(filled, readable, count), frames[-1]

    with ThreadPoolExecutor(max_workers=1) as ahead:
        last = ahead.submit(frame, 0).result()
        pending = ahead.submit(chunk, 0, last)
        for start in range(size, sequence.count - 1 + size, size):
            ready, last = pending.result()
            if start < sequence.count - 1:
                pending = ahead.submit(chunk, start, last)
            yield ready


def _offline(
    predictor: Predictor, count: int, chunks: Iterator[_Chunk], hop: int | None, seconds: Seconds
) -> tuple[Mixture, np.ndarray]:
    """Return the density of every step and which were held, from overlapping windows in constant memory."""
    window = predictor.config.data.window
    plan = list(window_plan(count, window, hop or max(1, window // 2)))
    results: list[Mixture] = []
    usable_steps: list[np.ndarray] = []
    kept = np.zeros((0, 0), np.float32)
    kept_usable = np.zeros(0, bool)
    offset = 0
    for chunk in chunks:
        began = time.perf_counter()
        found = np.asarray(predictor.features(predictor.model, chunk.frames[:-1], chunk.frames[1:]))[: chunk.pairs]
        seconds["convolutions"] += time.perf_counter() - began
        began = time.perf_counter()
        kept = np.concatenate([kept.reshape(-1, found.shape[1]), found])
        kept_usable = np.concatenate([kept_usable, chunk.usable])
        usable_steps.append(chunk.usable)
        complete = offset + len(kept)
        while plan and (complete == count or min(plan[0][0] + window, count) <= complete):
            ready = [entry for entry in plan[:_WINDOWS] if min(entry[0] + window, count) <= complete]
            plan = plan[len(ready) :]
            results += _window_densities(predictor, kept, kept_usable, offset, ready)
        if plan:
            drop = plan[0][0] - offset
            kept, kept_usable, offset = kept[drop:], kept_usable[drop:], plan[0][0]
        seconds["lstm and head"] += time.perf_counter() - began
    densities = jax.tree.map(lambda *leaves: np.concatenate(leaves), *results)
    usable = np.concatenate(usable_steps)
    return _hold(densities, usable, predictor.model.labels), ~usable


def _window_densities(
    predictor: Predictor, features: np.ndarray, usable: np.ndarray, offset: int, plan: list[tuple[int, int, int]]
) -> list[Mixture]:
    """Return the densities of the steps that the planned windows give, from features of step `offset` on."""
    window = predictor.config.data.window
    inputs = np.zeros((_WINDOWS, window, features.shape[1]), features.dtype)
    mask = np.zeros((_WINDOWS, window), bool)
    for row, (start, _, _) in enumerate(plan):
        part = slice(start - offset, start - offset + window)
        inputs[row, : len(features[part])] = features[part]
        mask[row, : len(usable[part])] = usable[part]
    found = jax.tree.map(np.asarray, predictor.densities(predictor.model, inputs, mask))
    return [
        Mixture(*(leaf[row, first - start : last - start] for leaf in found))
        for row, (start, first, last) in enumerate(plan)
    ]


def _hold(densities: Mixture, usable: np.ndarray, labels: Labels) -> Mixture:
    """Return densities whose unusable steps repeat the last usable one, less surely; see `held_step`."""
    if usable.all():
        return densities
    held = jax.tree.map(np.copy, densities)
    means, variances = mixture.mean(densities), mixture.variance(densities)
    mean, variance = jnp.asarray(labels.mean), jnp.zeros(6)
    for index, good in enumerate(usable):
        if good:
            mean, variance = means[index], variances[index]
            continue
        for leaf, value in zip(held, held_step(mean, variance, labels, densities.logits.shape[-1]), strict=True):
            leaf[index] = np.asarray(value)
    return held


def _stream(
    predictor: Predictor, count: int, chunks: Iterator[_Chunk], hop: int | None, seconds: Seconds
) -> tuple[Mixture, np.ndarray]:
    """Return the density of every step and which were held, frame by frame."""
    del hop
    state = predictor.stream_start(predictor.model)
    results, held = [], []
    for index, chunk in enumerate(chunks):
        began = time.perf_counter()
        for frame, readable in zip(chunk.frames[index > 0 :], chunk.readable[index > 0 :], strict=True):
            state, step = predictor.stream_step(predictor.model, state, frame, jnp.asarray(readable))
        results.append(jax.tree.map(np.asarray, step.mixture))
        held.append(bool(step.held))
        seconds["network"] += time.perf_counter() - began
    assert len(results) == count
    return jax.tree.map(lambda *leaves: np.stack(leaves), *results), np.array(held)
