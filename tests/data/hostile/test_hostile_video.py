"""Videos that are damaged, what is none, and names that no file can have."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hostile_files import PICTURE, damaged, in_one_line, quickly
from hypothesis import given

from mdnvo_jax.data.folder import Video, read_frames
from mdnvo_jax.errors import InputError


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("film") / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (32, 24))
    for _ in range(6):
        writer.write(PICTURE)
    writer.release()
    return path.read_bytes()


def test_damaged_videos_are_read_or_refused(film: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.avi"

    @quickly
    @given(damaged(film))
    def check(data: bytes) -> None:
        path.write_bytes(data)
        sequence = in_one_line(lambda: read_frames(path, 1))
        for index in range(0 if sequence is None else sequence.count):
            frame = in_one_line(lambda index=index: sequence.read(index))
            assert frame is None or frame.dtype == np.uint8

    check()


def test_a_playlist_is_no_video(film: bytes, tmp_path: Path) -> None:
    (tmp_path / "secret.avi").write_bytes(film)
    lists = {
        "m3u8": f"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{tmp_path}/secret.avi\n#EXT-X-ENDLIST\n",
        "ffconcat": f"ffconcat version 1.0\nfile {tmp_path}/secret.avi\n",
        "sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 26\n",
        "mp4": f"#EXTM3U\n#EXTINF:10,\n{tmp_path}/secret.avi\n\0",
    }
    for suffix, text in lists.items():
        path = tmp_path / f"list.{suffix}"
        path.write_text(text)
        with pytest.raises(InputError, match="is no video of a kind that is read"):
            read_frames(path, 1)
    assert Video(tmp_path / "secret.avi", 1).count == 6


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", ""])
def test_names_that_no_file_can_have(name: str) -> None:
    with pytest.raises(InputError):
        read_frames(name, 1)
