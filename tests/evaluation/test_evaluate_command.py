"""The command line, end to end on small files."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from mdnvo_jax import evaluate, geometry
from mdnvo_jax.baselines import orbslam
from mdnvo_jax.errors import exit_code
from mdnvo_jax.evaluation import commands, compare


def drive(count=40, *, error=0.0, scale=1.0, seed=0):
    rng = np.random.default_rng(seed)
    steps = np.zeros((count - 1, 6))
    steps[:, 2] = 1 + 0.4 * np.sin(np.arange(count - 1) / 7)
    steps[:, 4] = 0.05 * np.sin(np.arange(count - 1) / 5)
    steps[:, :3] = scale * (steps[:, :3] + error * rng.standard_normal((count - 1, 3)))
    return geometry.accumulate(geometry.step_to_matrix(steps))


def write_kitti(path, poses, numbered=None):
    rows = poses[:, :3].reshape(-1, 12)
    if numbered is not None:
        rows = np.column_stack([numbered, rows])
    np.savetxt(path, rows, fmt="%.12g")
    return str(path)


def write_tum(path, poses, times):
    quaternions = geometry.quaternion_from_matrix(poses[:, :3, :3])
    np.savetxt(path, np.column_stack([times, poses[:, :3, 3], quaternions]), fmt="%.12g")
    return str(path)


@pytest.fixture
def files(tmp_path):
    """The truth, three estimates and training poses."""
    truth = drive()
    kept = np.setdiff1d(np.arange(40), [0, 1, 17])
    return {
        "truth": write_kitti(tmp_path / "truth.txt", truth),
        "good": write_kitti(tmp_path / "good.txt", drive(error=0.01)),
        "poor": write_kitti(tmp_path / "poor.txt", drive(error=0.3)),
        "sparse": write_kitti(tmp_path / "sparse.txt", drive(scale=0.1)[kept], kept),
        "training": write_kitti(tmp_path / "training.txt", drive(60)),
        "output": str(tmp_path / "out"),
    }


def run(*arguments):
    return exit_code(evaluate.main, [str(argument) for argument in arguments])


def results(files):
    return json.loads(Path(files["output"], "results.json").read_text(encoding="utf-8"))


def paths_by_name(files):
    return {row["name"]: row for row in results(files)["results"]["paths"]}


def test_several_estimates_each_aligned_its_own_way(files, capsys):
    code = run(
        "trajectory", files["good"], files["poor"], files["sparse"], "--reference", files["truth"],
        "--align", "none", "--align", "none", "--align", "sim3", "--constant-from", files["training"],
        "--split", "a drive", "--output", files["output"],
    )  # fmt: skip
    assert code == 0
    printed = capsys.readouterr().out
    assert "every row: split a drive, delta 1 frame" in printed and "37 of 40" in printed
    found = paths_by_name(files)
    assert list(found) == ["good", "poor", "sparse", "constant predictor"]
    assert found["good"]["rpe_translation_m"]["rmse"]["value"] == pytest.approx(0.01 * np.sqrt(3), rel=0.2)
    assert found["good"]["rpe_rmse_minus_constant_m"]["high"] < 0
    assert found["sparse"]["alignment"] == "sim3, scale 10" and found["sparse"]["frames_covered"] == 37
    assert found["sparse"]["pairs"] == 35
    assert found["sparse"]["rpe_translation_m"]["rmse"]["value"] < 1e-6
    # Under each alignment that is used, the constant predictor has a row.
    rows = results(files)["tables"][0]["rows"]
    assert [row["alignment"].partition(",")[0] for row in rows] == ["none", "none", "sim3", "none", "sim3"]
    table = Path(files["output"], "table.md").read_text(encoding="utf-8")
    assert "mean step of training" in table and "**" in table
    assert "evo" in results(files)["versions"]


@pytest.mark.parametrize("how", ["none", "sim3"])
def test_the_constant_predictor_of_the_reference_itself_is_called_an_oracle(files, how):
    assert run(
        "trajectory", files["good"], "--reference", files["truth"], "--align", how, "--output", files["output"]
    ) == 0  # fmt: skip
    assert any("oracle" in note for note in results(files)["tables"][0]["notes"])


def test_timestamps_of_the_reference_may_come_from_their_own_file(files, tmp_path):
    times = 0.1 * np.arange(40)
    (tmp_path / "times.txt").write_text("\n".join(f"{time:.6e}" for time in times))
    estimate = write_tum(tmp_path / "estimate.txt", drive()[5:30], times[5:30] + 0.003)
    code = run(
        "trajectory", estimate, "--reference", files["truth"], "--reference-times", tmp_path / "times.txt",
        "--output", files["output"],
    )  # fmt: skip
    assert code == 0
    assert paths_by_name(files)["estimate"]["frames_covered"] == 25
    assert any("time within 0.01 s" in note for note in results(files)["tables"][0]["notes"])


def test_our_own_folder_is_calibrated_too(files, tmp_path):
    folder = tmp_path / "prediction"
    folder.mkdir()
    truth, estimate = drive(), drive(error=0.02)
    write_kitti(folder / "trajectory_kitti.txt", estimate)
    mean = geometry.matrix_to_step(geometry.relative_steps(estimate))
    sigma = np.tile([0.02] * 3 + [1e-3] * 3, (39, 2, 1)) * np.array([1, 3])[:, None]
    logits = np.tile(np.log([0.8, 0.2]), (39, 1))
    np.savez(folder / "mixture.npz", logits=logits, mean=np.stack([mean] * 2, 1), log_scale=np.log(sigma))
    assert run("trajectory", folder, "--reference", files["truth"], "--output", files["output"]) == 0
    rows = results(files)["results"]["calibration"]
    assert [(row["name"], row["sigma"]) for row in rows] == [
        ("prediction", "whole mixture"),
        ("prediction", "strongest component"),
        ("constant predictor", "whole mixture"),
    ]
    errors = geometry.matrix_to_step(geometry.relative_steps(truth)) - mean
    inside = np.mean(np.abs(errors[:, :3]) <= 0.02, axis=0)
    found = [rows[1]["coverage"]["1 sigma"][name]["value"] for name in ("tx", "ty", "tz")]
    # 68.27 % is 1.00002 sigma.
    np.testing.assert_allclose(found, inside, atol=1e-9)
    assert rows[1]["nll"]["value"] == pytest.approx(-stats.norm(0, sigma[:, 0]).logpdf(errors).sum(axis=1).mean())
    assert (
        rows[0]["coverage"]["1 sigma"]["tx"]["value"] >= found[0]
        and rows[0]["nees"]["value"] < rows[1]["nees"]["value"]
    )
    by_component = next(table for table in results(files)["tables"] if table["title"] == "Calibration by component")
    assert by_component["rows"][0]["crps"] == pytest.approx(1e3 * rows[0]["crps"]["tx"]["value"])
    written = {path.name for path in (tmp_path / "out" / "calibration-prediction").iterdir()}
    assert written == {"sigma_error.png", "reliability.png", "sparsification.png", "pit.png"}


def orbslam_folder(folder, poses, indices):
    """Write what a run of `baselines.orbslam` writes that tracked the frames `indices` of `poses`."""
    tracked = orbslam.Tracked(
        count=len(poses),
        indices=np.array(indices, np.int64),
        poses=poses[np.array(indices, np.int64)],
        kind="final",
        states=["OK" if index in indices else "NOT_INITIALIZED" for index in range(len(poses))],
        maps=[(indices[0], indices[-1], len(indices))] if indices else [],
        track_s=np.zeros(0),
        settle_s=np.zeros(0),
        unsettled=0,
        settings={"features": 2000},
    )
    folder.mkdir()
    orbslam.write(tracked, folder, np.arange(len(poses)), None)
    return folder


def test_a_run_of_orbslam_is_judged_on_the_frames_it_tracked(files, tmp_path, capsys):
    kept = [index for index in range(40) if index not in (0, 1, 2, 17)]
    found = orbslam_folder(tmp_path / "found", drive(scale=0.1), kept)
    lost = orbslam_folder(tmp_path / "lost", drive(), [])
    given = [found, lost, "--reference", files["truth"], "--align", "sim3", "--output", files["output"]]
    assert run("trajectory", *given) == 0
    rows = paths_by_name(files)
    assert list(rows) == ["found", "lost", "constant predictor"]
    assert (rows["found"]["frames_covered"], rows["found"]["frames_total"], rows["found"]["pairs"]) == (36, 40, 34)
    assert rows["found"]["alignment"] == "sim3, scale 10"
    assert rows["found"]["rpe_translation_m"]["rmse"]["value"] < 1e-6
    assert (rows["lost"]["frames_covered"], rows["lost"]["frames_total"], rows["lost"]["pairs"]) == (0, 40, 0)
    printed = capsys.readouterr().out
    assert "36 of 40" in printed and "found: frames matched by frame number" in printed
    assert "lost: no trajectory: ORB-SLAM did not initialise (40 frames, 2000 features)" in printed
    row = f"| lost | truth | sim3 | 1 frame | 0 of 40 |{' - |' * 8}\n"
    assert row in Path(files["output"], "table.md").read_text(encoding="utf-8")
    options = commands.parser().parse_args(["trajectory", *map(str, given)])
    assert list(compare.from_options(options).pictures[0].paths) == ["found (sim3, scale 10)"]


def test_a_lost_run_alone_is_a_row_too_but_no_truth(files, tmp_path, capsys):
    lost = orbslam_folder(tmp_path / "lost", drive(), [])
    assert run("trajectory", lost, "--reference", files["truth"], "--output", files["output"]) == 0
    assert "0 of 40" in capsys.readouterr().out
    assert Path(files["output"], "trajectory.png").stat().st_size > 5000
    assert run("trajectory", files["good"], "--reference", lost, "--output", tmp_path / "other") == 2
    assert "has no trajectory_kitti.txt" in capsys.readouterr().err
    (lost / "summary.json").write_text("{")
    assert run("trajectory", lost, "--reference", files["truth"], "--output", tmp_path / "another") == 2
    assert capsys.readouterr().err.startswith("error: ")


def test_delta_and_unit(files):
    assert run(
        "trajectory", files["good"], "--reference", files["truth"], "--delta", 5, "--delta-unit", "metres",
        "--output", files["output"],
    ) == 0  # fmt: skip
    assert paths_by_name(files)["good"]["delta"] == "5 metres"
    assert paths_by_name(files)["good"]["pairs"] < 8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--align", "se3", "--align", "none"], "--align is given 2 times for 1 estimates"),
        (["--align", "rigid"], "invalid choice: 'rigid'"),
        (["--names", "a", "b"], "--names is given 2 times for 1 estimates"),
        (["--delta", "0"], "delta is 0 frames; expected a positive number"),
        (["--delta", "100"], "choose another --delta"),
        (["--block", "0"], "--block is 0"),
        (["--tolerance", "-1"], "--tolerance is -1"),
        (["--reference-times", "absent.txt"], "no such file: absent.txt"),
        (["--constant-from", "absent.txt"], "no such file: absent.txt"),
        (["--first-frame", "3"], "frame 40 is outside the reference"),
    ],
)
def test_mistakes_are_one_line_and_exit_code_2(files, capsys, change, message):
    arguments = ["trajectory", files["good"], "--reference", files["truth"], "--output", files["output"], *change]
    assert run(*arguments) == 2
    complaint = capsys.readouterr().err
    assert message in complaint and complaint.count("\n") == 1 and complaint.startswith("error: ")


def test_estimates_of_one_name_are_told_apart_by_their_folders(tmp_path):
    paths = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        paths.append(write_kitti(tmp_path / folder / "10.txt", drive()))
    found = compare.candidates(paths, names=[], formats=[], alignments=[])
    assert [candidate.name for candidate in found] == ["a/10", "b/10"]
    with pytest.raises(compare.InputError, match="same name"):
        compare.candidates([paths[0], paths[0]], names=[], formats=[], alignments=[])


def test_nothing_is_overwritten_without_force(files, capsys):
    arguments = ["trajectory", files["good"], "--reference", files["truth"], "--output", files["output"]]
    assert run(*arguments) == 0
    assert run(*arguments) == 2
    assert "--force" in capsys.readouterr().err
    assert run(*arguments, "--force") == 0


@pytest.mark.parametrize("arguments", [["--help"], ["trajectory", "--help"], ["model", "--help"]])
def test_help_is_there_at_once(arguments):
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "mdnvo_jax.evaluate", *arguments], capture_output=True, text=True)
    seconds = time.perf_counter() - began
    assert done.returncode == 0 and "usage:" in done.stdout
    # 0.06 s on an idle machine; without laziness it would be two seconds and more.
    assert seconds < 1.0


def test_the_choices_repeated_for_help_are_those_of_the_library():
    from mdnvo_jax.evaluation import association, bootstrap, formats, trajectory

    assert commands.FORMATS == formats.FORMATS
    assert set(commands.ALIGNMENTS) == set(trajectory.ALIGNMENTS)
    options = commands.parser().parse_args(["trajectory", "a", "--reference", "b", "--output", "c"])
    assert options.tolerance == association.TIME_TOLERANCE_S and options.block == bootstrap.BLOCK_FRAMES
    assert options.delta_unit in trajectory.DELTA_UNITS


def test_published_estimates_in_one_table(data_root, tmp_path):
    folder = data_root / "trajectories"
    names = ("MDN-VO", "DeepVO", "ORB-SLAM")
    training = [folder / "ground_truth" / f"{name}.txt" for name in ("01", "04")]
    code = run(
        "trajectory", *(folder / "kitti_10" / f"{name}.txt" for name in names),
        "--reference", folder / "ground_truth" / "10.txt", "--constant-from", *training,
        "--align", "none", "--align", "none", "--align", "sim3", "--output", tmp_path / "out",
    )  # fmt: skip
    assert code == 0
    table = (tmp_path / "out" / "table.md").read_text(encoding="utf-8")
    for expected in ("**0.1365 [", "| 0.2186 |", "| 14.07 |", "| 7.00 |", "| 0.2112 [", "| 0.1657 [", "**0.0743**"):
        assert expected in table
