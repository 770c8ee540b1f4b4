import dataclasses

import numpy as np
import pytest

from mdnvo_jax.config import Config, DataConfig, ImageConfig
from mdnvo_jax.data import cache, load, synthetic
from mdnvo_jax.data.world.motion import CAMERA_HEIGHT_M, draw_mount
from mdnvo_jax.errors import InputError

IMAGE = ImageConfig(height=20, width=62, channels=3)


def config_of(root, image=IMAGE, **data):
    return Config(image=image, data=DataConfig(root=str(root), **data))


def test_the_tail_of_training_sequences_validates(kitti_root):
    config = config_of(kitti_root, train_sequences=("00", "07"), validation_tail=0.25)
    train, validation, image = load.load_split(config)
    assert [(s.name, s.count) for s in train] == [("00", 9), ("07", 6)]
    assert [(s.name, s.count) for s in validation] == [("00", 3), ("07", 2)]
    assert image.camera == pytest.approx((72 * 0.5, 71 * 20 / 37, 61.2 * 0.5 - 0.5, 19 * 20 / 37 - 0.5))
    assert train[0].read(8).shape == (37, 124, 3)


def test_named_validation_sequences_validate(kitti_root):
    config = config_of(kitti_root, train_sequences=("07",), validation_sequences=("00",), camera_folder="image_0")
    train, validation, _ = load.load_split(config)
    assert [(s.name, s.count) for s in train + validation] == [("07", 8), ("00", 12)]
    np.testing.assert_allclose(train[0].poses[0], np.eye(4), atol=1e-6)


def test_the_cache_takes_the_place_of_the_files(kitti_root, tmp_path):
    config = config_of(kitti_root, train_sequences=("00", "07"))
    train, validation, image = load.load_split(config)
    cache.prepare_cache(load.kitti_sequences(("00", "07"), config), image, tmp_path / "c")
    cached = load.load_split(config_of("", train_sequences=("00", "07"), cache=str(tmp_path / "c")))
    assert cached[2] == image
    for a, b in zip(train + validation, cached[0] + cached[1], strict=True):
        assert (a.name, a.count) == (b.name, b.count)
        np.testing.assert_array_equal(a.poses, b.poses)
        assert b.read(0).shape == (20, 62, 3)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"train_sequences": ("00", "07"), "validation_sequences": ("07",)}, "sequences 07 are for training and valid"),
        ({"train_sequences": ()}, "data.train_sequences is empty"),
        ({"train_sequences": ("00", "00")}, "each name once"),
        ({"train_sequences": ("09",)}, "no sequence 09"),
        ({"dataset": "synthetic", "worlds": 0}, "data.worlds 0"),
        ({"dataset": "synthetic", "validation_worlds": 0}, "data.validation_worlds 0"),
        ({"dataset": "synthetic", "first_world": -1}, "data.first_world -1 and data.worlds 64: expected seeds from 0"),
        ({"dataset": "synthetic", "worlds": 3, "first_world": 999_998}, "to 999999, for later ones validate"),
    ],
)
def test_mistakes_are_named(kitti_root, data, message):
    with pytest.raises(InputError, match=message):
        load.load_split(config_of(kitti_root, **data))


def test_a_raw_drive_is_read_as_one(raw_root):
    name = "2011_09_26/2011_09_26_drive_0001_sync"
    train, validation, image = load.load_split(config_of(raw_root, train_sequences=(name,), validation_tail=0.5))
    assert [(s.name, s.count) for s in train + validation] == [(name, 2), (name, 2)]
    assert image.camera == pytest.approx((35.0, 70 * 20 / 37, 60.5 / 2 - 0.5, 18.5 * 20 / 37 - 0.5))
    with pytest.raises(InputError, match=r"camera folder 'left': expected a name such as image_2"):
        load.load_split(config_of(raw_root, train_sequences=(name,), camera_folder="left"))


def test_a_root_is_asked_for():
    with pytest.raises(InputError, match=r"data.root is empty"):
        load.load_split(config_of(""))


@pytest.fixture
def asked(toy, monkeypatch):
    """Stand in for the renderer; note what is asked of it."""
    notes = []

    def drive(seed, frames, *, height, width, channels, camera, camera_height_m, scaled_to_height_m):
        assert camera_height_m == CAMERA_HEIGHT_M and scaled_to_height_m is None
        notes.append((seed, frames, height, width, channels, camera))
        return toy(frames, name=str(seed), camera=camera or (20.0, 20.0, 15.0, 8.0), size=(height, width))

    monkeypatch.setattr("mdnvo_jax.data.synthetic.drive", drive)
    return notes


def test_synthetic_worlds_are_disjoint_by_seed(asked):
    config = config_of("", dataset="synthetic", worlds=3, world_frames=7, validation_worlds=2)
    train, validation, image = load.load_split(config)
    assert asked == [(seed, 7, 20, 62, 3, None) for seed in (0, 1, 2, 1_000_000, 1_000_001)]
    assert [s.name for s in train] == ["0", "1", "2"] and len(validation) == 2
    assert image.camera == pytest.approx((20.0, 20.0, 15.0, 8.0))


def test_training_worlds_count_from_where_the_config_says(asked):
    config = config_of("", dataset="synthetic", worlds=2, first_world=999_998, world_frames=7, validation_worlds=1)
    load.load_split(config)
    assert [seed for seed, *_ in asked] == [999_998, 999_999, 1_000_000]


@pytest.mark.parametrize("rectify", [True, False])
def test_synthetic_worlds_are_seen_by_the_virtual_camera(asked, rectify):
    camera = (30.0, 31.0, 32.0, 9.0)
    image = ImageConfig(height=20, width=62, channels=1, camera=camera, rectify=rectify)
    load.synthetic_sequences([load.TEST_SEED], config_of("", image, world_frames=7))
    assert asked == [(2_000_000, 7, 20, 62, 1, camera if rectify else None)]


def test_other_lenses_film_each_world_at_half_of_kittis_size(asked):
    image = ImageConfig(height=20, width=62, channels=1, camera=(30.0, 31.0, 32.0, 9.0))
    seeds = [load.TEST_SEED, load.TEST_SEED + 1]
    load.synthetic_sequences(seeds, config_of("", image, world_frames=7), other_lenses=True)
    assert asked == [(seed, 7, 188, 620, 1, synthetic.varied_camera(seed, 188, 620)) for seed in seeds]
    assert asked[0][-1] != asked[1][-1]


def test_a_real_renderer_takes_what_is_asked_of_it():
    """Without rendering, which compiles for seconds and has tests of its own."""
    camera = (30.0, 31.0, 32.0, 9.0)
    image = ImageConfig(height=20, width=62, channels=1, camera=camera)
    config = config_of("", image, dataset="synthetic", worlds=2, world_frames=5, validation_worlds=1)
    train, validation, resolved = load.load_split(config)
    assert resolved == image and [s.camera for s in train + validation] == [camera] * 3
    assert all(s.count == 5 and s.poses.shape == (5, 4, 4) for s in train + validation)
    labels = np.stack([s.steps() for s in train + validation])
    assert (labels[0] != labels[1]).any() and (labels[0] != labels[2]).any()


def test_rendered_worlds_come_from_the_cache_and_are_scaled_to_the_height(tmp_path, monkeypatch):
    camera = (31.0, 31.0, 30.5, 8.0)
    config = config_of(
        "",
        ImageConfig(height=20, width=62, channels=1, camera=camera),
        dataset="synthetic",
        worlds=2,
        world_frames=3,
        validation_worlds=1,
        camera_height_m=1.8,
        camera_height_shares=(0.7, 1.2),
    )
    train, validation, image = load.load_split(config)
    drives = [*train, *validation]
    assert [drive.name for drive in drives] == ["world_000000", "world_000001", f"world_{load.VALIDATION_SEED}"]
    raw = synthetic.drive(1, 3, height=20, width=62, camera=camera, camera_height_m=(1.26, 2.16))
    height_m = draw_mount(1, (1.26, 2.16)).height_m
    np.testing.assert_allclose(drives[1].poses[2, :3, 3], raw.poses[2, :3, 3] * 1.8 / height_m)
    cache.prepare_cache(drives, image, tmp_path)
    cached = load.load_split(dataclasses.replace(config, data=dataclasses.replace(config.data, cache=str(tmp_path))))
    for drive, found in zip(drives, [*cached[0], *cached[1]], strict=True):
        np.testing.assert_array_equal(found.poses, drive.poses)
        np.testing.assert_array_equal(found.read(2), drive.read(2))
        np.testing.assert_allclose(found.flow(1), drive.flow(1), rtol=1e-3, atol=1e-6)
    more = dataclasses.replace(config, data=dataclasses.replace(config.data, cache=str(tmp_path), worlds=3))
    with pytest.raises(InputError, match="no finished sequence world_000002"):
        load.load_split(more)
