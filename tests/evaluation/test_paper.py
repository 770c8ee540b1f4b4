"""The paper's tables and figures, from whatever is there."""

import json
from pathlib import Path

import numpy as np
import nuscenes_fixture
import pytest

from mdnvo_jax import evaluate as command
from mdnvo_jax import geometry, recalibration
from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig
from mdnvo_jax.errors import InputError, exit_code
from mdnvo_jax.evaluation import commands, paper
from mdnvo_jax.evaluation.paper_tables import METHODS, PUBLISHED, published_table
from mdnvo_jax.evaluation.tables import as_markdown
from mdnvo_jax.model.head import Labels
from mdnvo_jax.model.network import build
from mdnvo_jax.training import checkpoint
from mdnvo_jax.training.state import initial_state, initial_variables
from mdnvo_jax.training.store import Store

LABELS = Labels(np.array([0, 0, 1, 0, 0.01, 0]), np.array([0.02, 0.02, 0.5, 0.005, 0.02, 0.005]))


def drive(count, *, offset_m=0.0, step_m=1.0):
    """A path along a bend whose every step is `offset_m` too far to the right."""
    steps = np.tile([offset_m, 0, step_m, 0, 0, 0], (count - 1, 1))
    steps[:, 4] = 0.05 * np.sin(np.arange(count - 1) / 5)
    return geometry.accumulate(geometry.step_to_matrix(steps))


def write(path, poses, numbers=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = poses[:, :3].reshape(len(poses), 12)
    np.savetxt(path, rows if numbers is None else np.column_stack([numbers, rows]), fmt="%.12g")


def save_model(folder, **data):
    """Save an untrained model as a training would."""
    config = Config(
        image=ImageConfig(height=32, width=64, channels=1),
        model=ModelConfig(width=1 / 16, lstm_hidden=4, lstm_layers=1, components=2),
        data=DataConfig(window=3, **data),
    )
    state = initial_state(initial_variables(build(config.image, config.model), config), config, LABELS)
    store = Store(folder, keep_latest=1)
    store.save(state, {}, config, 1.0)
    store.close()
    return folder


def run(*arguments):
    return exit_code(command.main, ["paper", *(str(argument) for argument in arguments)])


def rows_of(output):
    results = json.loads((output / "results.json").read_text(encoding="utf-8"))
    return {row["row"]: row for row in results["tables"][0]["rows"]}, results["tables"][0]


@pytest.fixture
def kitti(tmp_path):
    """Test sequences 03 and 10 and a training sequence, without images, and what each method left."""
    for name, count in (("03", 40), ("10", 60)):
        write(tmp_path / "kitti" / "poses" / f"{name}.txt", drive(count))
        write(tmp_path / "mdn" / f"{name}.txt", drive(count, offset_m=0.1))
    write(tmp_path / "kitti" / "poses" / "00.txt", drive(40, step_m=1.2))
    write(tmp_path / "deepvo" / "10.txt", drive(60, offset_m=0.05))
    # A tenth of the true scale, and the first two frames are missing.
    path = drive(40)
    path[:, :3, 3] *= 0.1
    write(tmp_path / "orbslam" / "03" / "trajectory_kitti_indexed.txt", path[2:], np.arange(2, 40))
    (tmp_path / "orbslam" / "10").mkdir()
    lost = {"tracked": 0, "failure": "no trajectory: ORB-SLAM did not initialise"}
    (tmp_path / "orbslam" / "10" / "summary.json").write_text(json.dumps(lost))
    return tmp_path


def test_table_one_from_files(kitti, capsys):
    output = kitti / "out"
    given = ["--mdn", kitti / "mdn", "--deepvo", kitti / "deepvo", "--orbslam", kitti / "orbslam"]
    assert run("--dataset", "kitti", "--root", kitti / "kitti", *given, "--output", output) == 0
    printed = capsys.readouterr().out
    assert f"absent from {kitti / 'kitti'}: 05 06 07" in printed
    assert "ORB-SLAM (Sim(3)-aligned)" in printed and "as published" in printed
    rows, table = rows_of(output)
    assert list(rows) == ["03", "10", "mean"]
    assert rows["03"]["MDN-VO rmse"] == pytest.approx(0.1, abs=1e-6)
    assert rows["10"]["DeepVO rmse"] == pytest.approx(0.05, abs=1e-6)
    assert rows["10"]["DeepVO max"] == pytest.approx(0.05, abs=1e-6)
    # Scale and frames are restored: the path is right.
    assert rows["03"]["ORB-SLAM rmse"] == pytest.approx(0, abs=1e-6)
    assert rows["03"]["ORB-SLAM frames"] == "38 of 40"
    # The training goes 1.2 m where the test goes 1 m.
    assert rows["03"]["constant predictor mean"]["value"] == pytest.approx(0.2, abs=0.02)
    assert rows["03"]["DeepVO rmse"] is None and rows["10"]["ORB-SLAM rmse"] is None
    # Means are of methods that have both.
    assert rows["mean"]["MDN-VO rmse"] == pytest.approx(0.1, abs=1e-6)
    assert rows["mean"]["DeepVO rmse"] is None and rows["mean"]["ORB-SLAM rmse"] is None
    notes = "\n".join(table["notes"])
    why = "ended without one (no trajectory: ORB-SLAM did not initialise)"
    assert f"ORB-SLAM has no trajectory of 10: its run in {kitti / 'orbslam' / '10'} {why}" in notes
    assert "DeepVO has no trajectory of 03" in notes and "training sequences 00" in notes
    # Of the figures of the paper that of 10 is there.
    assert [path.name for path in output.glob("*.png")] == ["trajectory-10.png"]
    page = (output / "report.html").read_text(encoding="utf-8")
    assert "<b>0.050</b>" in page and 'colspan="4">ORB-SLAM (Sim(3)-aligned)' in page


def test_what_is_not_given_is_said(kitti, monkeypatch, capsys):
    monkeypatch.chdir(kitti)
    (kitti / "kitti" / "poses" / "00.txt").unlink()
    assert run("--dataset", "kitti", "--root", "kitti") == 0
    printed = capsys.readouterr().out
    for option in ("--mdn", "--deepvo", "--orbslam"):
        assert f"not given ({option})" in printed
    assert "oracle: mean step of the test sequences" in printed
    assert Path("paper-kitti", "report.html").is_file()


def test_the_published_estimates_of_sequence_10(data_root, tmp_path):
    """What the authors' own files give is what they printed, where it is the same run."""
    for method in METHODS:
        (tmp_path / method).mkdir()
        estimate = data_root / "trajectories" / "kitti_10" / f"{method}.txt"
        (tmp_path / method / "10.txt").write_bytes(estimate.read_bytes())
    (tmp_path / "poses").mkdir()
    truth = data_root / "trajectories" / "ground_truth" / "10.txt"
    (tmp_path / "poses" / "10.txt").write_bytes(truth.read_bytes())
    folders = ["--mdn", tmp_path / "MDN-VO", "--deepvo", tmp_path / "DeepVO", "--orbslam", tmp_path / "ORB-SLAM"]
    assert run("--dataset", "kitti", "--root", tmp_path, *folders, "--output", tmp_path / "out") == 0
    rows, _ = rows_of(tmp_path / "out")
    found = [round(rows["10"][f"{name} rmse"], 4) for name in METHODS]
    assert found == [0.1657, 0.2112, 0.1365]
    assert [round(value, 2) for value in found[1:]] == [PUBLISHED["kitti"]["10"][k][0] for k in (1, 2)]


def test_a_checkpoint_on_the_clip_of_06(data_root, tmp_path, capsys):
    model = save_model(tmp_path / "mdn", camera_folder="image_0")
    given = ["--mdn", model, "--output", tmp_path / "out"]
    assert run("--dataset", "kitti", "--root", data_root / "kitti", *given) == 0
    assert "absent from" in (printed := capsys.readouterr().out) and ": 03 05 07 10" in printed
    rows, table = rows_of(tmp_path / "out")
    assert any(note.startswith("MDN-VO: offline, mean of the density, head mixture; ") for note in table["notes"])
    assert list(rows) == ["06"] and rows["06"]["MDN-VO rmse"] > 0
    assert (tmp_path / "out" / "trajectory-06.png").is_file()


def test_the_published_tables_are_consistent():
    table = PUBLISHED["kitti"]
    for method in range(3):
        rows = np.array([table[name][method] for name in ("03", "05", "06", "07", "10")])
        np.testing.assert_allclose(rows.mean(axis=0), table["mean"][method], atol=0.0051)
    # Bold as in the paper, ties too.
    lines = as_markdown(published_table("kitti")).splitlines()
    assert "| 07 | 0.17 | **0.35** | 0.13 ± 0.09 | 0.14 | **0.35** | 0.12 ± 0.07 | **0.08** | 0.51 |" in lines[7]
    night = as_markdown(published_table("nuscenes")).splitlines()[6]
    assert night == "| night | - | - | - | 0.12 | 0.74 | 0.09 ± 0.09 | **0.11** | **0.73** | **0.07 ± 0.08** |"


@pytest.fixture(scope="module")
def nuscenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nuscenes")
    nuscenes_fixture.write_nuscenes(folder / "data", frames=12)
    return folder / "data", save_model(folder / "mdn", dataset="nuscenes", version=nuscenes_fixture.VERSION)


def test_table_two_by_condition(nuscenes, tmp_path, capsys):
    root, model = nuscenes
    scale = recalibration.SigmaScale(np.full(6, 2.0), 10, 1.0, 0.5, {})
    recalibration.write(checkpoint.locate(model), scale)
    assert run("--dataset", "nuscenes", "--root", root, "--mdn", model, "--output", tmp_path / "out") == 0
    rows, table = rows_of(tmp_path / "out")
    assert list(rows) == ["daylight", "rain", "night"]
    # Test scenes of the fixture: 0768 and 0972 by day, 0572 in the rain, 0999 at night.
    assert [(row["drives"], row["frames"]) for row in rows.values()] == [("2", "24"), ("1", "12"), ("1", "12")]
    assert all(row["MDN-VO rmse"] > 0 and row["constant predictor rmse"] > 0 for row in rows.values())
    # Every pair of frames of a condition is in its row, and no method lacks any.
    results = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))["results"]["paths"]
    assert [(path["split"], path["frames_covered"], path["pairs"]) for path in results if path["name"] == "MDN-VO"] == [
        ("daylight", 24, 22),
        ("rain", 12, 11),
        ("night", 12, 11),
    ]
    assert "MDN-VO frames" not in rows["daylight"]
    assert any("scenes for training" in note for note in table["notes"])
    assert not any("left out" in note or "unknown" in note or "no test scene" in note for note in table["notes"])
    drawn = {path.name for path in (tmp_path / "out").glob("*.png")}
    assert drawn == {f"trajectory-scene-{n}.png" for n in ("0972", "0572", "0999")} | {"uncertainty-scene-0768.png"}
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "MDN-VO on scene-0768: x, y and yaw of every step with 3-sigma bands, sigma recalibrated" in page
    capsys.readouterr()


def test_any_scene_can_be_chosen(nuscenes, tmp_path, capsys):
    root, _ = nuscenes
    given = ["--dataset", "nuscenes", "--root", root, "--nuscenes-version", nuscenes_fixture.VERSION]
    path = tmp_path / "mdn"
    # Files of estimates have no density here.
    write(path / "scene-0999.txt", drive(12))
    assert run(*given, "--mdn", path, "--output", tmp_path / "out", "--scene", "scene-0061") == 0
    printed = capsys.readouterr().out
    assert "MDN-VO has no trajectory of scene-0572" in printed
    rows, _ = rows_of(tmp_path / "out")
    assert rows["rain"]["MDN-VO rmse"] is None and rows["night"]["MDN-VO rmse"] > 0


def test_scenes_of_unknown_condition_have_a_row_and_what_is_left_out_is_named(tmp_path):
    scenes = (
        nuscenes_fixture.Spec("scene-0061", "Parked lorry"),
        nuscenes_fixture.Spec("scene-0999", "Night, a lit crossing"),
        nuscenes_fixture.Spec("scene-0002", ""),
        nuscenes_fixture.Spec("scene-0025", " "),
        nuscenes_fixture.Spec("scene-0011", "Short", frames=1),
        nuscenes_fixture.Spec("scene-0014", "Gone", missing=(2,)),
    )
    nuscenes_fixture.write_nuscenes(tmp_path, scenes, frames=6)
    given = ["--dataset", "nuscenes", "--root", tmp_path, "--nuscenes-version", nuscenes_fixture.VERSION]
    assert run(*given, "--output", tmp_path / "out") == 0
    rows, table = rows_of(tmp_path / "out")
    assert [(name, row["drives"], row["frames"]) for name, row in rows.items()] == [
        ("night", "1", "6"),
        ("unknown", "2", "12"),
    ]
    assert rows["unknown"]["constant predictor rmse"] > 0
    said = [note for note in table["notes"] if "condition" in note or "scene" in note]
    assert said[:5] == [
        "test: scenes left out, of fewer than 2 frames: 1 (scene-0011)",
        "test: scenes left out, with images that are not on disk: 1 (scene-0014)",
        "no test scene: daylight",
        "no test scene: rain",
        "unknown: scenes without a description, which is what tells the condition",
    ]
    drawn = {path.name for path in (tmp_path / "out").glob("*.png")}
    assert drawn == {"trajectory-scene-0999.png", "trajectory-scene-0002.png"}


@pytest.mark.parametrize(("scene", "why"), [("scene-0103", "cannot be read"), ("scene-9999", "no scene scene-9999")])
def test_a_scene_that_cannot_be_drawn_costs_its_figure_alone(nuscenes, scene, why):
    root, _ = nuscenes
    arguments = ["paper", "--dataset", "nuscenes", "--root", str(root), "--scene", scene]
    config = Config(data=DataConfig(dataset="nuscenes", version=nuscenes_fixture.VERSION))

    def method(drive):
        raise InputError(f"an image of {drive.name} cannot be read")

    pictures, notes = paper._scenes(commands.parser().parse_args(arguments), config, method)
    assert pictures == [] and len(notes) == 1
    assert notes[0].startswith("no uncertainty figure: ") and why in notes[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--dataset", "kitti", "--root", "{root}/mdn"], "none of the paper's test sequences"),
        (["--dataset", "kitti", "--root", "{root}/kitti", "--mdn", "{root}/kitti"], "neither a checkpoint nor"),
        (["--dataset", "kitti", "--root", "{root}/kitti", "--mdn", "{root}/gone"], "no folder"),
        (["--dataset", "kitti", "--root", "{root}/kitti", "--orbslam", "{root}/gone"], "gone"),
        (["--dataset", "kitti", "--root", "{root}/kitti", "--block", "0"], "--block is 0"),
        (["--dataset", "nuscenes", "--root", "{root}/kitti"], "v1.0-trainval"),
        (["--dataset", "kitti"], "--root"),
    ],
)
def test_mistakes(kitti, capsys, arguments, message):
    given = [argument.format(root=kitti) for argument in arguments]
    assert run(*given, "--output", kitti / "out") == 2
    complaint = capsys.readouterr().err
    assert message in complaint and complaint.count("\n") == 1
