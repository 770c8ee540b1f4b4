"""The host half of the preprocessing, shared by training and prediction: decode, rectify, resize.

What a frame goes through here depends on its camera and the `ImageConfig` alone, so that training, prediction and
the cache give the network the same pixels. The other half, uint8 to float, runs on the device.
"""

import math
from pathlib import Path

import cv2
import numpy as np

from mdnvo_jax.config import ImageConfig
from mdnvo_jax.data import picture_header
from mdnvo_jax.data.sequence import Camera
from mdnvo_jax.errors import InputError

# File names that count as pictures in a folder.
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".pgm", ".ppm")
# A picture may have as many pixels as 8192 x 8192: decoded they take 200 MB, and 400 MB with 16 bits. Cameras stay far
# below; what states more would be decoded into as much memory as it likes.
MOST_PIXELS = 1 << 26
# And its file as many bytes as these pixels would take with four channels of 16 bits, not compressed.
_MOST_BYTES = 8 * MOST_PIXELS
# 65535 / 255: the full range of 16 bits becomes the full range of 8.
_SIXTEEN_BIT_SCALE = 257.0
# In lengths of the frame: a principal point further off than this is no camera's.
_FURTHEST = 1000
# Linear interpolation may step over this many source pixels a sample before it is refined: 1.25 loses little detail,
# and spares the common small excesses over a whole factor (KITTI to 608 is 2.04) half as many samples again.
_LONGEST_STEP = 1.25


def read_image(path: str | Path, channels: int) -> np.ndarray:
    """Return the picture at `path` as uint8 `[h, w, 3]` (RGB) or, for `channels` 1, `[h, w, 1]` (grey).

    Grey and colour are converted into each other. 16 bits are divided by 257. Alpha is dropped, not composited. A
    rotation in the EXIF data is applied. Of several pictures in one file the first is taken.

    Raises:
      InputError: the file is missing, is no picture, is cut short, is larger than `MOST_PIXELS`, or holds neither 8 nor
        16 bit samples.
    """
    data = _content(Path(path))
    if _cut_short(data):
        raise InputError(f"{path} is cut short ({len(data)} bytes): expected a whole picture; copy it again")
    stated = picture_header.size(data)
    if stated is None:
        raise InputError(f"{path} cannot be decoded: expected a picture ({', '.join(SUFFIXES)})")
    if stated[0] * stated[1] > MOST_PIXELS:
        raise InputError(f"{path} states {stated[0]}x{stated[1]} pixels: expected {MOST_PIXELS} or fewer in all")
    flags = cv2.IMREAD_GRAYSCALE if channels == 1 else cv2.IMREAD_COLOR_BGR
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:
        raise InputError(f"{path} cannot be decoded ({error.err}): expected a picture") from error
    if image is None:
        raise InputError(f"{path} cannot be decoded: expected a picture ({', '.join(SUFFIXES)})")
    if image.dtype == np.uint16:
        image = cv2.convertScaleAbs(image, alpha=1 / _SIXTEEN_BIT_SCALE)
    if image.dtype != np.uint8:
        raise InputError(f"{path} has samples of type {image.dtype}: expected 8 or 16 bits without a sign")
    if channels == 3:
        # Not left to the decoder: OpenCV 5.0 asked for RGB gives black for TIFF with 16 bits.
        cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)
    return image.reshape(*image.shape[:2], channels)


def _content(path: Path) -> bytes:
    """Return what is in a file, which must be one: reading a pipe would wait for ever."""
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{path} is no file: expected a picture")
        if (count := path.stat().st_size) > _MOST_BYTES:
            raise InputError(f"{path} has {count} bytes: expected a picture, of {_MOST_BYTES} or fewer")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        why = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"cannot read {path} ({why}): expected a picture") from error


def as_channels(image: np.ndarray, channels: int) -> np.ndarray:
    """Return an uint8 image `[h, w]`, `[h, w, 1]` or `[h, w, 3]` (RGB) as grey `[h, w, 1]` or RGB `[h, w, 3]`.

    Raises:
      InputError: it is not uint8 or not of these shapes.
    """
    if image.ndim == 2:
        image = image[..., None]
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (1, 3) or image.size == 0:
        raise InputError(
            f"found a frame {image.dtype} {list(image.shape)}: expected uint8 [h, w, 3] (RGB) or [h, w, 1]"
        )
    if image.shape[2] == channels:
        return image
    if channels == 1:
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None]
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)


def prepare(image: np.ndarray, camera: Camera | None, image_config: ImageConfig) -> np.ndarray:
    """Return a decoded frame as the network sees it: uint8 `[H, W, C]` of `image_config`.

    A frame of known `camera` is rectified: pixel u of the result shows what the virtual camera `image_config.camera`
    sees there, `u_source = fx / fx' (u - cx') + cx` (likewise for rows), so that another lens or resolution still
    means the same geometry. Where the virtual camera looks past the edge of the frame, the edge is repeated;
    `uncovered` says how much that is. Lens distortion is not undone. A frame of unknown camera, or with `rectify` off
    or no virtual camera, is resized as a whole. A frame that is there already is returned as it is, not copied.

    Args:
      image: uint8 `[h, w, C]`, RGB or grey; converted where `image_config.channels` says otherwise.
      camera: fx, fy, cx, cy of `image` in pixels, or None.
      image_config: size, channels and virtual camera.

    Raises:
      InputError: the frame is not uint8 of 1 or 3 channels, or `camera` is not that of a frame of this size.
    """
    image = as_channels(image, image_config.channels)
    columns, rows = _source_axes(image.shape[:2], camera, image_config)
    for (step, start), length in ((columns, image.shape[1]), (rows, image.shape[0])):
        if not (abs(step) <= length and abs(start) <= _FURTHEST * length):
            raise InputError(
                f"camera {camera} of a frame of {image.shape[1]}x{image.shape[0]} pixels: expected fx, fy, cx, cy in "
                "pixels of that frame"
            )
    if image.shape[:2] == (image_config.height, image_config.width) and _identity(*columns) and _identity(*rows):
        return image
    return resample(image, columns, rows, (image_config.height, image_config.width))


def uncovered(size: tuple[int, int], camera: Camera | None, image_config: ImageConfig) -> float:
    """Return the share of the network's input that a frame of `size` (height, width) and `camera` cannot fill, 0 to 1.

    A pixel counts as filled when its centre lies on the frame; `prepare` repeats the edge for the rest.
    """
    covered = 1.0
    targets = (image_config.width, image_config.height)
    for (step, start), target, length in zip(
        _source_axes(size, camera, image_config), targets, (size[1], size[0]), strict=True
    ):
        # Half a source pixel beyond the outer centres still belongs to the frame; the hair more is for rounding.
        source = step * np.arange(target) + start
        covered *= float(np.mean((source >= -0.5 - 1e-6) & (source <= length - 0.5 + 1e-6)))
    return 1 - covered


def scaled_camera(camera: Camera, from_size: tuple[int, int], to_size: tuple[int, int]) -> Camera:
    """Return the intrinsics after a whole frame of `from_size` is resized to `to_size`, both (height, width).

    With pixel centres at whole numbers, u becomes `(u + 0.5) s - 0.5`.
    """
    fx, fy, cx, cy = camera
    scale_y, scale_x = to_size[0] / from_size[0], to_size[1] / from_size[1]
    return fx * scale_x, fy * scale_y, (cx + 0.5) * scale_x - 0.5, (cy + 0.5) * scale_y - 0.5


def prepared_camera(size: tuple[int, int], camera: Camera | None, image_config: ImageConfig) -> Camera | None:
    """Return the intrinsics of what `prepare` makes of a frame of `size` (height, width), or None if unknown."""
    if camera is None:
        return None
    if image_config.rectify and image_config.camera:
        fx, fy, cx, cy = image_config.camera
        return fx, fy, cx, cy
    return scaled_camera(camera, size, (image_config.height, image_config.width))


def resample(
    image: np.ndarray, columns: tuple[float, float], rows: tuple[float, float], size: tuple[int, int]
) -> np.ndarray:
    """Return `image` sampled at source column `a u + b` and row `a v + b`, averaged over what a pixel covers.

    Shrinking is done by averages over whole numbers of samples, linearly interpolated at about the source's own
    resolution: the place is exact to a small part of a pixel, and nothing aliases. A negative `a` mirrors.

    Args:
      image: uint8 `[h, w, C]`.
      columns: (a, b), source pixels per pixel of the result and source position of its pixel 0.
      rows: the same downwards.
      size: height and width of the result.
    """
    height, width = size
    reduced = [max(1, math.floor(abs(step) / 2)) for step, _ in (columns, rows)]
    if max(reduced) > 1:
        # Far from the final resolution, whole pixels can be averaged first, at a tenth of the cost of interpolating.
        cut = image[: image.shape[0] // reduced[1] * reduced[1], : image.shape[1] // reduced[0] * reduced[0]]
        image = cv2.resize(cut, (cut.shape[1] // reduced[0], cut.shape[0] // reduced[1]), interpolation=cv2.INTER_AREA)
    axes = [(a / r, (b + 0.5) / r - 0.5) for (a, b), r in zip((columns, rows), reduced, strict=True)]
    factors = [max(1, math.ceil(abs(a) / _LONGEST_STEP)) for a, _ in axes]
    # Sample i of n over pixel u lies at u - 0.5 + (i + 0.5) / n.
    (ax, bx), (ay, by) = ((a / n, b + a * (0.5 / n - 0.5)) for (a, b), n in zip(axes, factors, strict=True))
    fine = cv2.warpAffine(
        image,
        np.array([[ax, 0.0, bx], [0.0, ay, by]]),
        (width * factors[0], height * factors[1]),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    if max(factors) > 1:
        fine = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
    return fine.reshape(height, width, -1)


def _source_axes(
    size: tuple[int, int], camera: Camera | None, image_config: ImageConfig
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return (a, b) of columns and of rows: pixel u of the network's input shows source column `a u + b`."""
    if camera is not None and image_config.rectify and image_config.camera:
        fx, fy, cx, cy = camera
        to_fx, to_fy, to_cx, to_cy = image_config.camera
        return (fx / to_fx, cx - fx / to_fx * to_cx), (fy / to_fy, cy - fy / to_fy * to_cy)
    scale_y, scale_x = size[0] / image_config.height, size[1] / image_config.width
    return (scale_x, 0.5 * scale_x - 0.5), (scale_y, 0.5 * scale_y - 0.5)


def _identity(step: float, start: float) -> bool:
    """Return whether `step u + start` is u, but for rounding of the intrinsics."""
    return abs(step - 1) < 1e-8 and abs(start) < 1e-5


def _cut_short(data: bytes) -> bool:
    """Return whether `data` is a PNG or JPEG without its end, which decoders fill with grey or report on stderr."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data
    if not data.startswith(b"\xff\xd8\xff"):
        return False
    # Walk over the segments to the entropy-coded data; in there 0xFFD9 can only be the end marker.
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF and data[position + 1] != 0xDA:
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return data.find(b"\xff\xd9", position) < 0
