"""A small training on rendered drives, minutes long, that choices are compared on: see `bin/ablate`.

bin/prepare_kitti --dataset synthetic --config configs/ablation.py --output CACHE
bin/ablate --cache CACHE --output runs/ablation
"""

from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig, TrainingConfig

config = Config(
    # The view of configs/pretrained.py at two thirds of its pixels in each direction.
    image=ImageConfig(
        height=32, width=128, channels=1, normalisation="local_contrast", camera=(74.133, 74.133, 63.5, 12.167)
    ),
    model=ModelConfig(
        width=0.125,
        conv_dropout=0.0,
        batch_norm_momentum=0.99,
        lstm_hidden=64,
        lstm_layers=1,
        lstm_dropout=0.1,
        components=3,
        flow_weight=0.5,
    ),
    data=DataConfig(
        dataset="synthetic",
        worlds=240,
        world_frames=60,
        validation_worlds=24,
        window=12,
        hop=3,
        mirror=0.5,
        narrow=0.3,
        camera_height_m=1.65,
        camera_height_shares=(0.75, 1.3),
    ),
    training=TrainingConfig(
        batch_size=8,
        epochs=5,
        steps_per_epoch=300,
        schedule="cosine",
        weight_decay=1e-2,
        gradient_clip=1.0,
        reduction="mean",
        beta=0.5,
    ),
)
