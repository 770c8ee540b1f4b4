"""The scenery of a world: buildings, fences, trees, poles, signs, rails, overpasses, parked cars.

Each kind is drawn from a stream of its own into places at a fixed pitch along the road, all of a kind at once.
"""

import numpy as np

from mdnvo_jax.data.world.cars import car_parts, park
from mdnvo_jax.data.world.road import BEHIND_M, NODE_M, Road, ground, place
from mdnvo_jax.data.world.style import Style, stream
from mdnvo_jax.data.world.things import BALL, CYLINDER, Things, fits, join, make, ordered, paint, select, slots, tint

_WALLS = np.array([(0.6, 0.58, 0.53), (0.45, 0.4, 0.33), (0.75, 0.74, 0.7), (0.3, 0.16, 0.11), (0.3, 0.3, 0.3)])
_ROOFS = np.array([(0.22, 0.09, 0.06), (0.1, 0.1, 0.1), (0.18, 0.15, 0.13)])
_LEAVES = np.array([(0.05, 0.09, 0.025), (0.09, 0.13, 0.04), (0.03, 0.06, 0.025), (0.12, 0.12, 0.05)])
_BARK = np.array([0.07, 0.06, 0.045])
# From a lamp post to the middle of its arm, m.
_ARM_M = 0.7
_STEEL = np.array([0.28, 0.29, 0.3])


def furnish(style: Style, road: Road) -> Things:
    """Return everything that stands still beside the road, in the order of s."""
    parts = [*_buildings(style, road), *_fences(style, road), *_trees(style, road), *_woods(style, road)]
    parts += [*_bushes(style, road), *_posts(style, road), *_rails(style, road), *_overpasses(style, road)]
    parts += _parked(style, road)
    return ordered(join(parts))


def _buildings(style: Style, road: Road) -> list[Things]:
    rng = stream(style.seed, "blocks")
    pitch, storey, floors = rng.uniform(11, 24), rng.uniform(2.7, 3.3), rng.uniform(1.5, 5)
    setback, pane = rng.uniform(0.5, 9), rng.uniform(1.8, 3.5)
    s, side, draw = slots(style, road, "buildings", pitch, 12, jitter=0.15)
    half = np.stack(
        [4 + 3 * draw[:, 0], np.rint(1 + floors * draw[:, 1]) * storey / 2 + 0.4, pitch * (0.3 + 0.19 * draw[:, 2])], 1
    )
    near = style.half_width_m + max(style.sidewalk_m, 0.5) + setback * (0.6 + 0.8 * draw[:, 3])
    d = side * (near + half[:, 0])
    keep = draw[:, 4] < style.built
    for across, along in ((-1, -1), (-1, 1), (1, -1), (1, 1), (-1, 0), (0, 0)):
        keep &= fits(style, road, s + along * half[:, 2], d + side * across * half[:, 0], 0.3)
    s, d, half, draw = s[keep], d[keep], half[keep], draw[keep]
    count = np.stack([half[:, 0] * 2 / pane, half[:, 1] * 2 / storey, half[:, 2] * 2 / pane], 1)
    walls = paint(
        tint(draw[:, 5:7], _WALLS),
        window=0.02 + 0.2 * draw[:, 7] ** 2,
        panes=np.maximum(np.rint(count), 1),
        width=0.3 + 0.4 * draw[:, 8],
        height=0.4 + 0.25 * draw[:, 9],
        top=0.4,
        contrast=0.04 + 0.12 * draw[:, 10],
        grain_m=1.5,
        glow=0.03,
    )
    # Cellars: the walls go on below the ground.
    parts = [make(road, s, d, half, walls)]
    pitched = draw[:, 11] < 0.6
    s, d, half, draw = s[pitched], d[pitched], half[pitched], draw[pitched]
    # A box on its edge, flattened: what looks out of the walls is a roof with its ridge along the road.
    slant = 0.75
    gable = np.stack([(half[:, 0] + 0.4) / np.sqrt(2)] * 2 + [half[:, 2] + 0.3], 1)
    top = 2 * half[:, 1] - gable[:, 1]
    tiles = paint(tint(draw[:, 6:8], _ROOFS), contrast=0.25, grain_m=0.6)
    return [*parts, make(road, s, d, gable, tiles, bottom_m=top, roll=np.pi / 4, squash=slant)]


def _fences(style: Style, road: Road) -> list[Things]:
    rng = stream(style.seed, "fence kinds")
    height = rng.uniform(0.5, 2.0)
    s, side, draw = slots(style, road, "fences", 7.0, 6, jitter=0.0)
    # Neighbouring places share a decision, so that fences are long.
    group = np.repeat(draw[::8, 0], 8)[: len(s)]
    hedge = draw[:, 1] < 0.7
    half = np.stack([0.1 + 0.4 * draw[:, 2] * hedge, height * (0.4 + 0.2 * draw[:, 3]), np.full(len(s), 3.45)], 1)
    d = side * (style.half_width_m + max(style.sidewalk_m, 1.0) + 0.3 + half[:, 0])
    keep = (group < style.hedges) & fits(style, road, s, d, half[:, 0])
    keep &= fits(style, road, s - 3, d) & fits(style, road, s + 3, d)
    s, d, half, draw, hedge = s[keep], d[keep], half[keep], draw[keep], hedge[keep]
    leaves, wall = tint(draw[:, 4:], _LEAVES), tint(draw[:, 4:], _WALLS)
    looks = paint(
        np.where(hedge[:, None], leaves, wall),
        panes=np.where(hedge[:, None], 0, np.array([0.0, 1.0, 16.0])),
        width=0.25,
        height=1.0,
        contrast=np.where(hedge, 0.6, 0.2),
        grain_m=0.7,
    )
    return [make(road, s, d, half, looks)]


def _trees(style: Style, road: Road) -> list[Things]:
    rng = stream(style.seed, "tree kinds")
    pitch, tall, wide = rng.uniform(7, 16), rng.uniform(4, 12), rng.uniform(1.3, 3.8)
    away, blobs = rng.uniform(0.8, 5), 7
    s, side, draw = slots(style, road, "trees", pitch, 10 + 4 * blobs)
    d = side * (style.half_width_m + away * (0.7 + 0.6 * draw[:, 0]))
    keep = (draw[:, 1] < 0.85 * style.trees) & fits(style, road, s, d, 0.4)
    s, d, draw = s[keep], d[keep], draw[keep]
    height, radius = tall * (0.7 + 0.6 * draw[:, 2]), wide * (0.7 + 0.6 * draw[:, 3])
    girth = 0.08 + 0.14 * draw[:, 4]
    clear = height * (0.25 + 0.2 * draw[:, 5])
    bark = paint(np.tile(_BARK, (len(s), 1)) * (0.6 + draw[:, 6:7]), contrast=0.4, grain_m=0.4)
    half = np.stack([girth, height * 0.35, girth], 1)
    parts = [make(road, s, d, half, bark, shape=CYLINDER)]
    conifer = draw[:, 7] < 0.25
    for blob in range(blobs):
        offset = draw[:, 10 + 4 * blob : 14 + 4 * blob]
        angle, out = 2 * np.pi * offset[:, 0], np.sqrt(offset[:, 1]) * 0.65
        level = (blob + 0.5) / blobs
        # Broad crowns are widest in the middle, conifers at the foot.
        profile = np.where(conifer, 0.75 * (1.1 - level), 1.3 * np.sqrt(level * (1 - level)) + 0.25)
        out = np.where(conifer, 0.0, out * profile)
        size = radius * np.where(conifer, profile, 0.42 + 0.25 * offset[:, 2])
        rise = clear + (height - clear) * (0.8 * level + 0.2 * offset[:, 3])
        high = size * np.where(conifer, 0.9, 0.8)
        green = tint(draw[:, 8:10], _LEAVES) * (0.6 + 0.8 * offset[:, 2:3])
        leaves = paint(green, contrast=1.1, grain_m=0.8, leafy=1.0)
        at_s, at_d = s + radius * out * np.sin(angle), d + radius * out * np.cos(angle)
        half = np.stack([size, high, size], 1)
        parts.append(make(road, at_s, at_d, half, leaves, bottom_m=rise - high, shape=BALL, yaw=angle))
    return parts


def _woods(style: Style, road: Road) -> list[Things]:
    rng = stream(style.seed, "woods")
    tall, away = rng.uniform(4, 13), rng.uniform(2, 16)
    s, side, draw = slots(style, road, "wood", 6.0, 8)
    patch = np.repeat(draw[::24, 0], 24)[: len(s)]
    half = np.stack([1.5 + 2 * draw[:, 1], tall * (0.3 + 0.25 * draw[:, 2]), 1.5 + 2 * draw[:, 3]], 1)
    d = side * (style.half_width_m + away + half[:, 0] + 8 * draw[:, 4])
    keep = (patch < style.trees * (1 - 0.6 * style.built)) & fits(style, road, s, d, half.max(1))
    s, d, side, half, draw = s[keep], d[keep], side[keep], half[keep], draw[keep]
    leaves = paint(tint(draw[:, 5:7], _LEAVES) * 0.8, contrast=1.1, grain_m=1.2, leafy=1.0)
    higher = half * np.array([0.75, 0.6, 0.75])
    at = s + 2.5 * (draw[:, 2] - 0.5), d + side * 1.5 * draw[:, 3]
    return [
        make(road, s, d, half, leaves, bottom_m=-0.3 * half[:, 1], shape=BALL, yaw=6 * draw[:, 7]),
        make(road, *at, higher, leaves, bottom_m=half[:, 1] * (0.6 + 0.5 * draw[:, 0]), shape=BALL, yaw=draw[:, 7]),
    ]


def _bushes(style: Style, road: Road) -> list[Things]:
    s, side, draw = slots(style, road, "bushes", 5.0, 8)
    size = 0.3 + 0.9 * draw[:, 0] ** 2
    half = np.stack([size * (0.8 + draw[:, 1]), size * (0.6 + 0.5 * draw[:, 2]), size * (0.8 + draw[:, 3])], 1)
    d = side * (style.half_width_m + max(style.sidewalk_m, 0.3) + half.max(1) + 4 * draw[:, 4])
    keep = (draw[:, 5] < 0.6 * style.bushes) & fits(style, road, s, d, half.max(1))
    s, d, half, draw = s[keep], d[keep], half[keep], draw[keep]
    leaves = paint(tint(draw[:, 6:], _LEAVES), contrast=0.8, grain_m=0.3, leafy=1.0)
    return [make(road, s, d, half, leaves, bottom_m=-0.4 * half[:, 1], shape=BALL)]


def _lamps(style: Style, road: Road) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return (s, d, side, height) of the street lamps."""
    rng = stream(style.seed, "lamp kinds")
    pitch, high, gap = rng.uniform(20, 45), rng.uniform(5, 9), rng.uniform(0.3, 1.5)
    there = rng.random() < style.poles or style.lamps > 0
    s, side, draw = slots(style, road, "lamps", pitch, 2, jitter=0.1)
    d = side * (style.half_width_m + gap)
    keep = (draw[:, 0] < 0.9 * there) & fits(style, road, s, d, 0.1)
    return s[keep], d[keep], side[keep], high


def lamp_heads(style: Style, road: Road) -> np.ndarray:
    """Return the heads of the street lamps in the order of s, as rows (s, x, y, z), m."""
    s, d, side, high = _lamps(style, road)
    x, z, _ = place(road, s, d - _ARM_M * side)
    return np.stack([s, x, -ground(road, x, z)[0] - high, z], 1)[np.argsort(s, kind="stable")]


def _posts(style: Style, road: Road) -> list[Things]:
    """Return lamp posts with their arms, sign posts with their plates, and delineators."""
    s, d, side, high = _lamps(style, road)
    rng = stream(style.seed, "post kinds")
    grey = np.tile(_STEEL * rng.uniform(0.3, 1.3), (len(s), 1))
    size = np.tile([0.06, high / 2, 0.06], (len(s), 1))
    arm = np.tile([0.7, 0.05, 0.1], (len(s), 1))
    shining = paint(grey, window=0.3, panes=(1.0, 1.0, 1.0), width=0.9, height=1.0, glow=6.0 * style.lamps)
    parts = [
        make(road, s, d, size, paint(grey), shape=CYLINDER),
        make(road, s, d - _ARM_M * side, arm, shining, bottom_m=high),
    ]
    s, side, draw = slots(style, road, "signs", 23.0, 8, jitter=0.8)
    d = side * (style.half_width_m + 0.4 + 1.2 * draw[:, 0])
    keep = (draw[:, 1] < 0.5 * style.poles) & fits(style, road, s, d, 0.4)
    s, d, draw = s[keep], d[keep], draw[keep]
    rise = 1.2 + 1.3 * draw[:, 2]
    plate = np.stack([0.2 + 0.4 * draw[:, 3] ** 2, 0.2 + 0.3 * draw[:, 4] ** 2, np.full(len(s), 0.02)], 1)
    face = paint(
        tint(draw[:, 5:7], np.array([(0.8, 0.8, 0.8), (0.6, 0.05, 0.05), (0.05, 0.12, 0.5), (0.7, 0.5, 0.03)])),
        window=0.1 + 0.7 * draw[:, 7],
        panes=(1.0, 1.0, 1.0),
        width=0.6,
        height=0.6,
        contrast=0.05,
    )
    size = np.stack([np.full(len(s), 0.04), rise / 2, np.full(len(s), 0.04)], 1)
    parts += [
        make(road, s, d, size, paint(np.tile(_STEEL, (len(s), 1))), shape=CYLINDER),
        make(road, s, d, plate, face, bottom_m=rise),
    ]
    s, side, draw = slots(style, road, "delineators", 25.0, 1, jitter=0.0)
    d = side * (style.half_width_m + 0.5)
    keep = fits(style, road, s, d, 0.1) & (style.sidewalk_m == 0) & (style.built < 0.3)
    s, d = s[keep], d[keep]
    white = paint(np.full((len(s), 3), 0.75), window=0.03, panes=(1.0, 3.0, 1.0), width=1.0, height=0.3)
    return [*parts, make(road, s, d, np.tile([0.05, 0.5, 0.06], (len(s), 1)), white)]


def _rails(style: Style, road: Road) -> list[Things]:
    pitch = 6.0
    s, side, draw = slots(style, road, "rails", pitch, 1, jitter=0.0)
    keep = np.full(len(s), style.rails) & (np.repeat(draw[::80, 0], 80)[: len(s)] < 0.8)
    d = side * (style.half_width_m + 0.6)
    keep &= fits(style, road, s, d, 0.3) & fits(style, road, s - 3, d) & fits(style, road, s + 3, d)
    s, d = s[keep], d[keep]
    steel = paint(np.tile(_STEEL * 1.5, (len(s), 1)), contrast=0.15, grain_m=0.5)
    half = np.tile([0.05, 0.16, pitch / 2 + 0.05], (len(s), 1))
    post = np.tile([0.05, 0.25, 0.05], (len(s), 1))
    return [make(road, s, d, half, steel, bottom_m=0.45), make(road, s, d, post, steel)]


def _overpasses(style: Style, road: Road) -> list[Things]:
    s, side, draw = slots(style, road, "overpasses", 400.0, 5, jitter=0.8)
    s, draw = s[side > 0], draw[side > 0]
    keep = draw[:, 0] < style.overpasses
    s, draw = s[keep], draw[keep]
    concrete = paint(np.full((len(s), 3), 0.35) * (0.6 + 0.6 * draw[:, 1:2]), contrast=0.25, grain_m=2.0)
    skew = 0.5 * (draw[:, 2] - 0.5)
    wide = style.half_width_m + 25
    deck = np.stack([np.full(len(s), wide), np.full(len(s), 0.8), 3 + 5 * draw[:, 3]], 1)
    rise = 5.0 + 1.5 * draw[:, 4]
    parts = [make(road, s, np.zeros(len(s)), deck, concrete, bottom_m=rise, yaw=skew)]
    for side_of in (-1, 1):
        wall = np.stack([np.full(len(s), 4.0), rise / 2, 0.8 * deck[:, 2]], 1)
        d = np.full(len(s), side_of * (style.half_width_m + 7.0))
        clear = fits(style, road, s, d, 4.0)
        parts.append(select(make(road, s, d, wall, concrete, yaw=skew), clear))
    return parts


def _parked(style: Style, road: Road) -> list[Things]:
    s, side, draw = slots(style, road, "parked", 6.5, 12, jitter=0.15)
    # At the kerb, or half on it where the lane leaves no room.
    d = side * max(style.half_width_m - 1.0, style.lane_m * (style.lanes - 0.5) + 2.3)
    run = np.repeat(draw[::10, 0], 10)[: len(s)]
    bend = road.curvature[np.rint((s + BEHIND_M) / NODE_M).astype(int)]
    keep = (draw[:, 1] < 0.8) & (run < style.parked) & (np.abs(bend) < 0.03)
    s, d, side, draw = s[keep], d[keep], side[keep], draw[keep]
    yaw = np.where(side == style.side, 0.0, np.pi) + 0.04 * (draw[:, 2] - 0.5)
    return park(road, s, d, yaw, car_parts(draw[:, 3:]))
