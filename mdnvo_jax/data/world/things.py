"""What stands beside the road and drives on it: boxes, ellipsoids and cylinders with paint.

Every thing is the affine image of a unit cube, ball or upright cylinder: `p = centre + axes @ q`, q in [-1, 1]^3. That
covers turned and tilted boxes, roofs, and shapes that follow the slope of the ground.
"""

from typing import NamedTuple, TypeVar

import jax
import numpy as np

from mdnvo_jax.data.world.motion import turn
from mdnvo_jax.data.world.road import (
    BEHIND_M,
    NODE_M,
    Road,
    clearance_to_side_roads,
    distance_to_road,
    ground,
    place,
)
from mdnvo_jax.data.world.style import Style, stream

BOX, BALL, CYLINDER = 0, 1, 2
Kind = TypeVar("Kind")


class Paint(NamedTuple):
    """How a surface looks; every field has a row, or a number, a thing.

    Attributes:
      albedo: linear reflectance (R, G, B). window: that of the pattern on the sides of boxes.
      panes: how many panes of the pattern lie along the box's x, y and z.
      width, height: share of its cell that a pane fills, across and upwards. lift: how far it is moved up, in cells.
      top: factor on the albedo of faces that look up.
      contrast, grain_m: strength and largest cell of the texture.
      glow: radiance of the panes at night.
      leafy: 1 where light shines through and around, as through leaves. seed: of its texture.
    """

    albedo: np.ndarray
    window: np.ndarray
    panes: np.ndarray
    width: np.ndarray
    height: np.ndarray
    lift: np.ndarray
    top: np.ndarray
    contrast: np.ndarray
    grain_m: np.ndarray
    glow: np.ndarray
    leafy: np.ndarray
    seed: np.ndarray


class Things(NamedTuple):
    """Things of a world.

    Attributes:
      s: road coordinate, `[n]`, m. centre: `[n, 3]`, m. axes: `[n, 3, 3]`, m. inverse: of the axes. shape: `[n]`.
      floor: y of the ground below, `[n]`, m.
      paint: how they look.
    """

    s: np.ndarray
    centre: np.ndarray
    axes: np.ndarray
    inverse: np.ndarray
    shape: np.ndarray
    floor: np.ndarray
    paint: Paint


def paint(
    albedo: np.ndarray,
    *,
    window: np.ndarray | float = 0.05,
    panes: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
    width: np.ndarray | float = 0.5,
    height: np.ndarray | float = 0.5,
    lift: np.ndarray | float = 0.0,
    top: np.ndarray | float = 1.0,
    contrast: np.ndarray | float = 0.15,
    grain_m: np.ndarray | float = 1.0,
    glow: np.ndarray | float = 0.0,
    leafy: float = 0.0,
) -> Paint:
    """Return a `Paint` with as many rows as `albedo`, `[n, 3]`."""
    n = len(albedo)
    columns = (np.broadcast_to(value, (n,)) for value in (width, height, lift, top, contrast, grain_m, glow, leafy, 0))
    window = np.asarray(window)
    window = np.broadcast_to(window if window.ndim == 2 else window.reshape(-1, 1), (n, 3))
    return Paint(albedo, window, np.broadcast_to(panes, (n, 3)), *columns)


def make(
    road: Road,
    s: np.ndarray,
    d: np.ndarray,
    half: np.ndarray,
    looks: Paint,
    *,
    bottom_m: np.ndarray | float = 0.0,
    shape: int | np.ndarray = BOX,
    yaw: np.ndarray | float = 0.0,
    roll: np.ndarray | float = 0.0,
    squash: float = 1.0,
) -> Things:
    """Return things at road coordinates `s`, `d` with half sizes `half`, `[n, 3]`, that stand `bottom_m` above ground.

    A thing is turned by `yaw` against the road and, about its own z, by `roll`, then flattened by `squash`; it is
    sheared along with the slope of the ground, so that its foot lies on it everywhere.
    """
    x, z, heading = place(road, s, d)
    height, slope_x, slope_z = ground(road, x, z)
    shear = np.tile(np.eye(3), (len(s), 1, 1))
    shear[:, 1, 0], shear[:, 1, 2] = -slope_x, -slope_z
    turned = turn(heading + yaw, 1) @ np.diag([1.0, squash, 1.0]) @ turn(np.broadcast_to(roll, s.shape), 2)
    centre = np.stack([x, -height - bottom_m - half[:, 1], z], axis=1)
    axes = shear @ turned * half[:, None, :]
    return Things(s, centre, axes, np.linalg.inv(axes), np.broadcast_to(shape, s.shape), -height, looks)


def join(parts: list[Things]) -> Things:
    """Return all things of `parts`, one part after the other."""
    return jax.tree.map(lambda *columns: np.concatenate(columns), *parts)


def select(things: Kind, rows: np.ndarray | slice) -> Kind:
    """Return some rows of things, or of a part of what describes them."""
    return jax.tree.map(lambda column: column[rows], things)


def ordered(things: Things) -> Things:
    """Return `things` in the order of s, each with the seed of a texture of its own."""
    things = select(things, np.argsort(things.s, kind="stable"))
    return things._replace(paint=things.paint._replace(seed=np.arange(len(things.s))))


def slots(
    style: Style, road: Road, name: str, pitch_m: float, columns: int, *, jitter: float = 0.3
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places on both sides all along the road: s `[n]`, side -1 or 1 `[n]`, numbers 0 to 1 `[n, columns]`."""
    count = int((len(road.x) - 1) * NODE_M / pitch_m)
    draw = stream(style.seed, name).random((count, 2, columns + 1))
    s = -BEHIND_M + pitch_m * (np.arange(count)[:, None] + 0.5 + jitter * (draw[..., 0] - 0.5))
    side = np.broadcast_to([-1.0, 1.0], s.shape)
    return s.ravel(), side.ravel(), draw[..., 1:].reshape(-1, columns)


def fits(style: Style, road: Road, s: np.ndarray, d: np.ndarray, radius_m: np.ndarray | float = 0.0) -> np.ndarray:
    """Return which discs of `radius_m` at road coordinates `s`, `d` touch neither the carriageway nor a side road."""
    x, z, _ = place(road, s, d)
    clear = distance_to_road(road, x, z, s) > style.half_width_m + radius_m
    return clear & (clearance_to_side_roads(road, x, z, s) > radius_m)


def tint(draw: np.ndarray, palette: np.ndarray, spread: float = 0.3) -> np.ndarray:
    """Return for every row of `draw`, `[n, 2]`, a colour of `palette`, `[k, 3]`, made lighter or darker by `spread`."""
    chosen = palette[(draw[:, 0] * len(palette)).astype(int)]
    return chosen * (1 + spread * (2 * draw[:, 1:2] - 1))
