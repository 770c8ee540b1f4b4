"""Windows of toy sequences, whose frame i is filled with the number i: their configuration, and what is in a batch."""

import itertools

import numpy as np
from scipy.spatial.transform import Rotation

from mdnvo_jax.config import Config, DataConfig, ImageConfig, TrainingConfig

IMAGE = ImageConfig(height=8, width=16, channels=1)


def config_of(batch_size=4, image=IMAGE, **data):
    return Config(image=image, data=DataConfig(**data), training=TrainingConfig(batch_size=batch_size))


def numbers(batch):
    """Return the numbers of the frames, `[B, T+1]`: toy frame i is filled with i."""
    images = batch["images"]
    assert (images == images[:, :, :1, :1]).all()
    return images[:, :, 0, 0, 0].astype(int)


def matrices(steps):
    result = np.tile(np.eye(4), (len(steps), 1, 1))
    result[:, :3, 3] = steps[:, :3]
    result[:, :3, :3] = Rotation.from_rotvec(steps[:, 3:]).as_matrix()
    return result


def taken(iterator, count):
    return list(itertools.islice(iterator, count))
