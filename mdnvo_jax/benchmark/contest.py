"""Who predicts against whom: our predictors and the twin's, on one network and the same frames."""

import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from mdnvo_jax import predictor
from mdnvo_jax.backend import Backend, Precision
from mdnvo_jax.benchmark import material, peers
from mdnvo_jax.benchmark.agreement import agree
from mdnvo_jax.benchmark.outcome import Outcome, Settings
from mdnvo_jax.benchmark.timing import Contender, Untimed
from mdnvo_jax.config import Config
from mdnvo_jax.data.folder import read_frames
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError
from mdnvo_jax.odometry import Trajectory
from mdnvo_jax.predictor import Predictor
from mdnvo_jax.training.state import Model

OURS = "ours, JAX float32"
CACHING, RECOMPUTING = "PyTorch caching, ", "PyTorch DeepVO-style, "
# Relative difference of the standardised densities. A toy network has too few channels for rounding to average out.
TOLERANCE, BF16_TOLERANCE, BF16_TOLERANCE_SHORT = 1e-3, 0.1, 0.5
_SPELLED = {"jax": "JAX", "openvino": "OpenVINO"}
# A form that takes longer than this, and longer than the same program in float32, is not run again.
_LONG_S = 15.0


@dataclasses.dataclass
class Contest:
    """Predictors of one network.

    Attributes:
      config: of the network.
      model: its weights, as trained.
      ours: our predictors by name.
      twins: the twin's, by precision.
      sequence: decoded frames in memory.
      folder: the same frames as files.
      took: seconds of the first run of each of the twin's programs.
    """

    config: Config
    model: Model
    ours: dict[str, Predictor]
    twins: dict[str, Any]
    sequence: Sequence
    folder: Path
    took: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def size(self) -> str:
        """What reports call the network."""
        return material.described(self.config)

    def decoded(self, outcome: Outcome) -> dict[str, Contender]:
        """Return what predicts from decoded frames; `outcome` is told of what is too slow to be run again."""
        found = {name: offline(model, self.sequence) for name, model in self.ours.items()}
        for precision, twin in self.twins.items():
            found[CACHING + precision] = functools.partial(twin.caching, self.sequence)
            name = RECOMPUTING + precision
            exact = RECOMPUTING + "float32"
            if self.took[name] > max(_LONG_S, self.took[exact]):
                outcome.left_out(self.size, name, self.took[name], exact, self.took[exact])
            else:
                found[name] = functools.partial(twin.recomputing, self.sequence)
        return found

    def from_disk(self) -> dict[str, Contender]:
        """Return what predicts from files."""
        found = {name: offline(model, self.folder) for name, model in self.ours.items()}
        return found | {
            CACHING + precision: functools.partial(_from_folder, twin, self.folder)
            for precision, twin in self.twins.items()
            if precision == "float32"
        }

    def live(self) -> dict[str, Contender]:
        """Return what predicts from files frame by frame."""
        return {
            f"{name}, streaming": offline(model, self.folder, mode="streaming") for name, model in self.ours.items()
        }

    def streams(self) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
        """Return what takes one prepared frame after the other and returns the mean of the step to it."""
        found = {name: _stream(model) for name, model in self.ours.items()}
        return found | {CACHING + precision: twin.stream() for precision, twin in self.twins.items()}

    def assert_agreement(self, settings: Settings, outcome: Outcome) -> None:
        """Assert that every contender finds the densities that ours finds in float32."""
        reference = _standard(predictor.predict(self.ours[OURS], self.sequence))
        # How exact a backend is, its own tests say; here it has to be the same network.
        found = {name: (predictor.predict(model, self.sequence), reference) for name, model in self.ours.items()}
        if self.twins:
            every = _standard(predictor.predict(self.ours[OURS], self.sequence, hop=1))
        for precision, twin in self.twins.items():
            for name, run, expected in ((CACHING, twin.caching, reference), (RECOMPUTING, twin.recomputing, every)):
                began = time.perf_counter()
                found[name + precision] = (run(self.sequence), expected)
                self.took[name + precision] = time.perf_counter() - began
        for name, (path, expected) in found.items():
            difference = agree(name, expected, _standard(path), tolerance(name, settings))
            outcome.agreement[f"predict {self.size}: {name}"] = difference


def enter(config: Config, frames: int, settings: Settings, outcome: Outcome) -> Contest:
    """Return the contest for an untrained network of `config` on so many frames.

    Raises:
      InputError: the user's folder has fewer.
    """
    model = material.untrained_model(config)
    backends: tuple[Backend, ...] = ("jax", "openvino") if peers.available("openvino", outcome) else ("jax",)
    precisions: tuple[Precision, ...] = ("float32", "bfloat16")
    ours = {
        f"ours, {_SPELLED[backend]} {precision}": predictor.from_model(
            model, config, source="benchmark", backend=backend, precision=precision
        )
        for backend in backends
        for precision in precisions
    }
    twins: dict[str, Any] = {}
    if peers.available("torch", outcome):
        import torch

        from mdnvo_jax.benchmark.torch_predict import PRECISIONS, TorchPredictor

        torch.set_num_threads(settings.threads)
        twins = {precision: TorchPredictor(config, model, precision) for precision in PRECISIONS}
    return Contest(config, model, ours, twins, *_frames(config, frames, settings))


def tolerance(name: str, settings: Settings) -> float:
    """Return how far from ours in float32 a contender may be."""
    if "float32" in name:
        return TOLERANCE
    return BF16_TOLERANCE_SHORT if settings.short else BF16_TOLERANCE


def offline(model: Predictor, frames: Sequence | Path | np.ndarray, **options: Any) -> Contender:
    """Return what predicts `frames` with one of ours; compiling and the trial run before are not timed."""

    def run() -> Untimed:
        path = predictor.predict(model, frames, **options)
        return Untimed(float(path.about["start_s"]))

    return run


def _frames(config: Config, count: int, settings: Settings) -> tuple[Sequence, Path]:
    """Return decoded frames in memory, and a folder that holds them as files."""
    channels = config.image.channels
    name = f"{config.image.width}x{channels}"
    if settings.data:
        found = read_frames(settings.data, channels)
        if found.count < count:
            raise InputError(f"{settings.data} has {found.count} frames: expected {count} or more")
        folder = settings.folder / f"links{name}"
        folder.mkdir()
        for path in found.paths[:count]:
            (folder / Path(path).name).symlink_to(Path(path).absolute())
        return material.in_memory(found.subsequence(0, count)), folder
    size = (94, 310) if settings.short else material.KITTI_SIZE
    sequence = material.in_memory(material.drawn(count, channels, size))
    return sequence, material.write_pngs(sequence, settings.folder / f"png{name}")


def _standard(path: Trajectory) -> np.ndarray:
    """Return the densities of all steps in standardised units, in one vector."""
    found, labels = path.mixture, material.LABELS
    parts = (found.logits, (found.mean - labels.mean) / labels.std, found.log_scale - np.log(labels.std))
    return np.concatenate([np.ravel(part) for part in parts])


def _from_folder(twin: Any, folder: Path) -> Trajectory:
    return twin.caching(read_frames(folder, twin.config.image.channels))


def _stream(model: Predictor) -> Callable[[np.ndarray], np.ndarray]:
    state = model.stream_start(model.model)
    usable = jnp.array(True)

    def step(frame: np.ndarray) -> np.ndarray:
        nonlocal state
        state, found = model.stream_step(model.model, state, frame, usable)
        return np.asarray(found.mean)

    return step
