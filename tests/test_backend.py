"""The convolutions outside JAX, and in another precision: the same steps within what is promised."""

import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from small_model import CONFIG, FRAMES, save, trained

from mdnvo_jax import backend, predictor
from mdnvo_jax.errors import InputError
from mdnvo_jax.model.fold import folded_stack
from mdnvo_jax.predict import main

openvino = pytest.mark.skipif(not importlib.util.find_spec("openvino"), reason="openvino is not installed")
# Of the features, relative to the largest, as the README promises.
TOLERANCE = {"float32": 1e-4, "bfloat16": 2e-2}


@pytest.fixture(scope="module")
def model() -> predictor.Predictor:
    return predictor.from_model(trained(), CONFIG, source="memory")


@pytest.fixture(scope="module")
def expected(model: predictor.Predictor) -> np.ndarray:
    features = np.asarray(model.features(model.model, FRAMES[:9]))
    # Features that hardly depend on the frames would agree whatever was computed.
    assert features.std(0).mean() > 0.1 * np.abs(features).mean()
    return features


@openvino
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_openvino_computes_the_same(model: predictor.Predictor, expected: np.ndarray, precision: str) -> None:
    other = predictor.from_model(trained(), CONFIG, source="memory", backend="openvino", precision=precision)
    assert (other.backend, other.precision) == ("openvino", precision)
    # Any number of pairs goes, and results stay when others follow.
    first, second = other.features(other.model, FRAMES[:4]), other.features(other.model, FRAMES[3:9])
    found = np.concatenate([first, second])
    assert np.abs(found - expected).max() < TOLERANCE[precision] * np.abs(expected).max()
    for mode in ("offline", "streaming"):
        ours, theirs = predictor.predict(model, FRAMES, mode=mode), predictor.predict(other, FRAMES, mode=mode)
        # In standard deviations of the step.
        assert np.abs((theirs.steps - ours.steps) / ours.sigma).max() < 5 * TOLERANCE[precision]
        assert np.abs(ours.steps - ours.steps[0]).max() > 0.05
        assert theirs.about["backend"] == "openvino"


@openvino
@pytest.mark.parametrize("mode", ["offline", "streaming"])
def test_openvino_looks_at_mirrored_pairs_too(model: predictor.Predictor, mode: str) -> None:
    config = dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, mirrored=True))
    ours, theirs = (
        predictor.predict(predictor.from_model(trained(), config, source="memory", backend=which), FRAMES, mode=mode)
        for which in ("jax", "openvino")
    )
    assert np.abs((theirs.steps - ours.steps) / ours.sigma).max() < 5 * TOLERANCE["float32"]
    single = predictor.predict(model, FRAMES, mode=mode)
    assert np.abs((single.steps - ours.steps) / ours.sigma).max() > 0.01


@openvino
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_maps_of_many_pixels(model: predictor.Predictor, precision: str) -> None:
    image = dataclasses.replace(CONFIG.image, height=70, width=150)
    pairs = np.random.default_rng(0).normal(size=(2, 70, 150, 2)).astype(np.float32)
    expected = np.asarray(folded_stack(model.model.stack, pairs))
    assert expected.shape == (2, 2 * 3 * 64)
    found = backend.openvino_compiled(model.model.stack, image, precision)(pairs)
    error = np.abs(found - expected).max() / np.abs(expected).max()
    assert error < TOLERANCE[precision]
    able = backend._import_openvino().Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    if precision == "bfloat16" and "BF16" in able:
        assert error > 1e-3


@openvino
def test_a_frame_that_cannot_be_read_is_held(model: predictor.Predictor) -> None:
    other = predictor.from_model(trained(), CONFIG, source="memory", backend="openvino")
    ours, theirs = (found.stream_start(found.model) for found in (model, other))
    for index, usable in enumerate([True, True, False, True, True]):
        ours, expected = model.stream_step(model.model, ours, FRAMES[index], usable)
        theirs, found = other.stream_step(other.model, theirs, FRAMES[index], usable)
        assert bool(found.held) == (index in (2, 3))
        np.testing.assert_allclose(found.mean, expected.mean, atol=1e-5)


def test_bfloat16_in_jax_is_for_matrix_units(model: predictor.Predictor, expected: np.ndarray) -> None:
    other = predictor.from_model(trained(), CONFIG, source="memory", precision="bfloat16")
    for found in (model, other):
        program = str(jax.make_jaxpr(found.features)(found.model, FRAMES[:9]))
        step = str(jax.make_jaxpr(found.stream_step)(found.model, found.stream_start(found.model), FRAMES[0], True))
        assert ("bf16" in program, "bf16" in step) == (found is other, found is other)
    error = np.abs(np.asarray(other.features(other.model, FRAMES[:9])) - expected).max()
    assert error < TOLERANCE["bfloat16"] * np.abs(expected).max()


def test_without_openvino_jax_computes_and_one_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(backend, "find_spec", lambda name: None)
    folder = tmp_path / "frames"
    folder.mkdir()
    for index, frame in enumerate(FRAMES[:4]):
        cv2.imwrite(str(folder / f"{index}.png"), frame)
    checkpoint = save(tmp_path / "run")
    arguments = [str(folder), "--checkpoint", str(checkpoint), "--precision", "bfloat16"]
    main([*arguments, "--output", str(tmp_path / "out"), "--backend", "openvino"])
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert "pip install 'mdnvo_jax[openvino]'" in errors
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["backend"], summary["precision"]) == ("jax", "bfloat16")
    assert set(summary["ms_per_frame"]) == {"read", "wait", "network"}


def test_a_missing_or_broken_openvino_is_named(monkeypatch: pytest.MonkeyPatch, model: predictor.Predictor) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(InputError, match="openvino is not installed: pip install"):
        backend.openvino_stack(model.model.stack, CONFIG.image)


@openvino
def test_importing_openvino_reports_nothing_and_forks_nothing(tmp_path: Path) -> None:
    script = """
import os, sys
forks = []
os.register_at_fork(before=lambda: forks.append(1))
from mdnvo_jax import backend
backend._import_openvino()
import threading
[thread.join(5) for thread in threading.enumerate() if thread is not threading.current_thread()]
assert not forks
assert "openvino_telemetry" not in sys.modules
"""
    environment = {**os.environ, "HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.iterdir())


@openvino
def test_the_file_of_the_stack_is_read_back(tmp_path: Path, model: predictor.Predictor, expected: np.ndarray) -> None:
    paths = backend.save(backend.openvino_stack(model.model.stack, CONFIG.image), tmp_path / "stack.xml")
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    # In float32, not rounded to half of it.
    assert paths[1].stat().st_size >= 4 * sum(leaf.size for leaf in jax.tree.leaves(model.model.stack))
    core = backend._import_openvino().Core()
    compiled = core.compile_model(paths[0], "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    assert (compiled.input(0).any_name, compiled.output(0).any_name) == ("pairs", "features")
    frames = (FRAMES[:9] / 255 - 0.5).astype(np.float32)
    found = compiled({"pairs": np.concatenate([frames[:-1], frames[1:]], -1)})["features"]
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()
