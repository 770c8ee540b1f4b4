"""Augmentation of windows: what is seen changes, and the labels change exactly with it."""

import dataclasses
import functools
import math
import statistics

import cv2
import numpy as np

from mdnvo_jax import geometry
from mdnvo_jax.data import images
from mdnvo_jax.data.sequence import Camera, Sequence
from mdnvo_jax.data.world.motion import swing
from mdnvo_jax.errors import InputError
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
# In two KITTI clips 5 to 19 % of the lower half of most frames are white for 50 and 150 frames.
_MOST_LOG_OVEREXPOSURE = float(np.log(2.5))
# Largest shares of a frame that a narrower view lacks at its top, bottom, left and right.
_NARROW = (0.3, 0.12, 0.25, 0.25)
# Attitude of a swaying camera about x, y and z (pitch, yaw, roll), as standard deviations: what stays the same over a
# window, what grows with every frame, and the strength of what swings, each in degrees. Mounts look up, down and aside
# by degrees. A network that never saw it takes every car to go where its camera looks, and reads a car whose camera
# looks down too fast, one whose camera looks up too slow. The swing is of the size of the rendered cars' own and of any
# frequency up to half the frame rate: no spring's alone. What grows are yaws as fast as cars turn in corners, at any
# speed, for else a network learns that who turns drives slowly and reads his speed so; and pitch and roll slower than
# springs', as on banked and rolling roads, which it would else read short.
_SWAY_OFFSET_DEG = (1.5, 2.5, 1.0)
_SWAY_RATE_DEG = (0.1, 0.8, 0.15)
_SWAY_SWING_DEG = (0.2, 0.15, 0.2)
_SWAY_SINES = 5
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
    if camera is None:
        return np.full_like(flow, np.nan)
    height, width = flow.shape[-3:-1]
    v, u = np.mgrid[:height, :width].astype(float)
    mirrored = _flow_at(flow, np.stack([2 * camera[2] / FLOW_STRIDE - u, v], -1)) * (-1.0, 1.0)
    return mirrored.astype(flow.dtype)


def narrow(frames: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a window of frames, `[T+1, H, W, C]`, as if a camera of narrower view had taken it: edges repeated.

    What lies outside of a rectangle that `rng` draws (up to `_NARROW` of the frame cut off at each side) shows the
    rectangle's nearest pixel, as `images.prepare` fills what a camera does not see.
    """
    height, width = frames.shape[1:3]
    top, bottom, left, right = (rng.random() * share for share in _NARROW)
    return _window_on(frames, round(top * height), round(bottom * height), round(left * width), round(right * width))


def most_pan(camera: Camera, width: int) -> float:
    """Return the angle, rad, by which a pan may move a frame `width` pixels wide: a quarter of it is lost then."""
    return math.atan(width / 4 / camera[0])


def draw_sway(count: int, rng: np.random.Generator, *, most_pan_rad: float) -> np.ndarray:
    """Return rotations `[count, 3, 3]` of a camera against its mount, one a frame: a few degrees, and a pan.

    Args:
      count: of the frames.
      rng: decides.
      most_pan_rad: how far a rotation that grows with every frame may have come at either end; see `most_pan`. 0 for
        whole drives, over which the camera would look aside.
    """
    frame = np.arange(count) - (count - 1) / 2
    frequency, phase = rng.uniform(0, 0.5, (_SWAY_SINES, 3)), rng.uniform(0, 2 * np.pi, (_SWAY_SINES, 3))
    swinging = swing(frequency, phase, frame[:, None, None])
    offset, rate, strength = rng.standard_normal((3, 3)) * (_SWAY_OFFSET_DEG, _SWAY_RATE_DEG, _SWAY_SWING_DEG)
    pan = np.deg2rad(rate) * frame[:, None]
    # The whole pan slows down where its ends would go too far.
    pan *= min(1.0, most_pan_rad / max(np.abs(pan).max(), 1e-12))
    return geometry.exp_so3(np.deg2rad(offset + strength * swinging) + pan)


def sway_frames(frames: np.ndarray, camera: Camera, rotations: np.ndarray) -> np.ndarray:
    """Return a window of frames, uint8 `[T+1, H, W, C]`, as the same camera sees them when it is turned.

    With K of `camera` and R of the frame, pixel x of the result shows pixel `K R K^-1 x`: exact whatever the depth, for
    the camera turns about its own centre. What some frame does not see repeats the edge in all frames alike, as in
    `narrow`.

    Args:
      frames: of `camera`.
      camera: fx, fy, cx, cy of the frames.
      rotations: attitude of the turned camera in the axes of the other, `[T+1, 3, 3]`.
    """
    maps = _homographies(camera, rotations)
    turned = np.stack([_turned(frame, homography) for frame, homography in zip(frames, maps, strict=True)])
    return _window_on(turned, *_unseen(frames.shape[1:3], maps))


def sway_flow(flow: np.ndarray, camera: Camera, rotations: np.ndarray) -> np.ndarray:
    """Return the optical flow `[T, h, w, 2]` of swaying frames, on the network's map: `sway_frames`'s labels.

    The place that a cell sees is found in the frame as it was, its flow there is that of the four cells about it, and
    where it leads is brought to the next turned frame. NaN where one of the four is not known or not on the map.
    """
    height, width = flow.shape[1:3]
    fx, fy, cx, cy = (value / FLOW_STRIDE for value in camera)
    maps = _homographies((fx, fy, cx, cy), rotations)
    v, u = np.mgrid[:height, :width].astype(float)
    cells = np.stack([u, v], -1)
    source = _through(maps[:-1, None, None], cells)
    led = source + _flow_at(flow, source)
    return (_through(np.linalg.inv(maps[1:])[:, None, None], led) - cells).astype(flow.dtype)


def sway_steps(steps: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return the steps `[T, 6]` of the swaying camera: `R_t^T T_{t,t+1} R_{t+1}` of those of the other."""
    turns = np.tile(np.eye(4), (len(rotations), 1, 1))
    turns[:, :3, :3] = rotations
    moved = geometry.compose(geometry.inverse(turns[:-1]), geometry.step_to_matrix(steps))
    return geometry.matrix_to_step(geometry.compose(moved, turns[1:]))


def sway_sequence(sequence: Sequence, seed: int) -> Sequence:
    """Return `sequence` as a camera films it that sways on its mount as `seed` says: poses follow, flow is not known.

    Raises:
      InputError: the sequence has no camera.
    """
    camera = sequence.camera
    if camera is None:
        raise InputError(f"sequence {sequence.name} has no intrinsics: what a swaying camera sees is not known")
    rotations = draw_sway(sequence.count, np.random.default_rng(seed), most_pan_rad=0.0)
    maps = _homographies(camera, rotations)
    unseen = functools.cache(lambda size: _unseen(size, maps))
    poses = None
    if sequence.poses is not None:
        poses = sequence.poses.copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ rotations

    def read(index: int) -> np.ndarray:
        frame = sequence.read(index)
        return _window_on(_turned(frame, maps[index]), *unseen(frame.shape[:2]))

    return dataclasses.replace(sequence, read=read, poses=poses, flow=None)


def overexpose(frames: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a window of frames, uint8 `[T+1, H, W, C]`, as a camera takes them that is exposed for the shade.

    `x <- min(gain x, 255)` with one gain for the window, `gain = exp(u)` with u uniform from 0 to log 2.5: what the sun
    lights goes white, and shows nothing of itself.
    """
    gain = np.exp(rng.uniform(0, _MOST_LOG_OVEREXPOSURE))
    return cv2.LUT(frames, np.rint(gain * np.arange(256)).clip(0, 255).astype(np.uint8)).reshape(frames.shape)


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


def _flow_at(flow: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return optical flow `[..., h, w, 2]` at places (column, row) of its map, a `place` for each cell of the result.

    The four cells about a place are blended; NaN where one that counts is not known or not on the map.
    """
    height, width = flow.shape[-3:-1]
    maps = flow.reshape(-1, height, width, 2)
    places = np.broadcast_to(place, flow.shape).reshape(maps.shape)
    corner = np.floor(places)
    share = places - corner
    column, row = np.moveaxis(corner.astype(int), -1, 0)
    number = np.arange(len(maps))[:, None, None]
    blended = np.zeros(maps.shape)
    for down in (0, 1):
        for right in (0, 1):
            weight = abs(1 - right - share[..., 0]) * abs(1 - down - share[..., 1])
            inside = (row + down >= 0) & (row + down < height) & (column + right >= 0) & (column + right < width)
            value = maps[number, np.clip(row + down, 0, height - 1), np.clip(column + right, 0, width - 1)]
            value = np.where(inside[..., None], value, np.nan)
            blended += np.where(weight[..., None] > 0, weight[..., None] * value, 0)
    return blended.reshape(flow.shape)


def _window_on(frames: np.ndarray, top: int, bottom: int, left: int, right: int) -> np.ndarray:
    """Return frames `[..., H, W, C]` without so many of their rows and columns, the edge repeated in their place."""
    height, width = frames.shape[-3:-1]
    rows = np.clip(np.arange(height), top, height - bottom - 1)
    columns = np.clip(np.arange(width), left, width - right - 1)
    return frames[..., rows, :, :][..., columns, :]


def _turned(frame: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Return a frame `[H, W, C]` whose pixel x shows what pixel `homography x` did; the edge is repeated."""
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    size = frame.shape[1], frame.shape[0]
    return cv2.warpPerspective(frame, homography, size, flags=flags, borderMode=cv2.BORDER_REPLICATE).reshape(
        frame.shape
    )


def _unseen(size: tuple[int, int], maps: np.ndarray) -> tuple[int, int, int, int]:
    """Return the rows and columns (top, bottom, left, right) that some frame of `size` lacks when `maps` turn it."""
    height, width = size
    v, u = np.mgrid[:height, :width].astype(float)
    edge = (u == 0) | (u == width - 1) | (v == 0) | (v == height - 1)
    u, v = u[edge], v[edge]
    column, row = np.moveaxis(_through(maps[:, None], np.stack([u, v], -1)), -1, 0)
    return (
        max(0, math.ceil(-row[:, v == 0].min())),
        max(0, math.ceil(row[:, v == height - 1].max() - (height - 1))),
        max(0, math.ceil(-column[:, u == 0].min())),
        max(0, math.ceil(column[:, u == width - 1].max() - (width - 1))),
    )


def _homographies(camera: Camera, rotations: np.ndarray) -> np.ndarray:
    """Return `K R K^-1`, `[..., 3, 3]`: from pixels of the turned camera to those of the other."""
    fx, fy, cx, cy = camera
    intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return intrinsics @ rotations @ np.linalg.inv(intrinsics)


def _through(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return where homographies `[..., 3, 3]` take points `[..., 2]`."""
    moved = homography[..., :2] @ points[..., None] + homography[..., 2:]
    return moved[..., :2, 0] / moved[..., 2:, 0]
