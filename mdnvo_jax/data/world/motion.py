"""How the camera moves: a car that follows the road at a speed, sways on its springs, and carries the camera."""

from typing import NamedTuple

import numpy as np

from mdnvo_jax.data.world.road import BEHIND_M, NODE_M, Road, ego_lane_m, ground, place
from mdnvo_jax.data.world.style import Style, stream

# KITTI's frame rate.
FRAME_S = 0.1
# Springs: sines of random phase at these frequencies, Hz, make a narrow band about the body's resonance. KITTI's pitch
# swings at about 1.3 Hz, its roll is slower.
_PITCH_HZ = (0.7, 2.0)
_ROLL_HZ = (0.2, 1.5)
_HEAVE_HZ = (0.9, 1.8)
_SINES = 7
# Where the camera of a car may sit above the road, m: about KITTI's 1.65.
CAMERA_HEIGHT_M = (1.55, 1.75)
# Bumps: drain covers, seams, speed humps. The body rings at its resonance, Hz, and calms down within so many seconds.
_BUMP_PITCH_M = 35.0
_RING_HZ = 1.4
_RING_S = 0.45


class Mount(NamedTuple):
    """Where the camera sits: ahead of the rear axle and above the road, m; attitude to the car, rad."""

    ahead_m: float
    height_m: float
    pitch_rad: float
    yaw_rad: float
    roll_rad: float


def draw_mount(seed: int, height_m: tuple[float, float] = CAMERA_HEIGHT_M) -> Mount:
    """Return the camera mount of a world: a height from the range `height_m`, KITTI's slightly lowered view, varied."""
    rng = stream(seed, "mount")
    return Mount(
        ahead_m=rng.uniform(0.3, 2.1),
        height_m=rng.uniform(*height_m),
        pitch_rad=np.deg2rad(np.clip(rng.normal(-0.6, 1.4), -4.2, 3.0)),
        yaw_rad=np.deg2rad(rng.normal(0, 0.6)),
        # On banked bends a car rolls as well. Where turns are seen level, a network reads pitch as zero in them.
        roll_rad=np.deg2rad(np.clip(rng.normal(0, 1.5), -4.0, 4.0)),
    )


def road_coordinate(road: Road, time: np.ndarray) -> np.ndarray:
    """Return s of the car, m, at `time`, s: the integral of the road's speed with s = 0 at time 0.

    Between two nodes the acceleration is constant, `a = (v1^2 - v0^2) / 2 l`, and takes `2 l / (v0 + v1)`; that holds
    from and to a standstill too.
    """
    v0, v1 = road.speed[:-1], road.speed[1:]
    if not road.speed.any():
        return np.zeros_like(time)
    arrival = np.concatenate([[0.0], np.cumsum(2 * NODE_M / (v0 + v1) + road.pause[:-1])])
    departure = arrival + road.pause
    # s and the clock start at the node where the road's table has s = 0.
    start = round(BEHIND_M / NODE_M)
    clock = time + departure[start]
    node = np.clip(np.searchsorted(departure, clock, side="right") - 1, 0, len(v0) - 1)
    elapsed = clock - departure[node]
    acceleration = (v1[node] ** 2 - v0[node] ** 2) / (2 * NODE_M)
    # While the car stands at the next node the parabola would run on.
    elapsed = np.clip(elapsed, 0, arrival[node + 1] - departure[node])
    travelled = v0[node] * elapsed + acceleration * elapsed**2 / 2
    return -BEHIND_M + NODE_M * node + np.minimum(travelled, NODE_M)


def camera_poses(style: Style, road: Road, frames: int, mount: Mount | None = None) -> np.ndarray:
    """Return `T_world_camera` of every frame, `[frames, 4, 4]`, in the world's axes, float64.

    The camera sits on `mount`, or where None on that of the world.
    """
    # Frames on either side, so that the smoothed acceleration does not depend on where the drive is cut.
    margin = 8
    time = FRAME_S * np.arange(-margin, frames + margin)
    s = road_coordinate(road, time)
    speed = np.gradient(s, FRAME_S)
    bend = road.curvature[np.rint((s + BEHIND_M) / NODE_M).astype(int)]
    kernel = np.hanning(11)[1:-1] / np.hanning(11).sum()
    braking, cornering = (
        np.convolve(acceleration, kernel, mode="same")[margin:-margin]
        for acceleration in (-np.gradient(speed, FRAME_S), bend * speed**2)
    )
    time, s, speed = time[margin:-margin], s[margin:-margin], speed[margin:-margin]

    d, drift = _wander(style, s)
    x, z, heading = place(road, s, d)
    # Rear tyres slip sideways by 0.05 to 0.4 degrees for a m/s^2: a cornering car looks into the bend.
    slip = np.deg2rad(stream(style.seed, "tyres").uniform(0.05, 0.4)) * cornering
    yaw = heading + np.arctan(drift) + slip
    rng = stream(style.seed, "springs")
    lively = np.minimum(np.abs(speed) / 8, 1.3) + 0.02
    softness = rng.uniform(0.5, 1.5)
    bounce_pitch = lively * np.deg2rad(rng.uniform(0.04, 0.3)) * _sway(rng, time, _PITCH_HZ)
    bounce_roll = lively * np.deg2rad(rng.uniform(0.05, 0.35)) * _sway(rng, time, _ROLL_HZ)
    heave = lively * rng.uniform(0.002, 0.015) * _sway(rng, time, _HEAVE_HZ)
    # A braking car noses down, a cornering one leans out: about 0.3 and 0.4 degrees for a m/s^2.
    bounce_pitch = bounce_pitch - softness * np.deg2rad(0.3) * braking
    bounce_roll = bounce_roll - softness * np.deg2rad(0.4) * cornering
    bump_pitch, bump_heave = _bumps(style, s, speed)
    bounce_pitch, heave = bounce_pitch + bump_pitch, heave + bump_heave
    if style.reversing:
        # The car looks the other way and keeps to the place where it would be: it rolls back along the road.
        yaw = yaw + np.pi
    height, slope_x, slope_z = ground(road, x, z)
    pitch = np.arctan(slope_x * np.sin(yaw) + slope_z * np.cos(yaw)) + bounce_pitch
    roll = -np.arctan(slope_x * np.cos(yaw) - slope_z * np.sin(yaw)) + bounce_roll
    body = turn(yaw, 1) @ turn(pitch, 0) @ turn(roll, 2)
    mount = draw_mount(style.seed) if mount is None else mount
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = body @ turn(mount.yaw_rad, 1) @ turn(mount.pitch_rad, 0) @ turn(mount.roll_rad, 2)
    axle = np.stack([x, -height - heave, z], axis=1)
    poses[:, :3, 3] = axle + body @ np.array([0.0, -mount.height_m, mount.ahead_m])
    return poses


def turn(angle: np.ndarray | float, axis: int) -> np.ndarray:
    """Return the rotation about coordinate `axis` by `angle`, rad, `[..., 3, 3]`."""
    angle = np.asarray(angle, np.float64)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    result = np.zeros((*angle.shape, 3, 3))
    result[..., axis, axis] = 1
    result[..., first, first] = result[..., second, second] = np.cos(angle)
    result[..., second, first] = np.sin(angle)
    result[..., first, second] = -np.sin(angle)
    return result


def _wander(style: Style, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (d, its derivative by s): the middle of the lane and a slow wander about it."""
    rng = stream(style.seed, "wander")
    amplitude, wavelength, phase = rng.uniform(0.03, 0.15, 3), rng.uniform(70, 200, 3), rng.uniform(0, 2 * np.pi, 3)
    angle = 2 * np.pi * s[:, None] / wavelength + phase
    d = ego_lane_m(style) + rng.normal(0, 0.2) + (amplitude * np.sin(angle)).sum(1)
    return d, (amplitude * 2 * np.pi / wavelength * np.cos(angle)).sum(1)


def _bumps(style: Style, s: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (pitch rad, heave m) that bumps in the road excite: a damped ringing since the car went over each.

    The time since then is taken from the distance at the speed of now.
    """
    rng = stream(style.seed, "bumps")
    strength, first = rng.uniform(0, 1) ** 2, -BEHIND_M
    count = int((s[-1] - first) / _BUMP_PITCH_M) + 2
    draw = stream(style.seed, "bump places").random((count, 3))
    place = first + _BUMP_PITCH_M * (np.arange(count) + draw[:, 0])
    since = np.clip((s[:, None] - place) / np.maximum(speed, 0.5)[:, None], 0, 10 * _RING_S)
    ring = (np.sin(2 * np.pi * _RING_HZ * since) * np.exp(-since / _RING_S) * draw[:, 1] ** 3 * (draw[:, 2] < 0.6)).sum(
        1
    )
    ring = ring * strength * np.minimum(np.abs(speed) / 6, 1)
    return np.deg2rad(1.0) * ring, -0.03 * ring


def swing(frequency: np.ndarray, phase: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return a swinging of unit variance at `time`: a sine for each row of `frequency`, added up over axis 1."""
    return np.sqrt(2 / len(frequency)) * np.sin(2 * np.pi * frequency * time + phase).sum(1)


def _sway(rng: np.random.Generator, time: np.ndarray, band_hz: tuple[float, float]) -> np.ndarray:
    """Return a swaying of unit variance within a band of frequencies, at `time`."""
    frequency, phase = rng.uniform(*band_hz, _SINES), rng.uniform(0, 2 * np.pi, _SINES)
    return swing(frequency, phase, time[:, None])
