"""What the README's quick start runs: bin/demo with the weights that ship, and the small training beside it."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mdnvo_jax import synthesize
from mdnvo_jax.config import load_config
from mdnvo_jax.data.load import load_split
from mdnvo_jax.data.windows import training_batches

ROOT = Path(__file__).resolve().parents[1]
HAS_WEIGHTS = (ROOT / "mdnvo_jax" / "weights" / "pretrained" / "model").is_dir()


def demo(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run bin/demo in `folder`, with this environment in place of the one that it would make."""
    programs = folder / "demo" / "venv" / "bin"
    if not programs.exists():
        programs.mkdir(parents=True)
        for name, script in (("python", f'exec "{sys.executable}" "$@"'), ("pip", "exit 0")):
            (programs / name).write_text(f"#!/bin/sh\n{script}\n")
            (programs / name).chmod(0o755)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [ROOT / "bin" / "demo", *arguments], cwd=folder, env=environment, capture_output=True, text=True
    )


@pytest.mark.skipif(not HAS_WEIGHTS, reason="no weights are shipped with this checkout")
def test_the_demonstration_shows_a_drive_and_then_one_s_own(tmp_path: Path) -> None:
    done = demo(tmp_path)
    assert done.returncode == 0, done.stderr
    assert "constant predictor" in done.stdout and "NEES" in done.stdout
    named = [line.split()[0] for line in done.stdout.split("Look at")[1].splitlines() if line.startswith("  demo/run/")]
    assert len(named) == 4
    assert all((tmp_path / name).stat().st_size > 1000 for name in named)
    # Frames of one's own, with options of predict; the first result stays.
    given = ("demo/run/drives/sequences/00/image_0", "--camera", "180,180,154.5,46.5", "--stride", "50")
    done = demo(tmp_path, *given)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "demo" / "run-2" / "result" / "summary.json").read_text())
    assert (summary["frames"], summary["camera"]) == (4, "given")
    assert "demo/run-2/result/trajectory.png" in done.stdout


@pytest.mark.skipif(HAS_WEIGHTS, reason="weights are shipped with this checkout")
def test_a_checkout_without_weights_says_so_before_anything_is_made(tmp_path: Path) -> None:
    done = subprocess.run([ROOT / "bin" / "demo"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("error: no weights") and done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_small_training_of_the_readme_finds_its_data(tmp_path: Path) -> None:
    """In the layout that the README's commands make. (Trainings run in tests/training.)"""
    config = load_config(str(ROOT / "configs" / "demo.py"))
    assert config.data.train_sequences == tuple(f"{number:02d}" for number in range(24))
    size = ["--height", str(config.image.height), "--width", str(config.image.width)]
    synthesize.main([str(tmp_path), "--sequences", "2", "--frames", "11", *size, "--samples", "1"])
    data = dataclasses.replace(config.data, root=str(tmp_path), train_sequences=("00", "01"), validation_tail=0.2)
    config = dataclasses.replace(config, data=data, training=dataclasses.replace(config.training, batch_size=2))
    sequences, validation, image = load_split(config)
    assert len(validation) == 2 and image.camera
    batch = next(training_batches(sequences, dataclasses.replace(config, image=image), seed=0))
    assert batch["images"].shape == (2, config.data.window + 1, config.image.height, config.image.width, 1)
