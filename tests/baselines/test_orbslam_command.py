"""The command line of the ORB-SLAM baseline: its files and exit codes."""

import json
import re

import cv2
import numpy as np
from orbslam_stand_in import CAMERA, CRASH, LOST, NONE, OK, frame, run, turned

from mdnvo_jax.baselines import orbslam
from mdnvo_jax.evaluation.formats import read_trajectory

CAMERA_OPTION = ["--camera", ",".join(map(str, CAMERA))]


def write_frames(folder, what):
    folder.mkdir()
    for number, do in enumerate(what):
        cv2.imwrite(str(folder / f"{number:03}.png"), frame(do))
    return str(folder)


def test_the_files_of_a_run(stand_in, vocabulary, tmp_path, capsys):
    images = write_frames(tmp_path / "frames", [NONE, LOST, NONE, LOST, OK, LOST, OK, LOST, LOST, LOST, OK])
    (tmp_path / "times.txt").write_text("".join(f"{1000 + n / 8}\n" for n in range(11)))
    code, output = run(
        tmp_path, images, vocabulary, *CAMERA_OPTION, "--stride", "2", "--timestamps", str(tmp_path / "times.txt")
    )
    said = capsys.readouterr().out
    assert code == 0
    assert said.startswith("3 of 6 frames tracked, up to scale, final poses, ms a frame ")
    assert sorted(path.name for path in output.iterdir()) == [
        "summary.json",
        "trajectory_kitti_indexed.txt",
        "trajectory_tum.txt",
    ]
    # Frame 4 of the folder is the third that was fed, 0.5 s after the first.
    expected = [turned(n / 8, n / 4) for n in (4, 6, 10)]
    indexed = read_trajectory(output / "trajectory_kitti_indexed.txt")
    assert (indexed.format, indexed.frames.tolist()) == ("indexed", [4, 6, 10])
    np.testing.assert_allclose(indexed.poses, expected, atol=1e-8)
    tum = read_trajectory(output / "trajectory_tum.txt")
    assert (tum.format, tum.timestamps.tolist()) == ("tum", [1000.5, 1000.75, 1001.25])
    np.testing.assert_allclose(tum.poses, expected, atol=1e-8)
    summary = json.loads((output / "summary.json").read_text())
    facts = {
        "frames": 6,
        "tracked": 3,
        "coverage": 0.5,
        "first_tracked": 4,
        "last_tracked": 10,
        "lost_frames": [[0, 2], [8, 8]],
        "maps": [{"first": 4, "last": 10, "tracked": 3}],
        "poses": "final",
        "failure": None,
        "timestamps": "given",
        "stride": 2,
        "images": images,
    }
    assert {key: summary[key] for key in facts} == facts
    assert summary["scale"].startswith("up to an unknown scale")
    assert summary["settings"]["camera"] == list(CAMERA)
    assert summary["settings"]["features"] == orbslam.FEATURES
    assert summary["versions"]["pyorbslam3"] == "0.0.7"
    assert len(summary["vocabulary"]["sha256"]) == 64


def test_no_trajectory_is_an_exit_code_of_its_own(stand_in, vocabulary, tmp_path, capsys):
    images = write_frames(tmp_path / "frames", [NONE] * 3)
    output = tmp_path / "out"
    output.mkdir()
    (output / "trajectory_tum.txt").write_text("of an earlier run")
    code, _ = run(tmp_path, images, vocabulary, *CAMERA_OPTION)
    assert (code, capsys.readouterr().err.count("holds files already")) == (2, 1)
    code, _ = run(tmp_path, images, vocabulary, *CAMERA_OPTION, "--force")
    assert code == orbslam.NO_TRAJECTORY == 3
    assert capsys.readouterr().err == (
        "error: no trajectory: ORB-SLAM did not initialise (3 frames, 2000 features); "
        f"{output / 'summary.json'} says more\n"
    )
    assert [path.name for path in output.iterdir()] == ["summary.json"]
    summary = json.loads((output / "summary.json").read_text())
    assert (summary["tracked"], summary["coverage"], summary["first_tracked"]) == (0, 0, None)
    assert summary["lost_frames"] == [[0, 2]]
    assert summary["failure"].startswith("no trajectory")


def test_a_crash_is_one_line_and_an_exit_code_of_its_own(stand_in, vocabulary, tmp_path, capsys):
    images = write_frames(tmp_path / "frames", [NONE, OK, OK, CRASH, OK])
    code, output = run(tmp_path, images, vocabulary, *CAMERA_OPTION)
    assert code == orbslam.DIED == 4
    assert re.fullmatch(r"error: ORB-SLAM died after 3 of 5 frames: .*SIGSEGV.*\n", capsys.readouterr().err)
    assert read_trajectory(output / "trajectory_kitti_indexed.txt").frames.tolist() == [1, 2]
    assert json.loads((output / "summary.json").read_text())["poses"] == "live"


def test_without_timestamps_the_frame_numbers_are_the_times(stand_in, vocabulary, tmp_path):
    images = write_frames(tmp_path / "frames", [NONE, OK, OK])
    code, output = run(tmp_path, images, vocabulary, *CAMERA_OPTION)
    assert code == 0
    assert read_trajectory(output / "trajectory_tum.txt").timestamps.tolist() == [1, 2]
    assert json.loads((output / "summary.json").read_text())["timestamps"] == "frame numbers"


def test_without_pyorbslam3_the_message_gives_the_pip_line(vocabulary, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    code, output = run(tmp_path, "anything", vocabulary)
    assert code == 2
    assert "pip install 'mdnvo_jax[orbslam]'" in capsys.readouterr().err
    assert not output.exists()
