"""The README's own blocks of Python run, one after the other, as a reader would paste them."""

import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig
from mdnvo_jax.model.head import Labels
from mdnvo_jax.model.network import build
from mdnvo_jax.training.state import initial_state, initial_variables
from mdnvo_jax.training.store import Store

README = Path(__file__).resolve().parents[1] / "README.md"


def test_the_blocks_of_the_readme_run(tmp_path: Path) -> None:
    config = Config(
        image=ImageConfig(height=32, width=64, channels=1),
        model=ModelConfig(width=1 / 16, lstm_hidden=8, lstm_layers=1, components=2),
        data=DataConfig(window=4),
    )
    labels = Labels(np.array([0, 0, 1, 0, 0, 0.0]), np.ones(6))
    store = Store(tmp_path / "runs" / "small", keep_latest=1)
    variables = initial_variables(build(config.image, config.model), config)
    store.save(initial_state(variables, config, labels), None, config, 1.0)
    store.close()
    (tmp_path / "my_frames").mkdir()
    for index in range(6):
        cv2.imwrite(str(tmp_path / "my_frames" / f"{index}.png"), np.full((48, 96), 20 * index, np.uint8))

    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    assert len(blocks) == 3
    script = "\n".join(blocks) + "\nassert trajectory.poses.shape == (6, 4, 4) and step.covariance.shape == (6, 6)\n"
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "result_python" / "trajectory_tum.txt").exists()


def test_the_commands_of_the_readme_name_files_that_are_there() -> None:
    text = README.read_text()
    named = set(re.findall(r"(?:configs|bin|docs)/[\w.]+", text)) - {"configs/", "bin/"}
    assert len(named) > 8
    missing = [name for name in sorted(named) if not (README.parent / name).exists()]
    assert not missing
