"""A saved model and frames: what goes through the network, offline and streaming, and what users get wrong."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_model
from small_model import CONFIG, LABELS

from mdnvo_jax import geometry, mixture, predictor
from mdnvo_jax.errors import InputError
from mdnvo_jax.mixture import Mixture
from mdnvo_jax.model.head import mixture_from_outputs
from mdnvo_jax.model.network import build
from mdnvo_jax.training.state import initial_state, initial_variables
from mdnvo_jax.training.store import Store

FRAMES = small_model.FRAMES[:12]


@pytest.fixture(scope="module")
def workdir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_model.save(tmp_path_factory.mktemp("model"))


@pytest.fixture(scope="module")
def model(workdir: Path) -> predictor.Predictor:
    model = predictor.load(workdir)
    steps = predictor.predict(model, FRAMES).steps
    assert np.all(steps.std(0) > 0.05 * LABELS.std), "a model that says the same of all frames tests nothing"
    return model


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    for index, frame in enumerate(FRAMES):
        cv2.imwrite(str(folder / f"frame{index}.png"), frame)
    return folder


def direct(model: predictor.Predictor, first_step: int, last_step: int) -> Mixture:
    """Return what the network as trained says of one window, frames in, without any machinery in between."""
    network = build(CONFIG.image, CONFIG.model)
    trained = predictor.trained(model.source)[0]
    variables = {"params": trained.params, "batch_stats": trained.batch_stats}
    images = FRAMES[None, first_step : last_step + 1]
    outputs = network.apply(variables, images, jnp.ones((1, last_step - first_step), bool), train=False)
    return mixture_from_outputs(outputs[0], model.model.labels, CONFIG.model)


def test_offline_every_step_is_that_of_its_window(model: predictor.Predictor) -> None:
    path = predictor.predict(model, FRAMES)
    assert path.poses.shape == (12, 4, 4)
    # Windows of four steps start at 0, 2, 4, 6, 7; step 3 is nearest to the middle of the one from 2.
    np.testing.assert_allclose(path.mixture.mean[3], direct(model, 2, 6).mean[1], atol=1e-5)
    np.testing.assert_allclose(path.mixture.log_scale[0], direct(model, 0, 4).log_scale[0], atol=1e-5)
    np.testing.assert_allclose(path.mixture.logits[10], direct(model, 7, 11).logits[3], atol=1e-5)


@pytest.mark.parametrize("mode", ["offline", "streaming"])
def test_mirrored_frames_show_the_mirrored_way_where_both_are_looked_at(model: predictor.Predictor, mode: str) -> None:
    """Not so by itself: the network's two answers differ, and sigma grows by what they differ."""
    config = dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, mirrored=True))
    both = predictor.from_model(predictor.trained(model.source)[0], config, source="memory")
    straight, turned = (predictor.predict(both, frames, mode=mode) for frames in (FRAMES, FRAMES[:, :, ::-1]))
    np.testing.assert_allclose(turned.steps, geometry.mirror_step(straight.steps), atol=1e-5)
    np.testing.assert_allclose(turned.sigma, straight.sigma, rtol=1e-4)
    one, other = (predictor.predict(model, frames, mode=mode) for frames in (FRAMES, FRAMES[:, :, ::-1]))
    apart = one.steps - geometry.mirror_step(other.steps)
    assert np.abs(apart / LABELS.std).max() > 0.05, "a network that sees no difference tests nothing"
    np.testing.assert_allclose(straight.steps, one.steps - apart / 2, atol=1e-5)
    expected = (one.sigma**2 + other.sigma**2) / 2 + apart**2 / 4
    np.testing.assert_allclose(straight.sigma**2, expected, rtol=1e-4)


def test_every_pair_goes_through_the_convolutions_once(model: predictor.Predictor) -> None:
    seen = []

    def counting(parameters: object, frames: np.ndarray) -> jax.Array:
        seen.extend(zip(frames[:-1, 0, 0, 0], frames[1:, 0, 0, 0], strict=True))
        return model.features(parameters, frames)

    numbered = np.broadcast_to(np.arange(12, dtype=np.uint8)[:, None, None, None], FRAMES.shape)
    predictor.predict(model._replace(features=counting), numbered, hop=1)
    # The first call, on blank frames, compiles.
    pairs = [(int(first), int(second)) for first, second in seen][8:]
    real = [(index, index + 1) for index in range(11)]
    assert pairs[:11] == real
    # What fills up the last chunk comes after the last frame.
    assert all(pair not in real for pair in pairs[11:])
    assert len(pairs) == 16


def test_streaming_sees_the_last_window_and_nothing_else(model: predictor.Predictor) -> None:
    path = predictor.predict(model, FRAMES, mode="streaming")
    np.testing.assert_allclose(path.mixture.mean[8], direct(model, 5, 9).mean[3], atol=1e-5)
    np.testing.assert_allclose(path.mixture.mean[1], direct(model, 0, 2).mean[1], atol=1e-5)
    # The future does not matter: the same frames cut short give the same steps.
    short = predictor.predict(model, FRAMES[:7], mode="streaming")
    np.testing.assert_array_equal(short.mixture.mean, path.mixture.mean[:6])


def test_a_bad_frame_is_held_and_flagged_or_stops(model: predictor.Predictor, folder: Path, tmp_path: Path) -> None:
    for index in range(12):
        (tmp_path / f"frame{index}.png").write_bytes((folder / f"frame{index}.png").read_bytes())
    (tmp_path / "frame5.png").write_bytes(b"not a picture")
    with pytest.raises(InputError, match=r"frame5\.png"):
        predictor.predict(model, tmp_path)
    whole = {mode: predictor.predict(model, folder, mode=mode) for mode in ("offline", "streaming")}
    for mode in ("offline", "streaming"):
        path = predictor.predict(model, tmp_path, mode=mode, bad_frames="hold")
        # Frame 5 belongs to two steps.
        assert [index for index, flag in enumerate(path.flags) if flag] == [4, 5], mode
        np.testing.assert_allclose(path.steps[4:6], np.tile(path.steps[3], (2, 1)), atol=1e-6)
        # What the last step was wrong by, and how far steps differ.
        np.testing.assert_allclose(path.sigma[4:6], np.tile(np.hypot(path.sigma[3], LABELS.std), (2, 1)), rtol=1e-5)
        # Steps whose window does not reach the bad frame are as they were.
        np.testing.assert_allclose(path.steps[:1], whole[mode].steps[:1], atol=1e-6)
        np.testing.assert_allclose(path.steps[-1:], whole[mode].steps[-1:], atol=1e-6)
        assert np.isfinite(path.poses).all()


def test_the_first_frame_may_be_bad_too(model: predictor.Predictor, folder: Path, tmp_path: Path) -> None:
    for index in range(12):
        (tmp_path / f"frame{index}.png").write_bytes((folder / f"frame{index}.png").read_bytes())
    (tmp_path / "frame0.png").write_bytes(b"")
    for mode in ("offline", "streaming"):
        path = predictor.predict(model, tmp_path, mode=mode, bad_frames="hold")
        assert set(path.about["ms_per_frame"]) == {"read", "wait", "network"}
        assert [bool(flag) for flag in path.flags] == [True] + [False] * 10
        np.testing.assert_allclose(path.steps[0], LABELS.mean, atol=1e-6)


def test_a_stream_is_a_pure_function_that_vmaps_over_cameras(model: predictor.Predictor) -> None:
    start = model.stream_start(model.model)
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), start)
    step = jax.jit(jax.vmap(model.stream_step, in_axes=(None, 0, 0, None)))
    single = start
    for index in range(3):
        both, found = step(model.model, both, jnp.stack([FRAMES[index], FRAMES[-1 - index]]), jnp.array(True))
        single, alone = model.stream_step(model.model, single, FRAMES[index], jnp.array(True))
    np.testing.assert_allclose(found.mean[0], alone.mean, atol=1e-5)
    assert not np.allclose(found.mean[0], found.mean[1])
    np.testing.assert_allclose(alone.mean, mixture.mean(alone.mixture), atol=1e-6)
    assert bool(alone.valid)


def test_a_frame_of_another_size_is_refused(model: predictor.Predictor) -> None:
    for image in (np.zeros((32, 63, 1), np.uint8), np.zeros((32, 64, 3), np.uint8)):
        with pytest.raises(ValueError, match=r"expected \(32, 64, 1\)"):
            model.stream_step(model.model, model.stream_start(model.model), image, True)


def test_the_command_line_does_not_take_the_place_of_the_function() -> None:
    import mdnvo_jax.predict
    from mdnvo_jax import predict
    from mdnvo_jax.predict import main

    assert predict is predictor.predict is mdnvo_jax.predict
    assert main.__module__ == "mdnvo_jax.predict"
    assert mdnvo_jax.mixture is mixture


def test_the_camera_brings_frames_to_that_of_the_training(model: predictor.Predictor) -> None:
    # The same scene by a camera of twice the resolution.
    large = np.stack([cv2.resize(cv2.GaussianBlur(f[..., 0], (9, 9), 0), (128, 64)) for f in FRAMES])[..., None]
    small = np.stack([cv2.resize(image[..., 0], (64, 32), interpolation=cv2.INTER_AREA) for image in large])[..., None]
    path = predictor.predict(model, large, camera=(80.0, 80.0, 63.5, 31.5))
    np.testing.assert_allclose(path.steps, predictor.predict(model, small).steps, atol=2e-2)
    other = predictor.predict(model, large, camera=(160.0, 160.0, 63.5, 31.5))
    assert np.abs(other.steps - path.steps).max() > 1e-3


def test_a_lens_that_sees_too_little_is_warned_of(
    model: predictor.Predictor, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for camera in (None, CONFIG.image.camera, (30.0, 30.0, 31.5, 15.5), (40.0, 40.0, 29.5, 15.5)):
        predictor.predict(model, FRAMES[:2], camera=camera)
        assert capsys.readouterr().err == "", camera
    # Twice the focal length: half the width, half the height. The first frame that can be read has the size.
    (tmp_path / "frame0.png").write_bytes(b"")
    for index in range(1, 12):
        (tmp_path / f"frame{index}.png").write_bytes((folder / f"frame{index}.png").read_bytes())
    predictor.predict(model, tmp_path, camera=(80.0, 80.0, 31.5, 15.5), bad_frames="hold")
    warning = capsys.readouterr().err
    assert warning.startswith(f"warning: {tmp_path} does not show 75 % of what")
    assert warning.count("\n") == 1


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (FRAMES[:1], "at least 2"),
        (FRAMES.astype(np.float32), "expected uint8"),
        (np.zeros((4, 32, 64, 3), np.uint8), "the model expects 1"),
        ("no/such/folder", "no/such/folder"),
    ],
)
def test_unusable_frames_are_named(model: predictor.Predictor, frames: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        predictor.predict(model, frames)


@pytest.mark.parametrize("hop", [0, 5])
def test_windows_that_leave_steps_out_are_refused(model: predictor.Predictor, hop: int) -> None:
    with pytest.raises(InputError, match=f"hop is {hop}: expected 1 to 4"):
        predictor.predict(model, FRAMES, hop=hop)


def test_a_checkpoint_that_is_none_or_does_not_fit_is_named(workdir: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no checkpoint in"):
        predictor.load(tmp_path)
    store = Store(tmp_path, keep_latest=1)
    state = initial_state(initial_variables(build(CONFIG.image, CONFIG.model), CONFIG), CONFIG, LABELS)
    wrong = dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, components=3))
    store.save(state, None, wrong, 1.0)
    store.close()
    with pytest.raises(InputError, match="does not fit"):
        predictor.load(tmp_path)


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "mdnvo_jax.predict", *arguments], capture_output=True, text=True)


def test_the_command_writes_its_files_once(workdir: Path, folder: Path, tmp_path: Path) -> None:
    arguments = (str(folder), "--checkpoint", str(workdir), "--output", str(tmp_path / "out"))
    done = run(*arguments, "--camera", "40,40,31.5,15.5")
    assert done.returncode == 0, done.stderr
    assert "12 frames" in done.stdout
    assert (tmp_path / "out" / "uncertainty.png").stat().st_size > 1000
    again = run(*arguments)
    assert again.returncode == 2
    assert again.stdout == ""
    assert again.stderr.count("\n") == 1
    assert "--force" in again.stderr


@pytest.mark.parametrize("module", ["train", "predict", "evaluate", "synthesize"])
def test_help_needs_no_heavy_import(module: str) -> None:
    script = (
        f"import runpy, sys; sys.argv = ['x', '--help']; runpy.run_module('mdnvo_jax.{module}', run_name='__main__')"
    )
    check = f"""
try:
    {script}
except SystemExit as done:
    assert not done.code
assert not {{'jax', 'cv2', 'flax', 'orbax', 'matplotlib', 'scipy'}} & set(sys.modules), sorted(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "usage" in done.stdout
