"""MDN-VO on KITTI, to the letter of the paper where it speaks (its sections IV-A and IV-B).

    bin/convert_flownet flownets_bn_EPE2.459.pth.tar flownet.npz
    bin/prepare_kitti --root KITTI --output CACHE --config configs/mdn_vo_kitti.py
    python -m mdnvo_jax.train configs/mdn_vo_kitti.py --workdir runs/mdn_vo --data.root KITTI --data.cache CACHE \
        --training.initial_stack flownet.npz

The paper: train 00 01 02 04 08 09, test 03 05 06 07 10, left colour camera, about 40 epochs, RPE RMSE 0.14 m. Not run
here: it takes the whole data set and an accelerator.
"""

from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig, TrainingConfig

config = Config(
    image=ImageConfig(height=184, width=608, channels=3, normalisation="flownet"),
    model=ModelConfig(coupling="independent"),
    data=DataConfig(dataset="kitti", camera_folder="image_2", window=6),
    training=TrainingConfig(epochs=40, reduction="sequence"),
)
