"""A small network whose outputs depend on what it sees, for tests of how prediction is run."""

from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np

from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig
from mdnvo_jax.model.head import Labels
from mdnvo_jax.model.network import build
from mdnvo_jax.training.state import Model, initial_state, initial_variables
from mdnvo_jax.training.store import Store

CONFIG = Config(
    image=ImageConfig(height=32, width=64, channels=1, camera=(40.0, 40.0, 31.5, 15.5)),
    model=ModelConfig(width=1 / 16, lstm_hidden=8, lstm_layers=2, components=2),
    data=DataConfig(window=4),
)
LABELS = Labels(np.array([0, 0, 1, 0, 0.01, 0]), np.array([0.02, 0.02, 0.5, 0.005, 0.02, 0.005]))
FRAMES = np.stack(
    [
        cv2.resize(np.random.default_rng(seed).integers(0, 256, (4 + seed, 8, 1), dtype=np.uint8), (64, 32))[..., None]
        for seed in range(30)
    ]
)


def trained() -> Model:
    """Return the model; nothing in it is zero, one or otherwise neutral."""
    variables = initial_variables(build(CONFIG.image, CONFIG.model), CONFIG)
    rng = np.random.default_rng(0)

    def draw(path: tuple, leaf: jax.Array) -> np.ndarray:
        name = path[-1].key
        if name == "var":
            # About what the layers give, so that features are of the order of one.
            return rng.uniform(0.06, 0.25, leaf.shape).astype(np.float32)
        if name in ("mean", "bias"):
            return rng.normal(scale=0.05, size=leaf.shape).astype(np.float32)
        if name == "scale":
            return rng.uniform(0.5, 1.5, leaf.shape).astype(np.float32)
        return np.asarray(leaf) * (5 if "head" in str(path) else 1)

    variables = jax.tree.map_with_path(draw, variables)
    return initial_state(variables, CONFIG, LABELS).model


def trained_variables() -> dict[str, Any]:
    """Return the model's variables, as a network takes them."""
    model = trained()
    return {"params": model.params, "batch_stats": model.batch_stats}


def save(folder: Path, config: Config = CONFIG) -> Path:
    """Write the model as a training of `config`, which has the network of `CONFIG`, does, and return the folder."""
    store = Store(folder, keep_latest=1)
    variables = initial_variables(build(CONFIG.image, CONFIG.model), CONFIG)
    store.save(initial_state(variables, CONFIG, LABELS)._replace(model=trained()), None, config, 1.0)
    store.close()
    return folder
