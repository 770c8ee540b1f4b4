"""The network whose weights ship with the package: trained on rendered drives alone.

    bin/prepare_kitti --dataset synthetic --config configs/pretrained.py --output CACHE
    python -m mdnvo_jax.train configs/pretrained.py --workdir runs/pretrained --data.cache CACHE
    python -m mdnvo_jax.evaluate recalibrate --checkpoint runs/pretrained --widen-only

Frames of any camera with known intrinsics are brought to one virtual camera: 82 degrees across, as KITTI's, without the
upper third of the sky. What each choice is worth at a small budget is in BENCHMARKS.md (`bin/ablate` on
`configs/ablation.py`). The weights that ship had fourteen sittings, each from the one before, which `bin/ship_weights`
had put into a copy of the repository: this file with `--model.width 0.25 --model.lstm_hidden 128` from scratch on 2,000
worlds, and thirteen times

    python -m mdnvo_jax.train configs/pretrained.py --workdir runs/next --data.cache CACHE \\
        --training.initial_weights shipped --training.learning_rate 5e-4 --training.epochs 22

(or 5 to 25 epochs) on worlds that came ever closer to real roads, with a camera that swayed from the third on, panned
as well from the fourth, looked aside in the ninth and up, down and aslant in the tenth, without dropout from the sixth,
overexposed from the eighth; the last five with the plain NLL (`--training.beta 0`): a training that begins with it
turns worse. What moves with the camera and windows played backwards came in the eleventh, noise in the twelfth. In the
thirteenth the network grew to the width below, in which the fourteenth went on. BENCHMARKS.md says which were which.
"""

from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig, TrainingConfig

config = Config(
    image=ImageConfig(
        height=48,
        width=192,
        channels=1,
        normalisation="local_contrast",
        # The ground plane gives the scale, and its near part the most of it: KITTI's last row is kept, the sky is not.
        camera=(111.2, 111.2, 95.5, 18.5),
    ),
    model=ModelConfig(
        width=0.375,
        conv_dropout=0.0,
        batch_norm_momentum=0.99,
        lstm_hidden=192,
        lstm_layers=1,
        lstm_dropout=0.0,
        components=3,
        mirrored=True,
        flow_weight=0.5,
    ),
    data=DataConfig(
        dataset="synthetic",
        worlds=5600,
        world_frames=100,
        validation_worlds=80,
        window=12,
        hop=3,
        reverse=0.05,
        mirror=0.5,
        photometric=0.5,
        narrow=0.3,
        overexposed=0.3,
        overlaid=0.12,
        sway=0.5,
        camera_height_m=1.65,
        camera_height_shares=(0.75, 1.3),
    ),
    training=TrainingConfig(
        batch_size=8,
        epochs=24,
        steps_per_epoch=450,
        schedule="cosine",
        weight_decay=1e-2,
        gradient_clip=1.0,
        reduction="mean",
        beta=0.5,
    ),
)
