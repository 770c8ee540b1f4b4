"""What moves with the camera and hides a part of its view: the hood of its own car, a caption."""

import cv2
import numpy as np

from mdnvo_jax.model.conv import FLOW_STRIDE

# Share of captions among what covers frames; largest shares of a frame's height that a hood covers, and of the hood's
# light that it mirrors.
_CAPTIONS = 0.25
_HOOD_HEIGHT = 0.25
_HOOD_MIRRORS = 0.6


def cover_frames(frames: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a window of frames, uint8 `[T+1, H, W, C]`, with something in view that moves with the camera, and cover.

    That is the hood (bonnet) of the camera's own car, as dash cameras see it, or in one case of four a caption. Cover
    `[H, W]`, 0 to 1, is how much of each pixel it hides, in all frames alike.
    """
    height, width = frames.shape[1:3]
    if rng.random() < _CAPTIONS:
        cover = _caption(height, width, rng)
        shown = np.full(frames.shape, rng.choice([0.0, 255.0]))
    else:
        cover = _hood(height, width, rng)
        shown = _paint(frames, cover, rng)
    return np.rint(frames + cover[..., None] * (shown - frames)).clip(0, 255).astype(np.uint8), cover


def cover_flow(flow: np.ndarray, cover: np.ndarray) -> np.ndarray:
    """Return the optical flow `[..., h, w, 2]` beside what hides it: NaN where half a pixel or more is covered."""
    height, width = flow.shape[-3:-1]
    hidden = cover[::FLOW_STRIDE, ::FLOW_STRIDE][:height, :width] >= 0.5
    return np.where(hidden[..., None], np.nan, flow).astype(flow.dtype)


def _hood(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Return the cover of a hood: below a parabola whose top, up to a quarter of the frame high, is near its middle."""
    top, droop = height * _HOOD_HEIGHT * rng.random(), rng.random()
    middle = width * (0.5 + 0.1 * rng.standard_normal())
    v, u = np.mgrid[:height, :width].astype(float)
    edge = height - top * (1 - droop * ((u - middle) / (width / 2)) ** 2)
    return np.clip(v + 0.5 - edge, 0, 1)


def _paint(frames: np.ndarray, cover: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return what the hood shows: paint of one brightness, shaded along the rows, and what is above it upside down."""
    height, width = cover.shape
    paint, slope, share = rng.uniform(0, 255), rng.normal(0, 30), rng.uniform(0, _HOOD_MIRRORS)
    rows = np.arange(height)[:, None]
    # As far above the edge as the pixel is below it.
    above = np.clip(2 * (height - np.rint(cover.sum(0)).astype(int)) - rows - 1, 0, rows)
    mirrored = frames[:, above, np.arange(width)]
    return (1 - share) * (paint + slope * (rows[..., None] / height - 0.5)) + share * mirrored


def _caption(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Return the cover of a line of 6 to 20 letters anywhere in the frame, an eighth to a quarter of it high."""
    text = "".join(map(chr, rng.integers(ord("!"), ord("z"), rng.integers(6, 21))))
    # The font's capitals are some 12 pixels high at a scale of 1.
    scale = height * rng.uniform(0.1, 0.2) / 10
    place = int(rng.uniform(-0.1, 0.8) * width), int(rng.uniform(0.1, 1.0) * height)
    cover = np.zeros((height, width), np.uint8)
    cv2.putText(cover, text, place, cv2.FONT_HERSHEY_PLAIN, scale, 255, max(1, round(scale)), cv2.LINE_AA)
    return cover / 255
