"""A world as a whole, and what of it one frame needs."""

from typing import NamedTuple, cast

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from mdnvo_jax import geometry
from mdnvo_jax.data.world.cars import Traffic, draw_traffic, drive_on
from mdnvo_jax.data.world.look import Look
from mdnvo_jax.data.world.motion import CAMERA_HEIGHT_M, FRAME_S, camera_poses, draw_mount, road_coordinate
from mdnvo_jax.data.world.pavement import CELL_M, CELLS, Lane
from mdnvo_jax.data.world.road import BEHIND_M, NODE_M, Road, build_road
from mdnvo_jax.data.world.scenery import furnish, lamp_heads
from mdnvo_jax.data.world.style import Style, draw_style
from mdnvo_jax.data.world.things import BALL, BOX, Paint, Things, join, select
from mdnvo_jax.data.world.trace import BOXES, ROUNDS, Shapes

# Things farther than this are not shown, m, and nodes of the road within the reach of the markings.
_RANGE_M = 200.0
_NODES = 160
_SIDE_ROADS = 4
_LAMPS = 8
# Where the lamps are that are not there.
_NOWHERE_M = 1e4
# Things this far behind the eye may still throw a shadow into view, m.
_SHADOW_M = 25.0
_LUMA = np.array([0.299, 0.587, 0.114])


class World(NamedTuple):
    """Everything that a seed decides, on the host in float64.

    Attributes:
      style: its choices. road: with hills. things: that stand still, in the order of s. traffic: cars that drive.
      poses: `T_world_camera` in the world's own axes, `[N, 4, 4]`. motion: `T_{i+1,i}` of each frame i, `[N, 4, 4]`.
      s: of the car at each frame, `[N]`, m. lamps: heads of street lamps in the order of s, as rows (s, x, y, z).
    """

    style: Style
    road: Road
    things: Things
    traffic: Traffic
    poses: np.ndarray
    motion: np.ndarray
    s: np.ndarray
    lamps: np.ndarray


class Frame(NamedTuple):
    """What a frame shows, relative to the eye in the world's axes, float32.

    Attributes:
      rotation: camera to world, `[3, 3]`. eye_m: height of the eye above the datum of the ground.
      motion: `T_{i+1,i}`, `[4, 4]`.
      hills: rows (amplitude, wave vector, phase at the eye), `[2, 4]`.
      shapes, paint: of the nearest things. lane: the road.
    """

    rotation: Array
    eye_m: Array
    motion: Array
    hills: Array
    shapes: Shapes
    paint: Paint
    lane: Lane


def build_world(seed: int, frames: int, camera_height_m: tuple[float, float] = CAMERA_HEIGHT_M) -> World:
    """Return the world of `seed` with `frames` frames of motion; the first ones do not depend on how many there are."""
    # One frame more than there is, for the motion of the last one.
    style, road, poses = path(seed, frames + 1, camera_height_m)
    s = road_coordinate(road, FRAME_S * np.arange(frames))
    return World(
        style=style,
        road=road,
        things=furnish(style, road),
        traffic=draw_traffic(style, road),
        poses=poses[:-1],
        motion=geometry.inverse(poses[1:]) @ poses[:-1],
        s=s,
        lamps=lamp_heads(style, road),
    )


def path(
    seed: int, frames: int, camera_height_m: tuple[float, float] = CAMERA_HEIGHT_M
) -> tuple[Style, Road, np.ndarray]:
    """Return (style, road, poses) of a world: its motion without what stands beside the road, which takes longer."""
    style = draw_style(seed)
    road = build_road(style, frames, FRAME_S)
    return style, road, camera_poses(style, road, frames, draw_mount(seed, camera_height_m))


def frame_at(world: World, index: int, channels: int) -> Frame:
    """Return what frame `index` shows, for `channels` colours."""
    pose, s = world.poses[index], world.s[index]
    things, rows = _seen(world, index, index)
    return Frame(
        rotation=single(pose[:3, :3]),
        eye_m=single(-pose[1, 3]),
        motion=single(world.motion[index]),
        hills=_hills(world.road, pose[:3, 3]),
        shapes=_shapes(things, rows, pose[:3, 3]),
        paint=_paint(things.paint, rows, channels),
        lane=_lane(world, s, pose[:3, 3], pose[:3, 2]),
    )


def moved_at(world: World, index: int) -> Shapes:
    """Return the shapes of frame `index` as they are one frame later, relative to the eye of frame `index`."""
    things, rows = _seen(world, index, index + 1)
    return _shapes(things, rows, world.poses[index, :3, 3])


def look_of(style: Style, channels: int) -> Look:
    """Return the look of a world for frames of `channels` colours."""
    values = {name: single(getattr(style, name)) for name in Look._fields if name not in ("colours", "sun", "seed")}
    seed = jnp.int32(style.seed * 2654435761 % 2**31)
    return Look(colours=colours(style.colours, channels), sun=single(style.sun), seed=seed, **values)


def colours(rgb: np.ndarray, channels: int) -> Array:
    """Return colours `[n, 3]` as `[n, channels]`: themselves, or their luma for one channel."""
    return single(rgb if channels == 3 else rgb @ _LUMA[:, None])


def single(values: ArrayLike) -> Array:
    """Return `values` in float32, still on the host: compiled functions take them as they are."""
    return cast(Array, np.asarray(values, np.float32))


def _seen(world: World, index: int, later: int) -> tuple[Things, np.ndarray]:
    """Return (things about the eye of frame `index` as they are at frame `later`, rows of those to show)."""
    s = world.s[index]
    part = slice(*np.searchsorted(world.things.s, [s - 1.5 * _RANGE_M, s + 1.5 * _RANGE_M]))
    still = select(world.things, part)

    def at(frame: int) -> Things:
        return join([still, drive_on(world.traffic, world.road, s, FRAME_S * index, FRAME_S * frame)])

    now = at(index)
    then = now if later == index else at(later)
    eye, forward = world.poses[index, :3, 3], world.poses[index, :3, 2]
    relative = now.centre - eye
    radius = np.sqrt((now.axes**2).sum((1, 2)))
    away = np.sqrt((relative**2).sum(1)) - radius
    visible = (away < _RANGE_M) & (relative @ forward > -radius - _SHADOW_M)
    away = np.where(visible, away, np.inf)
    boxes, rounds = _nearest(away, now.shape == BOX, BOXES), _nearest(away, now.shape != BOX, ROUNDS)
    return then, np.concatenate([boxes, rounds])


def _nearest(away: np.ndarray, kind: np.ndarray, most: int) -> np.ndarray:
    """Return the rows of the nearest things of a kind, -1 where there are fewer than `most`."""
    rows = np.flatnonzero(kind & np.isfinite(away))
    rows = rows[np.argsort(away[rows], kind="stable")[:most]]
    return np.concatenate([rows, np.full(most - len(rows), -1)])


def _shapes(things: Things, rows: np.ndarray, eye: np.ndarray) -> Shapes:
    # The gaps of a crown vary with its seed, by steps that never repeat.
    leafy = things.paint.leafy * (0.01 + 0.61803 * things.paint.seed % 1.0)
    return Shapes(
        centre=single(things.centre[rows] - eye),
        axes=single(things.axes[rows]),
        inverse=single(things.inverse[rows]),
        ball=single(things.shape[rows] == BALL),
        leafy=single(leafy[rows]),
        radius=single(np.linalg.norm(things.axes[rows, :, 0], axis=1)),
        floor=single(things.floor[rows] - eye[1]),
        present=single(rows >= 0),
    )


def _paint(paint: Paint, rows: np.ndarray, channels: int) -> Paint:
    shown = Paint(*(np.asarray(column[rows], np.float32) for column in paint))
    albedo, window = (np.asarray(colours(column, channels)) for column in (shown.albedo, shown.window))
    return shown._replace(albedo=albedo, window=window, seed=np.asarray(paint.seed[rows], np.int32))


def _hills(road: Road, eye: np.ndarray) -> Array:
    hills = road.hills.copy()
    hills[:, 3] = (hills[:, 1] * eye[0] + hills[:, 2] * eye[2] + hills[:, 3]) % 1.0
    return single(hills)


def _lane(world: World, s: float, eye: np.ndarray, forward: np.ndarray) -> Lane:
    road = world.road
    # A quarter of the nodes lie behind the eye, whichever way it looks along the road.
    ahead = 1 if forward @ _direction(road, s) > 0 else -1
    middle = round((s + BEHIND_M) / NODE_M) + ahead * _NODES // 4
    first = min(max(middle - _NODES // 2, 0), len(road.x) - _NODES)
    part = slice(first, first + _NODES)
    heading = road.heading[part]
    nodes = np.stack(
        [road.x[part] - eye[0], road.z[part] - eye[2], np.cos(heading), np.sin(heading), road.curvature[part],
         NODE_M * np.arange(first, first + _NODES) - BEHIND_M], 1,
    )  # fmt: skip
    centre = eye[[0, 2]] + forward[[0, 2]] * CELLS * CELL_M / 4
    corner = np.floor(centre / CELL_M - CELLS / 2) * CELL_M - eye[[0, 2]]
    near = np.argsort(np.abs(road.side[:, 0] - s), kind="stable")[:_SIDE_ROADS]
    side = np.full((_SIDE_ROADS, 7), -1.0)
    side[: len(near)] = road.side[near, 1:] - np.array([eye[0], eye[2], 0, 0, 0, 0, 0])
    lamps = np.full((_LAMPS, 3), _NOWHERE_M)
    near = np.argsort(np.abs(world.lamps[:, 0] - s - 20 * ahead), kind="stable")[:_LAMPS]
    lamps[: len(near)] = world.lamps[near, 1:] - eye
    return Lane(single(nodes), single(corner), single(side), single(eye), single(lamps))


def _direction(road: Road, s: float) -> np.ndarray:
    heading = road.heading[round((s + BEHIND_M) / NODE_M)]
    return np.array([np.sin(heading), 0.0, np.cos(heading)])
