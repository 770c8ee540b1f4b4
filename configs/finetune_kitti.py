"""The weights that ship with the package, trained further on real drives: here three sequences of KITTI.

    bin/prepare_kitti --root KITTI --output CACHE --config configs/finetune_kitti.py
    python -m mdnvo_jax.train configs/finetune_kitti.py --workdir runs/finetuned --data.root KITTI --data.cache CACHE
    python -m mdnvo_jax.evaluate recalibrate --checkpoint runs/finetuned --root KITTI --cache CACHE

Frames and network are those of the shipped weights; the rate is a tenth of theirs, for little data teaches to forget.
The last tenth of every sequence validates, and chooses the step that `predict --checkpoint runs/finetuned` uses.
"""

import dataclasses

from mdnvo_jax import weights
from mdnvo_jax.config import Config, DataConfig, TrainingConfig

shipped = weights.config()
config = Config(
    image=shipped.image,
    # Real frames have no exact optical flow to learn from.
    model=dataclasses.replace(shipped.model, flow_weight=0.0),
    data=DataConfig(
        dataset="kitti",
        camera_folder="image_0",
        train_sequences=("00", "01", "02"),
        window=shipped.data.window,
        mirror=0.5,
        photometric=0.5,
        camera_height_m=1.65,
    ),
    training=TrainingConfig(
        batch_size=8,
        epochs=10,
        learning_rate=1e-4,
        plateau_patience=2,
        gradient_clip=1.0,
        reduction="mean",
        initial_weights="shipped",
    ),
)
