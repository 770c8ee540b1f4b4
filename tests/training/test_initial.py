"""What a training starts from: the whole of another one, its units included, or a line that says why not."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from small_model import CONFIG, FRAMES, LABELS, save, trained, trained_variables

from mdnvo_jax import predictor, train, weights
from mdnvo_jax.config import Config, load_config
from mdnvo_jax.errors import InputError, exit_code
from mdnvo_jax.model.network import build
from mdnvo_jax.training import checkpoint, initial
from mdnvo_jax.training.state import initial_variables

CONFIG_FILE = """
import dataclasses
from small_model import CONFIG
config = dataclasses.replace(
    CONFIG,
    data=dataclasses.replace(
        CONFIG.data, root={root!r}, camera_folder="image_0", train_sequences=("00",), validation_tail=0.3
    ),
    training=dataclasses.replace(CONFIG.training, batch_size=4, epochs=1, initial_weights={weights!r}),
)
"""


def starting_from(weights: Path | str, **changes: object) -> Config:
    """Return a configuration that starts from `weights`, with fields changed by "section.field"."""
    config = dataclasses.replace(CONFIG, training=dataclasses.replace(CONFIG.training, initial_weights=str(weights)))
    for name, value in changes.items():
        section, field = name.split("__")
        part = dataclasses.replace(getattr(config, section), **{field: value})
        config = dataclasses.replace(config, **{section: part})
    return config


def start(config: Config) -> tuple[dict, object]:
    return initial.start(build(config.image, config.model), config, [])


def assert_same(first: object, second: object) -> None:
    leaves, others = jax.tree.leaves_with_path(first), jax.tree.leaves_with_path(second)
    assert [path for path, _ in leaves] == [path for path, _ in others]
    for (path, leaf), (_, other) in zip(leaves, others, strict=True):
        np.testing.assert_array_equal(leaf, other, err_msg=jax.tree_util.keystr(path))


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(tmp_path_factory.mktemp("first"))


def test_everything_that_predicts_comes_from_there(saved: Path) -> None:
    for path in (saved, checkpoint.locate(saved)):
        config = starting_from(path)
        initial.check(config)
        variables, labels = start(config)
        assert_same(variables, trained_variables())
        # The outputs are in units of these, whatever the new data is like.
        np.testing.assert_array_equal(labels.mean, np.float32(LABELS.mean))
        np.testing.assert_array_equal(labels.std, np.float32(LABELS.std))


def test_shipped_weights_have_a_name(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "folder", lambda: checkpoint.locate(saved))
    config = starting_from("shipped")
    initial.check(config)
    assert_same(start(config)[0]["params"], trained().params)


def test_what_only_trains_may_differ(saved: Path) -> None:
    free = {"model__conv_dropout": 0.3, "model__lstm_dropout": 0.0, "model__products": "mixed", "model__mirrored": True}
    with_flow = starting_from(saved, model__flow_weight=0.5, **free)
    initial.check(with_flow)
    variables, _ = start(with_flow)
    # The layer that the weights lack is drawn, by the seed of the new training.
    drawn = initial_variables(build(with_flow.image, with_flow.model), with_flow)["params"]
    assert_same(variables["params"].pop("flow"), drawn["flow"])
    assert_same(variables["params"], trained().params)


def test_the_layer_for_flow_is_left_out_where_it_is_not_wanted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_flow = dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, flow_weight=1.0))
    monkeypatch.setattr("small_model.CONFIG", with_flow)
    variables, _ = start(starting_from(save(tmp_path, with_flow)))
    assert sorted(variables["params"]) == ["head", "lstm", "stack"]


def test_a_wider_network_starts_with_the_outputs_of_the_one_before(saved: Path) -> None:
    wider = starting_from(saved, model__width=3 / 32, model__lstm_hidden=12, model__flow_weight=0.5)
    initial.check(wider)
    variables, labels = start(wider)
    np.testing.assert_array_equal(labels.std, np.float32(LABELS.std))
    mask = np.ones((1, 4), bool)
    before = build(CONFIG.image, CONFIG.model).apply(trained_variables(), FRAMES[None, :5], mask)
    after = build(wider.image, wider.model).apply(variables, FRAMES[None, :5], mask)
    np.testing.assert_allclose(after, before, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model__components": 3}, r"does not fit: model\.components is 3, trained with 2: set"),
        ({"model__width": 1 / 32}, r"model\.width is 0\.03125, trained with 0\.0625: set .* may be larger\)"),
        ({"model__coupling": "joint"}, r"model\.coupling is 'joint', trained with 'independent'"),
        ({"model__translation_floor_m": 0.01}, r"model\.translation_floor_m is 0\.01, trained with 0\.001"),
        ({"image__camera": ()}, r"image\.camera is \(\), trained with \(40\.0, 40\.0, 31\.5, 15\.5\)"),
        (
            {"image__height": 48, "image__normalisation": "local_contrast"},
            r"image\.height is 48, trained with 32; image\.normalisation is 'local_contrast', trained with 'standard'",
        ),
        ({"training__initial_stack": "flownet.npz"}, "both given"),
        ({"training__initial_weights": "no/such/folder"}, "no checkpoint in .*no/such/folder"),
    ],
)
def test_what_does_not_fit_is_named(saved: Path, changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        initial.check(starting_from(saved, **changes))


def test_without_initial_weights_nothing_is_asked() -> None:
    initial.check(CONFIG)


@pytest.fixture(scope="module")
def config_file(saved: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A config on a short drive in KITTI's layout, whose steps are unlike those of the first training."""
    folder = tmp_path_factory.mktemp("second")
    images = folder / "sequences" / "00" / "image_0"
    images.mkdir(parents=True)
    (folder / "poses").mkdir()
    (folder / "sequences" / "00" / "calib.txt").write_text("P0: 40 0 31.5 0 0 40 15.5 0 0 0 1 0\n")
    for index, frame in enumerate(FRAMES):
        cv2.imwrite(str(images / f"{index:06d}.png"), frame)
    rows = "".join(f"1 0 0 0 0 1 0 0 0 0 1 {3 * index}\n" for index in range(len(FRAMES)))
    (folder / "poses" / "00.txt").write_text(rows)
    (folder / "config.py").write_text(CONFIG_FILE.format(root=str(folder), weights=str(saved)))
    return folder / "config.py"


def test_a_training_goes_on_from_there(
    config_file: Path, saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = shutil.copytree(saved, tmp_path / "copy")
    given = [str(config_file), "--workdir", str(tmp_path / "run"), "--training.initial_weights", str(copy)]
    # Of steps too small to change a number.
    given += ["--training.learning_rate", "1e-30", "--model.conv_dropout", "0", "--model.lstm_dropout", "0"]
    assert exit_code(train.main, given) == 0, capsys.readouterr().err
    model, config, _ = predictor.trained(tmp_path / "run")
    assert_same(model.params, trained().params)
    labels = json.loads((tmp_path / "run" / "labels.json").read_text())
    assert list(labels["mean"].values()) == pytest.approx(LABELS.mean.tolist())
    np.testing.assert_array_equal(model.labels.std, np.float32(LABELS.std))
    assert config.image == CONFIG.image
    # Later, the first training may be gone.
    shutil.rmtree(copy)
    assert exit_code(train.main, [*given, "--resume", "--training.epochs", "2"]) == 0, capsys.readouterr().err


def test_a_training_that_cannot_start_from_there_reads_no_data(
    config_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [str(config_file), "--workdir", str(tmp_path / "run"), "--data.root", "gone", "--model.lstm_hidden", "7"]
    assert exit_code(train.main, given) == 2
    assert "model.lstm_hidden is 7, trained with 8" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_the_configuration_for_fine_tuning_fits_the_weights_it_starts_from(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weights, "folder", lambda: checkpoint.locate(saved))
    config = load_config(str(Path(__file__).parents[2] / "configs" / "finetune_kitti.py"))
    assert config.training.initial_weights == "shipped"
    assert (config.image, config.data.window) == (CONFIG.image, CONFIG.data.window)
    initial.check(config)
