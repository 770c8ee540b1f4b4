"""Weights that ship: what may, what is left behind, and that whoever has them needs to name no checkpoint."""

import dataclasses
import importlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_model import CONFIG, FRAMES
from small_model import save as save_model

from mdnvo_jax import predictor, recalibration, weights
from mdnvo_jax.config import Config
from mdnvo_jax.errors import InputError, exit_code
from mdnvo_jax.recalibration import SigmaScale
from mdnvo_jax.training import checkpoint
from mdnvo_jax.weights import ship

COMMAND = Path(__file__).resolve().parents[2] / "bin" / "ship_weights"
RENDERED = dataclasses.replace(
    CONFIG,
    data=dataclasses.replace(CONFIG.data, dataset="synthetic", root="/home/somebody", cache="/home/somebody/cache"),
)
FITTED = SigmaScale(np.linspace(0.5, 2, 6), 100, 1.0, 0.5, {"sequences": ["world_1000000"]}, 0.06, np.full(6, 0.2), 8)


def recalibrated(folder: Path, config: Config = RENDERED) -> Path:
    """Save a model as a training and `evaluate recalibrate` leave it, and return the --workdir."""
    workdir = save_model(folder, config)
    command = "/home/somebody/bin/python -m mdnvo_jax.evaluate recalibrate"
    recalibration.write(checkpoint.locate(workdir), FITTED, command=command)
    return workdir


@pytest.fixture(scope="module")
def workdir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recalibrated(tmp_path_factory.mktemp("training"))


@pytest.fixture(scope="module")
def shipped(workdir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("package") / "pretrained"
    assert ship.ship(workdir, target).name == "0"
    return target


@pytest.fixture
def installed(shipped: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the shipped weights, where the package finds it."""
    monkeypatch.setattr(weights.resources, "files", lambda _: shipped.parent)
    return shipped


def test_what_ships_predicts_as_the_training_does(workdir: Path, installed: Path) -> None:
    mine, theirs = (predictor.predict(predictor.load(path), FRAMES[:8]) for path in (None, workdir))
    np.testing.assert_array_equal(mine.mixture.mean, theirs.mixture.mean)
    np.testing.assert_array_equal(mine.covariance, theirs.covariance)
    assert mine.scale_sigma == 0.06 and mine.correlation.tolist() == [0.2] * 6
    assert mine.about["checkpoint"] == str(installed)
    assert weights.config().image == CONFIG.image


def test_the_optimiser_and_the_paths_of_the_trainer_stay_behind(workdir: Path, shipped: Path) -> None:
    assert sorted(path.name for path in shipped.iterdir()) == ["about", "model", "sigma_scale.json"]
    for path in shipped.rglob("*"):
        if path.is_file():
            content = path.read_bytes()
            assert b"/home/somebody" not in content and str(workdir.parent).encode() not in content, path
    config = checkpoint.read_config(shipped)
    assert (config.data.root, config.data.cache) == ("", "")
    assert config == dataclasses.replace(RENDERED, data=dataclasses.replace(RENDERED.data, root="", cache=""))


def test_the_command_replaces_weights_as_a_whole_and_only_when_told(workdir: Path, tmp_path: Path) -> None:
    target = tmp_path / "pretrained"
    arguments = [sys.executable, str(COMMAND), str(workdir), "--output", str(target)]
    target.mkdir()
    (target / "old").write_text("weights")
    refused = subprocess.run(arguments, capture_output=True, text=True)
    assert refused.returncode == 2
    assert "--force" in refused.stderr and refused.stderr.count("\n") == 1
    done = subprocess.run([*arguments, "--force"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "MB" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["pretrained"]
    assert not (target / "old").exists()
    np.testing.assert_array_equal(predictor.load(target).sigma_scale, FITTED.scale)


def with_training(**fields: str) -> Config:
    return dataclasses.replace(RENDERED, training=dataclasses.replace(RENDERED.training, **fields))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (CONFIG, "comes from data.dataset kitti: only weights from rendered drives"),
        (with_training(initial_stack="flownet.npz"), "comes from training.initial_stack flownet.npz"),
        (with_training(initial_weights="runs/kitti"), "comes from training.initial_weights runs/kitti"),
    ],
)
def test_weights_that_other_data_went_into_do_not_ship(config: Config, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        ship.ship(recalibrated(tmp_path / "run", config), tmp_path / "pretrained")
    assert not (tmp_path / "pretrained").exists()


def test_weights_that_go_on_from_shipped_ones_may_ship(tmp_path: Path) -> None:
    ship.ship(recalibrated(tmp_path / "run", with_training(initial_weights="shipped")), tmp_path / "pretrained")
    assert predictor.load(tmp_path / "pretrained").scale_sigma == 0.06


def test_sigmas_that_were_not_recalibrated_do_not_ship(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="run `evaluate recalibrate --checkpoint"):
        ship.ship(save_model(tmp_path / "run", RENDERED), tmp_path / "pretrained")


def test_weights_that_are_too_large_do_not_ship(workdir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert ship.LARGEST_BYTES == 20_000_000
    monkeypatch.setattr(ship, "LARGEST_BYTES", 10_000)
    with pytest.raises(InputError, match=r"lower model\.width"):
        ship.ship(workdir, tmp_path / "pretrained")
    assert not list(tmp_path.glob("pretrained/*"))


def test_a_build_without_weights_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights.resources, "files", lambda _: tmp_path)
    with pytest.raises(InputError, match="no weights are shipped with this build: give --checkpoint"):
        predictor.load()
    (tmp_path / weights.NAME).mkdir()
    with pytest.raises(InputError, match="no weights are shipped"):
        weights.config()


def test_the_commands_need_no_checkpoint(installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for picture in ("trajectory", "uncertainty"):
        monkeypatch.setattr(f"mdnvo_jax.evaluation.plots.plot_{picture}", lambda *_: None)
    (tmp_path / "frames").mkdir()
    for index, frame in enumerate(FRAMES[:6]):
        cv2.imwrite(str(tmp_path / "frames" / f"{index}.png"), frame)
    # The package's own name `predict` is the function.
    command = importlib.import_module("mdnvo_jax.predict")
    assert exit_code(command.main, [str(tmp_path / "frames"), "--output", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["checkpoint"] == str(installed)


@pytest.fixture(scope="module")
def pretrained() -> Path:
    """The weights of this checkout; without them the test is skipped."""
    try:
        return weights.folder()
    except InputError as error:
        pytest.skip(str(error))


def test_the_weights_of_this_checkout_are_small_and_from_rendered_drives(pretrained: Path, tmp_path: Path) -> None:
    assert ship.folder_bytes(pretrained) <= 20_000_000
    # They pass whatever is asked of weights that are to ship.
    ship.ship(pretrained, tmp_path / "again")
    for path in pretrained.rglob("*"):
        if path.is_file():
            assert path.read_bytes() == (tmp_path / "again" / path.relative_to(pretrained)).read_bytes()
    model = predictor.load()
    assert model.sigma_scale is not None and model.scale_sigma > 0
    assert model.config.data.camera_height_m > 0


def test_the_weights_of_this_checkout_see_motion(pretrained: Path) -> None:
    """Not a measurement (BENCHMARKS.md has those): enough to notice weights that were damaged or mixed up."""
    from mdnvo_jax.data import load

    model = predictor.load()
    errors = []
    for sequence in load.synthetic_sequences(range(load.TEST_SEED, load.TEST_SEED + 3), model.config):
        sequence = sequence.subsequence(0, min(sequence.count, 30))
        path, truth = predictor.predict(model, sequence), sequence.steps()
        constant = np.asarray(model.model.labels.mean)
        errors.append([np.square(steps - truth)[:, :3].sum(1).mean() for steps in (path.steps, constant)])
    found, floor = np.sqrt(np.mean(errors, axis=0))
    assert found < 0.7 * floor


def test_a_copy_of_the_shipped_folder_is_a_checkpoint(shipped: Path, tmp_path: Path) -> None:
    shutil.copytree(shipped, tmp_path / "mine")
    assert checkpoint.locate(tmp_path / "mine") == tmp_path / "mine"
    assert predictor.load(tmp_path / "mine").source == str(tmp_path / "mine")
