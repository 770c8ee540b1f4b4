"""A small network on a few KITTI sequences, for a first result within minutes on a laptop's processor.

    bin/prepare_kitti --root KITTI --output CACHE --config configs/kitti_small.py
    python -m mdnvo_jax.train configs/kitti_small.py --workdir runs/small --data.root KITTI --data.cache CACHE

Grey frames of the left camera (image_0), a quarter of the paper's width, a tenth of its pixels. BENCHMARKS.md has what
it reaches on short clips.
"""

from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig, TrainingConfig

config = Config(
    image=ImageConfig(height=80, width=256, channels=1, normalisation="local_contrast"),
    model=ModelConfig(width=0.25, lstm_hidden=128, lstm_layers=1, coupling="joint"),
    data=DataConfig(
        dataset="kitti",
        camera_folder="image_0",
        train_sequences=("00", "01", "02"),
        window=6,
        mirror=0.5,
        photometric=0.5,
    ),
    training=TrainingConfig(batch_size=8, epochs=12, reduction="mean"),
)
