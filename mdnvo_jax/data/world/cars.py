"""Cars: what they are made of, and those that drive."""

from typing import NamedTuple

import numpy as np

from mdnvo_jax.data.world.motion import road_coordinate
from mdnvo_jax.data.world.road import BEHIND_M, NODE_M, Road, ego_lane_m
from mdnvo_jax.data.world.style import Style, stream
from mdnvo_jax.data.world.things import BALL, BOX, Paint, Things, join, make, paint, select, tint

_COLOURS = np.array([(0.7, 0.7, 0.7), (0.4, 0.41, 0.43), (0.025, 0.025, 0.03), (0.12, 0.12, 0.13), (0.3, 0.03, 0.03),
                     (0.04, 0.07, 0.2)])  # fmt: skip
# Cars nearer than this along the road are looked at closely, m.
_NEAR_M = 320.0


class Part(NamedTuple):
    """A part of each car: half sizes `[n, 3]`, place ahead of the middle and height of the underside `[n]`, m.

    Attributes:
      shape: `BOX` or `BALL`, `[n]`. paint: how it looks.
    """

    half: np.ndarray
    ahead_m: np.ndarray
    bottom_m: np.ndarray
    shape: np.ndarray
    paint: Paint


class Traffic(NamedTuple):
    """The cars that drive, `[n]`: s at time 0 and d, m; speed along the road, m/s; heading against it, rad; parts.

    The first one drives ahead of us as we do, `headway_s` earlier, where `leads`.
    """

    start: np.ndarray
    speed: np.ndarray
    d: np.ndarray
    yaw: np.ndarray
    parts: tuple[Part, ...]
    headway_s: float
    leads: bool


def car_parts(draw: np.ndarray) -> tuple[Part, ...]:
    """Return the parts of cars that the numbers `draw`, `[n, 5]`, decide; one in ten is a van or a lorry."""
    colour, zero = tint(draw[:, 0:2], _COLOURS), np.zeros(len(draw))
    big, scale = draw[:, 2] < 0.1, 0.92 + 0.16 * draw[:, 3]
    body = np.stack([0.88 * scale + 0.2 * big, 0.36 * scale + 0.75 * big, 2.1 * scale + 0.8 * big], 1)
    # The greenhouse of a car is the upper half of an ellipsoid of glass, its roof of the car's colour; a van hides it.
    cabin = np.stack([0.78 * scale, 0.58 * scale, 1.55 * scale], 1)
    lights = body * np.array([0.92, 0.0, 1.0]) + np.array([0.0, 0.07, 0.015])
    # Panes low on the body pass for wheels.
    shell = paint(
        colour, window=0.015, panes=(0.0, 1.0, 2.0), width=0.32, height=0.42, lift=-0.3, top=1.2, contrast=0.03,
        grain_m=0.8,
    )  # fmt: skip
    pane = 0.02 + 0.06 * draw[:, 4]
    roof = np.clip(colour.mean(1) / pane, 0.5, 12)
    glass = paint(np.tile(pane[:, None], 3), top=roof, contrast=0.2, grain_m=0.8)
    lamps = paint(colour, window=0.45, panes=(2.0, 1.0, 0.0), width=0.35, height=1.0, contrast=0.03, glow=1.0)
    bottom, box, ball = np.full(len(draw), 0.2), np.full(len(draw), BOX), np.full(len(draw), BALL)
    back = np.where(big, 0.9, -0.25) * scale
    return (
        Part(body, zero, bottom, box, shell),
        Part(cabin, back, bottom + 2 * body[:, 1] - cabin[:, 1] * np.where(big, 2.2, 1), ball, glass),
        Part(lights, zero, bottom + 0.43 * scale, box, lamps),
    )


def park(road: Road, s: np.ndarray, d: np.ndarray, yaw: np.ndarray, parts: tuple[Part, ...]) -> list[Things]:
    """Return cars that stand at `s`, `d` with a heading of `yaw` against the road."""
    return [
        make(
            road,
            s + part.ahead_m * np.cos(yaw),
            d,
            part.half,
            part.paint,
            bottom_m=part.bottom_m,
            shape=part.shape,
            yaw=yaw,
        )
        for part in parts
    ]


def draw_traffic(style: Style, road: Road) -> Traffic:
    """Return the traffic of a world: oncoming cars, and perhaps one ahead."""
    rng = stream(style.seed, "traffic")
    headway_s, pace, chance = rng.uniform(1.5, 5.0), rng.uniform(0.8, 1.2), rng.random()
    speed = max(0.8 * style.cruise_mps, 6.0) * pace
    pitch, end = 60.0, (len(road.x) - 1) * NODE_M - BEHIND_M
    draw = stream(style.seed, "oncoming").random((int(end / pitch), 8))
    # Where a car is met decides where it starts: further on by the way it drives until then.
    meeting = pitch * (np.arange(len(draw)) + 0.6 * draw[:, 0])
    there = (draw[:, 2] < style.traffic) & (not style.reversing)
    draw, start = draw[there], meeting[there] * (1 + speed / max(style.cruise_mps, 6.0))
    lane = (draw[:, 1] * style.lanes).astype(int)
    d = -style.side * style.lane_m * (lane + 0.5)
    leads = bool(chance < 0.5 * style.traffic + 0.1 and not style.reversing)
    return Traffic(
        start=np.append(np.inf, start),
        speed=np.append(0, -speed * np.ones_like(start)),
        d=np.append(ego_lane_m(style), d),
        yaw=np.append(0, np.pi * np.ones_like(start)),
        parts=car_parts(np.concatenate([stream(style.seed, "leader").random((1, 5)), draw[:, 3:]])),
        headway_s=headway_s,
        leads=leads,
    )


def places(traffic: Traffic, road: Road, time: float) -> np.ndarray:
    """Return s of every car at `time`; infinite for a leader that is not there."""
    s = traffic.start + traffic.speed * time
    if traffic.leads:
        s[0] = road_coordinate(road, np.array([time + traffic.headway_s]))[0] + 9.0
    return s


def drive_on(traffic: Traffic, road: Road, own_s: float, time: float, later: float) -> Things:
    """Return the cars that are near `own_s` at `time`, as they are at `later`: the same rows for every `later`."""
    end = (len(road.x) - 3) * NODE_M - BEHIND_M
    s = places(traffic, road, time)
    rows = np.flatnonzero((np.abs(s - own_s) < _NEAR_M) & (np.abs(s) < end))
    parts = select(traffic.parts, rows)
    cars = join(park(road, places(traffic, road, later)[rows], traffic.d[rows], traffic.yaw[rows], parts))
    # Each car keeps its texture wherever it drives.
    return cars._replace(paint=cars.paint._replace(seed=np.tile(rows, len(parts))))
