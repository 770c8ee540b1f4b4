"""The command line that writes rendered drives."""

import re
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

from mdnvo_jax import synthesize
from mdnvo_jax.data import kitti, synthetic
from mdnvo_jax.errors import InputError, exit_code

# The size of test_synthetic.py: compiled once for both.
HEIGHT, WIDTH = 192, 640
SIZE = ["--height", str(HEIGHT), "--width", str(WIDTH), "--samples", "2"]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    root = tmp_path_factory.mktemp("drives") / "out"
    synthesize.main([str(root), "--sequences", "2", "--frames", "5", "--seed", "9", "--flow", *SIZE])
    return root


def test_what_is_written_is_read_as_kitti(written):
    for number in range(2):
        sequence = kitti.read_kitti(written, f"{number:02d}", camera_folder="image_0", channels=1)
        drive = synthetic.drive(9 + number, 5, height=HEIGHT, width=WIDTH)
        np.testing.assert_allclose(sequence.poses, drive.poses, atol=1e-9)
        np.testing.assert_allclose(sequence.timestamps, drive.timestamps, atol=1e-6)
        assert sequence.camera == pytest.approx(drive.camera)
        assert sequence.count == 5
        for index in range(5):
            np.testing.assert_array_equal(sequence.read(index).reshape(HEIGHT, WIDTH, 1), drive.read(index))


def test_flow_is_in_kitti_s_format(written):
    folder = written / "sequences" / "01" / "flow"
    assert sorted(path.name for path in folder.iterdir()) == [f"{index:06d}.png" for index in range(4)]
    # KITTI's development kit: R and G are (flow + 512) * 64 for u and v, B is validity. OpenCV reads B, G, R.
    blue, green, red = np.moveaxis(cv2.imread(str(folder / "000002.png"), cv2.IMREAD_UNCHANGED), -1, 0)
    assert blue.dtype == np.uint16
    flow = synthetic.optical_flow(10, 5, 2, height=HEIGHT, width=WIDTH)
    valid = blue > 0
    assert valid.mean() > 0.9
    assert (np.abs(red / 64.0 - 512 - flow[..., 0]) <= 1 / 128 + 1e-6)[valid].all()
    assert (np.abs(green / 64.0 - 512 - flow[..., 1]) <= 1 / 128 + 1e-6)[valid].all()


def test_flow_that_does_not_fit_is_not_valid():
    flow = np.float32([[[0, 0], [np.nan, 1], [600, 0], [-512, 511.9]]])
    np.testing.assert_array_equal(synthesize._kitti_flow(flow)[0, :, 0], [1, 0, 0, 1])
    np.testing.assert_array_equal(synthesize._kitti_flow(flow)[0, 0], [1, 2**15, 2**15])


def test_colour_goes_to_image_2_in_rgb(tmp_path):
    synthesize.main([str(tmp_path), "--sequences", "1", "--frames", "2", "--channels", "3", *SIZE])
    sequence = kitti.read_kitti(tmp_path, "00", camera_folder="image_2", channels=3)
    frame = synthetic.drive(0, 2, height=HEIGHT, width=WIDTH, channels=3).read(0)
    np.testing.assert_array_equal(sequence.read(0), frame)


def test_a_folder_with_files_is_refused_and_forced(written, capsys):
    arguments = [str(written), "--sequences", "1", "--frames", "2", *SIZE]
    before = (written / "poses" / "00.txt").read_text()
    assert exit_code(synthesize.main, arguments) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "--force" in message and str(written) in message
    assert (written / "poses" / "00.txt").read_text() == before


@pytest.mark.parametrize(
    "arguments",
    [
        ["--sequences", "0"],
        ["--sequences", "101"],
        ["--frames", "1"],
        ["--seed", "-1"],
        ["--height", "2"],
        ["--channels", "4"],
        ["--samples", "3"],
        ["--frames", "many"],
    ],
)
def test_mistakes_are_one_line_and_leave_no_folder(tmp_path, capsys, arguments):
    assert exit_code(synthesize.main, [str(tmp_path / "out"), *arguments]) == 2
    assert re.fullmatch(r"error: [^\n]+\n", capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def test_a_picture_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(cv2, "imwrite", lambda *_: False)
    with pytest.raises(InputError, match="cannot write"):
        synthesize._write_image(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
    assert not list(tmp_path.iterdir())


def test_help_is_quick():
    program = "import sys; from mdnvo_jax import synthesize, errors; errors.exit_code(synthesize.main, ['--help'])"
    start = time.process_time()
    result = subprocess.run([sys.executable, "-X", "importtime", "-c", program], capture_output=True, text=True)
    assert "--flow" in result.stdout and time.process_time() - start < 5
    for heavy in ("jax", "cv2", "rich", "flax"):
        assert not re.search(rf"\| +{heavy}$", result.stderr, re.MULTILINE)
