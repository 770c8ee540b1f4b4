"""Checkpoints on a disk that fails: the newest whole one is found, bit rot is noticed, and nothing is lost for good."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_model
from small_model import CONFIG, LABELS

from mdnvo_jax import predictor
from mdnvo_jax.errors import InputError
from mdnvo_jax.model.network import build
from mdnvo_jax.training import checkpoint, checksum
from mdnvo_jax.training.state import SKIPPED, State, initial_state, initial_variables
from mdnvo_jax.training.store import Restored, Store, UnsavedError, any_step

STEPS = (3, 6, 9)


def state_at(step: int, state: State) -> State:
    params = jax.tree.map(lambda leaf: leaf + step, state.model.params)
    return state._replace(model=state.model._replace(params=params), step=jnp.asarray(step, jnp.int32))


@pytest.fixture(scope="module")
def first_state() -> State:
    variables = initial_variables(build(CONFIG.image, CONFIG.model), CONFIG)
    return initial_state(variables, CONFIG, LABELS)._replace(model=small_model.trained())


@pytest.fixture(scope="module")
def saved(first_state: State, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The --workdir of a training with three checkpoints, the last of them the best."""
    workdir = tmp_path_factory.mktemp("saved")
    store = Store(workdir, keep_latest=3)
    for step in STEPS:
        store.save(state_at(step, first_state), {"next_index": step}, CONFIG, 1.0 / step)
    store.close()
    return workdir


@pytest.fixture
def workdir(saved: Path, tmp_path: Path) -> Path:
    return shutil.copytree(saved, tmp_path / "run")


def restore(workdir: Path) -> Restored:
    store = Store(workdir, keep_latest=3)
    try:
        return store.restore(checkpoint.template(CONFIG))
    finally:
        store.close()


def largest_file(folder: Path) -> Path:
    return max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)


def truncated(step: Path) -> None:
    path = largest_file(step / "model")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flipped_bytes(step: Path) -> None:
    path = largest_file(step / "training")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def without_a_manifest(step: Path) -> None:
    manifests = list((step / "model").rglob("manifest*"))
    assert manifests
    for path in manifests:
        path.unlink()


def empty(step: Path) -> None:
    shutil.rmtree(step)
    step.mkdir()


def half_written(step: Path) -> None:
    shutil.rmtree(step / "about")
    shutil.rmtree(step / "data")
    (step / "_CHECKPOINT_METADATA").unlink()


def other_parameters(step: Path) -> None:
    """Parameters that any reader of files is content with: nothing but the checksum tells."""
    shutil.rmtree(step / "model")
    shutil.copytree(step.parent / "3" / "model", step / "model")


def other_training(step: Path) -> None:
    shutil.rmtree(step / "training")
    shutil.copytree(step.parent / "6" / "training", step / "training")


def edited(step: Path, item: str, change: dict) -> None:
    path = step / item / "metadata"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))


def other_data(step: Path) -> None:
    edited(step, "data", {"iterator": {"next_index": 8}})


def no_json(step: Path) -> None:
    (step / "about" / "metadata").write_text('{"version": 2,')


DAMAGES = [
    truncated,
    flipped_bytes,
    without_a_manifest,
    empty,
    half_written,
    other_parameters,
    other_training,
    other_data,
    no_json,
]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_gives_way_to_the_one_before(
    workdir: Path, first_state: State, damage, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(workdir / "checkpoints" / "9")
    found = restore(workdir)
    assert (found.step, found.data_state) == (6, {"next_index": 6})
    jax.tree.map(np.testing.assert_array_equal, found.state, state_at(6, first_state))
    warning = capsys.readouterr().err
    place = workdir / "damaged_checkpoints" / "9"
    assert warning.startswith(f"warning: checkpoint 9 cannot be read and is now {place}; going on from step 6 (")
    assert warning.count("\n") == 1
    assert place.is_dir() and not (workdir / "checkpoints" / "9").exists()


def test_whole_checkpoints_are_restored_without_a_word(
    workdir: Path, first_state: State, capsys: pytest.CaptureFixture[str]
) -> None:
    found = restore(workdir)
    assert (found.step, found.data_state) == (9, {"next_index": 9})
    jax.tree.map(np.testing.assert_array_equal, found.state, state_at(9, first_state))
    assert capsys.readouterr().err == ""
    assert not (workdir / "damaged_checkpoints").exists()


def test_where_all_are_damaged_one_error_says_so_and_nothing_is_moved(workdir: Path) -> None:
    for step, damage in zip(STEPS, (truncated, empty, no_json), strict=True):
        damage(workdir / "checkpoints" / str(step))
    with pytest.raises(InputError, match=r"none of the 3 checkpoints in .* can be read .*start again") as caught:
        restore(workdir)
    assert "\n" not in str(caught.value)
    assert sorted(entry.name for entry in (workdir / "checkpoints").iterdir()) == ["3", "6", "9"]


def without_an_array(step: Path) -> None:
    about = json.loads((step / "about" / "metadata").read_text())
    about["checksums"]["model"]["params.head.extra"] = "0"
    (step / "about" / "metadata").write_text(json.dumps(about))


@pytest.mark.parametrize("damage", [truncated, without_a_manifest, without_an_array, no_json])
def test_prediction_refuses_damaged_weights(workdir: Path, damage) -> None:
    damage(workdir / "checkpoints" / "9")
    with pytest.raises(InputError, match=r"checkpoints/9 is damaged") as caught:
        predictor.load(workdir)
    assert "\n" not in str(caught.value)
    assert predictor.load(workdir / "checkpoints" / "6").source.endswith("6")


@pytest.mark.parametrize("folder", ["../beside/run", "./run", "../gr\u00fcn run"])
def test_a_checkpoint_may_have_any_name_and_be_named_from_anywhere(
    workdir: Path, folder: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    shutil.copytree(workdir, here / folder)
    monkeypatch.chdir(here)
    assert predictor.load(folder).source.endswith("9")


def test_the_checksum_names_the_array_that_differs(workdir: Path) -> None:
    other_parameters(workdir / "checkpoints" / "9")
    with pytest.raises(InputError, match=r"ChecksumError: params\.head\.bias is not what was saved"):
        predictor.load(workdir)


def test_every_bit_type_and_shape_counts() -> None:
    array = np.arange(6, dtype=np.float32)
    variants = [array, array.reshape(2, 3), array.view(np.int32), -array, array.astype(jnp.bfloat16)]
    found = {checksum.of_arrays({"a": variant})["a"] for variant in variants}
    assert len(found) == len(variants)
    assert checksum.of_arrays([jnp.asarray(array)]) == checksum.of_arrays([array])


def test_a_step_that_was_lost_is_saved_again(workdir: Path, first_state: State) -> None:
    truncated(workdir / "checkpoints" / "9")
    store = Store(workdir, keep_latest=3)
    store.restore(checkpoint.template(CONFIG))
    store.save(state_at(9, first_state), {"next_index": 9}, CONFIG, 0.1)
    store.close()
    assert restore(workdir).step == 9
    # A second time: what was moved first is kept as well.
    truncated(workdir / "checkpoints" / "9")
    assert restore(workdir).step == 6
    assert sorted(entry.name for entry in (workdir / "damaged_checkpoints").iterdir()) == ["9", "9+"]


def test_a_step_that_was_saved_before_its_validation_is_replaced(workdir: Path, first_state: State) -> None:
    store = Store(workdir, keep_latest=3)
    store.save(state_at(9, first_state)._replace(epoch=jnp.asarray(1)), {"next_index": 9}, CONFIG, 0.01)
    store.close()
    assert int(restore(workdir).state.epoch) == 1
    assert checkpoint.locate(workdir).name == "9"
    assert json.loads((workdir / "checkpoints" / "9" / "metrics" / "metrics").read_text())["validation_loss"] == 0.01
    assert not (workdir / "replaced_checkpoint").exists()


@pytest.mark.parametrize("finished", [True, False])
def test_a_kill_while_a_step_is_replaced_loses_nothing(workdir: Path, finished: bool) -> None:
    place = workdir / "replaced_checkpoint" / "9"
    place.parent.mkdir()
    (shutil.copytree if finished else shutil.move)(workdir / "checkpoints" / "9", place)
    assert any_step(workdir)
    assert not place.parent.exists()
    assert restore(workdir).step == 9


def test_checkpoints_of_the_first_version_are_read(workdir: Path, first_state: State) -> None:
    step = workdir / "checkpoints" / "9"
    # It has no checksums, and its state no count of skipped steps.
    about = json.loads((step / "about" / "metadata").read_text())
    del about["config"]["training"]["skip_nonfinite"]
    (step / "about" / "metadata").write_text(json.dumps({"version": 1, "config": about["config"]}))
    state = state_at(9, first_state)
    sums = {name: value for name, value in state.sums.items() if name != SKIPPED}
    training = {name: value for name, value in state._replace(sums=sums)._asdict().items() if name != "model"}
    shutil.rmtree(step / "training")
    with checkpoint.ocp.Checkpointer(checkpoint.ocp.StandardCheckpointHandler()) as writer:
        writer.save(step / "training", args=checkpoint.ocp.args.StandardSave(training))
    found = restore(workdir)
    assert found.step == 9
    jax.tree.map(np.testing.assert_array_equal, found.state, state)
    assert predictor.load(step).config == CONFIG
    # A copy of it gets them.
    checkpoint.write_about(step, CONFIG, checkpoint.trained(step)[0])
    assert json.loads((step / "about" / "metadata").read_text())["version"] == 2
    assert predictor.load(step).config == CONFIG


@pytest.mark.parametrize(("version", "message"), [(3, "newer release"), ("x", "none of ours")])
def test_checkpoints_of_other_versions_are_refused(workdir: Path, version: object, message: str) -> None:
    edited(workdir / "checkpoints" / "9", "about", {"version": version})
    for read in (restore, predictor.load):
        with pytest.raises(InputError, match=rf"checkpoints/9 has version {version}, expected 1 or 2: .*{message}"):
            read(workdir)


def test_a_copy_with_another_experiment_has_the_checksums_of_its_model(workdir: Path) -> None:
    step = workdir / "checkpoints" / "9"
    checkpoint.write_about(step, CONFIG, checkpoint.trained(step)[0])
    assert predictor.load(step).config == CONFIG
    other_parameters(step)
    with pytest.raises(InputError, match="damaged"):
        predictor.load(step)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own with room for one checkpoint and a half."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(place)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("a small tmpfs cannot be mounted here: that takes Linux and root")
    yield place
    subprocess.run(["umount", str(place)], check=True)


# Of writes that orbax gave up and nobody waits for.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("looks_first", [True, False])
def test_a_full_disk_costs_the_checkpoint_that_did_not_fit_and_no_other(
    small_disk: Path, first_state: State, monkeypatch: pytest.MonkeyPatch, looks_first: bool
) -> None:
    def padded(step: int, numbers: int) -> State:
        filler = jnp.asarray(np.random.default_rng(step).normal(size=numbers), jnp.float32)
        return initial_state({"params": {"head": filler}, "batch_stats": {}}, CONFIG, LABELS)._replace(
            step=jnp.asarray(step, jnp.int32)
        )

    if not looks_first:
        # As where another program fills the disk in the middle of a save.
        monkeypatch.setattr(Store, "_check_room", lambda *_: None)
    store = Store(small_disk, keep_latest=2)
    store.save(padded(1, 30_000), {}, CONFIG)
    store.wait()
    with pytest.raises(UnsavedError, match=r"No space left on device.*step 1 is the last whole one"):
        store.save(padded(2, 300_000), {}, CONFIG)
        store.wait()
    assert {path.name for path in (small_disk / checkpoint.FOLDER).iterdir()} == {"1"}
    # What fits is saved again, and both can be read.
    store.save(padded(3, 1_000), {}, CONFIG)
    store.close()
    again = Store(small_disk, keep_latest=2)
    assert again.steps() == [3, 1]
    restored = again.restore(checkpoint.abstract(padded(3, 1_000)))
    again.close()
    np.testing.assert_array_equal(restored.state.model.params["head"], padded(3, 1_000).model.params["head"])
