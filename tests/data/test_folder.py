import shutil

import cv2
import numpy as np
import pytest

from mdnvo_jax.data.folder import Video, natural_key, read_frames
from mdnvo_jax.errors import InputError


@pytest.fixture
def pictures(tmp_path):
    """A folder of 12 grey pictures, frame1.png to frame12.png, of grey level 10 times their number."""
    folder = tmp_path / "drive"
    folder.mkdir()
    for number in range(1, 13):
        cv2.imwrite(str(folder / f"frame{number}.png"), np.full((20, 30), 10 * number, np.uint8))
    return folder


def levels(sequence):
    return [round(float(sequence.read(i).mean()) / 10) for i in range(sequence.count)]


def test_a_folder_is_read_in_natural_order(pictures):
    (pictures / "notes.txt").write_text("not a frame")
    (pictures / "._frame3.png").write_bytes(b"left behind by another system")
    (pictures / "masks").mkdir()
    sequence = read_frames(pictures, 1)
    assert levels(sequence) == list(range(1, 13))
    assert sequence.read(0).shape == (20, 30, 1)
    assert (sequence.camera, sequence.timestamps, sequence.poses) == (None, None, None)
    assert sequence.label(9) == str(pictures / "frame10.png")
    assert read_frames(pictures, 3).read(0).shape == (20, 30, 3)


def test_natural_order():
    names = ["b1", "a10", "a9", "a09b", "a09", "a", "2", "10"]
    assert sorted(names, key=natural_key) == ["2", "10", "a", "a09", "a9", "a09b", "a10", "b1"]


def test_symbolic_links_and_upper_case_suffixes_are_frames(pictures, tmp_path):
    links = tmp_path / "links"
    links.mkdir()
    for number in (3, 4):
        (links / f"{number}.PNG").symlink_to(pictures / f"frame{number}.png")
    assert levels(read_frames(links, 1)) == [3, 4]


def test_a_glob_chooses_among_files(pictures):
    assert levels(read_frames(f"{pictures}/frame1*.png", 1)) == [1, 10, 11, 12]
    assert levels(read_frames(str(pictures.parent / "**" / "frame[2-4].png"), 1)) == [2, 3, 4]


def test_a_folder_whose_name_looks_like_a_glob_is_a_folder(pictures):
    renamed = pictures.rename(pictures.parent / "drive [1]")
    assert read_frames(renamed, 1).count == 12


def test_stride_takes_every_nth_frame_and_its_time(pictures, tmp_path):
    times = tmp_path / "times.txt"
    times.write_text("".join(f"{100 + 0.5 * i}\n" for i in range(12)))
    sequence = read_frames(pictures, 1, stride=5, timestamps=times, camera=(1.0, 2.0, 3.0, 4.0))
    assert levels(sequence) == [1, 6, 11]
    np.testing.assert_array_equal(sequence.timestamps, [100, 102.5, 105])
    assert sequence.camera == (1.0, 2.0, 3.0, 4.0)
    assert sequence.label(1).endswith("frame6.png")


def test_mixed_sizes_are_named_when_read(pictures):
    cv2.imwrite(str(pictures / "frame7.png"), np.zeros((30, 20), np.uint8))
    sequence = read_frames(pictures, 1)
    assert sequence.read(5).shape == (20, 30, 1)
    with pytest.raises(InputError, match=r"frame7.png is 20x30 but .*frame6.png is 30x20"):
        sequence.read(6)
    assert sequence.read(7).shape == (20, 30, 1)


def test_an_unreadable_frame_is_named_and_the_others_still_read(pictures):
    (pictures / "frame2.png").write_bytes(b"broken")
    sequence = read_frames(pictures, 1)
    with pytest.raises(InputError, match=r"frame2.png cannot be decoded"):
        sequence.read(1)
    assert sequence.read(2).mean() == 30


def test_mistakes_are_named(pictures, tmp_path):
    empty = tmp_path / "empty"
    (empty / "left").mkdir(parents=True)
    with pytest.raises(InputError, match=r"no pictures in .*empty; it has the folders left"):
        read_frames(empty, 1)
    with pytest.raises(InputError, match=r"nothing matches"):
        read_frames(f"{pictures}/*.jpg", 1)
    with pytest.raises(InputError, match=r"no .*nowhere: expected a folder of pictures, a glob in quotes, or a video"):
        read_frames(tmp_path / "nowhere", 1)
    with pytest.raises(InputError, match=r"frame1.png is one picture"):
        read_frames(pictures / "frame1.png", 1)
    with pytest.raises(InputError, match=r"1 frame in .*frame3.png.: expected two or more"):
        read_frames(f"{pictures}/frame3.png*", 1)
    with pytest.raises(InputError, match=r"1 frame in .* at stride 20"):
        read_frames(pictures, 1, stride=20)
    with pytest.raises(InputError, match=r"stride 0"):
        read_frames(pictures, 1, stride=0)
    with pytest.raises(InputError, match=r"no file"):
        read_frames(pictures, 1, timestamps=tmp_path / "none.txt")
    shutil.copy(pictures / "frame5.png", pictures / "frame5.tiff")
    with pytest.raises(InputError, match=r"may be one frame twice"):
        read_frames(pictures, 1)


# A sequence of KITTI


def test_a_kitti_sequence_brings_its_camera_and_times(kitti_root):
    folder = kitti_root / "sequences" / "00"
    for place in (folder, folder / "image_2"):
        sequence = read_frames(place, 3)
        assert sequence.count == 12 and sequence.camera == pytest.approx((72.0, 71.0, 60.7, 18.5))
        np.testing.assert_allclose(sequence.timestamps, np.arange(12) / 10)
        assert "image_2" in sequence.label(0)
    assert "image_0" in read_frames(folder, 1).label(0)
    assert read_frames(folder, 1, camera=(1.0, 1.0, 0.0, 0.0)).camera == (1.0, 1.0, 0.0, 0.0)
    shutil.rmtree(folder / "image_2")
    assert "image_0" in read_frames(folder, 3, stride=2).label(0)


def test_a_folder_called_as_in_kitti_takes_the_files_beside_it_and_no_other_does(pictures):
    """The README tells whoever has such files of another kind to rename the folder."""
    (pictures.parent / "calib.txt").write_text("P0: 72 0 60.7 0 0 71 18.5 0 0 0 1 0\n")
    (pictures.parent / "times.txt").write_text("\n".join(str(index / 10) for index in range(12)))
    for name in ("drive", "image_x"):
        sequence = read_frames(pictures.rename(pictures.parent / name), 1)
        assert sequence.camera is None and sequence.timestamps is None
        pictures = pictures.parent / name
    like_kitti = pictures.rename(pictures.parent / "image_0")
    assert read_frames(like_kitti, 1).camera == pytest.approx((72.0, 71.0, 60.7, 18.5))
    np.testing.assert_allclose(read_frames(like_kitti, 1).timestamps, np.arange(12) / 10)
    (pictures.parent / "calib.txt").write_text("fx = 72\n")
    with pytest.raises(InputError, match=r"calib\.txt"):
        read_frames(like_kitti, 1)


def test_a_real_kitti_sequence(data_root):
    sequence = read_frames(data_root / "kitti" / "sequences" / "06", 1, stride=10)
    assert sequence.count == 6 and sequence.camera[0] == pytest.approx(707.0912)
    assert sequence.read(5).shape == (370, 1226, 1)


# Video


def film(path, code, count=20, noise=0):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), 12.5, (64, 48))
    assert writer.isOpened()
    rng = np.random.default_rng(0)
    for index in range(count):
        frame = np.full((48, 64, 3), (0, 0, 10 * index + 10), np.uint8)  # blue, green, red
        writer.write(frame + rng.integers(0, noise + 1, frame.shape, dtype=np.uint8))
    writer.release()
    return path


@pytest.mark.parametrize(("name", "code"), [("a.avi", "MJPG"), ("a.mp4", "mp4v")])
def test_a_video_is_read_in_order_and_out_of_order(tmp_path, name, code):
    sequence = read_frames(film(tmp_path / name, code), 3)
    assert sequence.count == 20 and sequence.in_order
    np.testing.assert_allclose(sequence.timestamps, np.arange(20) / 12.5)
    assert "frame 7" in sequence.label(7)
    for index in [*range(20), 3, 4, 4, 15, 0, 19]:
        red, green, blue = sequence.read(index).reshape(-1, 3).mean(0)
        assert red == pytest.approx(10 * index + 10, abs=4) and green < 8 and blue < 8
    grey = read_frames(tmp_path / name, 1, stride=3)
    assert grey.count == 7 and grey.read(2).shape == (48, 64, 1)
    assert grey.read(2).mean() == pytest.approx(0.299 * 70, abs=3)


def test_reading_a_video_in_order_decodes_each_frame_once(tmp_path, monkeypatch):
    video = Video(film(tmp_path / "a.avi", "MJPG"), 1)
    grabs = []
    monkeypatch.setattr(video, "_capture", Counting(video._capture, grabs))
    for index in (0, 1, 2, 2, 5):
        video.read(index)
    assert len(grabs) == 6


class Counting:
    """A capture that notes every frame it decodes."""

    def __init__(self, capture, grabs):
        self.capture, self.grabs = capture, grabs

    def grab(self):
        self.grabs.append(1)
        return self.capture.grab()

    def retrieve(self):
        return self.capture.retrieve()


def test_a_video_that_is_cut_short_has_the_frames_it_has(tmp_path, capfd):
    path = film(tmp_path / "a.avi", "MJPG", noise=30)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    sequence = read_frames(path, 1)
    assert 5 <= sequence.count <= 12
    assert sequence.read(sequence.count - 2).shape == (48, 64, 1)
    with pytest.raises(InputError, match=rf"a\.avi: frame {sequence.count + 1} of {sequence.count} cannot be read"):
        sequence_past_its_end(path, sequence.count)


def sequence_past_its_end(path, count):
    video = Video(path, 1)
    last = video.read(count - 1)
    first = video.read(0)
    try:
        video.read(count + 1)
    finally:
        # The failure does not make the frame read before it pass for the last one.
        assert (video.read(count - 1) == last).all() and (first != last).any()


def test_a_file_that_is_no_video(tmp_path):
    path = tmp_path / "notes.mp4"
    path.write_text("no video")
    with pytest.raises(InputError, match=r"notes.mp4 is no video of a kind that is read"):
        read_frames(path, 1)
