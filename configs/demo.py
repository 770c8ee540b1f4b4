"""A tiny network on a few rendered drives: the whole pipeline in two minutes, for `bin/demo`.

    python -m mdnvo_jax.train configs/demo.py --workdir demo/train

It learns to tell a bend from a straight road and fast from slow, and no more: do not expect it to work on real frames.
"""

from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig, TrainingConfig

config = Config(
    image=ImageConfig(height=48, width=160, channels=1, normalisation="local_contrast"),
    model=ModelConfig(width=0.125, lstm_hidden=64, lstm_layers=1, coupling="joint"),
    data=DataConfig(dataset="synthetic", worlds=24, world_frames=40, validation_worlds=4, window=6, mirror=0.5),
    training=TrainingConfig(batch_size=8, epochs=4, reduction="mean"),
)
