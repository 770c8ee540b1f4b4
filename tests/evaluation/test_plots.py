import subprocess
import sys

import cv2
import jax
import numpy as np
import pytest

from mdnvo_jax import geometry, odometry
from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation import calibration_plots, optional, plots
from mdnvo_jax.evaluation.calibration import score
from mdnvo_jax.mixture import Mixture


def predicted(steps, *, sigma=0.02, flags=None):
    """A gentle left turn, and what happened: twice the sigma off."""
    rng = np.random.default_rng(0)
    truth = np.tile([0.0, 0, 1, 0, -0.02, 0], (steps, 1))
    scale = np.array([sigma] * 3 + [sigma / 20] * 3) * 10 ** rng.uniform(-0.3, 0.3, (steps, 1))
    return trajectory(truth + 2 * scale * rng.standard_normal((steps, 6)), scale, flags), truth


def trajectory(mean, sigma, flags=None):
    """A trajectory from one Gaussian a step, in numpy alone."""
    steps, covariance = geometry.step_to_matrix(mean), sigma[:, :, None] ** 2 * np.eye(6)
    perturbation = geometry.step_covariance_to_perturbation(mean, covariance)
    count = len(mean)
    return odometry.Trajectory(
        poses=geometry.accumulate(steps),
        covariance=geometry.propagate_covariance(steps, perturbation),
        steps=mean,
        step_covariance=covariance,
        timestamps=np.arange(count + 1.0),
        flags=flags or [""] * count,
        mixture=Mixture(np.zeros((count, 1)), mean[:, None], np.log(sigma)[:, None]),
        coupling="independent",
    )


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Draw few pixels: what is drawn is looked at, not how finely."""
    monkeypatch.setattr(plots, "_DPI", 50)


def ink(path):
    """Share of pixels that are not white."""
    image = cv2.imread(str(path))
    assert image is not None and min(image.shape[:2]) > 140
    return np.mean(np.any(image < 250, axis=-1))


@pytest.mark.parametrize("steps", [1, 400])
def test_what_predict_draws(tmp_path, steps):
    path, truth = predicted(steps, flags=["held"] + [""] * (steps - 1))
    plots.plot_trajectory(path, tmp_path / "trajectory.png")
    plots.plot_uncertainty(path, tmp_path / "uncertainty.png")
    plots.plot_uncertainty(path, tmp_path / "with_truth.png", truth=truth, title="a title")
    assert all(ink(tmp_path / name) > 0.02 for name in ("trajectory.png", "uncertainty.png", "with_truth.png"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["trajectory.png", "uncertainty.png", "with_truth.png"]


@pytest.mark.parametrize("sigma", [1e-9, 1e3])
def test_no_confidence_hides_the_path(tmp_path, sigma):
    path, _ = predicted(30, sigma=sigma)
    plots.plot_trajectory(path, tmp_path / "trajectory.png")
    plots.plot_uncertainty(path, tmp_path / "uncertainty.png")


def test_a_camera_that_stands_still(tmp_path):
    path = trajectory(np.zeros((5, 6)), np.full((5, 6), 1e-3))
    plots.plot_trajectory(path, tmp_path / "trajectory.png")
    plots.plot_paths({"still": path.poses}, tmp_path / "paths.png", title="still", reference=path.poses)


def ellipse_extent(tmp_path, monkeypatch, sigma):
    """Width and height, in metres, of the last of the ellipses on 39 steps of 1 m straight ahead."""
    path = trajectory(np.tile([0.0, 0, 1, 0, 0, 0], (39, 1)), np.tile(sigma, (39, 1)))
    figures = []
    monkeypatch.setattr(plots, "save", lambda figure, _: figures.append(figure))
    plots.plot_trajectory(path, tmp_path / "unused.png")
    (axes,) = figures[0].axes
    ellipses = [artist for artist in axes.get_children() if type(artist).__name__ == "Ellipse"]
    assert len(ellipses) == 24
    box = ellipses[-1].get_extents().transformed(axes.transData.inverted())
    return box.width, box.height


# An ellipse of 95 % reaches this many sigma to both sides.
REACH = 2 * np.sqrt(-2 * np.log(0.05))


def test_ellipses_lie_across_the_path_where_the_heading_is_unsure(tmp_path, monkeypatch):
    width, height = ellipse_extent(tmp_path, monkeypatch, [1e-6, 1e-6, 1e-6, 1e-6, 1e-2, 1e-6])
    # The error of a heading moves all that follows: sigma of x is 0.01 sqrt(sum of i^2) over the steps to come.
    assert width == pytest.approx(REACH * 0.01 * np.sqrt(sum(i * i for i in range(39))), rel=1e-3)
    assert height < 1e-3


def test_ellipses_lie_along_the_path_where_the_speed_is_unsure(tmp_path, monkeypatch):
    width, height = ellipse_extent(tmp_path, monkeypatch, [1e-6, 0.5, 0.1, 1e-6, 1e-6, 1e-6])
    assert height == pytest.approx(REACH * 0.1 * np.sqrt(39), rel=1e-3)
    assert width < 1e-3


def test_paths_are_seen_from_the_first_camera(tmp_path, monkeypatch):
    # The world is turned by 90 degrees; from the first camera the drive still goes ahead, along z.
    truth = np.tile(np.eye(4), (10, 1, 1))
    truth[:, 2, 3] = np.arange(10)
    world = np.array([[0.0, 0, 1, 5], [0, 1, 0, 6], [-1, 0, 0, 7], [0, 0, 0, 1]])
    figures = []
    monkeypatch.setattr(plots, "save", lambda figure, _: figures.append(figure))
    plots.plot_paths({"same": world @ truth}, tmp_path / "unused.png", title="T", reference=world @ truth)
    (axes,) = figures[0].axes
    for line in axes.get_lines()[:2]:
        np.testing.assert_allclose(line.get_xdata(), 0, atol=1e-12)
        np.testing.assert_allclose(line.get_ydata(), np.arange(10), atol=1e-12)
    assert axes.get_title() == "T" and axes.get_aspect() == 1
    assert [text.get_text() for text in figures[0].legends[0].get_texts()] == ["ground truth", "same", "start"]


@pytest.mark.parametrize("steps", [300])
def test_calibration_pictures(tmp_path, steps):
    path, truth = predicted(steps)
    scores = score(path.mixture, truth)
    names = calibration_plots.plot_calibration(scores, tmp_path, title="model, 10, no alignment")
    assert sorted(names) == sorted(p.name for p in tmp_path.iterdir())
    assert len(names) == 4 and all(ink(tmp_path / name) > 0.02 for name in names)


@pytest.mark.parametrize("draw", [calibration_plots.plot_sigma_error, calibration_plots.plot_sparsification])
def test_a_sigma_that_never_varies_and_no_error(tmp_path, draw):
    density = Mixture(np.zeros((20, 1)), np.zeros((20, 1, 6)), np.zeros((20, 1, 6)))
    draw(score(density, np.zeros((20, 6))), tmp_path / "drawn.png", title="exact")


def test_without_matplotlib_the_pip_line_is_given(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(InputError, match=r"matplotlib is not installed.*pip install 'mdnvo_jax\[eval\]'"):
        plots.canvas(1, 1)


def test_optional_modules():
    assert optional.load("json").loads("1") == 1
    with pytest.raises(InputError, match="no_such_package is not installed"):
        optional.load("no_such_package.part")


def test_pictures_need_neither_pyplot_nor_evo_nor_scipy():
    code = (
        "import sys, numpy as np; from mdnvo_jax.evaluation import plots;"
        "import tempfile, pathlib; folder = pathlib.Path(tempfile.mkdtemp());"
        "plots.plot_paths({'a': np.tile(np.eye(4), (3, 1, 1))}, folder / 'a.png', title='T');"
        "print([name for name in ('matplotlib.pyplot', 'evo', 'scipy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_jax_was_not_switched_to_float64_by_any_of_this():
    assert jax.numpy.zeros(1).dtype == np.float32
