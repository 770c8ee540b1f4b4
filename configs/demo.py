"""A tiny network on a few rendered drives: a whole training in a few minutes, to see how it goes.

    python -m mdnvo_jax.synthesize drives --sequences 24 --frames 60 --seed 0 --height 48 --width 160
    python -m mdnvo_jax.train configs/demo.py --workdir train --data.root drives

It learns something of the speed and next to nothing of the bends, which take many times as many drives (see
BENCHMARKS.md): do not expect it to beat the constant predictor everywhere, or to work on real frames.
"""

from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig, TrainingConfig

config = Config(
    image=ImageConfig(height=48, width=160, channels=1, normalisation="local_contrast"),
    model=ModelConfig(width=0.125, lstm_hidden=64, lstm_layers=1, coupling="joint"),
    data=DataConfig(
        camera_folder="image_0",
        train_sequences=tuple(f"{number:02d}" for number in range(24)),
        window=6,
        hop=2,
        mirror=0.5,
        photometric=0.5,
    ),
    training=TrainingConfig(batch_size=8, epochs=8, reduction="mean"),
)
