"""What kind of world a seed stands for: how fast, how built up, which road, which light, which materials."""

import zlib
from typing import NamedTuple

import numpy as np


class Style(NamedTuple):
    """The choices that hold for a whole world. Colours are linear reflectances (R, G, B).

    Attributes:
      seed: of the world.
      cruise_mps: speed on the open road; 0 stands still.
      reversing: whether the car drives backwards.
      acceleration_mps2: of speeding up and braking.
      lateral_mps2, yaw_rate_radps: how quickly the driver takes the sharpest bends.
      stops, slows: chances that a place on the road makes the car stop, or slow down.
      bends: strength of ordinary bends, as a share of what the speed allows.
      winding: whether corner follows corner, as sharp as the car can take them: junctions, narrow streets, ramps.
      side_roads: chance of a side road every 90 m.
      steepness: largest slope of the ground, m/m.
      side: 1 for traffic on the right, -1 on the left.
      lane_m, lanes, half_width_m: width of a lane, lanes a direction, half the width of the carriageway.
      sidewalk_m: width of the sidewalk, 0 for none.
      built, trees, hedges, bushes, parked, poles, traffic: densities, 0 to 1.
      rails, overpasses: whether there are guard rails; chance of an overpass every 400 m.
      colours: of asphalt, verge, sidewalk, backdrop, sky overhead, sky at the horizon, sunlight, `[7, 3]`.
      sun: unit vector towards the sun, `[3]`.
      sun_strength, sky_strength: direct and diffuse light on level ground; their sum is 1 on a clear noon.
      clouds: cover, 0 to 1. haze_m: distance at which a 1/e of the contrast is left.
      centre_line, lane_period_m, lane_duty, edge_line, paint, wear: road markings: 0 none, 1 dashed, 2 solid; length of
        a dash and gap; share of the dash; whether edges are marked; reflectance; how worn.
      roughness: contrast of the asphalt. history: how much its repairs, tracks, seams and cracks show, 0 to 1. sheen:
        how it mirrors the sun. cracks, patches: how many. zebra: chance of a crossing every 60 m.
      backdrop_rad: how high the distant trees or houses stand.
      daylight: brightness of the sky's colours, 1 by day. headlight, lamps: strength of the car's own headlights and of
        street lamps, 0 by day.
      stone_m: size of the stones that the road is paved with, 0 for asphalt. arrows: chance of an arrow on every lane
        every 40 m.
      wet, rain: how wet the road is, how hard it rains, 0 to 1.
    """

    seed: int
    cruise_mps: float
    reversing: bool
    acceleration_mps2: float
    lateral_mps2: float
    yaw_rate_radps: float
    stops: float
    slows: float
    bends: float
    winding: bool
    side_roads: float
    steepness: float
    side: int
    lane_m: float
    lanes: int
    half_width_m: float
    sidewalk_m: float
    built: float
    trees: float
    hedges: float
    bushes: float
    parked: float
    poles: float
    traffic: float
    rails: bool
    overpasses: float
    colours: np.ndarray
    sun: np.ndarray
    sun_strength: float
    sky_strength: float
    clouds: float
    haze_m: float
    centre_line: int
    lane_period_m: float
    lane_duty: float
    edge_line: bool
    paint: float
    wear: float
    roughness: float
    history: float
    sheen: float
    cracks: float
    patches: float
    zebra: float
    backdrop_rad: float
    daylight: float
    headlight: float
    lamps: float
    stone_m: float
    arrows: float
    wet: float
    rain: float


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the generator of one aspect of a world.

    Each aspect has its own, and draws rows of a table: a longer drive then has the same first rows, and a change to one
    aspect leaves the others alone.
    """
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def draw_style(seed: int) -> Style:
    """Return the style of the world `seed`: a tenth of them stand, some crawl, the others cruise at 1 to 30 m/s."""
    rng = stream(seed, "style")
    cruise = 0.0 if rng.random() < 0.1 else 1 + 29 * rng.random() ** 0.7
    # Car parks, robots, and whatever drives before a camera of 30 frames a second: steps of centimetres, not metres.
    pace = stream(seed, "pace")
    if cruise > 0 and pace.random() < 0.12:
        cruise = float(np.exp(pace.uniform(np.log(0.5), np.log(5))))
    # Slow worlds are towns, fast ones open roads, with a wide overlap.
    town = float(np.clip((19 - cruise) / 10 + rng.normal(0, 0.35), 0, 1))
    # But for half of those that wind: ramps and narrow bends in the open. Else a network would learn that who turns
    # sharply is in a town, and that in the open the road is straight.
    turns = stream(seed, "winding")
    winding = bool(3 < cruise < 20 and turns.random() < 0.5)
    in_the_open = winding and bool(turns.random() < 0.5)
    town = 0.15 * turns.random() if in_the_open else town
    ramp = in_the_open and bool(turns.random() < 0.6)
    motorway = bool(cruise > 19 and rng.random() < 0.6)
    as_motorway = motorway or ramp
    lanes = int(rng.integers(2, 4)) if motorway else int(1 + (rng.random() < 0.12))
    lane = rng.uniform(3.3, 3.8) if as_motorway else rng.uniform(2.6, 3.6)
    shoulder = rng.uniform(0.8, 2.5) if as_motorway else rng.uniform(0.1, 0.6) + town * rng.choice([0.0, 2.0])
    wooded = rng.random()
    weather = stream(seed, "weather")
    night, rainy = weather.random() < 0.12, weather.random() < 0.14
    daylight, amount = (weather.uniform(0.003, 0.03) if night else 1.0), weather.uniform(0.2, 1)
    overcast = bool(rng.random() < 0.3) or rainy
    elevation, azimuth = np.deg2rad(rng.uniform(15, 65)), rng.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
    sun_strength = rng.uniform(0, 0.15) if overcast else rng.uniform(0.55, 0.85)
    # Cobbles in towns and gravel in the country bear no lines.
    surface = stream(seed, "surface")
    cobbles, gravel = (bool(surface.random() < share) for share in (0.2 * town, 0.12 * (cruise < 14) * (1 - town)))
    marked = not (cobbles or gravel)
    # New asphalt shows next to nothing from a car: else a network would learn that who sees no ground move is slow.
    cover = stream(seed, "cover")
    new = bool(cover.random() < 0.4) and marked
    plainness = cover.uniform(0.1, 0.5) if new else 1.0
    # Far beyond what passengers bear. Where all that was seen ends at some lateral acceleration, or at some yaw rate,
    # a network knows from how a car turns how fast it can be at most, and reads those that are faster as that.
    driver = stream(seed, "driver")
    lateral, yaw_rate = driver.uniform(3, 10), driver.uniform(0.6, 1.4)
    sky_strength = 1 - sun_strength - (0.1 if overcast else 0.0)
    haze = np.exp(rng.uniform(np.log(300), np.log(3000)))
    return Style(
        seed=seed,
        cruise_mps=cruise,
        reversing=bool(cruise < 6 and rng.random() < 0.25),
        acceleration_mps2=rng.uniform(1.2, 4.0),
        lateral_mps2=lateral,
        yaw_rate_radps=yaw_rate,
        stops=0.15 * town * rng.random(),
        slows=0.8 * (1 - motorway) * rng.random(),
        bends=rng.random(),
        winding=winding,
        side_roads=0.6 * town + 0.1 * (not as_motorway),
        steepness=abs(rng.normal(0, 0.03)) if town > 0.5 else abs(rng.normal(0, 0.045)),
        side=1 if rng.random() < 0.75 else -1,
        lane_m=lane,
        lanes=lanes,
        half_width_m=lane * lanes + shoulder,
        sidewalk_m=rng.uniform(1.2, 3.0) if rng.random() < town else 0.0,
        built=town * rng.uniform(0.4, 1.0),
        trees=wooded**0.7 * rng.uniform(0.5, 1.0),
        hedges=rng.random() * (0.4 + 0.5 * town),
        bushes=rng.random(),
        parked=town * rng.uniform(0, 0.8),
        poles=rng.uniform(0.1, 1.0),
        traffic=rng.uniform(0, 0.7) if motorway else rng.uniform(0, 0.4),
        rails=bool(as_motorway and rng.random() < 0.7) or bool(town < 0.3 and rng.random() < 0.2),
        overpasses=0.35 if motorway else 0.05,
        colours=_colours(rng, overcast)[[1 if gravel else 0, 1, 2, 3, 4, 5, 6]],
        sun=sun,
        sun_strength=0.0 if night else sun_strength,
        sky_strength=daylight * (0.9 if night else sky_strength),
        clouds=rng.uniform(0.6, 1.0) if overcast else rng.uniform(0, 0.6),
        haze_m=float(haze * (1 - 0.7 * amount * rainy)),
        centre_line=marked * (2 if as_motorway else int(rng.choice(3, p=[0.25, 0.55, 0.2]))),
        lane_period_m=rng.choice([6.0, 9.0, 12.0, 18.0]),
        lane_duty=rng.uniform(0.3, 0.5),
        edge_line=bool(as_motorway or rng.random() < 0.5 * (1.2 - town)) and marked,
        paint=rng.uniform(0.4, 0.8),
        wear=rng.uniform(0.1, 0.9),
        roughness=plainness * rng.uniform(0.12, 0.45) + 0.25 * gravel,
        history=cover.uniform(0, 0.6) if new else 1.0,
        sheen=cover.uniform(0, 0.35) if new else 0.0,
        cracks=rng.random() * (0.4 + 0.6 * town),
        patches=rng.random() * (0.4 + 0.6 * town),
        zebra=0.25 * town * rng.random(),
        backdrop_rad=rng.uniform(0.015, 0.12) * (0.4 + wooded),
        daylight=daylight,
        headlight=weather.uniform(0.4, 0.9) * night,
        lamps=weather.uniform(0.1, 0.5) * night * (weather.random() < 0.4 + 0.6 * town),
        wet=float(rainy or weather.random() < 0.06) * weather.uniform(0.3, 1),
        stone_m=surface.uniform(0.12, 0.45) * cobbles,
        arrows=surface.random() ** 2 * marked,
        rain=amount * rainy,
    )


def _colours(rng: np.random.Generator, overcast: bool) -> np.ndarray:
    """Return the table `Style.colours`."""
    asphalt = rng.uniform(0.07, 0.24) * (1 + rng.normal(0, 0.04, 3))
    verge = _pick(rng, [(0.08, 0.13, 0.04), (0.16, 0.19, 0.07), (0.27, 0.23, 0.14), (0.22, 0.21, 0.19)])
    sidewalk = _pick(rng, [(0.32, 0.31, 0.29), (0.22, 0.21, 0.20), (0.34, 0.25, 0.20)])
    backdrop = _pick(rng, [(0.03, 0.05, 0.02), (0.06, 0.09, 0.04), (0.12, 0.13, 0.14)])
    if overcast:
        zenith = rng.uniform(0.5, 1.0) * np.array([0.95, 0.98, 1.0])
        horizon = zenith * rng.uniform(0.9, 1.3)
        sunlight = np.ones(3)
    else:
        zenith = rng.uniform(0.25, 0.7) * np.array([0.5, 0.75, 1.15])
        horizon = rng.uniform(0.6, 1.4) * np.array([0.92, 0.98, 1.05])
        sunlight = np.array([1.05, 1.0, rng.uniform(0.75, 0.95)])
    return np.stack([asphalt, verge, sidewalk, backdrop, zenith, horizon, sunlight])


def _pick(rng: np.random.Generator, choices: list[tuple[float, float, float]]) -> np.ndarray:
    """Return one of the colours, lighter or darker and a little off."""
    colour = np.array(choices[int(rng.integers(len(choices)))])
    return colour * rng.uniform(0.7, 1.3) * (1 + rng.normal(0, 0.05, 3))
