"""From a training to the weights that ship: what `bin/ship_weights` does."""

import dataclasses
import shutil
import tempfile
from pathlib import Path

from mdnvo_jax import files, predictor, recalibration, weights
from mdnvo_jax.config import Config
from mdnvo_jax.errors import InputError
from mdnvo_jax.training import checkpoint

# A wheel is downloaded by everybody who installs the package.
LARGEST_BYTES = 20_000_000
# What orbax leaves in a folder that it finished; it holds the folder's path at the time, and is not read.
_LEFT_OUT = "commit_success.txt"


def ship(source: str | Path, target: Path, *, force: bool = False) -> Path:
    """Copy what prediction needs of a training's best step into `target`, and return the step's folder.

    The optimiser's state stays behind, and so do the paths of the machine that trained.

    Args:
      source: the --workdir of a training, or the folder of one step.
      target: the folder to fill.
      force: replace all that is in it.

    Raises:
      InputError: there is no checkpoint; or it may not ship, because it has seen other data than rendered drives; or
        its sigmas were not recalibrated; or it is too large; or `target` is not empty and `force` is false.
    """
    step = checkpoint.locate(source)
    model, config, _ = checkpoint.trained(step)
    _check_origin(step, config)
    fitted = recalibration.read(step)
    if fitted is None:
        raise InputError(f"{step} has no {recalibration.FILE}: run `evaluate recalibrate --checkpoint {source}` first")
    files.claim_output(target, force=force)
    data = dataclasses.replace(config.data, root="", cache="")
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}-") as name:
        staged = Path(name) / target.name
        for item in ("model", "about"):
            shutil.copytree(step / item, staged / item, ignore=shutil.ignore_patterns(_LEFT_OUT))
        checkpoint.write_about(staged, dataclasses.replace(config, data=data), model)
        recalibration.write(staged, fitted)
        size = folder_bytes(staged)
        if size > LARGEST_BYTES:
            raise InputError(
                f"the weights take {size / 1e6:.1f} MB; at most {LARGEST_BYTES / 1e6:.0f} MB ship: lower model.width"
            )
        # Whoever installs them must be able to read them.
        predictor.load(staged)
        # Whole: a file of other weights must not be left among these.
        shutil.rmtree(target)
        staged.rename(target)
    return step


def folder_bytes(folder: Path) -> int:
    """Return the size of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _check_origin(step: Path, config: Config) -> None:
    """Refuse weights that data sets with licences of their own went into."""
    training = config.training
    if config.data.dataset != "synthetic":
        found = f"data.dataset {config.data.dataset}"
    elif training.initial_stack:
        found = f"training.initial_stack {training.initial_stack}"
    elif training.initial_weights not in ("", weights.SHIPPED):
        found = f"training.initial_weights {training.initial_weights}"
    else:
        return
    raise InputError(
        f"{step} comes from {found}: only weights from rendered drives (data.dataset synthetic) ship, since other data "
        "and weights have licences of their own"
    )
