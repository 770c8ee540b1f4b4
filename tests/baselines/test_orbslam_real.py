"""The real ORB-SLAM on real frames, where it is installed."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from orbslam_stand_in import run

from mdnvo_jax.baselines import orbslam
from mdnvo_jax.data.folder import read_frames
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.evaluation.association import pair
from mdnvo_jax.evaluation.formats import read_trajectory
from mdnvo_jax.evaluation.scoring import score_path


@pytest.fixture(scope="module")
def real_vocabulary():
    reason = "pyorbslam3 is not installed, or does not load: pip install 'mdnvo_jax[orbslam]'"
    pytest.importorskip("pyorbslam3", reason=reason, exc_type=ImportError)
    default = Path(__file__).resolve().parents[3] / "shared" / "orbslam" / "ORBvoc_small.txt.gz"
    path = Path(os.environ.get("MDNVO_ORB_VOCABULARY", default))
    if not path.is_file():
        pytest.skip(f"no vocabulary at {path}: set MDNVO_ORB_VOCABULARY to a DBoW2 vocabulary of ORB words")
    return path


def test_a_clip_of_kitti_is_tracked_to_half_a_percent(real_vocabulary, data_root, tmp_path, capfd):
    clip = data_root / "kitti" / "sequences" / "06"
    if not clip.is_dir():
        pytest.skip(f"no {clip}")
    # Less patience than by default bounds the time of the test on a busy machine.
    code, output = run(tmp_path, str(clip), real_vocabulary, "--rate", "30", "--patience", "0.3")
    out, err = capfd.readouterr()
    assert (code, out.count("\n"), err) == (0, 1, ""), "one line of ours, none of ORB-SLAM's"
    summary = json.loads((output / "summary.json").read_text())
    assert (summary["frames"], summary["tracked"], summary["lost_frames"]) == (51, 50, [[0, 0]])
    assert summary["poses"] == "final"
    estimate = read_trajectory(output / "trajectory_kitti_indexed.txt")
    reference = read_trajectory(data_root / "kitti" / "poses" / "06.txt")
    score = score_path("ORB-SLAM", "06", pair(estimate, reference), "sim3")
    length_m = np.linalg.norm(np.diff(reference.poses[:, :3, 3], axis=0), axis=1).sum()
    assert np.sqrt((score.absolute_m**2).mean()) < 0.005 * length_m
    assert score.relative.rotation_deg.mean() < 0.2
    # Without a scale the estimate is far off: the alignment is what brings it there.
    assert not 0.5 < np.linalg.norm(estimate.poses[-1, :3, 3]) / length_m < 2


def test_what_does_not_move_does_not_initialise(real_vocabulary, data_root):
    clip = data_root / "kitti" / "sequences" / "06"
    if not clip.is_dir():
        pytest.skip(f"no {clip}")
    frames = read_frames(clip, 1)
    still = Sequence("still", 5, lambda index: frames.read(0), camera=frames.camera)
    tracked = orbslam.track(still, real_vocabulary, rate_hz=30)
    assert (len(tracked.indices), tracked.poses.shape, tracked.died) == (0, (0, 4, 4), "")
    assert orbslam.failure(tracked).startswith("no trajectory: ORB-SLAM did not initialise")
