"""Checkpoints with random damage: what is restored is the newest or the one before, exactly, or nothing, and said."""

import contextlib
import io
import random
import shutil
import tempfile
import time
from pathlib import Path

from mdnvo_jax.config import from_json
from mdnvo_jax.errors import InputError
from mdnvo_jax.soak.tally import Tally
from mdnvo_jax.training import checkpoint, checksum
from mdnvo_jax.training.state import State
from mdnvo_jax.training.store import Restored, Store


def run(seconds: float, seed: int, workdir: Path) -> Tally:
    """Damage copies of a training's checkpoints and restore them, for some time.

    Args:
      seconds: no new trial is begun after that.
      seed: of the damage.
      workdir: of a training with two checkpoints or more.
    """
    tally, draw = Tally("corruption"), random.Random(seed)
    template = checkpoint.template(from_json((workdir / "config.json").read_text()))
    steps = checkpoint.steps_in(workdir / checkpoint.FOLDER)
    with tempfile.TemporaryDirectory() as folder:
        whole = {step: _digest(_restored(_only(workdir, step, Path(folder)), template)) for step in steps[:2]}
    fallen = refused = 0
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with tempfile.TemporaryDirectory() as folder:
            copy = shutil.copytree(workdir, Path(folder) / "run")
            what = _damage(copy / checkpoint.FOLDER / str(steps[0]), draw)
            both = draw.random() < 0.1
            if both:
                for older in steps[1:]:
                    shutil.rmtree(copy / checkpoint.FOLDER / str(older) / "model")
            tally.tried += 1
            said = io.StringIO()
            try:
                with contextlib.redirect_stderr(said):
                    found = _restored(copy, template)
            except InputError:
                refused += 1
                if not both:
                    tally.lost.append(f"{what}: nothing was restored")
                continue
            except Exception as error:
                tally.lost.append(f"{what}: {type(error).__name__}: {str(error)[:200]}")
                continue
            if whole.get(found.step) != _digest(found):
                tally.lost.append(f"{what}: step {found.step} is not what was saved")
            elif found.step != steps[0]:
                fallen += 1
                if f"checkpoint {steps[0]} cannot be read" not in said.getvalue():
                    tally.lost.append(f"{what}: fell back without a word")
    tally.note = f"{fallen} fell back, {refused} refused, the rest harmless"
    return tally


def _only(workdir: Path, step: int, folder: Path) -> Path:
    """Return a workdir in `folder` with one step of another one."""
    place = folder / str(step)
    shutil.copytree(workdir / checkpoint.FOLDER / str(step), place / checkpoint.FOLDER / str(step))
    return place


def _restored(workdir: Path, template: State) -> Restored:
    store = Store(workdir, keep_latest=2)
    try:
        return store.restore(template)
    finally:
        store.close()


def _digest(found: Restored) -> str:
    return checksum.of_json([checksum.of_arrays(found.state), found.data_state])


def _damage(step: Path, draw: random.Random) -> str:
    """Damage a step's folder in one of many ways, and say how."""
    paths = sorted(path for path in step.rglob("*") if path.is_file())
    # By size, for that is where bits rot; and each file as such, for small ones say what the large ones mean.
    weights = [1.0 if draw.random() < 0.5 else path.stat().st_size for path in paths]
    path = draw.choices(paths, weights)[0]
    name, data = path.relative_to(step), bytearray(path.read_bytes())
    kind = draw.choice(["flip", "flip", "truncate", "remove", "zero", "folder", "item", "swap"])
    if kind in ("flip", "zero") and data:
        at = draw.randrange(len(data))
        length = draw.choice([1, 1, 64, 4096])
        for index in range(at, min(at + length, len(data))):
            data[index] = 0 if kind == "zero" else data[index] ^ (1 << draw.randrange(8))
        path.write_bytes(data)
        return f"{kind} {length} bytes at {at} in {name}"
    if kind == "truncate":
        path.write_bytes(data[: draw.randrange(len(data) + 1)])
    elif kind == "folder":
        shutil.rmtree(step)
        step.mkdir()
        return "an empty folder"
    elif kind == "item":
        item = draw.choice(["model", "training", "data", "about", "metrics"])
        shutil.rmtree(step / item)
        return f"no {item}"
    elif kind == "swap":
        other = draw.choice(paths)
        path.write_bytes(other.read_bytes())
        return f"{other.relative_to(step)} in place of {name}"
    else:
        path.unlink()
    return f"{kind} {name}"
