"""Figures that others published, to the last digit they printed."""

import numpy as np
import pytest

from mdnvo_jax.evaluation.association import pair
from mdnvo_jax.evaluation.formats import read_trajectory
from mdnvo_jax.evaluation.kitti_segments import by_length, segment_errors
from mdnvo_jax.evaluation.scoring import score_path
from mdnvo_jax.evaluation.trajectory import statistics

GROUND_TRUTH_10 = "ground_truth/10.txt"


@pytest.mark.parametrize(
    ("estimate", "reference", "alignment", "translation", "rotation", "t_rel", "r_rel"),
    [
        ("kitti_10/MDN-VO.txt", GROUND_TRUTH_10, "none", "0.1365", "0.2186", "14.07", "7.00"),
        ("kitti_10/DeepVO.txt", GROUND_TRUTH_10, "none", "0.2112", "0.2251", "14.80", "6.67"),
        ("kitti_10/ORB-SLAM.txt", GROUND_TRUTH_10, "sim3", "0.1657", "0.0743", "9.01", "0.69"),
        # 111 m hold a single segment, which is no statistic.
        ("nuscenes_0972/MDN-VO.txt", "nuscenes_0972/GT.txt", "none", "0.1699", "0.2131", "nan", "nan"),
    ],
)
def test_published_estimates(data_root, estimate, reference, alignment, translation, rotation, t_rel, r_rel):
    folder = data_root / "trajectories"
    paired = pair(read_trajectory(folder / estimate), read_trajectory(folder / reference))
    score = score_path("estimate", "split", paired, alignment)
    assert f"{statistics(score.relative.translation_m).rmse:.4f}" == translation
    assert f"{statistics(score.relative.rotation_deg).mean:.4f}" == rotation
    assert f"{score.segments.translation_percent:.2f}" == t_rel
    assert f"{score.segments.rotation_deg_per_100m:.2f}" == r_rel


def test_an_estimate_that_misses_frames(data_root):
    folder = data_root / "trajectories"
    estimate = read_trajectory(folder / "kitti_10" / "ORB-SLAM2_without_loop_closing.txt")
    paired = pair(estimate, read_trajectory(folder / GROUND_TRUTH_10))
    assert (estimate.format, len(paired.frames), len(paired.reference)) == ("indexed", 1198, 1201)
    score = score_path("ORB-SLAM2", "10", paired, "sim3")
    assert len(score.relative.frames) == 1197
    # Without loop closing the scale drifts, yet shapes agree: a few per cent of 920 m.
    assert np.sqrt((score.absolute_m**2).mean()) < 30
    # The three missing frames begin no segment but those from frame 0.
    assert score.segments.possible - len(score.segments.start) == 8


@pytest.mark.parametrize("name", ["00", "04", "10"])
def test_the_truth_is_without_error(data_root, name):
    poses = read_trajectory(data_root / "trajectories" / "ground_truth" / f"{name}.txt").poses
    found = segment_errors(poses, poses, np.arange(len(poses)))
    assert found.translation_percent < 1e-9
    assert len(by_length(found)) == (3 if name == "04" else 8)
