"""Scenes of nuScenes that a configuration asks for."""

from pathlib import Path

import numpy as np
import pytest
from nuscenes_fixture import VERSION, edit_table
from nuscenes_reading import rebased

from mdnvo_jax.config import Config, DataConfig, ImageConfig, load_config
from mdnvo_jax.data import cache, load, windows
from mdnvo_jax.errors import InputError


def config_of(root, **data):
    values = {"version": VERSION, "train_sequences": (), "window": 4, **data}
    return Config(
        image=ImageConfig(height=18, width=32, channels=1),
        data=DataConfig(dataset="nuscenes", root=str(root), **values),
    )


def test_the_documented_split_is_loaded_but_for_what_cannot_be_used(mini, capsys):
    root, _ = mini
    config = config_of(root)
    train, validation, image = load.load_split(config)
    assert [sequence.name for sequence in train] == ["scene-0061", "scene-0571", "scene-1077"]
    assert [sequence.name for sequence in validation] == ["scene-0655"]
    # Of the first scene, 0.79 of a width of 64 and half the size.
    assert image.camera == pytest.approx((25.28, 25.28, (0.51 * 64 + 0.5) / 2 - 0.5, (0.546 * 36 + 0.5) / 2 - 0.5))
    told = capsys.readouterr().err
    assert "train: scenes left out, of fewer than 5 frames: 1 (scene-0553)" in told
    assert "train: scenes left out, with images that are not on disk: 1 (scene-0103)" in told
    assert "train: frames were dropped in 1 of 3 scenes (gaps: 1, up to 0.25 s)" in told
    assert "validation" not in told
    batch = next(iter(windows.validation_batches(validation, config)))
    np.testing.assert_allclose(batch["steps"][0], validation[0].steps()[:4], rtol=1e-6)


def test_named_scenes_are_loaded(mini):
    root, _ = mini
    config = config_of(root, train_sequences=("scene-0768", "scene-0999"), key_frames_only=True)
    train, validation, _ = load.load_split(config)
    assert [(s.name, s.count) for s in train + validation] == [("scene-0768", 4), ("scene-0999", 4), ("scene-0655", 4)]
    assert train[0].read(0).shape == (36, 64, 1)


def test_the_configuration_asks_for_interpolation(one):
    root, truth = one
    edit_table(root, "ego_pose", lambda rows: [row for row in rows if row["timestamp"] != truth.times_us[5]])
    (sequence,) = load.nuscenes_sequences(("scene-0061",), config_of(root, interpolate=True))
    np.testing.assert_allclose(sequence.poses, rebased(truth.poses), atol=5e-3)


def test_a_cache_takes_the_place_of_the_files(mini, tmp_path):
    root, _ = mini
    config = config_of(root)
    train, validation, image = load.load_split(config)
    cache.prepare_cache([*train, *validation], image, tmp_path)
    cached = load.load_split(config_of("", cache=str(tmp_path)))
    for files, prepared in zip((train, validation), cached[:2], strict=True):
        assert [s.name for s in files] == [s.name for s in prepared]
        np.testing.assert_array_equal(files[0].poses, prepared[0].poses)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"train_sequences": ("scene-0655",)}, "scene-0655 are for training and validation"),
        ({"train_sequences": ("scene-0061", "scene-0061")}, "each name once"),
        ({"train_sequences": ("00",)}, r"no scene 00 in .*v1.0-mini: found 10, from scene-0061 to scene-1077"),
        ({"window": 99}, r"has no scene of nuScenes for train that can be used"),
        ({"version": "v1.0-trainval"}, r"no folder v1.0-trainval in .*: found v1.0-mini"),
        ({"root": ""}, "data.root is empty"),
    ],
)
def test_mistakes_in_the_configuration_are_named(mini, data, message):
    root, _ = mini
    values = {"root": str(root), **data}
    with pytest.raises(InputError, match=message):
        load.load_split(config_of(**values))


def test_the_config_asks_for_the_documented_split():
    config = load_config(str(Path(__file__).parents[2] / "configs" / "mdn_vo_nuscenes.py"))
    assert config.data.dataset == "nuscenes" and config.data.train_sequences == config.data.validation_sequences == ()
