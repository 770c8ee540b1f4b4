"""From densities of steps to a trajectory and its files."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnvo_jax import geometry, odometry
from mdnvo_jax.errors import InputError
from mdnvo_jax.mixture import Mixture

RHO = np.array([0.6, 0.2, 0.0, 0.5, 0.4, 0.1])


def densities(count: int, components: int = 2, seed: int = 0) -> Mixture:
    generator = np.random.default_rng(seed)
    mean = np.array([0, 0, 1, 0, 0.03, 0]) + 0.01 * generator.normal(size=(count, components, 6))
    return Mixture(
        generator.normal(size=(count, components)), mean, np.log(generator.uniform(0.005, 0.02, (count, components, 6)))
    )


@given(st.integers(1, 60), st.integers(1, 12), st.integers(1, 12))
def test_every_step_comes_once_and_from_the_window_that_sees_most_around_it(count: int, window: int, hop: int) -> None:
    hop = min(hop, window)
    plan = list(odometry.window_plan(count, window, hop))
    assert [step for _, first, last in plan for step in range(first, last)] == list(range(count))
    starts = [start for start, _, _ in plan]
    assert starts[0] == 0
    assert starts == sorted(set(starts))
    for start, first, last in plan:
        assert start <= first <= last <= start + window
        for step in range(first, last):
            off_centre = [abs(step - other - (window - 1) / 2) for other in starts]
            assert abs(step - start - (window - 1) / 2) == min(off_centre)


def test_the_trajectory_composes_the_means_and_their_covariance() -> None:
    steps = densities(30)
    path = odometry.trajectory(steps, coupling="joint")
    weights = np.exp(steps.logits) / np.exp(steps.logits).sum(-1, keepdims=True)
    means = (weights[..., None] * steps.mean).sum(1)
    np.testing.assert_allclose(path.steps, means, rtol=1e-5, atol=1e-7)
    pose = np.eye(4)
    np.testing.assert_array_equal(path.poses[0], pose)
    for index, step in enumerate(geometry.step_to_matrix(path.steps), start=1):
        pose = pose @ step
        np.testing.assert_allclose(path.poses[index], pose, atol=1e-12)
    # Law of total variance, by hand.
    variance = (weights[..., None] * (np.exp(2 * steps.log_scale) + (steps.mean - means[:, None]) ** 2)).sum(1)
    np.testing.assert_allclose(path.sigma, np.sqrt(variance), rtol=1e-4)
    assert not path.covariance[0].any()
    # On a path that hardly bends, the variance along z grows by that of every step.
    assert np.all(np.linalg.eigvalsh(path.covariance[1:]) > 0)
    assert np.all(np.diff(np.trace(path.covariance, axis1=1, axis2=2)) > 0)
    np.testing.assert_allclose(path.distance_m, np.linalg.norm(means[:, :3], axis=1).sum(), rtol=1e-5)


def test_the_strongest_component_can_be_reported() -> None:
    steps = densities(5)
    path = odometry.trajectory(steps, coupling="independent", estimate="strongest")
    best = steps.logits.argmax(-1)
    np.testing.assert_allclose(path.steps, steps.mean[np.arange(5), best], rtol=1e-6)
    np.testing.assert_allclose(path.sigma, np.exp(steps.log_scale[np.arange(5), best]), rtol=1e-5)


def test_a_monte_carlo_over_the_steps_has_the_covariance_that_is_told() -> None:
    generator = np.random.default_rng(1)
    count, draws = 20, 4000
    scale = np.array([0.01, 0.01, 0.03, 0.002, 0.01, 0.002])
    mean = np.tile([0, 0, 1, 0, 0.05, 0], (count, 1)).astype(float)
    steps = Mixture(np.zeros((count, 1)), mean[:, None], np.tile(np.log(scale), (count, 1, 1)))
    path = odometry.trajectory(steps, coupling="joint")
    samples = np.tile(np.eye(4), (draws, 1, 1))
    for index in range(count):
        samples = samples @ geometry.step_to_matrix(mean[index] + scale * generator.normal(size=(draws, 6)))
    errors = geometry.log_se3(geometry.inverse(path.poses[-1]) @ samples)
    np.testing.assert_allclose(np.cov(errors.T), path.covariance[-1], atol=0.05 * np.abs(path.covariance[-1]).max())


def gaussian_steps(mean: np.ndarray, scale: np.ndarray) -> Mixture:
    return Mixture(np.zeros((len(mean), 1)), mean[:, None], np.tile(np.log(scale), (len(mean), 1, 1)))


def test_an_error_of_scale_grows_with_the_distance_where_those_of_steps_average_out() -> None:
    straight = gaussian_steps(np.tile([0, 0, 2.0, 0, 0, 0], (100, 1)), np.array([0.01, 0.01, 0.1, 1e-9, 1e-9, 1e-9]))
    path = odometry.trajectory(straight, coupling="joint", scale_sigma=0.05)
    sigma = np.sqrt(np.diagonal(path.covariance, axis1=1, axis2=2))
    count = np.arange(101)
    np.testing.assert_allclose(sigma[:, 2], np.hypot(0.1 * np.sqrt(count), 0.05 * 2 * count), rtol=1e-6)
    np.testing.assert_allclose(sigma[:, 0], 0.01 * np.sqrt(count), rtol=1e-6)
    # What is said of single steps stays as it is.
    alone = odometry.trajectory(straight, coupling="joint")
    np.testing.assert_array_equal(path.step_covariance, alone.step_covariance)
    np.testing.assert_array_equal(path.mixture.log_scale, alone.mixture.log_scale)
    assert (alone.scale_sigma, path.scale_sigma) == (0, 0.05)


def test_without_errors_that_steps_share_nothing_changes() -> None:
    path = odometry.trajectory(densities(30), coupling="joint", scale_sigma=0.0, correlation=np.zeros(6))
    perturbation = geometry.step_covariance_to_perturbation(path.steps, path.step_covariance)
    expected = geometry.propagate_covariance(geometry.step_to_matrix(path.steps), perturbation)
    assert path.covariance.tobytes() == np.asarray(expected).tobytes()


def test_a_monte_carlo_over_steps_and_scale_has_the_covariance_that_is_told() -> None:
    generator = np.random.default_rng(2)
    count, draws, scale_sigma = 30, 4000, 0.04
    scale = np.array([0.01, 0.01, 0.03, 0.001, 0.004, 0.001])
    mean = np.tile([0.02, 0, 1, 0, 0.07, 0], (count, 1)).astype(float)
    path = odometry.trajectory(gaussian_steps(mean, scale), coupling="joint", scale_sigma=scale_sigma)
    samples = np.tile(np.eye(4), (draws, 1, 1))
    factor = 1 + scale_sigma * generator.normal(size=(draws, 1))
    for index in range(count):
        step = mean[index] + scale * generator.normal(size=(draws, 6))
        step[:, :3] *= factor
        samples = samples @ geometry.step_to_matrix(step)
    errors = geometry.log_se3(geometry.inverse(path.poses[-1]) @ samples)
    expected = path.covariance[-1]
    np.testing.assert_allclose(np.cov(errors.T), expected, atol=0.05 * np.abs(expected).max())
    # Without the term it would be told several times too small.
    told = odometry.trajectory(gaussian_steps(mean, scale), coupling="joint").covariance[-1]
    assert np.trace(np.linalg.solve(told, np.cov(errors.T))) / 6 > 1.5
    assert np.trace(np.linalg.solve(expected, np.cov(errors.T))) / 6 == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("rho", [0.0, 0.3, 1.0])
def test_correlated_errors_of_steps_add_up_where_independent_ones_average_out(rho: float) -> None:
    sigma = np.array([0.01, 0.02, 0.1, 1e-9, 1e-9, 1e-9])
    straight = gaussian_steps(np.tile([0, 0, 2.0, 0, 0, 0], (100, 1)), sigma)
    path = odometry.trajectory(straight, coupling="joint", correlation=np.array([rho, 0, rho, 0, 0, 0]))
    count = np.arange(101)
    # Of n errors of variance 1, any two of which have the correlation rho: n + n (n - 1) rho.
    grown = np.sqrt(count + count * (count - 1) * rho)
    found = np.sqrt(np.diagonal(path.covariance, axis1=1, axis2=2))
    expected = np.stack([sigma[0] * grown, sigma[1] * np.sqrt(count), sigma[2] * grown], axis=1)
    np.testing.assert_allclose(found[:, :3], expected, rtol=1e-6)
    # A single step is as unsure as it says.
    np.testing.assert_allclose(path.sigma, np.tile(sigma, (100, 1)), rtol=1e-6)
    np.testing.assert_allclose(found[1, :3], sigma[:3], rtol=1e-6)


def test_a_monte_carlo_over_correlated_steps_has_the_covariance_that_is_told() -> None:
    generator = np.random.default_rng(3)
    count, draws = 25, 4000
    scale = np.array([0.01, 0.01, 0.03, 0.001, 0.004, 0.001])
    mean = np.tile([0.02, 0, 1, 0, 0.05, 0], (count, 1)).astype(float)
    path = odometry.trajectory(gaussian_steps(mean, scale), coupling="joint", correlation=RHO)
    samples = np.tile(np.eye(4), (draws, 1, 1))
    shared = generator.normal(size=(draws, 6))
    for index in range(count):
        error = np.sqrt(RHO) * shared + np.sqrt(1 - RHO) * generator.normal(size=(draws, 6))
        samples = samples @ geometry.step_to_matrix(mean[index] + scale * error)
    errors = geometry.log_se3(geometry.inverse(path.poses[-1]) @ samples)
    np.testing.assert_allclose(np.cov(errors.T), path.covariance[-1], atol=0.05 * np.abs(path.covariance[-1]).max())
    assert np.trace(np.linalg.solve(path.covariance[-1], np.cov(errors.T))) / 6 == pytest.approx(1, abs=0.1)


def test_errors_that_neighbours_share_average_out_slowly() -> None:
    sigma = np.array([0.01, 0.02, 0.1, 1e-9, 1e-9, 1e-9])
    straight = gaussian_steps(np.tile([0, 0, 2.0, 0, 0, 0], (100, 1)), sigma)
    serial = np.array([0.9, 0.0, 1.0, 0, 0, 0])
    path = odometry.trajectory(straight, coupling="joint", serial_correlation=serial)
    found = np.sqrt(np.diagonal(path.covariance, axis1=1, axis2=2))
    for count in (1, 2, 10, 100):
        apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
        expected = [s * np.sqrt((r**apart).sum()) for s, r in zip(sigma[:3], serial, strict=False)]
        np.testing.assert_allclose(found[count, :3], expected, rtol=1e-6)


def test_a_monte_carlo_over_all_that_steps_share_has_the_covariance_that_is_told() -> None:
    generator = np.random.default_rng(4)
    count, draws = 25, 4000
    scale = np.array([0.01, 0.01, 0.03, 0.001, 0.004, 0.001])
    serial = np.array([0.9, 0.0, 0.6, 0.8, 0.95, 0.3])
    mean = np.tile([0.02, 0, 1, 0, 0.05, 0], (count, 1)).astype(float)
    steps = gaussian_steps(mean, scale)
    path = odometry.trajectory(steps, coupling="joint", correlation=RHO, serial_correlation=serial)
    samples = np.tile(np.eye(4), (draws, 1, 1))
    shared, wander = generator.normal(size=(2, draws, 6))
    for index in range(count):
        error = np.sqrt(RHO) * shared + np.sqrt(1 - RHO) * wander
        samples = samples @ geometry.step_to_matrix(mean[index] + scale * error)
        wander = serial * wander + np.sqrt(1 - serial**2) * generator.normal(size=(draws, 6))
    errors = geometry.log_se3(geometry.inverse(path.poses[-1]) @ samples)
    assert np.trace(np.linalg.solve(path.covariance[-1], np.cov(errors.T))) / 6 == pytest.approx(1, abs=0.1)
    without = odometry.trajectory(steps, coupling="joint", correlation=RHO).covariance[-1]
    assert np.trace(np.linalg.solve(without, np.cov(errors.T))) / 6 > 1.5


def test_the_correlation_of_steps_does_not_matter_after_the_first() -> None:
    # A large turn, so that the axes of the two frames differ.
    turn = gaussian_steps(np.array([[0.3, -0.1, 1, 0.4, 1.2, -0.3]]), np.array([0.01, 0.02, 0.1, 0.01, 0.03, 0.05]))
    alone, together = (
        odometry.trajectory(turn, coupling="joint", correlation=rho, serial_correlation=rho) for rho in (None, RHO)
    )
    np.testing.assert_allclose(together.covariance, alone.covariance, atol=1e-15)


def test_correlated_components_of_a_step_stay_a_covariance() -> None:
    """A joint density couples components; taking a share of some variances must leave a covariance."""
    some = np.array([1, 0, 0.5, 0.9, 0, 0.99])
    path = odometry.trajectory(densities(20), coupling="joint", correlation=some, serial_correlation=some[::-1])
    assert np.all(np.linalg.eigvalsh(path.covariance[1:]) > 0)


@pytest.mark.parametrize("correlation", [np.full(6, 1.1), np.full(6, -0.1), np.full(6, np.nan), np.zeros(3)])
def test_correlations_that_are_none_are_named(correlation: np.ndarray) -> None:
    with pytest.raises(ValueError, match="six numbers from 0 to 1"):
        odometry.trajectory(densities(3), coupling="joint", correlation=correlation)
    with pytest.raises(ValueError, match="serial_correlation is"):
        odometry.trajectory(densities(3), coupling="joint", serial_correlation=correlation)


@pytest.mark.parametrize("sigma", [-0.01, float("nan"), float("inf")])
def test_a_scale_error_that_is_none_is_named(sigma: float) -> None:
    with pytest.raises(InputError, match="expected a share"):
        odometry.trajectory(densities(3), coupling="joint", scale_sigma=sigma)


def test_the_files_hold_the_trajectory(tmp_path: Path) -> None:
    path = odometry.trajectory(
        densities(12),
        coupling="joint",
        timestamps=100 + 0.1 * np.arange(13),
        flags=["held"] + [""] * 11,
        scale_sigma=0.05,
        correlation=np.array([0, 0, 0, 0, 0.25, 0]),
        serial_correlation=np.array([0.5, 0, 0, 0, 0, 0]),
    )
    path.save(tmp_path / "out")
    names = {entry.name for entry in (tmp_path / "out").iterdir()}
    assert names == {
        "trajectory_kitti.txt",
        "trajectory_tum.txt",
        "steps.csv",
        "covariance.csv",
        "mixture.npz",
        "trajectory.png",
        "uncertainty.png",
        "summary.json",
    }
    kitti = np.loadtxt(tmp_path / "out" / "trajectory_kitti.txt")
    np.testing.assert_allclose(kitti.reshape(13, 3, 4), path.poses[:, :3], atol=1e-8)
    tum = np.loadtxt(tmp_path / "out" / "trajectory_tum.txt")
    np.testing.assert_allclose(tum[:, 0], path.timestamps)
    np.testing.assert_allclose(tum[:, 1:4], path.poses[:, :3, 3], atol=1e-8)
    np.testing.assert_allclose(geometry.matrix_from_quaternion(tum[:, 4:]), path.poses[:, :3, :3], atol=1e-7)
    with (tmp_path / "out" / "steps.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    names = ["tx", "ty", "tz", "rx", "ry", "rz"]
    assert list(rows[0]) == ["frame", "timestamp", *names, *(f"sigma_{n}" for n in names), "log_density_peak", "flags"]
    assert [row["frame"] for row in rows] == [str(frame) for frame in range(1, 13)]
    np.testing.assert_allclose([[float(row[name]) for name in names] for row in rows], path.steps, rtol=1e-8)
    np.testing.assert_allclose([[float(row[f"sigma_{n}"]) for n in names] for row in rows], path.sigma, rtol=1e-8)
    assert [row["flags"] for row in rows] == ["held"] + [""] * 11
    with (tmp_path / "out" / "covariance.csv").open(newline="") as stream:
        covariance = np.array([[float(value) for value in row] for row in list(csv.reader(stream))[1:]])
    assert covariance.shape == (13, 1 + 21 + 21)
    upper = np.triu_indices(6)
    np.testing.assert_allclose(covariance[:, 1:22], path.covariance[:, *upper], rtol=1e-8)
    np.testing.assert_allclose(covariance[1:, 22:], path.step_covariance[:, *upper], rtol=1e-8)
    with np.load(tmp_path / "out" / "mixture.npz", allow_pickle=False) as stored:
        np.testing.assert_array_equal(stored["mean"], path.mixture.mean)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["frames"] == 13
    assert summary["flagged_steps"] == 1
    assert summary["coupling"] == "joint"
    assert summary["scale_sigma"] == 0.05
    assert summary["step_correlation"]["ry"] == 0.25 and summary["serial_correlation"]["tx"] == 0.5


def test_results_are_not_overwritten_by_accident(tmp_path: Path) -> None:
    path = odometry.trajectory(densities(3), coupling="joint")
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(InputError, match="--force"):
        path.save(tmp_path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["mine.txt"]
    path.save(tmp_path, force=True)
    assert (tmp_path / "mine.txt").read_text() == "precious"
