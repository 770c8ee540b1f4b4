"""A camera at another height above the road: the same frames, another scale, wherever metres come out."""

import dataclasses
import importlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_model import CONFIG, FRAMES, LABELS, trained
from small_model import save as save_model

from mdnvo_jax import export, predictor
from mdnvo_jax.config import Config
from mdnvo_jax.errors import InputError, exit_code
from mdnvo_jax.training import checkpoint

HEIGHT_M = 1.65
KNOWN = dataclasses.replace(CONFIG, data=dataclasses.replace(CONFIG.data, camera_height_m=HEIGHT_M))
TWICE = np.array([2, 2, 2, 1, 1, 1.0])


def load(config: Config = KNOWN, height_m: float | None = None, **more: object) -> predictor.Predictor:
    return predictor.from_model(trained(), config, source="memory", camera_height_m=height_m, **more)


@pytest.fixture(scope="module")
def usual() -> predictor.Predictor:
    return load()


@pytest.fixture(scope="module")
def high() -> predictor.Predictor:
    return load(height_m=2 * HEIGHT_M)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames of which one in the middle cannot be read, and neither can the first."""
    folder = tmp_path_factory.mktemp("frames")
    for index, frame in enumerate(FRAMES[:12]):
        cv2.imwrite(str(folder / f"{index:02d}.png"), frame)
    for index in (0, 6):
        (folder / f"{index:02d}.png").write_bytes(b"no picture")
    return folder


@pytest.mark.parametrize("mode", ["offline", "streaming"])
def test_at_twice_the_height_everything_is_twice_as_far(
    usual: predictor.Predictor, high: predictor.Predictor, folder: Path, mode: str
) -> None:
    low, twice = (predictor.predict(model, folder, mode=mode, bad_frames="hold") for model in (usual, high))
    assert [bool(flag) for flag in low.flags] == [index in (0, 5, 6) for index in range(11)]
    # Two is a power of two: scaled exactly, held steps included.
    np.testing.assert_array_equal(twice.mixture.mean, TWICE * low.mixture.mean)
    np.testing.assert_array_equal(twice.steps, TWICE * low.steps)
    np.testing.assert_allclose(twice.mixture.log_scale, low.mixture.log_scale + np.log(TWICE), atol=1e-6)
    np.testing.assert_allclose(twice.sigma, TWICE * low.sigma, rtol=1e-5)
    np.testing.assert_array_equal(twice.mixture.logits, low.mixture.logits)
    np.testing.assert_allclose(twice.covariance, low.covariance * np.outer(TWICE, TWICE), rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(twice.poses[:, :3, 3], 2 * low.poses[:, :3, 3], rtol=1e-12)
    assert twice.about["camera_height_m"] == 2 * HEIGHT_M
    assert low.about["camera_height_m"] == "not given: 1.65 as in the training"


def test_the_floor_of_sigma_is_scaled_too() -> None:
    # A floor far above what the network says of its sigmas.
    floored = dataclasses.replace(KNOWN, model=dataclasses.replace(KNOWN.model, translation_floor_m=5.0))
    low, twice = (predictor.predict(load(floored, height_m), FRAMES[:6]) for height_m in (None, 2 * HEIGHT_M))
    assert low.sigma[:, :3].min() > 5
    np.testing.assert_allclose(twice.sigma, TWICE * low.sigma, rtol=1e-5)


def test_a_head_that_predicts_no_sigma_is_scaled_too() -> None:
    config = dataclasses.replace(KNOWN, model=dataclasses.replace(KNOWN.model, head="regression"))
    model = trained()
    head = {name: leaf[..., :6] for name, leaf in model.params["head"].items()}
    model = model._replace(params={**model.params, "head": head}, residual_scale=np.full(6, 0.5, np.float32))
    low, twice = (
        predictor.predict(predictor.from_model(model, config, source="memory", camera_height_m=height_m), FRAMES[:6])
        for height_m in (None, 2 * HEIGHT_M)
    )
    np.testing.assert_array_equal(twice.steps, TWICE * low.steps)
    np.testing.assert_allclose(twice.sigma, TWICE * low.sigma, rtol=1e-5)
    np.testing.assert_allclose(low.sigma, np.tile(0.5 * LABELS.std, (5, 1)), rtol=1e-5)


def test_the_height_of_the_training_changes_nothing(usual: predictor.Predictor) -> None:
    same = predictor.predict(load(height_m=HEIGHT_M), FRAMES[:6])
    np.testing.assert_array_equal(same.mixture.mean, predictor.predict(usual, FRAMES[:6]).mixture.mean)
    assert same.about["camera_height_m"] == HEIGHT_M


def test_sigma_factors_and_the_error_of_scale_stay_shares(usual: predictor.Predictor) -> None:
    more = {"sigma_scale": np.linspace(0.5, 2, 6), "scale_sigma": 0.05}
    low, twice = (predictor.predict(load(height_m=height_m, **more), FRAMES[:6]) for height_m in (None, 2 * HEIGHT_M))
    np.testing.assert_allclose(twice.sigma, TWICE * low.sigma, rtol=1e-5)
    np.testing.assert_allclose(twice.covariance, low.covariance * np.outer(TWICE, TWICE), rtol=1e-4, atol=1e-12)


def test_what_is_exported_is_for_that_height(high: predictor.Predictor, tmp_path: Path) -> None:
    export.write(high, tmp_path)
    assert json.loads((tmp_path / "about.json").read_text())["camera_height_m"] == 2 * HEIGHT_M
    with np.load(tmp_path / "weights.npz") as weights:
        np.testing.assert_allclose(weights["labels.std"], TWICE * LABELS.std, rtol=1e-6)


@pytest.mark.parametrize("height_m", [0.0, -1.5, float("nan"), float("inf")])
def test_a_height_that_is_none_is_named(height_m: float) -> None:
    with pytest.raises(InputError, match="expected metres above the road"):
        load(height_m=height_m)


def test_the_command_says_when_the_training_knew_no_height(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The package's own name `predict` is the function.
    command = importlib.import_module("mdnvo_jax.predict")
    given = [str(folder), "--bad-frames", "hold", "--checkpoint", str(save_model(tmp_path / "run"))]
    assert exit_code(command.main, [*given, "--output", str(tmp_path / "out"), "--camera-height", "1.2"]) == 2
    assert "trained without a known one" in capsys.readouterr().err


def test_the_command_scales(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for picture in ("trajectory", "uncertainty"):
        monkeypatch.setattr(f"mdnvo_jax.evaluation.plots.plot_{picture}", lambda *_: None)
    step = checkpoint.locate(save_model(tmp_path / "run", KNOWN))
    command = importlib.import_module("mdnvo_jax.predict")
    given = [str(folder), "--bad-frames", "hold", "--checkpoint", str(step)]
    distances = []
    for number, height in enumerate(([], ["--camera-height", "3.3"])):
        output = tmp_path / f"out{number}"
        assert exit_code(command.main, [*given, "--output", str(output), *height]) == 0
        distances.append(json.loads((output / "summary.json").read_text())["distance_m"])
    assert distances[1] == pytest.approx(2 * distances[0])
