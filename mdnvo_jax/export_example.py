"""The program that `bin/export` writes beside the exported step and shows in its help."""

EXAMPLE = '''\
"""Run the exported step: python run.py [FRAMES.npy], uint8 [N, height, width, channels]; about.json says the rest."""
import json, pathlib, sys
import jax, jax.export, numpy as np

folder = pathlib.Path(__file__).resolve().parent
step = jax.jit(jax.export.deserialize((folder / "step.jax").read_bytes()).call)
weights = jax.device_put(dict(np.load(folder / "weights.npz")))
state = {name: value[None] for name, value in np.load(folder / "start.npz").items()}  # one camera; any number goes
blank = np.zeros((3, *json.loads((folder / "about.json").read_text())["image"]["shape"]), np.uint8)
for image in np.load(sys.argv[1]) if sys.argv[1:] else blank:
    state, found = step(weights, state, image[None], np.array([True]))
    print(*np.asarray(found["mean"][0]), *np.sqrt(np.diagonal(found["covariance"][0])))  # metres and radians
'''
