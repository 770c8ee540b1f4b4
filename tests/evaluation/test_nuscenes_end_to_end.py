"""nuScenes from the tables and images on disk to the paper's Table II, by the commands that a user types.

The data set is small but odd: frames were dropped, images are not on disk, scenes have one frame, and one has no
description. The figures of Table II are computed here a second time, with numpy and scipy, from what `predict` wrote.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from nuscenes_fixture import VERSION, Spec, write_nuscenes
from scipy.spatial.transform import Rotation

from mdnvo_jax.evaluate import main as evaluate
from mdnvo_jax.predict import main as predict

REPOSITORY = Path(__file__).parents[2]
TRAINING = (
    Spec("scene-0061", "Parked lorry, crossing"),
    Spec("scene-1077", "Night, a wide street", dropped=(4, 5)),
    Spec("scene-0103", "Many people on the right", missing=(3,)),
    Spec("scene-0553", "Wait at a crossing", frames=1),
)
VALIDATION = (Spec("scene-0655", "Car park, a train behind the fence"),)
# In the order of Table II. Of as many frames each: what has another shape is compiled for again.
TEST = {
    "daylight": (
        Spec("scene-0768", "Turn left at a junction, a lorry", frames=13, dropped=(7,)),
        Spec("scene-0972", "Low sun, a narrow street"),
    ),
    "rain": (Spec("scene-0572", "Turn right, rain, people with umbrellas"),),
    "night": (Spec("scene-0999", "Night, after rain, a lit crossing"),),
    "unknown": (Spec("scene-0002", ""),),
}
TESTED = tuple(spec for row in TEST.values() for spec in row)
UNUSABLE = (Spec("scene-0011", "A street", frames=1), Spec("scene-0014", "Rain, a street", missing=(2, 5)))
FRAMES = 12
TINY = {
    "image.height": 32, "image.width": 64, "model.width": 1 / 32, "model.lstm_hidden": 8, "model.lstm_layers": 1,
    "model.components": 2, "data.window": 3, "training.batch_size": 4, "training.epochs": 1,
    "training.steps_per_epoch": 3,
}  # fmt: skip


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Everything, once: the folder of what the commands left, the truth by scene, what training said on stderr."""
    folder = tmp_path_factory.mktemp("end-to-end")
    root, model = folder / "nuscenes", folder / "runs" / "mdn_vo_nuscenes"
    scenes = (*TRAINING, *VALIDATION, *TESTED, *UNUSABLE)
    truth = write_nuscenes(root, scenes, FRAMES, size=(36, 64), rendered=True)

    overrides = [str(part) for name, value in TINY.items() for part in (f"--{name}", value)]
    given = ["--workdir", str(model), "--data.root", str(root), "--data.version", VERSION, *overrides]
    # A process of its own, as for a user; it finds the package of this checkout.
    trained = subprocess.run(
        [sys.executable, "-m", "mdnvo_jax.train", "configs/mdn_vo_nuscenes.py", *given],
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY), *sys.path])},
        capture_output=True,
        text=True,
    )
    assert trained.returncode == 0, trained.stderr

    for name in (spec.name for spec in TESTED):
        # Images of one scene lie in two folders among those of others: they are linked in the order of time.
        frames = folder / "frames" / name
        frames.mkdir(parents=True)
        for number, file in enumerate(truth[name].files):
            (frames / f"{number:03}.jpg").symlink_to(root / file)
        np.savetxt(folder / "times.txt", truth[name].times_us / 1e6, fmt="%.6f")
        camera = ",".join(map(str, truth[name].camera))
        given = ["--camera", camera, "--timestamps", str(folder / "times.txt")]
        predict([str(frames), "--checkpoint", str(model), "--output", str(folder / "predicted" / name), *given])
    data = ["--dataset", "nuscenes", "--root", str(root), "--output"]
    named = ["--sequences", "scene-0768", "scene-0999"]
    evaluate(["model", *data, str(folder / "model"), "--checkpoint", str(model), *named])
    evaluate(["paper", *data, str(folder / "paper"), "--mdn", str(model)])
    return SimpleNamespace(folder=folder, truth=truth, said=trained.stderr)


def steps(poses):
    """Motions from each pose to the next, `[N-1, 4, 4]`."""
    return np.linalg.inv(poses[:-1]) @ poses[1:]


def step_errors_m(estimate, truth):
    """Distance of each estimated step's end from the true one's."""
    return np.linalg.norm((np.linalg.inv(truth) @ estimate)[:, :3, 3], axis=1)


def mean_step(paths, window=1):
    """The motion whose translation and rotation vector are the means of those of all windows' steps, `[4, 4]`."""
    every = np.concatenate([steps(poses) for poses in paths])
    # A step is in as many windows as reach over it.
    weights = np.concatenate([np.convolve(np.ones(len(poses) - window), np.ones(window)) for poses in paths])
    turns = Rotation.from_matrix(every[:, :3, :3]).as_rotvec()
    T = np.eye(4)
    T[:3, 3] = np.average(every[:, :3, 3], axis=0, weights=weights)
    T[:3, :3] = Rotation.from_rotvec(np.average(turns, axis=0, weights=weights)).as_matrix()
    return T


def predicted_steps(done, scene):
    rows = np.loadtxt(done.folder / "predicted" / scene / "trajectory_kitti.txt")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    return steps(poses)


def printed(errors_m):
    """The cells of Table II for these errors."""
    rmse = np.sqrt((errors_m**2).mean())
    return [f"{rmse:.3f}", f"{errors_m.max():.3f}", f"{errors_m.mean():.3f} ± {errors_m.std():.3f}"]


def first_table(folder):
    """The headers and the rows, by their first cell, of the first table in table.md."""
    lines = (folder / "table.md").read_text(encoding="utf-8").split("###")[1].splitlines()
    cells = [[cell.strip(" *") for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return cells[0], {row[0]: row for row in cells[2:]}


def results(folder):
    return json.loads((folder / "results.json").read_text(encoding="utf-8"))


# Two tests and no more: run in parallel, each process that has one of them does everything.


def test_every_scene_is_used_or_named(done):
    _check_training(done)
    _check_predictions(done)
    _check_conditions(done)
    _check_pictures(done)


def test_tables_are_what_numpy_finds(done):
    _check_table_two(done)
    _check_model(done)


def _check_training(done):
    for expected in (
        "train: scenes left out, of fewer than 4 frames: 1 (scene-0553)",
        "train: scenes left out, with images that are not on disk: 1 (scene-0103)",
        "train: frames were dropped in 1 of 2 scenes (gaps: 1, up to 0.25 s)",
    ):
        assert expected in done.said
    assert "validation:" not in done.said


def _check_predictions(done):
    for scene in TESTED:
        folder = done.folder / "predicted" / scene.name
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        assert summary["frames"] == FRAMES and summary["camera"] == "given"
        times = np.loadtxt(folder / "trajectory_tum.txt")[:, 0]
        np.testing.assert_allclose(times, done.truth[scene.name].times_us / 1e6, rtol=0, atol=1e-6)


def _check_conditions(done):
    _, rows = first_table(done.folder / "paper")
    assert {name: row[1:3] for name, row in rows.items()} == {
        "daylight": ["2", "24"],
        "rain": ["1", "12"],
        "night": ["1", "12"],
        "unknown": ["1", "12"],
    }
    notes = results(done.folder / "paper")["tables"][0]["notes"]
    for expected in (
        "test: scenes left out, of fewer than 2 frames: 1 (scene-0011)",
        "test: scenes left out, with images that are not on disk: 1 (scene-0014)",
        "ORB-SLAM: not given (--orbslam)",
        "DeepVO: not given (--deepvo)",
        "constant predictor: mean step of the 3 scenes for training",
    ):
        assert expected in notes
    assert any(note.startswith("unknown: ") for note in notes)


def _check_table_two(done):
    header, rows = first_table(done.folder / "paper")
    # Scenes of one frame have no step; poses are known of frames whose images are not there.
    constant = mean_step([done.truth[spec.name].poses for spec in TRAINING if spec.frames != 1])
    for row, scenes in TEST.items():
        truth = np.concatenate([steps(done.truth[spec.name].poses) for spec in scenes])
        predicted = np.concatenate([predicted_steps(done, spec.name) for spec in scenes])
        expected = printed(step_errors_m(predicted, truth)), printed(step_errors_m(constant, truth))
        first = header.index("MDN-VO (no alignment) RMSE"), header.index("constant predictor (no alignment) RMSE")
        assert tuple(rows[row][start : start + 3] for start in first) == expected, row
        # Else one method may have passed for the other.
        assert expected[0] != expected[1]
        for absent in ("ORB-SLAM (Sim(3)-aligned) RMSE", "DeepVO (no alignment) mean ± std"):
            assert rows[row][header.index(absent)] == "-"


def _check_model(done):
    found = {(row["name"], row["split"]): row for row in results(done.folder / "model")["results"]["paths"]}
    scenes = ("scene-0768", "scene-0999")
    methods = ("model (offline, mean)", "constant predictor")
    assert list(found) == [(method, split) for split in (*scenes, "all") for method in methods]
    errors = [step_errors_m(predicted_steps(done, scene), steps(done.truth[scene].poses)) for scene in scenes]
    for split, of_split in zip((*scenes, "all"), (*errors, np.concatenate(errors)), strict=True):
        row = found[methods[0], split]
        assert row["pairs"] == len(of_split) and row["frames_covered"] == row["frames_total"]
        assert row["rpe_translation_m"]["rmse"]["value"] == pytest.approx(np.sqrt((of_split**2).mean()), rel=1e-6)
        assert row["rpe_translation_m"]["mean"]["value"] == pytest.approx(of_split.mean(), rel=1e-6)
    # The labels that the training kept are of the windows of the two scenes that it used.
    constant = mean_step([done.truth[name].poses for name in ("scene-0061", "scene-1077")], TINY["data.window"])
    night = step_errors_m(constant, steps(done.truth["scene-0999"].poses))
    row = found[methods[1], "scene-0999"]
    assert row["rpe_translation_m"]["max"]["value"] == pytest.approx(night.max(), rel=1e-5)
    calibration = results(done.folder / "model")["results"]["calibration"]
    assert {(row["name"], row["split"]) for row in calibration} >= set(found)


def _check_pictures(done):
    paths = [f"trajectory-scene-{number}" for number in ("0002", "0572", "0768", "0972", "0999")]
    bands = [f"uncertainty-scene-{number}" for number in ("0768", "0999")]
    drawn = {
        "paper": [*paths[:2], *paths[3:], bands[0]],
        "model": ["pit", "reliability", "sigma_error", "sparsification", paths[2], paths[4], *bands],
        "predicted/scene-0999": ["trajectory", "uncertainty"],
    }
    for folder, names in drawn.items():
        files = sorted((done.folder / folder).glob("*.png"))
        assert [file.stem for file in files] == names
        for file in files:
            data = file.read_bytes()
            assert data.startswith(b"\x89PNG\r\n\x1a\n") and data.endswith(b"IEND\xaeB`\x82"), file
            picture = cv2.imread(str(file), cv2.IMREAD_COLOR)
            height, width, _ = picture.shape
            assert 400 <= height <= 2000 and 500 <= width <= 2400, file
            # Ink on paper, and more than black ink.
            assert picture.std() > 5 and np.ptp(picture.astype(int), axis=-1).max() > 80, file
    page = (done.folder / "paper" / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == len(drawn["paper"])
    assert "MDN-VO on scene-0768: x, y and yaw of every step with 3-sigma bands" in page
