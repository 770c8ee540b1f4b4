"""A small training on rendered drives, minutes long, that choices are compared on: see `bin/ablate`.

    bin/prepare_kitti --dataset synthetic --config configs/ablation.py --output CACHE
    bin/ablate --cache CACHE --output runs/ablation

All that is not named here is as in configs/pretrained.py.
"""

import dataclasses
from pathlib import Path

from mdnvo_jax.config import load_config

shipped = load_config(str(Path(__file__).with_name("pretrained.py")))
config = dataclasses.replace(
    shipped,
    # The same view, at two thirds of its pixels in each direction.
    image=dataclasses.replace(shipped.image, height=32, width=128, camera=(74.133, 74.133, 63.5, 12.167)),
    # As the table in BENCHMARKS.md was made: with the dropout of the first five sittings, a still camera, a free view,
    # in the light that is there, forwards in time.
    model=dataclasses.replace(shipped.model, width=0.125, lstm_hidden=64, lstm_dropout=0.1),
    data=dataclasses.replace(
        shipped.data,
        worlds=240,
        world_frames=60,
        validation_worlds=24,
        reverse=0.0,
        photometric=0.0,
        overexposed=0.0,
        overlaid=0.0,
        sway=0.0,
    ),
    training=dataclasses.replace(shipped.training, epochs=4, steps_per_epoch=300),
)
