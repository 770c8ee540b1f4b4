"""Augmentation of windows: what is seen changes, and the labels change exactly with it."""

import statistics

import cv2
import numpy as np

from mdnvo_jax.data import images
from mdnvo_jax.data.sequence import Camera
from mdnvo_jax.model.conv import FLOW_STRIDE

# What one draw of strength 1 does, as standard deviations: natural logarithms of gain and gamma of the window, of the
# gain of one colour and of one frame; offset and noise in grey levels of 255. Exposure and tone differ much between
# cameras and little between neighbouring frames. Found by eye on KITTI: strength 1 is about the most that still looks
# like daylight.
_LOG_GAIN = 0.25
_LOG_GAMMA = 0.25
_LOG_COLOUR_GAIN = 0.05
_LOG_FRAME_GAIN = 0.02
_OFFSET = 12.0
_NOISE = 4.0
# Largest shares of a frame that a narrower view lacks at its top, bottom, left and right.
_NARROW = (0.3, 0.12, 0.25, 0.25)
# Rows and columns by which the noise of one frame may be moved against that of another.
_NOISE_SHIFT = 64
# 256 values that are equally likely under the standard normal distribution: a byte draws one of them, at a tenth of
# the cost of a normal number.
_NORMAL = np.array([statistics.NormalDist().inv_cdf((i + 0.5) / 256) for i in range(256)])


def mirror_frame(image: np.ndarray, camera: Camera | None) -> np.ndarray:
    """Return the frame, uint8 `[H, W, C]`, that the left-right mirrored world would show to the same camera.

    Pixel u of the result is pixel `2 cx - u` of `image`: a point at x / z = a is seen at `fx a + cx`, its mirror at
    `-fx a + cx`. Where that leaves the frame the edge is repeated. Without a `camera`, cx is taken as the middle.
    """
    width = image.shape[1]
    centre = (width - 1) / 2 if camera is None else camera[2]
    if abs(centre - (width - 1) / 2) < 1e-6:
        return image[:, ::-1]
    return images.resample(image, (-1.0, 2 * centre), (1.0, 0.0), (image.shape[0], width))


def mirror_flow(flow: np.ndarray, camera: Camera | None) -> np.ndarray:
    """Return the optical flow `[..., h, w, 2]` of mirrored frames, on the network's map: `mirror_frame`'s labels.

    Cell i of the map sees pixel 8 i, so its mirror `2 cx - 8 i` lies between cells: the two about it are blended. NaN
    where one of them is not known or not on the map. Without a `camera` there is no saying where: all NaN.
    """
    width = flow.shape[-2]
    if camera is None:
        return np.full_like(flow, np.nan)
    place = 2 * camera[2] / FLOW_STRIDE - np.arange(width)
    left = np.floor(place).astype(int)
    share = (place - left)[:, None]
    known = (left >= 0) & (left + (share[:, 0] > 0) < width)
    first, second = (flow[..., np.clip(column, 0, width - 1), :] for column in (left, left + 1))
    blended = np.where(share > 0, (1 - share) * first + share * second, first) * (-1.0, 1.0)
    return np.where(known[:, None], blended, np.nan).astype(flow.dtype)


def narrow(frames: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a window of frames, `[T+1, H, W, C]`, as if a camera of narrower view had taken it: edges repeated.

    What lies outside of a rectangle that `rng` draws (up to `_NARROW` of the frame cut off at each side) shows the
    rectangle's nearest pixel, as `images.prepare` fills what a camera does not see.
    """
    height, width = frames.shape[1:3]
    top, bottom, left, right = (rng.random() * share for share in _NARROW)
    rows = np.clip(np.arange(height), round(top * height), round((1 - bottom) * height) - 1)
    columns = np.clip(np.arange(width), round(left * width), round((1 - right) * width) - 1)
    return frames[:, rows][:, :, columns]


def photometric(frames: np.ndarray, strength: float, rng: np.random.Generator) -> np.ndarray:
    """Return a window of frames, uint8 `[T+1, H, W, C]`, as another camera in another light might have taken it.

    With x from 0 to 1, `x <- gain x^gamma + offset` is drawn once for the window, with a small gain of each colour;
    each frame gets a small gain of its own and noise. The standard deviations grow in proportion to `strength`.
    """
    count, height, width, channels = frames.shape
    gain = np.exp(strength * _LOG_GAIN * rng.standard_normal())
    gamma = np.exp(strength * _LOG_GAMMA * rng.standard_normal())
    offset = strength * _OFFSET * rng.standard_normal()
    noise = strength * _NOISE * abs(rng.standard_normal())
    colour_gain = np.exp(strength * _LOG_COLOUR_GAIN * rng.standard_normal(channels))
    frame_gain = np.exp(strength * _LOG_FRAME_GAIN * rng.standard_normal(count))
    curve = 255 * gain * (np.arange(256) / 255) ** gamma
    # One field of noise is drawn; every frame takes it from another place.
    field = rng.integers(0, 256, (height + _NOISE_SHIFT, width + _NOISE_SHIFT, channels), dtype=np.uint8)
    field = cv2.LUT(field, np.rint(noise * _NORMAL).astype(np.int16)).reshape(field.shape)
    result = np.empty_like(frames)
    for index, frame in enumerate(frames):
        tone = np.rint(curve[:, None] * colour_gain * frame_gain[index] + offset).clip(-1000, 1000).astype(np.int16)
        row, column = (int(rng.integers(_NOISE_SHIFT)) for _ in range(2))
        moved = field[row : row + height, column : column + width]
        toned = cv2.LUT(frame, tone[None]).reshape(frame.shape)
        result[index] = cv2.add(toned, moved, dtype=cv2.CV_8U).reshape(frame.shape)
    return result
