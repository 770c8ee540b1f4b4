"""Record PyTorch's plateau schedule for tests/training/test_step.py.

pip install torch==2.13.0
python tests/golden/make_plateau_golden.py > tests/golden/plateau.json
"""

import json

import numpy as np


def case(values: list[float], patience: int, factor: float, threshold: float) -> dict:
    import torch

    optimiser = torch.optim.Adam([torch.zeros(1, requires_grad=True)], lr=1.0)
    scheduler = torch.optim.lr_scheduler.ReduceLROnPlateau(
        optimiser, patience=patience, factor=factor, threshold=threshold, threshold_mode="abs"
    )
    scales = []
    for value in values:
        scheduler.step(value)
        scales.append(round(optimiser.param_groups[0]["lr"], 12))
    return {"patience": patience, "factor": factor, "threshold": threshold, "values": values, "scales": scales}


if __name__ == "__main__":
    walk = [round(float(value), 4) for value in -np.cumsum(np.random.default_rng(0).normal(0.02, 0.5, 60))]
    negative = [-3.0, -3.00005, -3.0002, -3.01, *[-3.005] * 12, -4.0, *[-3.9] * 10]
    print(json.dumps([case([1.0] * 14, 8, 0.7, 1e-4), case(negative, 8, 0.7, 1e-4), case(walk, 2, 0.5, 0.05)]))
