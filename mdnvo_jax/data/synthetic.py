"""A procedural driving world: frames, exact poses, depth and optical flow, all decided by a seed.

A seed stands for a world and a drive through it. The layout is drawn on the host (`data/world/`); frames are rendered
by a ray caster in JAX when they are read, with one compilation for each size. The same seed gives the same bits on the
same machine however the frames are read, and the first frames of a longer drive are those of a shorter one.
"""

import collections
import functools
import math
import threading
from typing import NamedTuple

import jax
import numpy as np

from mdnvo_jax import geometry
from mdnvo_jax.data.sequence import Camera, Sequence
from mdnvo_jax.data.world import film, render, world
from mdnvo_jax.data.world.motion import CAMERA_HEIGHT_M, FRAME_S, draw_mount
from mdnvo_jax.data.world.style import stream
from mdnvo_jax.errors import InputError
from mdnvo_jax.model.conv import FLOW_LAYERS, FLOW_STRIDE, map_size

# Intrinsics and size of KITTI's left grey camera, sequence 00.
_KITTI_CAMERA = (718.856, 718.856, 607.1928, 185.2157)
_KITTI_SIZE = (376, 1241)
# Frames of a drive that are kept: neighbouring windows share them.
_KEPT_FRAMES = 16
# Worlds that are kept whole; a world of 120 frames takes about a megabyte.
_KEPT_WORLDS = 16


class Truth(NamedTuple):
    """What is known exactly about a frame.

    Attributes:
      depth: z of what the centre of each pixel sees, `[H, W]` float32, m; infinite in the sky.
      flow: where that goes in the next frame, (u, v) in pixels, `[H, W, 2]` float32; NaN where it passes the camera.
      moving: whether it belongs to something that moves by itself, `[H, W]` bool.
    """

    depth: np.ndarray
    flow: np.ndarray
    moving: np.ndarray


def kitti_camera(height: int, width: int) -> Camera:
    """Return KITTI's intrinsics scaled to a frame of `height` x `width`: 81 degrees across at KITTI's shape.

    Both focal lengths follow the width, so that pixels stay square; pixel centres are at whole numbers.
    """
    scale = width / _KITTI_SIZE[1]
    cy = (_KITTI_CAMERA[3] + 0.5) * height / _KITTI_SIZE[0] - 0.5
    return _KITTI_CAMERA[0] * scale, _KITTI_CAMERA[1] * scale, (_KITTI_CAMERA[2] + 0.5) * scale - 0.5, cy


def varied_camera(seed: int, height: int, width: int) -> Camera:
    """Return a camera of another make for the world of `seed`: for training that meets more than KITTI's.

    The focal length is 0.7 to 1.4 of KITTI's, 102 to 63 degrees across, and the principal point lies up to 3 % of the
    width and 8 % of the height off KITTI's.
    """
    fx, fy, cx, cy = kitti_camera(height, width)
    focal, right, down = stream(seed, "camera").uniform(-1, 1, 3)
    scale = float(np.exp(np.log(1.4) * focal))
    return fx * scale, fy * scale, cx + 0.03 * width * float(right), cy + 0.08 * height * float(down)


def name_of(seed: int) -> str:
    """Return the name of the drives through the world of `seed`."""
    return f"world_{seed:06d}"


def drive(
    seed: int,
    frames: int,
    *,
    height: int,
    width: int,
    channels: int = 1,
    camera: Camera | None = None,
    samples: int = 2,
    effects: float = 1.0,
    camera_height_m: tuple[float, float] = CAMERA_HEIGHT_M,
    scaled_to_height_m: float | None = None,
) -> Sequence:
    """Return a drive through the world of `seed`, its frames rendered when they are read.

    Args:
      seed: of the world, 0 or more.
      frames: how many; 10 a second, as KITTI.
      height: of a frame, rows.
      width: of a frame, columns.
      channels: 1 for grey, 3 for RGB.
      camera: fx, fy, cx, cy in pixels; KITTI's, scaled to the frame, where None.
      samples: rays a pixel, 1, 2 or 4: more is smoother and slower.
      effects: strength of what cameras and weather do to frames: blur, noise, vignetting, jumps of exposure, glare,
        rain on the glass, JPEG; 0 leaves them out.
      camera_height_m: range from which the world draws the height of its camera above the road, 0.3 to 5 m. Widen it
        to (1.2, 2.2) for cameras in other vehicles: the same motion then looks slower the higher the camera is.
      scaled_to_height_m: scale the world, its poses that is, so that the camera sits at this height: the frames do not
        change. Labels then follow the ground plane alone, and things beside the road vary in size.

    Returns:
      A sequence with poses (the first is the identity), timestamps and camera; `read` may be called by many threads.

    Raises:
      InputError: an argument is out of range.
    """
    camera = _checked(seed, frames, height, width, camera, camera_height_m)
    if channels not in (1, 3):
        raise InputError(f"channels {channels} of a synthetic drive: expected 1 for grey or 3 for RGB")
    if samples not in (1, 2, 4):
        raise InputError(f"samples {samples} a pixel of a synthetic drive: expected 1, 2 or 4")
    if not 0 <= effects <= 10:
        raise InputError(f"effects {effects} of a synthetic drive: expected 0 to 10, where 1 is ordinary")
    style, _, poses = world.path(seed, frames, camera_height_m)
    rows = film.films(style, effects, FRAME_S * np.arange(frames))
    poses = geometry.inverse(poses[0]) @ poses
    # Not only to rounding.
    poses[0] = np.eye(4)
    if scaled_to_height_m is not None:
        poses[:, :3, 3] *= scaled_to_height_m / draw_mount(seed, camera_height_m).height_m
    look = functools.cache(lambda: jax.device_put(world.look_of(style, channels)))
    kept: collections.OrderedDict[int, np.ndarray] = collections.OrderedDict()
    lock = threading.Lock()

    def read(index: int) -> np.ndarray:
        if not 0 <= index < frames:
            raise IndexError(f"frame {index} of a drive of {frames} frames")
        with lock:
            if index in kept:
                kept.move_to_end(index)
                return kept[index]
        # Outside the lock: two threads that want the same frame at once render the same bits twice.
        shown = render.render(
            world.frame_at(_world(seed, frames, camera_height_m), index, channels),
            look(),
            film.Film(*map(world.single, rows[index])),
            world.single(camera),
            index,
            height=height,
            width=width,
            samples=samples,
        )
        frame = _through_jpeg(np.asarray(shown), int(film.Film(*rows[index]).quality))
        with lock:
            kept[index] = frame
            while len(kept) > _KEPT_FRAMES:
                kept.popitem(last=False)
        return frame

    return Sequence(
        name=name_of(seed),
        count=frames,
        read=read,
        timestamps=FRAME_S * np.arange(frames),
        poses=poses,
        camera=camera,
        flow=functools.partial(_flow_map, seed, frames, (height, width), camera, camera_height_m),
    )


def _flow_map(
    seed: int, frames: int, size: tuple[int, int], camera: Camera, camera_height_m: tuple[float, float], index: int
) -> np.ndarray:
    """Return the flow of frame `index` of a drive on the network's map, `[h, w, 2]`; see `Sequence.flow`.

    Cell i of the map sees what pixel `FLOW_STRIDE * i` does: every layer before it pads by (kernel - 1) / 2.
    """
    fx, fy, cx, cy = (value / FLOW_STRIDE for value in camera)
    return _truth(seed, frames, index, map_size(*size, FLOW_LAYERS), (fx, fy, cx, cy), camera_height_m).flow


def truth(
    seed: int,
    frames: int,
    index: int,
    *,
    height: int,
    width: int,
    camera: Camera | None = None,
    camera_height_m: tuple[float, float] = CAMERA_HEIGHT_M,
) -> Truth:
    """Return exact depth and flow of frame `index` of `drive(seed, frames, ...)`; see there for the arguments.

    The point that a pixel's centre u sees, moved along with its thing, is seen at u + flow one frame later, whether or
    not something hides it there. The flow of the last frame is that to the frame which a longer drive would have.

    Raises:
      InputError: an argument is out of range.
    """
    camera = _checked(seed, frames, height, width, camera, camera_height_m)
    if not 0 <= index < frames:
        raise InputError(f"frame {index} of a drive of {frames} frames: expected 0 to {frames - 1}")
    return _truth(seed, frames, index, (height, width), camera, camera_height_m)


def _truth(
    seed: int, frames: int, index: int, size: tuple[int, int], camera: Camera, camera_height_m: tuple[float, float]
) -> Truth:
    """Return `truth` of arguments that are in order."""
    whole = _world(seed, frames, camera_height_m)
    depth, flow, moving = render.geometry(
        world.frame_at(whole, index, 1),
        world.moved_at(whole, index),
        world.single(whole.motion[index]),
        world.single(camera),
        height=size[0],
        width=size[1],
    )
    return Truth(np.asarray(depth), np.asarray(flow), np.asarray(moving))


def depth(seed: int, frames: int, index: int, *, height: int, width: int, camera: Camera | None = None) -> np.ndarray:
    """Return `Truth.depth` of a frame, `[H, W]`, m; see `truth`."""
    return truth(seed, frames, index, height=height, width=width, camera=camera).depth


def optical_flow(
    seed: int, frames: int, index: int, *, height: int, width: int, camera: Camera | None = None
) -> np.ndarray:
    """Return `Truth.flow` from frame `index` to the next, `[H, W, 2]`, px; see `truth`."""
    return truth(seed, frames, index, height=height, width=width, camera=camera).flow


_world = functools.lru_cache(maxsize=_KEPT_WORLDS)(world.build_world)


def _through_jpeg(frame: np.ndarray, quality: int) -> np.ndarray:
    """Return `frame`, `[H, W, C]`, as it comes back from a JPEG file of this quality; itself for 0."""
    if quality == 0:
        return frame
    import cv2

    kind = cv2.IMREAD_GRAYSCALE if frame.shape[-1] == 1 else cv2.IMREAD_COLOR
    stored = cv2.imencode(".jpg", np.ascontiguousarray(frame[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(stored, kind)).reshape(frame.shape)[..., ::-1].copy()


def _checked(
    seed: int, frames: int, height: int, width: int, camera: Camera | None, camera_height_m: tuple[float, float]
) -> Camera:
    """Return the camera of a drive, after a look at what else it is made of."""
    if seed < 0:
        raise InputError(f"seed {seed} of a synthetic drive: expected 0 or more")
    if frames < 1:
        raise InputError(f"{frames} frames of a synthetic drive: expected 1 or more")
    if min(height, width) < 8:
        raise InputError(f"synthetic frames of {width}x{height}: expected 8 or more rows and columns")
    low, high = camera_height_m
    if not 0.3 <= low <= high <= 5:
        raise InputError(f"camera_height_m {low} to {high} of a synthetic drive: expected a range within 0.3 to 5 m")
    if camera is None:
        return kitti_camera(height, width)
    if len(camera) != 4 or not all(math.isfinite(value) for value in camera) or min(camera[:2]) <= 0:
        raise InputError(f"camera {camera} of a synthetic drive: expected fx, fy, cx, cy with fx and fy above 0")
    return camera
