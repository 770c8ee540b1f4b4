"""Print the peak memory of a fresh process that predicts: `python -m mdnvo_jax.benchmark.memory CHECKPOINT FRAMES`."""

import sys
from collections.abc import Sequence

from mdnvo_jax.errors import exit_code


def main(arguments: Sequence[str]) -> None:
    """Predict from frames that are drawn when they are read, and print the peak memory in MB."""
    from mdnvo_jax import predictor
    from mdnvo_jax.benchmark import machine, material

    path, frames = arguments
    model = predictor.load(path)
    image = model.config.image
    found = predictor.predict(model, material.drawn(int(frames), image.channels, (image.height, image.width)))
    assert len(found.poses) == int(frames)
    print(machine.peak_memory_mb())


if __name__ == "__main__":
    raise SystemExit(exit_code(main, sys.argv[1:]))
