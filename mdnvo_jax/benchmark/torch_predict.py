"""Prediction with the twin in PyTorch, in the two ways it is done: windows recomputed, or every pair computed once.

It imports torch at its head: only sections that found torch import this module.
"""

import functools
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mdnvo_jax.benchmark.torch_twin import Density, Twin, copy_weights, for_prediction
from mdnvo_jax.config import Config, ImageConfig
from mdnvo_jax.data import ahead
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.mixture import Mixture
from mdnvo_jax.odometry import Trajectory, trajectory, window_plan
from mdnvo_jax.training.state import Model

# Pairs, or windows where they are recomputed, that go through the network at a time.
_BATCH = 8

PRECISIONS = ("float32", "bf16 autocast", "bf16")


class TorchPredictor:
    """The twin as a predictor; the frames' preparation and the trajectory are our own functions, the same for all."""

    def __init__(self, config: Config, model: Model, precision: str) -> None:
        twin = Twin(config)
        copy_weights(twin, model.params, model.batch_stats)
        self.config = config
        self.twin = for_prediction(twin, torch.bfloat16 if precision == "bf16" else torch.float32)
        self.density = Density(config, model.labels)
        self.autocast = functools.partial(torch.autocast, "cpu", torch.bfloat16, enabled=precision == "bf16 autocast")

    def recomputing(self, sequence: Sequence) -> Trajectory:
        """Predict as DeepVO code does: a window for every step, each with all its pairs through the convolutions."""
        window = self.config.data.window
        steps = sequence.count - 1
        frames: list[Tensor] = []
        outputs: list[Tensor] = []
        waiting = 0
        for frame in _frames(sequence, self.config.image):
            frames.append(frame)
            waiting += len(frames) > window
            if waiting == _BATCH or (waiting and len(frames) + len(outputs) == sequence.count):
                windows = torch.stack([torch.stack(frames[i : i + window + 1]) for i in range(len(frames) - window)])
                outputs += list(self.windows(windows))
                frames, waiting = frames[-window:], 0
        # Of overlapping windows, the one that sees most on both sides of a step gives it, as in ours.
        plan = window_plan(steps, window, 1)
        found = torch.cat([outputs[start][first - start : last - start] for start, first, last in plan])
        return self.trajectory(found)

    def caching(self, sequence: Sequence) -> Trajectory:
        """Predict as ours does: every pair through the convolutions once, the LSTM over the same windows."""
        window = self.config.data.window
        every = torch.cat([self.pairs(frames) for frames in _chunks(sequence, self.config.image)])
        plan = list(window_plan(len(every), window, max(1, window // 2)))
        found = []
        for place in range(0, len(plan), _BATCH):
            chosen = plan[place : place + _BATCH]
            outputs = self.outputs(torch.stack([every[start : start + window] for start, _, _ in chosen]))
            found += [o[first - start : last - start] for o, (start, first, last) in zip(outputs, chosen, strict=True)]
        return self.trajectory(torch.cat(found))

    def stream(self) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function that takes a prepared frame and returns the mean of the step to it."""
        window = self.config.data.window
        features: list[Tensor] = []
        last: list[Tensor] = []

        def step(frame: np.ndarray) -> np.ndarray:
            now = torch.from_numpy(np.ascontiguousarray(frame))
            last.append(now)
            if len(last) < 2:
                return np.zeros(6)
            features.append(self.pairs(torch.stack(last[-2:]))[0])
            del features[:-window], last[:-2]
            density = self.density(self.outputs(torch.stack(features)[None])[0, -1:])
            return _mean(density)[0]

        return step

    @torch.inference_mode()
    def windows(self, images: Tensor) -> Tensor:
        """Return the raw outputs of windows of frames."""
        with self.autocast():
            return self.twin(images).float()

    @torch.inference_mode()
    def pairs(self, images: Tensor) -> Tensor:
        """Return the features of consecutive frames."""
        with self.autocast():
            normalised = self.twin.normalise(images)
            return self.twin.features(torch.cat([normalised[:-1], normalised[1:]], dim=-1))

    @torch.inference_mode()
    def outputs(self, features: Tensor) -> Tensor:
        """Return the raw outputs of windows of features."""
        with self.autocast():
            return self.twin.outputs_from_features(features).float()

    @torch.inference_mode()
    def trajectory(self, outputs: Tensor) -> Trajectory:
        """Return the trajectory of raw outputs `[N-1, D]`."""
        leaves: list[Any] = [part.numpy() for part in self.density(outputs)]
        return trajectory(Mixture(*leaves), coupling=self.config.model.coupling)


def _mean(density: tuple[Tensor, Tensor, Tensor]) -> np.ndarray:
    logits, means, _ = density
    return (torch.softmax(logits, -1)[..., None] * means).sum(-2).numpy()


def _chunks(sequence: Sequence, image: ImageConfig) -> Iterator[Tensor]:
    """Yield the frames of pairs, the last of a chunk being the first of the next, read ahead as ours are."""
    for chunk in ahead.chunks(sequence, image, _BATCH, hold=False, seconds=defaultdict(float)):
        yield torch.from_numpy(chunk.frames[: chunk.pairs + 1])


def _frames(sequence: Sequence, image: ImageConfig) -> Iterator[Tensor]:
    """Yield every frame once."""
    for index, frames in enumerate(_chunks(sequence, image)):
        yield from frames[index > 0 :]
