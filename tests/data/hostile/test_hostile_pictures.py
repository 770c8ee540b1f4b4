"""Pictures that are damaged, unusual or ask for too much, and cameras of any numbers."""

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hostile_files import PICTURE, damaged, in_one_line, quickly
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from mdnvo_jax.config import ImageConfig
from mdnvo_jax.data import images, picture_header
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError

SUFFIXES = ("png", "jpg", "webp", "tiff", "bmp", "ppm", "pgm")


def encoded(suffix: str, picture: np.ndarray = PICTURE) -> bytes:
    return cv2.imencode(f".{suffix}", picture[..., 0] if suffix == "pgm" else picture)[1].tobytes()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damaged_pictures_are_read_or_refused(suffix: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    whole = encoded(suffix)
    path = tmp_path / f"a.{suffix}"

    @quickly
    @given(damaged(whole), st.sampled_from([1, 3]))
    def check(data: bytes, channels: int) -> None:
        path.write_bytes(data)
        image = in_one_line(lambda: images.read_image(path, channels))
        assert image is None or (image.dtype == np.uint8 and image.shape[2] == channels)
        assert image is None or image.size <= 3 * images.MOST_PIXELS

    check()


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_bomb(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    rows = zlib.compress(bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def patched(suffix: str, find: bytes, replace: bytes) -> bytes:
    whole = encoded(suffix)
    assert whole.count(find) >= 1
    return whole.replace(find, replace, 1)


BIG = 20_000
BOMBS = {
    "png": png_bomb(BIG, BIG),
    "jpg": patched("jpg", struct.pack(">HH", 24, 32), struct.pack(">HH", BIG, BIG)),
    "tiff": patched("tiff", struct.pack("<HHII", 256, 3, 1, 32), struct.pack("<HHII", 256, 4, 1, BIG * BIG)),
    "bmp": patched("bmp", struct.pack("<ii", 32, 24), struct.pack("<ii", BIG, -BIG)),
    "ppm": patched("ppm", b"32 24", b"20000\n# a comment\n20000"),
    "webp": b"RIFF\x20\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0" + (BIG - 1).to_bytes(3, "little") * 2 + bytes(40),
}


@pytest.mark.parametrize("suffix", BOMBS)
def test_a_header_that_asks_for_too_much_is_refused_before_decoding(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(BOMBS[suffix])
    monkeypatch.setattr(images.cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
    with pytest.raises(InputError, match=r"states 20000x20000 pixels|states 400000000x24 pixels"):
        images.read_image(path, 3)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
def test_the_size_in_every_kind_of_tiff(order: str, big: bool) -> None:
    mark = b"II" if order == "<" else b"MM"
    if big:
        head = mark + struct.pack(f"{order}HHHQ", 43, 8, 0, 16) + struct.pack(f"{order}Q", 2)
        entries = [struct.pack(f"{order}HHQQ", 257, 16, 1, 480), struct.pack(f"{order}HHQI4x", 256, 4, 1, 640)]
    else:
        head = mark + struct.pack(f"{order}HI", 42, 8) + struct.pack(f"{order}H", 2)
        entries = [struct.pack(f"{order}HHIH2x", 256, 3, 1, 640), struct.pack(f"{order}HHII", 257, 4, 1, 480)]
    data = head + b"".join(entries)
    assert picture_header.size(data) == (640, 480)
    assert picture_header.size(data[:-12]) is None


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("shape", [(1, 1), (300, 7), (3, 500)])
def test_the_size_in_the_header_is_that_of_the_picture(suffix: str, shape: tuple[int, int]) -> None:
    assert picture_header.size(encoded(suffix, np.zeros((*shape, 3), np.uint8))) == shape[::-1]


def test_the_size_of_lossless_and_lossy_webp() -> None:
    for quality in (50, 101):
        data = cv2.imencode(".webp", PICTURE, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
        assert picture_header.size(data) == (32, 24), data[12:16]


def test_pictures_that_are_unusual(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(PICTURE).convert("CMYK").save(path, quality=95)
    assert np.abs(images.read_image(path, 3).astype(int) - PICTURE).mean() < 30
    path.write_bytes(encoded("png"))
    assert (images.read_image(path, 3) == PICTURE[..., ::-1]).all(), "the content counts, not the name"
    for suffix in SUFFIXES:
        path.write_bytes(encoded(suffix, PICTURE[:1, :1]))
        assert images.read_image(path, 1).shape == (1, 1, 1)
        assert images.prepare(images.read_image(path, 3), None, ImageConfig()).shape == (184, 608, 3)
    for suffix in ("webp", "png"):
        film = cv2.Animation()
        film.frames, film.durations = [PICTURE, 255 - PICTURE], np.array([100, 100])
        path.write_bytes(cv2.imencodeanimation(f".{suffix}", film)[1].tobytes())
        first = images.read_image(path, 3)[..., ::-1]
        assert np.abs(first.astype(int) - PICTURE).mean() < 6, "the first picture of a film"


def test_what_is_no_picture_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    gif = cv2.imencode(".gif", PICTURE)[1].tobytes()
    exr = b"\x76\x2f\x31\x01" + bytes(100)
    for content in (b"", b"\0" * 100, gif, exr, b"P6", b"BM", b"II*\0", b"RIFF\0\0\0\0WEBP"):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"a\.png (cannot be decoded|is cut short)"):
            images.read_image(path, 3)
    for values in (np.full((4, 4), np.nan, np.float32), np.full((4, 4), 1e30, np.float64)):
        cv2.imwrite(str(tmp_path / "a.tiff"), values)
        with pytest.raises(InputError, match=r"samples of type float"):
            images.read_image(tmp_path / "a.tiff", 1)
    with pytest.raises(InputError, match="is no file"):
        images.read_image(tmp_path, 3)
    fifo = tmp_path / "pipe.png"
    os.mkfifo(fifo)
    with pytest.raises(InputError, match="is no file"):
        images.read_image(fifo, 3)
    with pytest.raises(InputError, match="cannot read"):
        images.read_image(f"{tmp_path}/nul\0.png", 3)
    with pytest.raises(InputError, match="cannot read"):
        images.read_image(tmp_path / ("x" * 5000), 3)


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # takes no room
    with pytest.raises(InputError, match="has 1099511627776 bytes"):
        images.read_image(path, 3)


@given(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False) | st.floats(-2000, 2000)] * 4))
@quickly
def test_any_camera_is_taken_or_refused(camera: tuple[float, float, float, float]) -> None:
    config = ImageConfig(height=20, width=40, channels=1, camera=(30.0, 30.0, 19.5, 9.5))

    def read() -> np.ndarray:
        sequence = Sequence("toy", 1, lambda _: np.zeros((24, 32, 1), np.uint8), camera=camera)
        return images.prepare(sequence.read(0), sequence.camera, config)

    frame = in_one_line(read)
    assert frame is None or frame.shape == (20, 40, 1)
