"""MDN-VO on nuScenes ("Experiments on the nuScenes Dataset", Table II and the last two figures of the paper).

    bin/convert_flownet flownets_bn_EPE2.459.pth.tar flownet.npz
    python -m mdnvo_jax.train configs/mdn_vo_nuscenes.py --workdir runs/mdn_vo_nuscenes --data.root NUSCENES \
        --training.initial_stack flownet.npz

`bin/prepare_kitti --root NUSCENES --output CACHE --config configs/mdn_vo_nuscenes.py` and `--data.cache CACHE` spare
the decoding of JPEG in every epoch.

NUSCENES holds samples/CAM_FRONT, sweeps/CAM_FRONT and v1.0-trainval/ (--data.version v1.0-mini for the ten scenes of
the mini set). The paper defines a split of its own and does not give it; ours is in `mdnvo_jax/data/nuscenes.py`:
scenes 0572, 0768, 0972 and 0999 of the figures and 20 % of the others are for test, night and rain in every part.

The paper: RPE RMSE 0.07 m in daylight, 0.06 m in rain, 0.11 m at night, on test scenes it does not name. Not run here:
it takes the whole data set and an accelerator. The image is 0.28 of nuScenes' 1600x900; the paper's is not given.
"""

from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig, TrainingConfig

config = Config(
    image=ImageConfig(height=252, width=448, channels=3, normalisation="flownet"),
    model=ModelConfig(coupling="independent"),
    data=DataConfig(dataset="nuscenes", train_sequences=(), window=6),
    training=TrainingConfig(epochs=40, reduction="sequence"),
)
