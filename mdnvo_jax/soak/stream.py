"""A stream that goes on and on: its memory stays flat and no frame takes long, whatever the camera gives."""

import gc
import time
from pathlib import Path

import cv2
import jax
import numpy as np

from mdnvo_jax import predictor
from mdnvo_jax.soak.tally import Tally
from mdnvo_jax.watch import Watch

# Frames before memory is looked at: by then everything is compiled and every buffer made.
_WARM_UP = 500
# What may come on top of that: the allocator's own, which does not grow with the number of frames.
MOST_GROWTH_BYTES = 16 << 20


def run(seconds: float, seed: int, workdir: Path, frames: int = 0) -> Tally:
    """Feed a stream for some time.

    Args:
      seconds: how long.
      seed: of the frames.
      workdir: of a training.
      frames: how many at least, whatever the time.
    """
    tally = Tally("stream")
    model = predictor.load(workdir)
    pool = _pool(model, np.random.default_rng(seed))
    state, watch = model.stream_start(model.model), Watch()
    warm, flagged = 0, 0
    # Counted in classes of a hundredth of their logarithm, so that they take no memory of their own.
    classes = np.zeros(3000, np.int64)
    end = time.monotonic() + seconds
    while tally.tried < max(frames, 2 * _WARM_UP) or time.monotonic() < end:
        frame, readable = pool[tally.tried % len(pool)]
        began = time.perf_counter()
        state, step = model.stream_step(model.model, state, frame, readable)
        mean, covariance = np.asarray(step.mean), np.asarray(step.covariance)
        spent = time.perf_counter() - began
        flagged += bool(watch.look(frame if readable else None, 0.1 * tally.tried))
        tally.tried += 1
        if not (np.isfinite(mean).all() and np.isfinite(covariance).all() and (np.diagonal(covariance) > 0).all()):
            tally.lost.append(f"frame {tally.tried}: the estimate is not finite")
            break
        if tally.tried == _WARM_UP:
            gc.collect()
            warm, arrays = _resident_bytes(), len(jax.live_arrays())
        elif tally.tried > _WARM_UP:
            classes[min(int(100 * np.log(spent * 1e6)), len(classes) - 1)] += 1
    gc.collect()
    growth = _resident_bytes() - warm
    if warm and growth > MOST_GROWTH_BYTES:
        tally.lost.append(f"memory grew by {growth / 1e6:.1f} MB from {warm / 1e6:.0f} MB")
    if warm and len(jax.live_arrays()) > arrays:
        tally.lost.append(f"{len(jax.live_arrays()) - arrays} more arrays are alive than after {_WARM_UP} frames")
    shares = np.cumsum(classes) / max(classes.sum(), 1)
    p50, p99, p999 = (np.exp(np.searchsorted(shares, share) / 100) / 1e3 for share in (0.5, 0.99, 0.999))
    tally.note = (
        f"{p50:.2f} / {p99:.2f} / {p999:.2f} ms a frame (50, 99, 99.9 %), resident memory {warm / 1e6:.0f} MB "
        f"{growth / 1e6:+.1f} MB, {flagged} frames flagged"
    )
    return tally


def _pool(model: predictor.Predictor, draw: np.random.Generator) -> list[tuple[np.ndarray, bool]]:
    """Return frames of every kind: textures, equal ones, black, white, noise, unreadable."""
    image = model.config.image
    shape = (image.height, image.width, image.channels)
    frames = [cv2.GaussianBlur(draw.integers(0, 256, shape, dtype=np.uint8), (0, 0), 2) for _ in range(200)]
    pool = [(frame.reshape(shape), True) for frame in frames]
    pool[20:24] = [pool[20]] * 4
    pool[50:60] = [(np.zeros(shape, np.uint8), True)] * 10
    pool[90:100] = [(np.full(shape, 255, np.uint8), True)] * 10
    pool[130:140] = [(draw.integers(0, 256, shape, dtype=np.uint8), True) for _ in range(10)]
    pool[170:172] = [(np.zeros(shape, np.uint8), False)] * 2
    return pool


def _resident_bytes() -> int:
    """Return the memory that this process has now (not its peak)."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return 1024 * int(status.split("VmRSS:")[1].split()[0])
