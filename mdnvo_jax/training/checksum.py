"""Checksums of what a checkpoint holds: a bit that changed on disk is found when it is read."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tensorstore as ts

from mdnvo_jax import leaves


class ChecksumError(ValueError):
    """Something read back is not what was saved."""


def of_arrays(tree: Any) -> dict[str, str]:
    """Return the SHA-256 of every array of a pytree, its type and shape included, by its name (`leaves.by_name`).

    Args:
      tree: of arrays that this process holds wholly: on one device, or a copy on every device, as `parallel.replicated`
        has it. So every process of a training computes the same.
    """
    return {name: _of_array(leaf) for name, leaf in leaves.by_name(tree).items()}


def of_json(value: Any) -> str:
    """Return the SHA-256 of JSON values."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def check_stored(folder: Path, expected: Mapping[str, str] | None) -> None:
    """Read every array that orbax wrote into the folder of an item, and refuse those without the checksums `expected`.

    One after another, before orbax reads them: it reads all at once, and where one of them is damaged those under way
    print a traceback each.

    Args:
      folder: of the item.
      expected: by the array's path in its tree, as `of_arrays` names it; None where none were saved.

    Raises:
      ChecksumError: an array differs, or is missing, or was not saved, or there is none at all; it names the first.
      ValueError: an array cannot be read.
    """
    store = {"driver": "ocdbt", "base": {"driver": "file", "path": f"{folder.resolve()}/"}}
    context = ts.Context()
    found = {}
    for key in ts.KvStore.open(store, context=context).result().list().result():
        path, _, file = key.decode().rpartition("/")
        if file == ".zarray":
            spec = {"driver": "zarr", "kvstore": {**store, "path": f"{path}/"}}
            found[path] = _of_array(ts.open(spec, context=context, open=True).result().read().result())
    if not found:
        raise ChecksumError(f"{folder.name} holds no arrays")
    if expected is not None and (wrong := sorted(path for path, _ in found.items() ^ expected.items())):
        raise ChecksumError(f"{wrong[0]} is not what was saved, by its checksum")


def check_json(value: Any, expected: str, what: str) -> None:
    """Refuse JSON values that do not have the checksum `expected`.

    Raises:
      ChecksumError: they differ; it calls them `what`.
    """
    if of_json(value) != expected:
        raise ChecksumError(f"{what} is not what was saved, by its checksum")


def _of_array(leaf: Any) -> str:
    """Return the SHA-256 of one array."""
    if isinstance(leaf, jax.Array) and leaf.is_fully_replicated:
        # Of all the copies this process holds one, whatever the other processes hold.
        leaf = leaf.addressable_data(0)
    values = np.ascontiguousarray(leaf)
    digest = hashlib.sha256(f"{values.dtype} {np.shape(leaf)} ".encode())
    digest.update(values.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()
