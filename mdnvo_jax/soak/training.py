"""A training of seconds, in a process of its own, that every part of the loop takes part in."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mdnvo_jax.training import checkpoint, checksum, processes
from mdnvo_jax.training.store import any_step

CONFIG = """
from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig, TrainingConfig
config = Config(
    image=ImageConfig(height=32, width=64, channels=1),
    model=ModelConfig(width=1 / 16, lstm_hidden=8, lstm_layers=1, components=2),
    data=DataConfig(
        root={root!r}, camera_folder="image_0", train_sequences=("00",), validation_tail=0.2,
        window=3, shortest_window=2, mirror=0.5, reverse=0.2, photometric=0.5,
    ),
    training=TrainingConfig(batch_size=4, epochs={epochs}, plateau_patience=0, plateau_threshold=10.0),
)
"""
# Longer than any of these trainings takes on any machine: what takes longer hangs.
TIMEOUT_S = 300


def write_drive(folder: Path, epochs: int = 6) -> Path:
    """Write 60 frames of noise in KITTI's layout and the config of a training on them; return the config's path.

    48 frames train: 45 windows of three steps, 11 batches of four in an epoch. The plateau's threshold asks for more
    than any epoch improves by.
    """
    generator = np.random.default_rng(0)
    images = folder / "sequences" / "00" / "image_0"
    images.mkdir(parents=True)
    (folder / "poses").mkdir()
    (folder / "sequences" / "00" / "calib.txt").write_text("P0: 40 0 31.5 0 0 40 15.5 0 0 0 1 0\n")
    rows = []
    for frame in range(60):
        cv2.imwrite(str(images / f"{frame:06d}.png"), generator.integers(0, 256, (32, 64), dtype=np.uint8))
        rows.append(f"1 0 0 0 0 1 0 0 0 0 1 {frame * (1 + 0.01 * frame):.6f}\n")
    (folder / "poses" / "00.txt").write_text("".join(rows))
    path = folder / "config.py"
    path.write_text(CONFIG.format(root=str(folder), epochs=epochs))
    return path


def start(config: Path, workdir: Path, *options: str) -> subprocess.Popen[str]:
    """Start the training, or go on with it where there is a checkpoint."""
    resume = ["--resume"] if any_step(workdir) else []
    command = [sys.executable, "-m", "mdnvo_jax.train", str(config), "--workdir", str(workdir), *resume, *options]
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def start_together(config: Path, workdir: Path, count: int, *options: str) -> list[subprocess.Popen[str]]:
    """Start the training by `count` processes that meet over loopback, or go on with it; one is not told of others."""
    if count == 1:
        return [start(config, workdir, *options)]
    together = ["--coordinator", processes.loopback(), "--processes", str(count)]
    return [start(config, workdir, *together, "--process", str(number), *options) for number in range(count)]


def result(workdir: Path) -> dict[str, Any]:
    """Return what a training ended with: the checksums of everything in its last checkpoint, and its rows.

    Raises:
      ChecksumError: the checkpoint is not what was saved.
    """
    step = workdir / checkpoint.FOLDER / str(checkpoint.steps_in(workdir / checkpoint.FOLDER)[0])
    checksums = json.loads((step / "about" / "metadata").read_text())["checksums"]
    for item in ("model", "training"):
        checksum.check_stored(step / item, checksums[item])
    return {"step": step.name, "checksums": checksums, "rows": (workdir / "metrics.csv").read_text()}
