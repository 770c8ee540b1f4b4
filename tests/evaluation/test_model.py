"""A model judged on sequences: from a checkpoint and frames to tables and pictures."""

import argparse
import json

import cv2
import numpy as np
import pytest

from mdnvo_jax import evaluate as command
from mdnvo_jax import geometry, odometry
from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig
from mdnvo_jax.data import synthetic
from mdnvo_jax.errors import exit_code
from mdnvo_jax.evaluation import model
from mdnvo_jax.evaluation.compare import MeanStep
from mdnvo_jax.mixture import Mixture
from mdnvo_jax.model.head import Labels
from mdnvo_jax.model.network import build
from mdnvo_jax.training.state import initial_state, initial_variables
from mdnvo_jax.training.store import Store

CONFIG = Config(
    image=ImageConfig(height=32, width=64, channels=1),
    model=ModelConfig(width=1 / 16, lstm_hidden=4, lstm_layers=1, components=2),
    data=DataConfig(window=3, camera_folder="image_0"),
)
LABELS = Labels(np.array([0, 0, 1, 0, 0.01, 0]), np.array([0.02, 0.02, 0.5, 0.005, 0.02, 0.005]))
MEAN_STEP = MeanStep(np.array([0, 0, 1, 0, 0, 0.0]), np.array([0.1] * 3 + [0.01] * 3), "training")


def prediction(name, steps, sigma, seed):
    """A drive whose steps are predicted with exactly the sigma they have."""
    rng = np.random.default_rng(seed)
    truth = np.tile([0.0, 0, 1, 0, 0.01, 0], (steps, 1))
    truth[:, 2] += 0.3 * np.sin(np.arange(steps) / 20)
    scale = np.tile([sigma] * 3 + [sigma / 50] * 3, (steps, 1))
    mean = truth + scale * rng.standard_normal((steps, 6))
    matrices = geometry.step_to_matrix(mean)
    path = odometry.Trajectory(
        poses=geometry.accumulate(matrices),
        covariance=np.zeros((steps + 1, 6, 6)),
        steps=mean,
        step_covariance=scale[:, :, None] ** 2 * np.eye(6),
        timestamps=np.arange(steps + 1.0),
        flags=[""] * steps,
        mixture=Mixture(np.zeros((steps, 1)), mean[:, None], np.log(scale)[:, None]),
        coupling="independent",
    )
    return model.Predicted(name, path, geometry.accumulate(geometry.step_to_matrix(truth)))


def test_each_sequence_and_all_of_them_have_rows_for_both_methods():
    items = [prediction(name, steps, 0.02, seed) for seed, (name, steps) in enumerate([("03", 150), ("a/05", 90)])]
    found = model.evaluate("model", items, MEAN_STEP, block=10)
    errors, calibration, drifts, means = found.tables
    named = [(row["name"], row["split"]) for row in errors.rows]
    assert named == [(name, split) for split in ("03", "a/05", "all") for name in ("model", "constant predictor")]
    assert [(row["name"], row["split"]) for row in calibration.rows] == named
    assert errors.rows[4]["frames"] == "242 of 242" and calibration.rows[4]["frames"] == "242 of 242"
    assert errors.rows[4]["rmse"].value == pytest.approx(0.02 * np.sqrt(3), rel=0.15)
    assert [(row["name"], row["split"]) for row in drifts.rows] == named[:4]
    # Each sequence counts the same in the means, whatever its length.
    assert means.rows[0]["sequences"] == "03 a/05" and means.rows[0]["frames"] == "151 91"
    for key in ("rmse", "rotation"):
        assert means.rows[0][key].value == pytest.approx((errors.rows[0][key].value + errors.rows[2][key].value) / 2)
    biases = [abs(row["bias"].value) for row in drifts.rows]
    assert means.rows[0]["bias"].value == pytest.approx(max(biases[0], biases[2]))
    inside = [
        [[share.value for share in found.results["calibration"][row]["coverage"]["3 sigma"].values()] for row in rows]
        for rows in ((0, 2), (1, 3))
    ]
    for row, values in zip(means.rows, inside, strict=True):
        assert row["inside"].value == pytest.approx(100 * np.mean(values, axis=0).min())
    assert found.results["calibration"][4]["steps"] == 240
    assert calibration.rows[4]["nees"].value == pytest.approx(6, abs=0.8)
    assert calibration.rows[4]["nll"].value < calibration.rows[5]["nll"].value
    assert errors.rows[4]["gain"].high < 0
    assert [picture.file for picture in found.pictures] == ["trajectory-03.png", "trajectory-a_05.png"]
    assert len(found.uncertainty) == 2 and len(found.calibration[0].scores.nll) == 240


def test_one_sequence_needs_no_row_over_all():
    found = model.evaluate("model", [prediction("03", 40, 0.02, 0)], MEAN_STEP, block=10)
    assert [row["split"] for row in found.tables[0].rows] == ["03", "03"]
    assert [row["split"] for row in found.tables[1].rows] == ["03", "03"]


def test_a_noisy_reference_is_judged_as_one():
    """Right sigmas hold too few of the steps that a noisy reference gives, and the right number once that is known."""
    item = prediction("03", 400, 0.02, 0)
    noise = np.array([0.04, 0.0, 0.0, 0.0, 0.0008, 0.0])
    rng = np.random.default_rng(1)
    noisy = geometry.matrix_to_step(geometry.relative_steps(item.truth)) + noise * rng.standard_normal((400, 6))
    item = model.Predicted("03", item.trajectory, geometry.accumulate(geometry.step_to_matrix(noisy)))
    plain, told = (
        model.evaluate("model", [item], MEAN_STEP, block=10, reference_sigma=sigma) for sigma in (None, noise)
    )
    inside = [
        {name: share.value for name, share in found.results["calibration"][0]["coverage"]["1 sigma"].items()}
        for found in (plain, told)
    ]
    for component in ("tx", "ry"):
        assert inside[0][component] < 0.45 and inside[1][component] == pytest.approx(0.683, abs=0.08)
    for component in ("ty", "tz", "rx", "rz"):
        assert inside[0][component] == inside[1][component]
    assert plain.tables[1].rows[0]["nees"].value > 8
    assert told.tables[1].rows[0]["nees"].value == pytest.approx(6, abs=0.6)
    # Poses and their drift are what they were.
    for table in (0, 2):
        assert str(told.tables[table].rows) == str(plain.tables[table].rows)


@pytest.fixture(scope="module")
def workdir(tmp_path_factory):
    """An untrained model, saved as a training would."""
    folder = tmp_path_factory.mktemp("model")
    state = initial_state(initial_variables(build(CONFIG.image, CONFIG.model), CONFIG), CONFIG, LABELS)
    store = Store(folder, keep_latest=1)
    store.save(state, None, CONFIG, 1.0)
    store.close()
    return folder


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two drives in KITTI's layout, one of them without poses."""
    folder = tmp_path_factory.mktemp("kitti")
    (folder / "poses").mkdir()
    for name in ("06", "11"):
        images = folder / "sequences" / name / "image_0"
        images.mkdir(parents=True)
        (folder / "sequences" / name / "calib.txt").write_text("P0: 40 0 31.5 0 0 40 15.5 0 0 0 1 0\n")
        for frame in range(8):
            noise = np.random.default_rng(frame).integers(0, 256, (32, 64), dtype=np.uint8)
            cv2.imwrite(str(images / f"{frame:06d}.png"), noise)
    (folder / "poses" / "06.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {1.1 * frame}\n" for frame in range(8)))
    return folder


def run(*arguments):
    return exit_code(command.main, ["model", *(str(argument) for argument in arguments)])


def test_a_checkpoint_on_kitti(workdir, root, tmp_path, capsys):
    output = tmp_path / "out"
    assert run("--root", root, "--sequences", "06", "--checkpoint", workdir, "--output", output) == 0
    assert "model (offline, mean)" in capsys.readouterr().out
    results = json.loads((output / "results.json").read_text(encoding="utf-8"))
    constant = results["results"]["paths"][1]
    assert constant["name"] == "constant predictor"
    # The training's mean step is 1 m ahead with 0.01 rad of yaw, the truth 1.1 m.
    assert constant["rpe_translation_m"]["mean"]["value"] == pytest.approx(0.1, abs=1e-6)
    assert constant["rpe_rotation_deg"]["mean"]["value"] == pytest.approx(np.rad2deg(0.01), rel=1e-4)
    assert any("mean step of the training split" in note for note in results["tables"][0]["notes"])
    pictures = ("trajectory-06", "uncertainty-06", "sigma_error", "reliability", "sparsification", "pit")
    assert {path.name for path in output.iterdir()} == {
        "table.md",
        "report.html",
        "results.json",
        *(f"{p}.png" for p in pictures),
    }


def test_a_camera_that_sways_has_other_poses_to_find(workdir, root, tmp_path):
    def rotation_deg(*options):
        output = tmp_path / f"out{len(options)}"
        assert run("--root", root, "--sequences", "06", "--checkpoint", workdir, "--output", output, *options) == 0
        paths = json.loads((output / "results.json").read_text(encoding="utf-8"))["results"]["paths"]
        assert ("swaying camera" in paths[0]["name"]) == bool(options)
        return paths[1]["rpe_rotation_deg"]["mean"]["value"]

    # Some 0.3 degrees about each axis, which the constant predictor cannot know, on top of the 0.57 that it turns.
    assert 0.03 < rotation_deg("--sway") - rotation_deg() < 1


def test_the_noise_of_the_reference_is_given_in_metres_and_degrees(workdir, root, tmp_path):
    sigma = ["0.01", "0", "0", "0.041", "0.03", "0.05"]
    given = ("--root", root, "--sequences", "06", "--checkpoint", workdir, "--output", tmp_path / "out")
    assert run(*given, "--reference-sigma", *sigma) == 0
    tables = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))["tables"]
    noted = {table["title"]: any("0.01 0 0 m and 0.041 0.03 0.05 deg" in n for n in table["notes"]) for table in tables}
    assert noted["Calibration of the predicted steps"] and noted["Calibration by component"]
    assert sum(noted.values()) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sequences", "06"], "--root is missing: give the folder of KITTI"),
        (["--dataset", "nuscenes", "--sequences", "scene-0001"], "--root is missing: give the folder of nuScenes"),
        (["--dataset", "nuscenes", "--sequences", "scene-0001", "--root", "{root}", "--nuscenes-version", "v1"], "v1"),
        (["--dataset", "synthetic", "--sequences", "first"], "--sequences first: expected seeds"),
        (["--root", "{root}", "--sequences", "06", "--other-lenses"], "--other-lenses is for --dataset synthetic"),
        (["--root", "{root}", "--sequences", "11"], "no poses at"),
        (["--root", "{root}", "--sequences", "99"], "no sequence 99"),
        (["--root", "{root}", "--sequences", "06", "--block", "0"], "--block is 0"),
        (
            ["--reference-sigma", *["1", "0", "0", "0", "0", "-1"], "--sequences", "06"],
            "expected six numbers of 0 or more",
        ),
        (["--root", "{root}", "--sequences", "06", "--checkpoint", "absent"], "absent"),
    ],
)
def test_mistakes(workdir, root, tmp_path, capsys, arguments, message):
    given = [argument.format(root=root) for argument in arguments]
    assert run("--checkpoint", workdir, "--output", tmp_path / "out", *given) == 2
    complaint = capsys.readouterr().err
    assert message in complaint and complaint.count("\n") == 1


def test_worlds_of_a_known_height_are_all_seen_from_just_there():
    height_m = 2.1
    data = DataConfig(world_frames=3, camera_height_m=height_m, camera_height_shares=(0.7, 1.3))
    config = Config(image=ImageConfig(height=16, width=32, camera=(20.0, 20.0, 15.5, 7.5)), data=data)
    given = {"dataset": "synthetic", "sequences": ["5"], "other_lenses": False}

    def step(known):
        return model.sequences(argparse.Namespace(**given, camera_height=known), config)[0].poses[1, :3, 3]

    drawn, known = step(None), step(height_m)
    just = synthetic.drive(5, 3, height=16, width=32, camera_height_m=(height_m, height_m)).poses[1, :3, 3]
    np.testing.assert_allclose(known, just, rtol=1e-9)
    # Not scaled: the height that the world would have drawn is another one.
    assert abs(np.linalg.norm(drawn) / np.linalg.norm(known) - 1) > 0.02
