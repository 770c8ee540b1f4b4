"""The exported step runs without this package and says what ours says."""

import dataclasses
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.export
import numpy as np
import pytest
from small_model import CONFIG, FRAMES, save, trained

from mdnvo_jax import export, predictor

COMMAND = Path(__file__).resolve().parents[1] / "bin" / "export"
SCALE = np.linspace(0.5, 2, 6)


@pytest.fixture(scope="module")
def model() -> predictor.Predictor:
    """One that looks at mirrored pairs, too, as the weights that ship."""
    config = dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, mirrored=True))
    return predictor.from_model(
        trained(), config, source="memory", sigma_scale=SCALE, scale_sigma=0.06, correlation=SCALE / 10
    )


@pytest.fixture(scope="module")
def folder(model: predictor.Predictor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported")
    paths = export.write(model, folder)
    assert sorted(folder.iterdir()) == sorted(paths)
    return folder


@pytest.fixture(scope="module")
def streamed(model: predictor.Predictor) -> list:
    """What our own stream says of each frame; the fourth cannot be read."""
    state, steps = model.stream_start(model.model), []
    for index, frame in enumerate(FRAMES[:7]):
        state, step = model.stream_step(model.model, state, frame, index != 3)
        steps.append(step)
    return steps


def run_without(packages: tuple[str, ...], *arguments: str) -> list[list[float]]:
    """Run a program in a process that cannot import `packages`, and return the numbers it prints."""
    script = f"""
import runpy, sys
sys.modules.update(dict.fromkeys({packages!r}))
sys.argv = {list(arguments)!r}
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-W", "error", "-I", "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [[float(word) for word in line.split()] for line in done.stdout.splitlines()]


def test_the_program_beside_it_needs_none_of_us(folder: Path, tmp_path: Path, model: predictor.Predictor) -> None:
    np.save(tmp_path / "frames.npy", FRAMES[:7])
    ours = ("mdnvo_jax", "flax", "optax", "orbax", "cv2", "grain")
    found = np.array(run_without(ours, str(folder / "run.py"), str(tmp_path / "frames.npy")))
    path = predictor.predict(model, FRAMES[:7], mode="streaming")
    assert found.shape == (7, 12)
    np.testing.assert_allclose(found[1:, :6], path.steps, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found[1:, 6:], path.sigma, rtol=1e-5)
    assert np.ptp(found[1:, 2]) > 0.01


def test_any_number_of_cameras_each_with_its_own_state(folder: Path, streamed: list) -> None:
    step = jax.jit(jax.export.deserialize((folder / "step.jax").read_bytes()).call)
    weights, start = (dict(np.load(folder / name)) for name in ("weights.npz", "start.npz"))
    state = {name: np.stack([value] * 3) for name, value in start.items()}
    for index, expected in enumerate(streamed):
        # The second camera is the one that was recorded; the others see other things, or nothing.
        images = np.stack([FRAMES[-1 - index], FRAMES[index], FRAMES[index]])
        state, found = step(weights, state, images, np.array([True, index != 3, False]))
        for name in ("mean", "covariance", "held", "valid"):
            np.testing.assert_allclose(found[name][1], getattr(expected, name), rtol=1e-5, atol=1e-6)
        for name, leaf in expected.mixture._asdict().items():
            np.testing.assert_allclose(found[f"mixture_{name}"][1], leaf, rtol=1e-5, atol=1e-5)
    assert np.abs(found["mean"][0] - found["mean"][1]).max() > 1e-3
    assert list(found["held"]) == [False, False, True]


def test_it_holds_for_every_platform(folder: Path) -> None:
    exported = jax.export.deserialize((folder / "step.jax").read_bytes())
    assert exported.platforms == ("cpu", "cuda", "tpu")
    assert [str(size) for size in exported.in_avals[-1].shape] == ["cameras"]


def test_about_says_what_a_reader_has_to_know(folder: Path) -> None:
    about = json.loads((folder / "about.json").read_text())
    assert about["image"]["shape"] == [32, 64, 1]
    assert about["image"]["camera"] == [40.0, 40.0, 31.5, 15.5]
    assert about["image"]["normalisation"].startswith("standard")
    assert about["components"] == ["tx", "ty", "tz", "rx", "ry", "rz"]
    assert about["result"]["covariance"] == {"shape": ["B", 6, 6], "type": "float32"}
    assert about["result"]["mixture_mean"]["shape"] == ["B", 4, 6]
    assert about["state"]["gates"]["shape"] == [4, 128]
    assert about["mirrored"] is True
    assert about["sigma_scale"] == SCALE.tolist()
    assert about["scale_sigma"] == 0.06
    assert about["step_correlation"] == pytest.approx(SCALE / 10)
    with np.load(folder / "start.npz") as start:
        assert {name: list(value.shape) for name, value in start.items()} == {
            name: leaf["shape"] for name, leaf in about["state"].items()
        }


def test_the_command_exports_a_checkpoint_once(tmp_path: Path) -> None:
    checkpoint = save(tmp_path / "run")
    with_openvino = ["--openvino"] if importlib.util.find_spec("openvino") else []
    arguments = [sys.executable, COMMAND, "--checkpoint", checkpoint, "--output", tmp_path / "out"]
    done = subprocess.run([*arguments, *with_openvino], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    names = {"step.jax", "weights.npz", "start.npz", "about.json", "run.py"}
    names |= {"stack.xml", "stack.bin"} if with_openvino else set()
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    again = subprocess.run(arguments, capture_output=True, text=True)
    assert again.returncode == 2
    assert "--force" in again.stderr
    assert again.stderr.count("\n") == 1


def test_the_help_shows_the_program(folder: Path) -> None:
    done = subprocess.run([sys.executable, COMMAND, "--help"], capture_output=True, text=True)
    assert done.returncode == 0
    assert (folder / "run.py").read_text() in done.stdout
