"""Frames from wherever a user has them: a folder, a glob, a video file, a sequence of KITTI."""

import dataclasses
import glob
import os
import re
import threading
from collections.abc import Sequence as Many
from pathlib import Path

import cv2
import numpy as np

from mdnvo_jax.data import images as pictures
from mdnvo_jax.data import kitti
from mdnvo_jax.data.sequence import Camera, Sequence, one_size
from mdnvo_jax.errors import InputError


def read_frames(
    images: str | Path,
    channels: int,
    *,
    stride: int = 1,
    timestamps: str | Path | None = None,
    camera: Camera | None = None,
) -> Sequence:
    """Return the frames at `images`, without poses.

    - A folder: its pictures (the suffixes in `images.SUFFIXES`) in natural order, so that frame2 comes before frame10.
      Hidden files are left out.
    - A glob, such as "drive/*.png": the files it matches in natural order of their whole paths.
    - A folder of KITTI (calib.txt beside image_0 to image_3), or one of the image folders in it: the pictures with
      the camera of calib.txt and the times of times.txt. For the folder as a whole, `channels` 1 prefers image_0 and
      `channels` 3 prefers image_2.
    - A video file: its frames in order, the times by its frame rate. Reading in order is fast; going back begins again
      at the start of the file. A rotation in its metadata is applied.

    Args:
      images: as above.
      channels: 3 for RGB, 1 for grey; pictures are converted.
      stride: takes every `stride`-th frame.
      timestamps: file with the time of every frame (before striding) in s, a line each.
      camera: fx, fy, cx, cy of the frames in pixels; goes before that of a calib.txt.

    Returns:
      The sequence. Its `read` raises `InputError` for a frame that cannot be read, and for one of another size than
      the first that was read: a trajectory needs one camera.

    Raises:
      InputError: there are not two frames at `images`, or `timestamps` does not fit them.
    """
    if stride < 1:
        raise InputError(f"stride {stride}: expected 1 or more")
    sequence = _find(images, channels)
    if timestamps is not None:
        times = kitti.read_times(timestamps, sequence.count)
        if times is None:
            raise InputError(f"no file {timestamps}: expected a text file, a line with the time of each frame in s")
        sequence = dataclasses.replace(sequence, timestamps=times)
    if camera is not None:
        sequence = dataclasses.replace(sequence, camera=camera)
    kept = range(0, sequence.count, stride)
    if len(kept) < 2:
        raise InputError(
            f"{len(kept)} frame in {images}" + (f" at stride {stride}" if stride > 1 else "") + ": "
            "expected two or more, since motion is what lies between them"
        )
    return dataclasses.replace(
        sequence,
        count=len(kept),
        read=one_size(lambda index: sequence.read(kept[index]), lambda index: sequence.label(kept[index])),
        timestamps=None if sequence.timestamps is None else sequence.timestamps[::stride],
        paths=[sequence.label(index) for index in kept],
    )


def as_sequence(
    frames: str | os.PathLike[str] | Sequence | np.ndarray,
    channels: int,
    *,
    stride: int = 1,
    timestamps: np.ndarray | None = None,
    camera: Camera | None = None,
) -> Sequence:
    """Return frames in whatever form they were given as a sequence.

    Args:
      frames: what `read_frames` reads, or a sequence, or an array `[N, H, W]` or `[N, H, W, C]` of uint8.
      channels: 3 for RGB, 1 for grey.
      stride: takes every `stride`-th frame, but for a sequence.
      timestamps: of the frames taken, s, but for a sequence.
      camera: fx, fy, cx, cy of the frames in pixels.

    Raises:
      InputError: the array is of another type, shape or number of channels, or see `read_frames`.
    """
    if isinstance(frames, (str, os.PathLike)):
        found = read_frames(os.fspath(frames), channels, stride=stride, camera=camera)
        return found if timestamps is None else dataclasses.replace(found, timestamps=timestamps)
    if isinstance(frames, Sequence):
        return frames if camera is None else dataclasses.replace(frames, camera=camera)
    images = np.asarray(frames)
    if images.ndim not in (3, 4) or images.dtype != np.uint8:
        raise InputError(f"frames are {images.dtype} {images.shape}: expected uint8 [N, H, W] or [N, H, W, C]")
    images = images.reshape(*images.shape[:3], -1)[::stride]
    if images.shape[-1] != channels:
        raise InputError(f"frames have {images.shape[-1]} channels: the model expects {channels}")
    return Sequence(name="array", count=len(images), read=images.__getitem__, timestamps=timestamps, camera=camera)


def natural_key(text: str) -> tuple[list[tuple[int, int, str]], str]:
    """Return a key to sort by that compares runs of digits by their number: frame2 before frame10."""
    parts = [part for part in re.split(r"(\d+)", text) if part]
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts], text


# How videos begin: Matroska and WebM, AVI, MPEG (program and elementary streams, H.264, H.265), FLV, Ogg, WMV, IVF,
# Y4M.
_STARTS = (
    *(b"\x1aE\xdf\xa3", b"RIFF", b"\0\0\x01", b"\0\0\0\x01", b"FLV\x01", b"OggS"),
    *(b"0&\xb2u\x8ef\xcf\x11", b"DKIF", b"YUV4MPEG2 "),
)
# The kinds of the first atom of MP4 and MOV files, after its length.
_ATOMS = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot")
# Bytes of a packet of an MPEG transport stream; each begins with a G.
_PACKET = 188


class Video:
    """A video file read frame by frame, holding one decoder and one frame whatever its length.

    Containers count, seek and time frames unreliably, so a frame is only ever reached by decoding up to it.
    """

    def __init__(self, path: str | Path, channels: int):
        self.path = str(path)
        self.channels = channels
        # The decoder has a position: threads take turns.
        self._lock = threading.Lock()
        self._last: np.ndarray | None = None
        self._open()
        self.frame_rate_hz = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.count = self._count()

    def read(self, index: int) -> np.ndarray:
        """Return frame `index`, uint8 `[h, w, C]`.

        Raises:
          InputError: the file ends before, or the frame cannot be decoded.
        """
        with self._lock:
            if index == self._next - 1 and self._last is not None:
                return self._last
            if index < self._next:
                self._open()
            # Whatever fails below, the frame kept must not pass for the one reached.
            self._last = None
            while self._next <= index:
                if not self._capture.grab():
                    raise self._error(index)
                self._next += 1
            decoded, frame = self._capture.retrieve()
            if not decoded:
                raise self._error(index)
            self._last = pictures.as_channels(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), self.channels)
            return self._last

    def _open(self) -> None:
        self._capture = cv2.VideoCapture(self.path, cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise InputError(f"{self.path} cannot be opened as a video: expected a folder, a glob or a video file")
        self._next = 0
        self._last = None

    def _error(self, index: int) -> InputError:
        return InputError(f"{self.path}: frame {index} of {self.count} cannot be read: expected a whole file")

    def _count(self) -> int:
        """Return the number of frames, by decoding them all where the container's figure proves wrong."""
        stated = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if stated > 0:
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, stated - 1)
            right = self._capture.grab() and not self._capture.grab()
            self._open()
            if right:
                return stated
        count = 0
        while self._capture.grab():
            count += 1
        self._open()
        return count


def _find(images: str | Path, channels: int) -> Sequence:
    """Return every frame at `images`."""
    try:
        return _found(Path(images), images, channels)
    except OSError as error:
        raise InputError(f"cannot read {str(images)[:200]} ({error.strerror}): expected frames") from error


def _found(path: Path, images: str | Path, channels: int) -> Sequence:
    """Return every frame at `images`, which is `path` where it is no glob."""
    if path.is_dir():
        return _directory(path, channels)
    if path.is_file():
        return _video(path, channels)
    matches = [Path(match) for match in glob.glob(str(images), recursive=True)]  # noqa: PTH207 the pattern may be absolute
    if any(sign in str(images) for sign in "*?["):
        files = [match for match in matches if match.is_file()]
        if not files:
            raise InputError(f"nothing matches {images}: expected pictures ({', '.join(pictures.SUFFIXES)})")
        return _files(str(images), files, channels)
    raise InputError(f"no {images}: expected a folder of pictures, a glob in quotes, or a video file")


def _directory(folder: Path, channels: int) -> Sequence:
    """Return the frames of a folder, with the calibration of KITTI where it lies beside them."""
    cameras = sorted(path.name for path in folder.glob("image_*") if path.is_dir())
    if cameras and (folder / "calib.txt").is_file():
        favourite = "image_0" if channels == 1 else "image_2"
        folder = folder / (favourite if favourite in cameras else cameras[0])
    files = [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in pictures.SUFFIXES and not path.name.startswith(".") and path.is_file()
    ]
    if not files:
        below = sorted(path.name for path in folder.iterdir() if path.is_dir())
        hint = f"; it has the folders {', '.join(below[:5])}" if below else ""
        raise InputError(f"no pictures in {folder}{hint}: expected {', '.join(pictures.SUFFIXES)}")
    sequence = _files(str(folder), files, channels)
    if not re.fullmatch(r"image_\d+", folder.name) or not (folder.parent / "calib.txt").is_file():
        return sequence
    return dataclasses.replace(
        sequence,
        camera=kitti.read_camera(folder.parent, folder.name),
        timestamps=kitti.read_times(folder.parent / "times.txt", sequence.count),
    )


def _files(name: str, files: Many[Path], channels: int) -> Sequence:
    """Return picture files in natural order as a sequence."""
    files = sorted(files, key=lambda path: natural_key(str(path)))
    stems = [path.with_suffix("") for path in files]
    for first, second in zip(range(len(files)), range(1, len(files)), strict=False):
        if stems[first] == stems[second]:
            raise InputError(
                f"{files[first]} and {files[second].name} may be one frame twice: give one kind, as in "
                f"'*{files[first].suffix}'"
            )
    return Sequence(
        name=name,
        count=len(files),
        read=lambda index: pictures.read_image(files[index], channels),
        paths=[str(path) for path in files],
    )


def _is_video(path: Path) -> bool:
    """Return whether a file begins as a video does.

    A playlist is none: the decoder would follow it to other files and hosts than the one that the user named.
    """
    with path.open("rb") as file:
        data = file.read(2 * _PACKET)
    transport = data[:1] == b"G" and data[_PACKET : _PACKET + 1] in (b"G", b"")
    return transport or data[4:8] in _ATOMS or any(data.startswith(start) for start in _STARTS)


def _video(path: Path, channels: int) -> Sequence:
    """Return a video file as a sequence."""
    if path.suffix.lower() in pictures.SUFFIXES:
        raise InputError(f"{path} is one picture: expected a folder of pictures, a glob in quotes, or a video file")
    if not _is_video(path):
        raise InputError(
            f"{path} is no video of a kind that is read: expected MP4, MOV, AVI, Matroska, WebM, MPEG, H.264, H.265, "
            "FLV, Ogg, WMV or Y4M; convert it, or give a folder of pictures"
        )
    video = Video(path, channels)
    rate = video.frame_rate_hz
    return Sequence(
        name=str(path),
        count=video.count,
        read=video.read,
        timestamps=np.arange(video.count) / rate if np.isfinite(rate) and rate > 0 else None,
        paths=[f"{path}: frame {index}" for index in range(video.count)],
        in_order=True,
    )
