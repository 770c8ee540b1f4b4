"""A sigma scale: fitted on the validation split alone, kept with the weights, applied by whatever predicts."""

import dataclasses
import importlib
import json
import shutil

import cv2
import numpy as np
import pytest

from mdnvo_jax import evaluate as command
from mdnvo_jax import geometry, odometry, predictor, recalibration
from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig
from mdnvo_jax.errors import InputError, exit_code
from mdnvo_jax.evaluation import recalibrate
from mdnvo_jax.mixture import Mixture, widen
from mdnvo_jax.model.head import Labels
from mdnvo_jax.model.network import build
from mdnvo_jax.recalibration import SigmaScale
from mdnvo_jax.training import checkpoint
from mdnvo_jax.training.state import initial_state, initial_variables, state_template
from mdnvo_jax.training.store import Store

CONFIG = Config(
    image=ImageConfig(height=32, width=64, channels=1),
    model=ModelConfig(width=1 / 16, lstm_hidden=4, lstm_layers=1, components=2),
    data=DataConfig(window=3, camera_folder="image_0", train_sequences=("00", "01"), validation_tail=0.4),
)
LABELS = Labels(np.array([0, 0, 1, 0, 0.01, 0]), np.array([0.02, 0.02, 0.5, 0.005, 0.02, 0.005]))
SCALE = np.array([0.5, 1, 2, 3, 4, 5])
RHO = np.array([0.9, 0.6, 0.1, 0.2, 0.3, 0.2])


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Three drives of 20 frames in KITTI's layout; 06 is for tests, and goes another way."""
    folder = tmp_path_factory.mktemp("kitti")
    (folder / "poses").mkdir()
    for name, step_m in (("00", 1.1), ("01", 1.1), ("06", 9.0)):
        images = folder / "sequences" / name / "image_0"
        images.mkdir(parents=True)
        (images.parent / "calib.txt").write_text("P0: 40 0 31.5 0 0 40 15.5 0 0 0 1 0\n")
        for frame in range(20):
            noise = np.random.default_rng(frame).integers(0, 256, (32, 64), dtype=np.uint8)
            cv2.imwrite(str(images / f"{frame:06d}.png"), noise)
        rows = "".join(f"1 0 0 {0.01 * (-1) ** t} 0 1 0 0 0 0 1 {step_m * t}\n" for t in range(20))
        (folder / "poses" / f"{name}.txt").write_text(rows)
    return folder


@pytest.fixture(scope="module")
def saved(root, tmp_path_factory):
    """An untrained model, saved as a training on 00 and 01 would."""
    folder = tmp_path_factory.mktemp("run")
    config = dataclasses.replace(CONFIG, data=dataclasses.replace(CONFIG.data, root=str(root)))
    state = initial_state(initial_variables(build(CONFIG.image, CONFIG.model), CONFIG), CONFIG, LABELS)
    store = Store(folder, keep_latest=1)
    store.save(state, {}, config, 1.0)
    store.close()
    return folder


@pytest.fixture
def workdir(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "run")


def run(*arguments):
    return exit_code(command.main, ["recalibrate", *(str(argument) for argument in arguments)])


def some_scale():
    about = {"split": "validation split of the training", "sequences": ["00"]}
    return SigmaScale(
        SCALE, 10, 1.0, 0.5, about, scale_sigma=0.06, correlation=RHO, serial_correlation=RHO / 2, drives=3
    )


def test_a_mixture_too_sure_by_two_is_widened_by_two():
    rng = np.random.default_rng(0)
    centres = np.array([-1.0, 1.0])[:, None] * np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.01])
    density = Mixture(
        np.zeros((3000, 2)), np.tile(centres, (3000, 1, 1)), np.full((3000, 2, 6), np.log(0.5 * centres[1]))
    )
    # Of either mode, then twice as far from the mean as the density says.
    drawn = centres[rng.integers(2, size=(3000, 6)), np.arange(6)] + 0.5 * centres[1] * rng.standard_normal((3000, 6))
    parts = [(Mixture(*(leaf[rows] for leaf in density)), 2 * drawn[rows]) for rows in (slice(1000), slice(1000, None))]
    found, table = recalibrate.fit(parts, "independent", {"sequences": ["a", "b"]})
    np.testing.assert_allclose(found.scale, 2, rtol=0.03)
    assert found.steps == 3000
    assert found.nll_after < found.nll_before - 1
    row = table.rows[0]
    assert row["after_0"].value == pytest.approx(68.27, abs=3)
    assert row["before_0"].value < 60


def drives_too_sure_by_three(errors, steps):
    """Predictions of drives with these errors of scale, 3 * 0.1 m a step beside it; they claim 0.1 m."""
    rng = np.random.default_rng(4)
    sigma = np.array([0.02, 0.02, 0.1, 0.01, 0.01, 0.01])
    for error in errors:
        mean = np.tile([0, 0, 1, 0, 0.01, 0.0], (steps, 1)) + sigma * rng.standard_normal((steps, 6))
        truth = mean + 3 * sigma * rng.standard_normal((steps, 6))
        truth[:, :3] += error * mean[:, :3]
        yield Mixture(np.zeros((steps, 1)), mean[:, None], np.tile(np.log(sigma), (steps, 1, 1))), truth


def test_sigmas_that_are_too_wide_may_be_left_so():
    """Half of the components too sure by two, half too wide by two: the former are mended, the latter said."""
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(4000, 6)) * np.array([2, 2, 2, 0.5, 0.5, 0.5])
    density = Mixture(np.zeros((4000, 1)), np.zeros((4000, 1, 6)), np.zeros((4000, 1, 6)))
    found, table = recalibrate.fit([(density, truth)], "joint", {"sequences": ["a"]}, widen_only=True)
    np.testing.assert_allclose(found.scale[:3], 2, rtol=0.04)
    np.testing.assert_array_equal(found.scale[3:], 1)
    np.testing.assert_allclose(found.fitted_on["fitted_scale"], [2, 2, 2, 0.5, 0.5, 0.5], rtol=0.04)
    (note,) = [line for line in table.notes if "left so" in line]
    assert "rx 0.5" in note and "rz 0.5" in note and "tx" not in note
    plain, table = recalibrate.fit([(density, truth)], "joint", {"sequences": ["a"]})
    np.testing.assert_array_equal(plain.scale, plain.fitted_on["fitted_scale"])
    assert not any("left so" in line for line in table.notes)


def test_errors_of_steps_do_not_pass_for_errors_of_scale():
    names = {"sequences": [f"{i:02d}" for i in range(60)]}
    found, _ = recalibrate.fit(list(drives_too_sure_by_three(np.zeros(60), 25)), "joint", names)
    # Judged by what the drives claim, their 0.06 would be sqrt(0.06^2 - 0.02^2) too much.
    assert np.std(found.fitted_on["scale_errors"]) == pytest.approx(0.06, rel=0.3)
    assert found.scale_sigma < 0.03


def test_the_error_of_scale_that_drives_share_is_found():
    errors = 0.08 * np.random.default_rng(5).standard_normal(40)
    parts = list(drives_too_sure_by_three(errors, 400))
    found, table = recalibrate.fit(parts, "joint", {"sequences": [f"{i:02d}" for i in range(40)]})
    np.testing.assert_allclose(found.scale, 3, rtol=0.1)
    # Each is known to 3 * 0.1 / sqrt(400) of a metre a metre.
    np.testing.assert_allclose(found.fitted_on["scale_errors"], errors, atol=4 * 0.015)
    assert found.scale_sigma == pytest.approx(np.sqrt(np.mean(errors**2)), rel=0.1)
    assert found.drives == 40
    assert f"{100 * found.scale_sigma:.1f} % (1 sigma" in " ".join(table.notes)
    assert "40 drives are few" not in " ".join(table.notes)
    few = recalibrate.fit(parts[:3], "joint", {"sequences": ["a", "b", "c"]})[1]
    assert "3 drives are few: it is known to some 41 %" in " ".join(few.notes)


def test_the_correlation_of_steps_is_found_beside_the_error_of_scale():
    rng = np.random.default_rng(6)
    sigma, rho = np.array([0.02, 0.02, 0.1, 0.001, 0.001, 0.001]), np.array([0.8, 0.3, 0.0, 0.0, 0.5, 0.1])
    parts = []
    for _ in range(80):
        mean = np.tile([0, 0, 1.5, 0, 0.01, 0.0], (100, 1))
        error = np.sqrt(rho) * rng.standard_normal(6) + np.sqrt(1 - rho) * rng.standard_normal((100, 6))
        truth = mean + sigma * error
        truth[:, 2] += 0.06 * rng.standard_normal() * 1.5
        parts.append((Mixture(np.zeros((100, 1)), mean[:, None], np.tile(np.log(sigma), (100, 1, 1))), truth))
    names = {"sequences": [str(number) for number in range(80)]}
    found, table = recalibrate.fit(parts, "joint", names)
    np.testing.assert_allclose(np.delete(found.correlation, 2), np.delete(rho, 2), atol=0.12)
    # What lasts in the direction of motion is called scale, and once.
    assert found.correlation[2] < 0.01
    assert found.scale_sigma == pytest.approx(0.06, rel=0.25)
    assert table.rows[0]["correlation"].value == found.correlation[0]
    # Neighbours are no more alike than any two.
    assert found.serial_correlation.max() < 0.2
    # The covariance of the end then holds what the drives were off by.
    nees = {"independent": [], "together": []}
    for density, truth in parts:
        for name, more in (
            ("independent", {}), ("together", {"scale_sigma": found.scale_sigma, "correlation": found.correlation}),
        ):  # fmt: skip
            path = odometry.trajectory(widen(density, found.scale), coupling="joint", **more)
            end = geometry.accumulate(geometry.step_to_matrix(truth))[-1]
            error = geometry.log_se3(geometry.inverse(path.poses[-1]) @ end)
            nees[name].append(error @ np.linalg.solve(path.covariance[-1], error))
    assert np.mean(nees["independent"]) > 50
    assert np.mean(nees["together"]) == pytest.approx(6, rel=0.3)


def test_the_command_fits_on_the_validation_split_alone(workdir, root, tmp_path, capsys):
    assert run("--checkpoint", workdir) == 0
    assert "14 steps" in capsys.readouterr().out
    stored = json.loads((checkpoint.locate(workdir) / "sigma_scale.json").read_text())
    assert stored["fitted_on"]["split"] == "validation split of the training"
    # Tails of 40 %: the last 8 of 20 frames, 7 steps, of each.
    assert stored["fitted_on"]["sequences"] == ["00", "01"]
    config = checkpoint.read_config(checkpoint.locate(workdir))
    tails = recalibrate.validation_sequences(config, root=None, cache=None)
    assert stored["steps"] == sum(sequence.count - 1 for sequence in tails)
    assert stored["nll_after"] < stored["nll_before"]
    # An untrained model is wrong by much the same on both.
    assert stored["drives"] == 2
    assert stored["scale_sigma"] > 0
    # A second time it has to be asked for, and the first factors do not enter.
    assert run("--checkpoint", workdir) == 2
    assert "--force" in capsys.readouterr().err
    assert run("--checkpoint", workdir, "--force") == 0
    again = json.loads((checkpoint.locate(workdir) / "sigma_scale.json").read_text())
    assert again["scale"] == stored["scale"]


def test_no_sequence_can_be_named(workdir, capsys):
    assert run("--checkpoint", workdir, "--sequences", "06") == 2
    assert "--sequences" in capsys.readouterr().err


def test_data_that_moved_is_found_by_root(workdir, root, tmp_path, capsys):
    shutil.copytree(root, tmp_path / "moved")
    config = checkpoint.read_config(checkpoint.locate(workdir))
    lost = dataclasses.replace(config, data=dataclasses.replace(config.data, root="gone", cache="gone as well"))
    found = recalibrate.validation_sequences(lost, root=str(tmp_path / "moved"), cache=None)
    assert {sequence.name for sequence in found} == {"00", "01"}
    with pytest.raises(InputError, match="gone"):
        recalibrate.validation_sequences(lost, root=None, cache=None)


def test_the_stride_is_that_of_the_validation(workdir):
    config = checkpoint.read_config(checkpoint.locate(workdir))
    whole = recalibrate.validation_sequences(config, root=None, cache=None)[0]
    thrice = dataclasses.replace(config, data=dataclasses.replace(config.data, strides=(3, 1)))
    strided = recalibrate.validation_sequences(thrice, root=None, cache=None)[0]
    assert strided.count == -(-whole.count // 3)
    np.testing.assert_array_equal(strided.poses, whole.poses[::3])
    np.testing.assert_array_equal(strided.read(1), whole.read(3))
    np.testing.assert_allclose(strided.steps()[0], whole.steps(3)[0])


@pytest.mark.parametrize("mode", ["offline", "streaming"])
def test_every_sigma_is_multiplied_and_nothing_else(workdir, root, mode):
    frames = str(root / "sequences" / "06" / "image_0")
    before = predictor.predict(predictor.load(workdir), frames, mode=mode)
    assert before.about["sigma_scale"] == "none"
    recalibration.write(checkpoint.locate(workdir), some_scale())
    after = predictor.predict(predictor.load(workdir), frames, mode=mode)
    np.testing.assert_allclose(after.sigma, SCALE * before.sigma, rtol=2e-5)
    np.testing.assert_allclose(after.steps, before.steps, atol=2e-6)
    assert after.about["sigma_scale"] == SCALE.tolist()
    assert (before.scale_sigma, after.scale_sigma) == (0, 0.06)
    # Of poses it is the scale's error that is added to those of the steps; one who knows better may say so.
    own = predictor.predict(predictor.load(workdir), frames, mode=mode, scale_sigma=0.0)
    added = after.covariance - own.covariance
    np.testing.assert_allclose(added, geometry.scale_covariance(after.poses, 0.06), atol=1e-9)
    again = odometry.trajectory(
        after.mixture, coupling=after.coupling, scale_sigma=0.06, correlation=RHO, serial_correlation=RHO / 2
    )
    np.testing.assert_allclose(after.covariance, again.covariance, rtol=1e-9)
    np.testing.assert_array_equal((before.correlation, after.correlation), (np.zeros(6), RHO))
    # The density has the same shape: its components are as many sigmas from the mean as they were.
    offsets = [(path.mixture.mean - path.steps[:, None]) / path.sigma[:, None] for path in (before, after)]
    np.testing.assert_allclose(offsets[1], offsets[0], atol=1e-4)
    without = predictor.load(workdir, recalibrated=False)
    assert without.sigma_scale is None and without.correlation is None and without.scale_sigma == 0


def test_an_impossible_error_of_scale_is_refused_before_the_work(workdir, root):
    frames = str(root / "sequences" / "06" / "image_0")
    never = predictor.load(workdir)._replace(features=None)
    with pytest.raises(InputError, match="expected a share"):
        predictor.predict(never, frames, scale_sigma=-1)


def test_predict_can_do_without(workdir, root, tmp_path, monkeypatch):
    for picture in ("trajectory", "uncertainty"):
        monkeypatch.setattr(f"mdnvo_jax.evaluation.plots.plot_{picture}", lambda *_: None)
    recalibration.write(checkpoint.locate(workdir), some_scale())
    # The package's own name `predict` is the function.
    command = importlib.import_module("mdnvo_jax.predict")
    given = [root / "sequences" / "06" / "image_0", "--checkpoint", workdir, "--output", tmp_path / "out"]
    assert exit_code(command.main, [*map(str, given), "--no-recalibration"]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["sigma_scale"], summary["scale_sigma"]) == ("none", 0)
    assert exit_code(command.main, [*map(str, given), "--force", "--scale-sigma", "0.11"]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["sigma_scale"], summary["scale_sigma"]) == (SCALE.tolist(), 0.11)


def test_the_training_goes_on_beside_the_file(workdir):
    recalibration.write(checkpoint.locate(workdir), some_scale())
    store = Store(workdir, keep_latest=1)
    restored = store.restore(checkpoint.abstract(state_template(build(CONFIG.image, CONFIG.model), CONFIG)))
    # A better checkpoint takes the place of the old one, and the factors of the old weights go with them.
    store.save(restored.state._replace(step=restored.state.step + 5), {}, CONFIG, 0.5)
    store.close()
    assert checkpoint.locate(workdir).name == "5"
    assert [path.name for path in (workdir / checkpoint.FOLDER).iterdir() if path.is_dir()] == ["5"]
    assert predictor.load(workdir).sigma_scale is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 9}, "version 9"),
        ({"scale": [1, 2, 3]}, "expected six factors"),
        ({"scale": [1, 1, 1, 1, 1, 0]}, "expected six factors"),
        ({"scale": [1, 1, 1, 1, 1, float("nan")]}, "expected six factors"),
        ({"scale": "two"}, "damaged"),
        ({"steps": None}, "damaged"),
        ({"scale_sigma": -0.1}, "expected 0 or more"),
        ({"scale_sigma": float("nan")}, "expected 0 or more"),
        ({"scale_sigma": None}, "damaged"),
        ({"correlation": [0, 0, 0, 0, 0, 1.5]}, "six numbers from 0 to 1"),
        ({"correlation": [0, 0]}, "six numbers from 0 to 1"),
        ({"serial_correlation": [-0.1, 0, 0, 0, 0, 0]}, "serial_correlation .* six numbers from 0 to 1"),
    ],
)
def test_a_damaged_file_is_named(tmp_path, change, message):
    path = recalibration.write(tmp_path, some_scale())
    stored = json.loads(path.read_text())
    assert recalibration.read(tmp_path).steps == 10
    path.write_text(json.dumps({**stored, **change}))
    with pytest.raises(InputError, match=message):
        recalibration.read(tmp_path)


def test_a_file_of_the_first_version_has_factors_alone(tmp_path):
    path = recalibration.write(tmp_path, some_scale())
    assert (recalibration.read(tmp_path).scale_sigma, recalibration.read(tmp_path).drives) == (0.06, 3)
    stored = json.loads(path.read_text())
    later = ("scale_sigma", "correlation", "serial_correlation", "drives")
    path.write_text(json.dumps({name: stored[name] for name in stored if name not in later} | {"version": 1}))
    found = recalibration.read(tmp_path)
    assert (found.scale_sigma, found.drives, found.scale.tolist()) == (0, 0, SCALE.tolist())
    np.testing.assert_array_equal((found.correlation, found.serial_correlation), np.zeros((2, 6)))


def test_a_file_of_the_second_version_has_no_serial_correlation(tmp_path):
    path = recalibration.write(tmp_path, some_scale())
    np.testing.assert_array_equal(recalibration.read(tmp_path).serial_correlation, RHO / 2)
    stored = json.loads(path.read_text())
    del stored["serial_correlation"]
    path.write_text(json.dumps(stored | {"version": 2}))
    found = recalibration.read(tmp_path)
    np.testing.assert_array_equal((found.correlation, found.serial_correlation), (RHO, np.zeros(6)))


def test_no_step_no_fit():
    with pytest.raises(InputError, match="no step"):
        recalibrate.fit([], "independent", {"sequences": []})
