"""Paths: steps accumulated to poses, and poses taken apart to steps."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_values import steps

from mdnvo_jax import geometry as geo


def test_accumulate_multiplies_from_the_right(lib: SimpleNamespace) -> None:
    T, first = geo.step_to_matrix(steps(3)), geo.step_to_matrix(steps(1, seed=1)[0])
    poses = lib.accumulate(T, first)
    expected = [first, first @ T[0], first @ T[0] @ T[1], first @ T[0] @ T[1] @ T[2]]
    np.testing.assert_allclose(poses, expected, atol=1e-13)
    np.testing.assert_allclose(lib.relative_steps(poses), T, atol=1e-13)
    np.testing.assert_array_equal(lib.accumulate(T)[0], np.eye(4))
    assert lib.accumulate(T[:0]).shape == (1, 4, 4)


def test_batches_of_paths(lib: SimpleNamespace) -> None:
    T = geo.step_to_matrix(steps(10)).reshape(2, 5, 4, 4)
    covariance = np.broadcast_to(np.diag([1.0, 2, 3, 4, 5, 6]) * 1e-2, (2, 5, 6, 6))
    poses = lib.accumulate(T)
    assert poses.shape == (2, 6, 4, 4)
    np.testing.assert_allclose(poses[1], geo.accumulate(T[1]), atol=1e-12)
    for order in (1, 2):
        spread = lib.propagate_covariance(T, covariance, order=order)
        assert spread.shape == (2, 6, 6, 6)
        np.testing.assert_allclose(
            spread[1], geo.propagate_covariance(T[1], covariance[1], order=order), rtol=1e-9, atol=1e-12
        )


@pytest.mark.parametrize("name", [f"{number:02d}" for number in range(11)])
def test_labels_give_the_poses_of_kitti_back(name: str, data_root: Path) -> None:
    lines = np.loadtxt(data_root / "trajectories" / "ground_truth" / f"{name}.txt")
    poses = np.tile(np.eye(4), (len(lines), 1, 1))
    poses[:, :3] = lines.reshape(-1, 3, 4)
    poses[:, :3, :3] = geo.project_to_so3(poses[:, :3, :3])
    # The files carry 7 digits.
    np.testing.assert_allclose(poses[:, :3].reshape(-1, 12), lines, atol=2e-6)
    labels = geo.matrix_to_step(geo.relative_steps(poses))
    back = geo.accumulate(geo.step_to_matrix(labels), poses[0])
    np.testing.assert_allclose(back[:, :3, 3], poses[:, :3, 3], rtol=0, atol=1e-6)
    np.testing.assert_allclose(back[:, :3, :3], poses[:, :3, :3], rtol=0, atol=1e-9)
