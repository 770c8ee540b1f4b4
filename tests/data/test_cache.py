import dataclasses
import errno
import json
import shutil

import numpy as np
import pytest

from mdnvo_jax.config import Config, DataConfig, ImageConfig, TrainingConfig
from mdnvo_jax.data import cache, images, windows
from mdnvo_jax.data.kitti import read_kitti
from mdnvo_jax.errors import InputError

IMAGE = ImageConfig(height=20, width=62, channels=3)


@pytest.fixture
def sequences(kitti_root):
    return [read_kitti(kitti_root, name) for name in ("00", "07")]


@pytest.fixture
def image():
    # Not the camera of the sequences: frames have to be rectified.
    return dataclasses.replace(IMAGE, camera=(33.0, 34.0, 29.0, 9.5))


def counted(sequence, reads):
    """Return `sequence` with a note in `reads` of every frame decoded."""

    def read(index):
        reads.append((sequence.name, index))
        return sequence.read(index)

    return dataclasses.replace(sequence, read=read)


def test_what_comes_out_is_what_would_be_prepared(sequences, image, tmp_path):
    cache.prepare_cache(sequences, image, tmp_path / "c")
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == ["00.json", "00.npy", "07.json", "07.npy"]
    for cached, source in zip(cache.read_cache(tmp_path / "c", image), sequences, strict=True):
        assert (cached.name, cached.count) == (source.name, source.count)
        np.testing.assert_array_equal(cached.poses, source.poses)
        np.testing.assert_array_equal(cached.timestamps, source.timestamps)
        assert cached.camera == image.camera
        for index in range(source.count):
            expected = images.prepare(source.read(index), source.camera, image)
            np.testing.assert_array_equal(cached.read(index), expected)
            np.testing.assert_array_equal(images.prepare(cached.read(index), cached.camera, image), expected)


@pytest.mark.parametrize("rectify", [True, False])
def test_training_from_the_cache_is_training_from_the_files(sequences, image, tmp_path, rectify):
    image = dataclasses.replace(image, rectify=rectify)
    data = DataConfig(window=3, mirror=0.5, reverse=0.5, photometric=1.0)
    config = Config(image=image, data=data, training=TrainingConfig(batch_size=4))
    cache.prepare_cache(sequences, image, tmp_path / "c")
    cached = cache.read_cache(tmp_path / "c", image)
    runs = [windows.training_batches(source, config, seed=0) for source in (sequences, cached)]
    for _ in range(6):
        first, second = (next(run) for run in runs)
        for key in first:
            np.testing.assert_array_equal(first[key], second[key])


def test_the_cache_is_a_map_of_the_file_not_a_copy(sequences, image, tmp_path):
    cache.prepare_cache(sequences, image, tmp_path)
    frame = cache.read_cache(tmp_path, image)[0].read(3)
    assert not frame.flags.owndata and not frame.flags.writeable
    file = np.load(tmp_path / "00.npy", allow_pickle=False)
    assert file.shape == (12, 20, 62, 3) and file.dtype == np.uint8


def test_finished_sequences_are_kept(sequences, image, tmp_path):
    reads, seen = [], []
    sequences = [counted(sequence, reads) for sequence in sequences]
    cache.prepare_cache(sequences[:1], image, tmp_path)
    assert {name for name, _ in reads} == {"00"}
    reads.clear()
    cache.prepare_cache(sequences, image, tmp_path, lambda *args: seen.append(args))
    assert {name for name, _ in reads} == {"07"}
    assert seen == [("00", 12, 12)] + [("07", done, 8) for done in range(1, 9)]
    total, missing = cache.cache_bytes(sequences, image, tmp_path)
    assert (total, missing) == (20 * 20 * 62 * 3, 0)


def test_an_interrupted_sequence_is_absent_and_done_again(sequences, image, tmp_path):
    def stop(name, done, count):
        if name == "07" and done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cache.prepare_cache(sequences, image, tmp_path, stop)
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "kitti") == ["00.json", "00.npy"]
    with pytest.raises(InputError, match=r"has no finished sequence 07: found 00"):
        cache.read_cache(tmp_path, image, ["00", "07"])
    # A process that was killed outright leaves its temporary files, or an array without a description.
    (tmp_path / ".07-abcdefgh.npy").write_bytes(b"half")
    (tmp_path / ".07.flow-abcdefgh.npy").write_bytes(b"half")
    (tmp_path / "07.npy").write_bytes(b"half")
    assert [s.name for s in cache.read_cache(tmp_path, image)] == ["00"]
    cache.prepare_cache(sequences, image, tmp_path)
    assert not list(tmp_path.glob(".*"))
    assert [s.name for s in cache.read_cache(tmp_path, image, ["07", "00"])] == ["07", "00"]


def test_two_that_write_the_same_sequence_leave_each_other_alone(sequences, image, tmp_path):
    """The second begins and ends while the first has its temporary file open, and lets it be."""

    def meanwhile(name, done, count):
        if done == 3:
            assert list(tmp_path.glob(".07-*.npy"))
            cache.prepare_cache(sequences[1:], image, tmp_path)

    cache.prepare_cache(sequences[1:], image, tmp_path, meanwhile)
    assert sorted(path.name for path in tmp_path.glob("*07*")) == ["07.json", "07.npy"]
    expected = images.prepare(sequences[1].read(5), sequences[1].camera, image)
    np.testing.assert_array_equal(cache.read_cache(tmp_path, image)[0].read(5), expected)


def test_a_changed_source_is_prepared_again(kitti_root, sequences, image, tmp_path):
    cache.prepare_cache(sequences, image, tmp_path / "c")
    path = kitti_root / "poses" / "07.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(reversed(lines)) + "\n")
    changed = [read_kitti(kitti_root, name) for name in ("00", "07")]
    assert cache.cache_bytes(changed, image, tmp_path / "c")[1] == 8 * 20 * 62 * 3
    cache.prepare_cache(changed, image, tmp_path / "c")
    np.testing.assert_array_equal(cache.read_cache(tmp_path / "c", image)[1].poses, changed[1].poses)


@pytest.mark.parametrize(
    ("field", "value"),
    [("height", 24), ("width", 60), ("channels", 1), ("rectify", False), ("camera", (30.0, 30.0, 30.0, 9.0))],
)
def test_a_cache_for_other_images_is_refused(sequences, image, tmp_path, field, value):
    cache.prepare_cache(sequences[1:], image, tmp_path)
    other = dataclasses.replace(image, **{field: value})
    with pytest.raises(InputError, match=rf"07.json was prepared for image.{field} .*, but .* asked for"):
        cache.read_cache(tmp_path, other)
    with pytest.raises(InputError, match=rf"image.{field}"):
        cache.prepare_cache(sequences, other, tmp_path)


def test_what_does_not_touch_the_pixels_may_differ(sequences, image, tmp_path):
    cache.prepare_cache(sequences[1:], image, tmp_path)
    assert cache.read_cache(tmp_path, dataclasses.replace(image, normalisation="local_contrast"))
    # Training that asks for no camera in particular takes that of the cache.
    (cached,) = cache.read_cache(tmp_path, IMAGE)
    assert windows.resolve_camera([cached], IMAGE).camera == pytest.approx(image.camera)
    assert cache.with_cached_camera(tmp_path, IMAGE) == image
    # But one cache holds frames of one virtual camera.
    with pytest.raises(InputError, match=r"prepared for image.camera \[33.0, 34.0, 29.0, 9.5\], but \[\] is asked for"):
        cache.prepare_cache(sequences, IMAGE, tmp_path)
    assert cache.cache_bytes(sequences[1:], IMAGE, tmp_path)[1] == 8 * 20 * 62 * 3
    assert cache.with_cached_camera(tmp_path / "none", IMAGE) is IMAGE


def test_sequences_without_poses_times_or_camera(toy, tmp_path):
    image = ImageConfig(height=8, width=16, channels=1)
    plain = toy(5, name="a/b", poses=None)
    cache.prepare_cache([plain], image, tmp_path)
    (cached,) = cache.read_cache(tmp_path, image)
    assert (cached.name, cached.poses, cached.timestamps, cached.camera) == ("a/b", None, None, None)
    assert cached.read(4)[0, 0, 0] == 4


def test_a_disk_that_is_too_small_is_refused_before_anything_is_written(sequences, image, tmp_path, monkeypatch):
    small = shutil._ntuple_diskusage(10**9, 9 * 10**8, 10**8)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: small)
    with pytest.raises(InputError, match=r"needs 1 MB and 200 MB to spare, but .* has 100 MB free"):
        cache.prepare_cache(sequences, image, tmp_path / "deep" / "down")
    assert not (tmp_path / "deep").exists()


def test_damage_is_named(sequences, image, tmp_path):
    with pytest.raises(InputError, match=r"no finished cache in"):
        cache.read_cache(tmp_path / "none", image)
    with pytest.raises(InputError, match=r"expected each name once"):
        cache.prepare_cache([sequences[0]] * 2, image, tmp_path / "c")
    cache.prepare_cache(sequences, image, tmp_path / "c")
    array, description = tmp_path / "c" / "07.npy", tmp_path / "c" / "07.json"
    whole = array.read_bytes()
    for damaged in (whole[:1000], whole[:40], b"", b"\x93NUMPY nonsense"):
        array.write_bytes(damaged)
        with pytest.raises(InputError, match=r"07.npy is damaged"):
            cache.read_cache(tmp_path / "c", image)
    np.save(array, np.zeros((7, 20, 62, 3), np.uint8))
    with pytest.raises(InputError, match=r"07.npy holds uint8 \[7, 20, 62, 3\], expected uint8 \[8, 20, 62, 3\]"):
        cache.read_cache(tmp_path / "c", image)
    array.unlink()
    with pytest.raises(InputError, match=r"07.npy is damaged"):
        cache.read_cache(tmp_path / "c", image)
    array.write_bytes(whole)
    stored = json.loads(description.read_text())
    description.write_text(description.read_text()[:-5])
    with pytest.raises(InputError, match=r"07.json cannot be read"):
        cache.read_cache(tmp_path / "c", image)
    del stored["poses"]
    description.write_text(json.dumps(stored))
    with pytest.raises(InputError, match=r"07.json lacks poses"):
        cache.read_cache(tmp_path / "c", image)


def test_an_unreadable_frame_leaves_nothing_behind(kitti_root, sequences, image, tmp_path):
    (kitti_root / "sequences" / "00" / "image_2" / "000009.png").write_bytes(b"broken")
    with pytest.raises(InputError, match=r"000009.png cannot be decoded"):
        cache.prepare_cache(sequences, image, tmp_path / "c")
    assert not list((tmp_path / "c").iterdir())


def test_an_output_that_cannot_be_written_is_named(sequences, image, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot make the folder .*file \(File exists\): choose another"):
        cache.prepare_cache(sequences, image, tmp_path / "file")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full, raising=False)
    with pytest.raises(InputError, match=r"cannot write into .* \(No space left on device\)"):
        cache.prepare_cache(sequences, image, tmp_path / "c")
    assert not list((tmp_path / "c").iterdir())


def test_sizes_as_text():
    assert [cache.megabytes(n) for n in (0, 1, 10**6, 1.5e9, 23e9)] == ["0 MB", "1 MB", "1 MB", "1.5 GB", "23.0 GB"]


def test_optical_flow_is_kept_beside_the_frames(sequences, image, tmp_path):
    rng = np.random.default_rng(0)
    flow = rng.normal(size=(12, 3, 8, 2)).astype(np.float16).astype(np.float32)
    flow[-1] = np.nan
    source = dataclasses.replace(sequences[0], flow=lambda index: flow[index])
    cache.prepare_cache([source, sequences[1]], image, tmp_path)
    first, second = cache.read_cache(tmp_path, image)
    assert second.flow is None
    np.testing.assert_array_equal(np.stack([first.flow(index) for index in range(12)]), flow)
    np.testing.assert_array_equal(first.subsequence(4, 9).flow(2), flow[6])
    np.save(tmp_path / "00.flow.npy", flow[:5])
    with pytest.raises(InputError, match=r"00.flow.npy has 5 frames, expected 12"):
        cache.read_cache(tmp_path, image)
    (tmp_path / "00.flow.npy").write_bytes(b"no array")
    with pytest.raises(InputError, match=r"00.flow.npy is damaged"):
        cache.read_cache(tmp_path, image)
