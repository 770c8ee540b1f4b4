"""The road of a world: a smooth centreline with a design speed, side roads, and the hills it lies on.

World axes are those of a camera that looks north: x east, y down, z north, m. A heading h is an angle from north to
east: forward is `(sin h, cos h)` and right is `(cos h, -sin h)` in (x, z), and a positive curvature bends right. Road
coordinates are s, the distance along the centreline, and d, the distance to its right.
"""

from typing import NamedTuple

import numpy as np

from mdnvo_jax.data.world.style import Style, stream

# Distance between nodes of the centreline, and how much road there is behind the start and beyond the end, m: more than
# can be seen and far enough to brake, so that what is near a frame never depends on how many frames were asked for.
NODE_M = 2.0
BEHIND_M = 320.0
AHEAD_M = 720.0
# Road is laid for this speed, m/s; nothing drives faster.
TOP_SPEED_MPS = 30.0
# Radius of the tightest circle that the middle of the car's rear axle goes around, m.
TURNING_RADIUS_M = 4.5
# Share of the driver's limits that the road uses: smoothing the curvature and wandering in the lane take the rest.
_MARGIN = 0.95


class Road(NamedTuple):
    """The centreline as arcs: node i is the middle of an arc of `NODE_M` with constant curvature.

    Attributes:
      x, z: node positions, `[n]`, m.
      heading: `[n]`, rad.
      curvature: `[n]`, 1/m.
      speed: at which it is driven, `[n]`, m/s; 0 where the car stops.
      pause: how long the car stands at a node, `[n]`, s.
      hills: two plane waves as rows (amplitude m, wave vector x and z in cycles/m, phase in cycles), `[2, 4]`.
      side: side roads as rows (s, x, z, direction x, direction z, half width, reach to the left, to the right),
        `[k, 8]`; the direction points to the right of the main road.
    """

    x: np.ndarray
    z: np.ndarray
    heading: np.ndarray
    curvature: np.ndarray
    speed: np.ndarray
    pause: np.ndarray
    hills: np.ndarray
    side: np.ndarray


def build_road(style: Style, frames: int, frame_s: float) -> Road:
    """Return a road long enough for `frames` frames; a longer drive has the same road, further on."""
    length = BEHIND_M + TOP_SPEED_MPS * frame_s * frames + AHEAD_M
    s = -BEHIND_M + NODE_M * np.arange(int(np.ceil(length / NODE_M)))
    speed, pause, curvature = _events(style, s)
    half = curvature * NODE_M / 2
    heading = np.concatenate([[0.0], np.cumsum(half[:-1] + half[1:])])
    # From node to node along the two half arcs: each is a chord of length 2 sin(k l / 2) / k at its middle heading.
    chord = NODE_M / 2 * np.sinc(half / 2 / np.pi)
    after, before = heading[:-1] + half[:-1] / 2, heading[1:] - half[1:] / 2
    x = np.concatenate([[0.0], np.cumsum(chord[:-1] * np.sin(after) + chord[1:] * np.sin(before))])
    z = np.concatenate([[0.0], np.cumsum(chord[:-1] * np.cos(after) + chord[1:] * np.cos(before))])
    road = Road(x, z, heading, curvature, speed, pause, _hills(style), np.zeros((0, 8)))
    return road._replace(side=_side_roads(style, road, s[-1]))


def place(road: Road, s: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (x, z, heading of the road) at the road coordinates `s` and `d`."""
    node = np.clip(np.rint((s + BEHIND_M) / NODE_M), 0, len(road.x) - 1).astype(int)
    along = s + BEHIND_M - NODE_M * node
    bend = road.curvature[node]
    middle = road.heading[node] + bend * along / 2
    chord = along * np.sinc(bend * along / 2 / np.pi)
    heading = road.heading[node] + bend * along
    x = road.x[node] + chord * np.sin(middle) + d * np.cos(heading)
    z = road.z[node] + chord * np.cos(middle) - d * np.sin(heading)
    return x, z, heading


def ego_lane_m(style: Style) -> float:
    """Return d of the middle of the lane that the car drives in, m."""
    lane = int(stream(style.seed, "lane").integers(style.lanes))
    return style.side * style.lane_m * (lane + 0.5)


def ground(road: Road, x: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (height above the datum, its slopes along x and z) of the ground at `x`, `z`, m and m/m.

    Each hill is `a w(k . (x, z) + phase)` with the parabola wave `w(u) = 16 f (1/2 - |f|)`, `f = u - floor(u) - 1/2`: a
    sine to the eye, continuous in its slope, and cheap enough to march rays over.
    """
    amplitude, kx, kz, phase = (column[:, None] for column in road.hills.T)
    flat = np.shape(x)
    f = kx * np.ravel(x) + kz * np.ravel(z) + phase
    f = f - np.floor(f) - 0.5
    height = (amplitude * 16 * f * (0.5 - np.abs(f))).sum(0)
    slope = amplitude * (8 - 32 * np.abs(f))
    return height.reshape(flat), (slope * kx).sum(0).reshape(flat), (slope * kz).sum(0).reshape(flat)


def distance_to_road(road: Road, x: np.ndarray, z: np.ndarray, s: np.ndarray, reach_m: float = 140.0) -> np.ndarray:
    """Return how far points near road coordinate `s` are from any centreline node within `reach_m` of it, m."""
    span = int(reach_m / NODE_M)
    node = np.rint((s + BEHIND_M) / NODE_M).astype(int)[:, None] + np.arange(-span, span + 1)
    node = np.clip(node, 0, len(road.x) - 1)
    return np.sqrt(((road.x[node] - x[:, None]) ** 2 + (road.z[node] - z[:, None]) ** 2).min(1))


def clearance_to_side_roads(road: Road, x: np.ndarray, z: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return how far points near road coordinate `s` are from the edge of the nearest side road, m (inf: none)."""
    if not len(road.side):
        return np.full(len(x), np.inf)
    s0, x0, z0, ux, uz, half, left, right = road.side.T
    dx, dz = x[:, None] - x0, z[:, None] - z0
    outward, across = dx * ux + dz * uz, dx * uz - dz * ux
    gap = np.abs(across) - half
    beyond = np.maximum(outward - right, -outward - left)
    gap = np.where(np.abs(s[:, None] - s0) < 140, np.maximum(gap, beyond), np.inf)
    return gap.min(1)


class _Corners(NamedTuple):
    """Places where the driver may slow down and the road may bend, each field `[n]`.

    Attributes:
      place: s, m. stop: whether the car stops there. pause: for how long, s.
      target: speed where it does not stop, m/s, kept for `hold` metres before and after.
      share: of the sharpest bend that may be driven there, positive to the right.
      turn: angle of the bend, rad, over `longest` metres at most, which is a number.
    """

    place: np.ndarray
    stop: np.ndarray
    pause: np.ndarray
    target: np.ndarray
    hold: np.ndarray
    share: np.ndarray
    turn: np.ndarray
    longest: float


def _events(style: Style, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (speed, pause, curvature) of the nodes at `s`, from places where the car slows and the road bends.

    The speed is the upper envelope that constant acceleration a allows: `v(s)^2 = min_j v_j^2 + 2 a |s - s_j|`. A bend
    takes a share of what speed, lateral acceleration and yaw rate allow at its place.
    """
    corners = _winding_corners(style, s) if style.winding else _ordinary_corners(style, s)
    target, hold = (np.where(corners.stop, 0.0, value) for value in (corners.target, corners.hold))
    away = np.abs(s[:, None] - corners.place)
    squared = (target**2 + 2 * style.acceleration_mps2 * np.maximum(away - hold, 0)).min(1)
    # A car that barely moves still gets somewhere; one that stands has no speed anywhere.
    speed = np.minimum(np.sqrt(squared), min(1.15 * style.cruise_mps, TOP_SPEED_MPS))
    node = np.rint((corners.place - s[0]) / NODE_M).astype(int)
    pause = np.zeros(len(s))
    pause[node[corners.stop]] = corners.pause[corners.stop]

    limit = _curvature_limit(style, speed)
    bend = corners.share * limit[node]
    extent = np.clip(corners.turn / np.maximum(np.abs(bend), 1e-6), 12.0, corners.longest)
    ramp = np.clip((0.5 - away / extent) / 0.3, 0, 1)
    curvature = (bend * ramp * ramp * (3 - 2 * ramp)).sum(1)
    curvature = np.clip(curvature, -limit, limit)
    window = np.hanning(5)[1:-1]
    return speed, pause, np.convolve(curvature, window / window.sum(), mode="same")


def _ordinary_corners(style: Style, s: np.ndarray) -> _Corners:
    """Return corners where the car slows for them; elsewhere small bends are common and strong ones rare."""
    # 4 to 6 s apart.
    pitch = 30 + 2.8 * style.cruise_mps
    place, stop, draw = _places(style, s, pitch)
    slow = draw[:, 1] < style.stops + style.slows
    factor = np.where(slow, 0.15 + 0.4 * draw[:, 2], 0.88 + 0.24 * draw[:, 2])
    share = np.where(slow & ~stop, 0.4 + 0.6 * draw[:, 3], style.bends * draw[:, 3])
    return _Corners(
        place=place,
        stop=stop,
        pause=1 + 5 * draw[:, 7],
        target=np.minimum(style.cruise_mps * factor, TOP_SPEED_MPS),
        hold=np.where(slow, 8.0, 0.3 * pitch),
        share=np.where(draw[:, 4] < 0.5, -1, 1) * (draw[:, 5] < 0.8) * share,
        turn=np.deg2rad(10 + 90 * draw[:, 6]),
        longest=0.9 * pitch,
    )


def _winding_corners(style: Style, s: np.ndarray) -> _Corners:
    """Return corner after corner, at every speed and of every sharpness that lateral acceleration and yaw rate allow.

    Were all of them slow, a network would learn that who turns is slow; were all as sharp as their speed allows, that
    the speed follows from the turn.
    """
    pitch = 18.0 + 2.0 * style.cruise_mps
    place, stop, draw = _places(style, s, pitch)
    share = np.where(stop, style.bends * draw[:, 3], 0.5 + 0.5 * draw[:, 3])
    # Left and right by turns: so many sharp corners to one side would lead the road across itself.
    side = np.where((np.arange(len(place)) + style.seed) % 2, -1, 1)
    return _Corners(
        place=place,
        stop=stop,
        pause=1 + 5 * draw[:, 7],
        target=np.minimum(style.cruise_mps, 3.5 + 14 * draw[:, 2]),
        hold=np.full(len(place), 0.3 * pitch),
        share=side * share,
        # The ramps at both ends of a corner take as much of its angle again.
        turn=1.6 * np.deg2rad(60 + 50 * draw[:, 6]),
        longest=0.9 * pitch,
    )


def _places(style: Style, s: np.ndarray, pitch: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places about `pitch` metres apart, at which of them the car stops, and a row of draws for each."""
    count = int((s[-1] - s[0]) // pitch)
    draw = stream(style.seed, "events").random((count, 8))
    place = s[0] + pitch * (np.arange(count) + 0.5 + 0.4 * (draw[:, 0] - 0.5))
    place = s[0] + NODE_M * np.rint((place - s[0]) / NODE_M)
    # Nobody stops for the first metres: a still start is the business of worlds that stand.
    return place, (draw[:, 1] < style.stops) & (np.abs(place) > 15), draw


def _curvature_limit(style: Style, speed: np.ndarray) -> np.ndarray:
    """Return the largest curvature, 1/m, that may be driven at `speed`: such that a car in its lane gets around it."""
    fast = np.maximum(speed, 1e-3)
    bearable = _MARGIN * np.minimum(style.lateral_mps2 / fast**2, style.yaw_rate_radps / fast)
    return np.minimum(bearable, 1 / (TURNING_RADIUS_M + abs(ego_lane_m(style))))


def _hills(style: Style) -> np.ndarray:
    """Return the two plane waves of the ground: their largest slopes add up to `style.steepness`."""
    draw = stream(style.seed, "hills").random((2, 4))
    wavelength = 180 + 320 * draw[:, 0]
    angle = 2 * np.pi * draw[:, 1]
    share = np.array([0.6, 0.4]) * style.steepness
    return np.stack(
        [share * wavelength / 8, np.cos(angle) / wavelength, np.sin(angle) / wavelength, draw[:, 2]], axis=1
    )


def _side_roads(style: Style, road: Road, end_m: float) -> np.ndarray:
    """Return the side roads of a `Road`: straight, at right angles, to the left, the right or both."""
    pitch = 90.0
    count = int((end_m + BEHIND_M) // pitch)
    draw = stream(style.seed, "side roads").random((count, 4))
    s = -BEHIND_M + pitch * (np.arange(count) + 0.2 + 0.6 * draw[:, 0])
    x, z, heading = place(road, s, np.zeros(count))
    reach = 120.0
    left, right = (draw[:, 2] < 0.65) * reach, (draw[:, 2] > 0.35) * reach
    half = 2.5 + 1.5 * draw[:, 3]
    rows = np.stack([s, x, z, np.cos(heading), -np.sin(heading), half, left, right], axis=1)
    # Straight side roads off a tight bend would cross the main road.
    bend = np.abs(road.curvature[np.rint((s + BEHIND_M) / NODE_M).astype(int)])
    return rows[(draw[:, 1] < style.side_roads) & (bend < 0.01)]
