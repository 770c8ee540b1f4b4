"""Try the installed wheel from outside the checkout: `python tests/wheel_smoke.py`, run by bin/test."""

import subprocess
import sys
import tempfile
from pathlib import Path

CONFIG = """
from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig, TrainingConfig
config = Config(
    image=ImageConfig(height=32, width=64, channels=1),
    model=ModelConfig(width=1 / 32, lstm_hidden=4, lstm_layers=1),
    data=DataConfig(dataset="synthetic", worlds=1, world_frames=12, validation_worlds=1, window=3),
    training=TrainingConfig(batch_size=2, epochs=1, steps_per_epoch=2),
)
"""


def main() -> None:
    import mdnvo_jax

    checkout = Path(__file__).resolve().parents[1]
    installed = Path(mdnvo_jax.__file__).parent
    assert not installed.is_relative_to(checkout), f"{mdnvo_jax.__file__} is not the installed wheel"
    shipped = weights_in(checkout / "mdnvo_jax")
    assert weights_in(installed) == shipped, "the wheel holds other weights than the checkout"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "config.py").write_text(CONFIG)

        def run(module: str, *arguments: str) -> None:
            command = [sys.executable, "-W", "error::DeprecationWarning:mdnvo_jax", "-m", f"mdnvo_jax.{module}"]
            subprocess.run([*command, *arguments], cwd=folder, check=True, stdout=subprocess.DEVNULL)

        run(
            "synthesize",
            "drives",
            "--sequences",
            "1",
            "--frames",
            "12",
            "--seed",
            "1",
            "--height",
            "32",
            "--width",
            "64",
        )
        run("train", "config.py", "--workdir", "train")
        run("predict", "drives/sequences/00", "--checkpoint", "train", "--output", "result")
        run("evaluate", "trajectory", "result", "--reference", "drives/poses/00.txt", "--output", "evaluation")
        assert len((folder / "result" / "trajectory_kitti.txt").read_text().splitlines()) == 12
        if shipped:
            run("predict", "drives/sequences/00", "--output", "shipped")
            assert len((folder / "shipped" / "trajectory_kitti.txt").read_text().splitlines()) == 12
    with_weights = "and predicted with its own weights" if shipped else "(no weights ship with it)"
    print(f"wheel: installed, trained, predicted and evaluated outside the checkout {with_weights}")


def weights_in(package: Path) -> dict[str, bytes]:
    """Return the files of the shipped weights by name."""
    folder = package / "weights" / "pretrained"
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


if __name__ == "__main__":
    main()
