"""What is measured on: configurations, frames as hard to decode as real ones, networks that are not trained."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig, TrainingConfig
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.model.head import Labels
from mdnvo_jax.model.network import Network, Variables, build, template
from mdnvo_jax.training import parallel
from mdnvo_jax.training.state import Model, State, initial_state
from mdnvo_jax.training.store import Store

# Rows and columns of KITTI's frames.
KITTI_SIZE = (376, 1241)
# Mean and standard deviation of a step in m and rad, about those of KITTI's training sequences.
_MEAN: Any = np.array([0.0, -0.02, 1.0, 0.0, 0.0, 0.0], np.float32)
_STD: Any = np.array([0.02, 0.02, 0.4, 0.003, 0.02, 0.003], np.float32)
LABELS = Labels(_MEAN, _STD)
# Grey levels of noise in a frame. Real ones in PNG take 0.55 to 0.65 of their raw bytes, and so do frames with this.
_NOISE = 3.0
# Pixels that the picture moves from a frame to the next.
_MOTION = 3


def paper_config(height: int, width: int, multiplier: float, *, batch: int = 8, window: int = 6) -> Config:
    """Return the configuration of configs/mdn_vo_kitti.py at another size, stack and LSTM scaled by `multiplier`."""
    return Config(
        image=ImageConfig(height=height, width=width, channels=3, normalisation="flownet"),
        model=ModelConfig(width=multiplier, lstm_hidden=max(4, round(1000 * multiplier)), coupling="independent"),
        data=DataConfig(dataset="kitti", window=window),
        training=TrainingConfig(batch_size=batch, reduction="sequence"),
    )


def small_config(height: int = 80, width: int = 256, multiplier: float = 0.25, *, batch: int = 8) -> Config:
    """Return the configuration of configs/kitti_small.py, at another size where given."""
    return Config(
        image=ImageConfig(height=height, width=width, channels=1, normalisation="local_contrast"),
        model=ModelConfig(width=multiplier, lstm_hidden=round(512 * multiplier), lstm_layers=1, coupling="joint"),
        data=DataConfig(dataset="kitti", camera_folder="image_0", window=6, mirror=0.5, photometric=0.5),
        training=TrainingConfig(batch_size=batch, reduction="mean"),
    )


def described(config: Config) -> str:
    """Return the size of a configuration in words."""
    model = config.model
    return f"{config.image.width}x{config.image.height}, width {model.width:g}"


def without_dropout(config: Config) -> Config:
    """Return `config` with nothing random in a training step."""
    return dataclasses.replace(config, model=dataclasses.replace(config.model, conv_dropout=0.0, lstm_dropout=0.0))


def with_products(config: Config, products: Literal["float32", "mixed"]) -> Config:
    """Return `config` with the precision in which the convolutions' products are taken."""
    return dataclasses.replace(config, model=dataclasses.replace(config.model, products=products))


def frame_reader(channels: int, size: tuple[int, int] = KITTI_SIZE, seed: int = 0) -> Any:
    """Return a function that draws frame i, uint8 `[h, w, C]`: the same every time, whatever was drawn before.

    Blotches of all sizes that move over the picture, with the noise of a sensor.
    """
    rng = np.random.default_rng(seed)
    height, width = size
    period = 64 * _MOTION
    canvas = np.full((height, width + period, channels), 110.0, np.float32)
    for octave in (4, 8, 16, 32, 64, 128, 256):
        coarse = rng.normal(0, 3.0 * octave**0.4, (height // octave + 2, (width + period) // octave + 2, channels))
        fine = cv2.resize(coarse.astype(np.float32), (width + period, height), interpolation=cv2.INTER_CUBIC)
        canvas += fine.reshape(canvas.shape)
    noise = rng.normal(0, _NOISE, (height + 64, width + 64, channels)).astype(np.float32)

    def read(index: int) -> np.ndarray:
        shift = _MOTION * (index % 64)
        row, column = (7 * index) % 64, (13 * index) % 64
        picture = canvas[:, shift : shift + width] + noise[row : row + height, column : column + width]
        return np.clip(picture, 0, 255).astype(np.uint8)

    return read


def drawn(count: int, channels: int, size: tuple[int, int] = KITTI_SIZE) -> Sequence:
    """Return a sequence of `count` frames, each drawn when it is read."""
    return Sequence(name="drawn", count=count, read=frame_reader(channels, size))


def in_memory(sequence: Sequence) -> Sequence:
    """Return `sequence` with all its frames decoded."""
    frames = [sequence.read(index) for index in range(sequence.count)]
    return dataclasses.replace(sequence, read=frames.__getitem__)


def write_pngs(sequence: Sequence, folder: Path) -> Path:
    """Write the frames of a sequence as PNG files and return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(sequence.count):
        cv2.imwrite(str(folder / f"{index:06d}.png"), sequence.read(index)[..., ::-1])
    return folder


def training_batch(config: Config) -> dict[str, np.ndarray]:
    """Return one batch of textured windows with random labels, no step masked."""
    image, batch, window = config.image, config.training.batch_size, config.data.window
    read = frame_reader(image.channels, (image.height, image.width))
    rng = np.random.default_rng(1)
    frames = np.stack([np.stack([read(17 * row + step) for step in range(window + 1)]) for row in range(batch)])
    steps = _MEAN + _STD * rng.normal(size=(batch, window, 6))
    return {"images": frames, "steps": steps.astype(np.float32), "mask": np.ones((batch, window), bool)}


def moving_batch(config: Config, number: int) -> dict[str, np.ndarray]:
    """Return batch `number` of windows in which the picture moves once, twice or three times as far, as labels say."""
    image, batch, window = config.image, config.training.batch_size, config.data.window
    read = frame_reader(image.channels, (image.height, image.width))
    rng = np.random.default_rng(number)
    strides = rng.integers(1, 4, (batch, window))
    first = rng.integers(0, 64, (batch, 1))
    at = np.concatenate([first, first + np.cumsum(strides, 1)], axis=1)
    steps = np.tile(_MEAN, (batch, window, 1))
    steps[..., 2] += _STD[2] * (strides - 2)
    frames = np.stack([np.stack([read(int(index)) for index in row]) for row in at])
    return {"images": frames, "steps": steps, "mask": np.ones((batch, window), bool)}


def fresh_variables(network: Network, config: Config) -> Variables:
    """Return variables of Xavier's distribution, as training starts from; drawn by NumPy, which is faster at it."""
    rng = np.random.default_rng(0)

    def draw(path: Any, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        name = jax.tree_util.keystr(path[-1:], simple=True)
        if not name.endswith("kernel"):
            return jnp.full(leaf.shape, float(name in ("scale", "var")), leaf.dtype)
        area, gates = int(np.prod(leaf.shape[:-2])), 4 if name != "kernel" else 1
        limit = np.sqrt(6 / (area * (leaf.shape[-2] + leaf.shape[-1] // gates)))
        return jnp.asarray((2 * rng.random(leaf.shape, np.float32) - 1) * np.float32(limit))

    return jax.tree.map_with_path(draw, template(network, config.image, config.data.window))


def fresh_state(config: Config, mesh: Mesh) -> State:
    """Return the state before the first step of training, on all devices of `mesh`."""
    variables = fresh_variables(build(config.image, config.model), config)
    return jax.device_put(initial_state(variables, config, LABELS), parallel.replicated(mesh))


def untrained_model(config: Config) -> Model:
    """Return a network that was not trained, as prediction takes it.

    Its statistics of batch normalisation are those of one batch: at their initial values the signal would fade from
    layer to layer, and all frames would look alike to the head.
    """
    network = build(config.image, config.model)
    variables = settled(network, config, fresh_variables(network, config))
    labels = Labels(*(jnp.asarray(value) for value in LABELS))
    return Model(variables["params"], variables["batch_stats"], labels, jnp.ones(6))


def write_checkpoint(model: Model, config: Config, folder: Path) -> Path:
    """Write the checkpoint of a model, and return `folder`."""
    variables = {"params": model.params, "batch_stats": model.batch_stats}
    # Prediction reads the model alone; the moments of Adam would take twice its space.
    state = initial_state(variables, config, LABELS)._replace(optimiser={"left_out": jnp.zeros(())})
    store = Store(folder, keep_latest=1)
    store.save(state, None, config, 1.0)
    store.close()
    return folder


def settled(network: Network, config: Config, variables: Variables) -> Variables:
    """Return `variables` with the statistics of one batch in place of the initial ones."""
    image = config.image
    read = frame_reader(image.channels, (image.height, image.width))
    images = np.stack([[read(index) for index in range(3)]])

    @jax.jit
    def look(variables: Variables, images: jax.Array) -> Any:
        calm = build(image, without_dropout(config).model)
        mask = jnp.ones((1, 2), bool)
        return calm.apply(variables, images, mask, train=True, mutable=["batch_stats"])[1]["batch_stats"]

    # A running statistic becomes 0.9 of what it was and 0.1 of the batch's.
    before = variables["batch_stats"]
    after = look(variables, images)
    exact = jax.tree.map(lambda new, old: (new - 0.9 * old) / 0.1, after, before)
    return {**variables, "batch_stats": jax.tree.map(lambda value: value + 1e-6, exact)}
