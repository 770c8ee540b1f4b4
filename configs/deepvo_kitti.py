"""DeepVO on KITTI: the regression head on the data, windows and schedule of `mdn_vo_kitti.py` (the paper's rival).

    python -m mdnvo_jax.train configs/deepvo_kitti.py --workdir runs/deepvo --data.root KITTI --data.cache CACHE \
        --training.initial_stack flownet.npz

The paper reports an RPE RMSE of 0.17 m for it, mean over 03 05 06 07 10. Not run here: see `mdn_vo_kitti.py`.
"""

from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig, TrainingConfig

config = Config(
    image=ImageConfig(height=184, width=608, channels=3, normalisation="flownet"),
    model=ModelConfig(head="regression"),
    data=DataConfig(dataset="kitti", camera_folder="image_2", window=6),
    training=TrainingConfig(epochs=40, kappa=100.0),
)
