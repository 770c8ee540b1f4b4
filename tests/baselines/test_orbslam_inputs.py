"""What ORB-SLAM is given, as it wants it, and what is told before it crashes on it."""

import gzip
import io
import tarfile

import numpy as np
import pytest
from orbslam_stand_in import CAMERA, NONE, OK, WORDS, sequence

from mdnvo_jax.baselines import orbslam, orbslam_system
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError


def test_a_library_that_is_missing_is_not_blamed_on_the_vocabulary(stand_in, vocabulary):
    (stand_in / "pyorbslam3.py").write_text("raise ImportError('libOpenGL.so.0: no such file')")
    with pytest.raises(InputError, match=r"libOpenGL.so.0: no such file: install it \(Debian: apt install libgl1"):
        orbslam.track(sequence([OK, OK]), vocabulary)


def test_a_crash_at_the_start_is_blamed_on_the_vocabulary(stand_in, vocabulary):
    (stand_in / "pyorbslam3.py").write_text("print('Loading'); import os; os._exit(255)")
    with pytest.raises(InputError, match=r"ended with exit code 255.*: fetch .*words.txt.gz again"):
        orbslam.track(sequence([OK, OK]), vocabulary)


@pytest.mark.parametrize(
    ("known", "options", "message"),
    [
        ({"camera": None}, {}, "drive has no camera: .* give --camera fx,fy,cx,cy"),
        ({"timestamps": np.array([0.0, 1.0, 1.0])}, {}, "frame 2 of sequence drive is not later than the frame before"),
        ({}, {"features": 0}, "0 features"),
        ({}, {"rate_hz": 0.0}, "0 Hz"),
        ({}, {"rate_hz": float("nan")}, "nan Hz"),
        ({}, {"patience_s": -1.0}, "patience -1 s"),
        ({}, {"poses": "best"}, "'best': expected 'final' or 'live'"),
        ({"read": lambda index: np.zeros((6, 8, 3), np.uint8)}, {}, "expected a grey frame"),
    ],
)
def test_what_a_user_can_mend(stand_in, vocabulary, known, options, message):
    read = known.pop("read", None)
    frames = sequence([NONE, OK, OK], **known)
    if read is not None:
        frames = Sequence("drive", 3, read, camera=CAMERA)
    with pytest.raises(InputError, match=message):
        orbslam.track(frames, vocabulary, **options)


def packed(name, content):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        entry = tarfile.TarInfo(name)
        entry.size = len(content)
        archive.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("ORBvoc.txt", WORDS.encode()),
        ("ORBvoc.txt.gz", gzip.compress(WORDS.encode(), mtime=0)),
        ("ORBvoc.txt.tar.gz", packed("ORBvoc.txt", WORDS.encode())),
    ],
)
def test_a_vocabulary_is_unpacked(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    (tmp_path / "work").mkdir()
    assert orbslam_system.unpack_vocabulary(tmp_path / name, tmp_path / "work").read_text() == WORDS


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("v.txt", None, "no vocabulary at .*v.txt: expected a DBoW2 vocabulary"),
        ("v.txt", b"not a vocabulary\n", "v.txt is no vocabulary: expected DBoW2's text"),
        ("v.txt", b"10 6 0 0\n", "is no vocabulary"),
        ("v.txt", b"\x00\xff" * 5000, "is no vocabulary"),
        ("v.txt.gz", WORDS.encode(), "cannot read the vocabulary"),
        ("v.txt.gz", gzip.compress(WORDS.encode() * 100, mtime=0)[:40], "cannot read the vocabulary"),
        ("v.tar.gz", WORDS.encode(), "cannot read the vocabulary"),
        ("v.tar.gz", packed("readme.md", b"hello"), "holds 0 files .txt"),
    ],
)
def test_what_is_no_vocabulary_is_told_before_orbslam_crashes_on_it(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    (tmp_path / "work").mkdir()
    with pytest.raises(InputError, match=message):
        orbslam_system.unpack_vocabulary(tmp_path / name, tmp_path / "work")


def test_settings_are_typed_as_orbslam_wants_them():
    # It ends the process on `fx: 700` and on `nFeatures: 2000.0`.
    lines = orbslam_system.settings((700.0, 710.5, 601.8873, 183), (370, 1226), 1500, 9.67).splitlines()
    assert lines[:2] == ["%YAML:1.0", "---"]
    written = dict(line.split(": ") for line in lines[2:])
    assert written["Camera1.fx"] == "700.000000000"
    assert written["Camera1.fy"] == "710.500000000"
    assert written["Camera1.cx"] == "601.887300000"
    assert written["Camera1.cy"] == "183.000000000"
    assert (written["Camera.width"], written["Camera.height"], written["Camera.fps"]) == ("1226", "370", "10")
    assert (written["ORBextractor.nFeatures"], written["loopClosing"]) == ("1500", "0")
    assert "." in written["Viewer.PointSize"]
