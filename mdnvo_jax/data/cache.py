"""Prepared frames on disk: decoded, rectified and resized once, memory-mapped ever after.

For each sequence the folder holds `NAME.npy`, uint8 `[N, H, W, C]`, and `NAME.json`: poses, times, camera, image
configuration and a fingerprint of the source. Rendered drives have `NAME.flow.npy` as well, float16 `[N, h, w, 2]`,
optical flow on a map of the network. The JSON file is written last: a sequence without one is unfinished.
"""

import concurrent.futures
import dataclasses
import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable
from collections.abc import Sequence as Many
from pathlib import Path
from typing import Any

import numpy as np

from mdnvo_jax.config import ImageConfig
from mdnvo_jax.data import images
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError
from mdnvo_jax.files import remove_remnants, whole_file, write_text

# Of the free disk, what is left alone: other programs need some, and so does the file system.
_SPARE_BYTES = 200_000_000
# Fields of the image configuration that the pixels depend on. Normalisation comes later, on the device.
_FIELDS = ("height", "width", "channels", "rectify", "camera")

Progress = Callable[[str, int, int], None]


def cache_bytes(sequences: Many[Sequence], image_config: ImageConfig, directory: str | Path) -> tuple[int, int]:
    """Return (total, missing): bytes of the cache of `sequences`, and of what is not in `directory` yet."""
    frame = image_config.height * image_config.width * image_config.channels
    sizes = [(sequence.count * frame, _finished(sequence, image_config, Path(directory))) for sequence in sequences]
    return sum(size for size, _ in sizes), sum(size for size, finished in sizes if not finished)


def check_disk(missing: int, directory: str | Path) -> int:
    """Return the free bytes of the disk on which `directory` is or will be.

    Raises:
      InputError: `missing` bytes, and some to spare, do not fit.
    """
    place = Path(directory).absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if missing + _SPARE_BYTES > free:
        raise InputError(
            f"the cache needs {megabytes(missing)} and {megabytes(_SPARE_BYTES)} to spare, but {place} has "
            f"{megabytes(free)} free: choose another --output, fewer --sequences or a smaller --height and --width"
        )
    return free


def prepare_cache(
    sequences: Many[Sequence],
    image_config: ImageConfig,
    directory: str | Path,
    progress: Progress | None = None,
    *,
    threads: int = 2,
) -> None:
    """Write the prepared frames of `sequences` into `directory`, which is made where it is missing.

    Sequences that are there already, of the same source and configuration, are kept; others are written to a temporary
    name that takes the final one when whole. Memory use does not grow with the length of a sequence.

    Args:
      sequences: to decode; their names become file names.
      image_config: what to prepare for, its virtual camera resolved (see `windows.resolve_camera`).
      directory: to write into.
      progress: called with a sequence's name, the frames of it that are done, and its frames in all.
      threads: that decode at once.

    Raises:
      InputError: the disk is too small, a frame cannot be read, `directory` holds a cache for other images, or two
        sequences have one name.
    """
    directory = Path(directory)
    names = [_file_name(sequence.name) for sequence in sequences]
    if len(set(names)) < len(names):
        raise InputError(f"sequences {', '.join(names)}: expected each name once")
    for path in sorted(directory.glob("*.json")):
        _check_fields(_load(path)["image"], image_config, path, any_camera=False)
    _, missing = cache_bytes(sequences, image_config, directory)
    check_disk(missing, directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {directory} ({error.strerror}): choose another --output") from error
    for sequence in sequences:
        if _finished(sequence, image_config, directory):
            if progress is not None:
                progress(sequence.name, sequence.count, sequence.count)
        else:
            try:
                _write(sequence, image_config, directory, progress, threads)
            except OSError as error:
                raise InputError(
                    f"cannot write into {directory} ({error.strerror}): choose another --output"
                ) from error


def read_cache(directory: str | Path, image_config: ImageConfig, names: Many[str] | None = None) -> list[Sequence]:
    """Return the sequences in a cache, their frames memory-mapped and already prepared.

    `images.prepare` leaves such frames as they are, so they can be used like any other sequence.

    Args:
      directory: written by `prepare_cache`.
      image_config: what the frames must have been prepared for; an empty virtual camera asks for none in particular.
      names: of the sequences to return, in this order; all of them, sorted, when None.

    Raises:
      InputError: there is no cache, a sequence is missing or unfinished, a file is damaged, or the images were prepared
        for another configuration; the message names the field.
    """
    directory = Path(directory)
    stored = {data["name"]: (path, data) for path, data in ((p, _load(p)) for p in sorted(directory.glob("*.json")))}
    if not stored:
        raise InputError(f"no finished cache in {directory}: make one with bin/prepare_kitti --output {directory}")
    wanted = list(stored) if names is None else list(names)
    for name in wanted:
        if name not in stored:
            raise InputError(
                f"the cache {directory} has no finished sequence {name}: found {', '.join(stored)}; "
                "run bin/prepare_kitti again, it keeps what is there"
            )
    return [_open(*stored[name], image_config) for name in wanted]


def with_cached_camera(directory: str | Path, image_config: ImageConfig) -> ImageConfig:
    """Return `image_config` with the virtual camera that the cache in `directory` was prepared for, if it has none.

    So a cache can be extended by sequences of other cameras.
    """
    for path in sorted(Path(directory).glob("*.json")):
        if image_config.rectify and not image_config.camera:
            return dataclasses.replace(image_config, camera=tuple(_load(path)["image"]["camera"]))
    return image_config


def megabytes(count: int) -> str:
    """Return a number of bytes as text, in MB or GB."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{math.ceil(count / 1e6)} MB"


def _open(path: Path, stored: dict[str, Any], image_config: ImageConfig) -> Sequence:
    """Return the sequence that `path`, a JSON file of a cache, describes."""
    _check_fields(stored["image"], image_config, path, any_camera=not image_config.camera)
    array_file = path.with_suffix(".npy")
    frames = _mapped(array_file, path)
    shape = (stored["count"], *(stored["image"][field] for field in ("height", "width", "channels")))
    if frames.shape != shape or frames.dtype != np.uint8:
        raise InputError(
            f"{array_file} holds {frames.dtype} {list(frames.shape)}, expected uint8 {list(shape)} by {path.name}: "
            "remove both, then prepare again"
        )
    poses = None
    if stored["poses"] is not None:
        poses = np.tile(np.eye(4), (stored["count"], 1, 1))
        poses[:, :3] = np.array(stored["poses"]).reshape(-1, 3, 4)
    flow = None
    if stored.get("flow"):
        flow = _mapped(path.with_suffix(".flow.npy"), path)
        if len(flow) != stored["count"]:
            raise InputError(
                f"{path.with_suffix('.flow.npy')} has {len(flow)} frames, expected {stored['count']}: "
                f"remove it and {path.name}"
            )
    return Sequence(
        name=stored["name"],
        count=stored["count"],
        flow=None if flow is None else lambda index: np.asarray(flow[index], np.float32),
        read=lambda index: np.asarray(frames[index]),
        timestamps=None if stored["timestamps"] is None else np.array(stored["timestamps"]),
        poses=poses,
        camera=None if stored["camera"] is None else tuple(stored["camera"]),
    )


def _mapped(file: Path, path: Path) -> np.ndarray:
    """Return an array of a cache, mapped into memory; `path` is the JSON file that describes it."""
    try:
        return np.lib.format.open_memmap(file, mode="r")
    except (OSError, ValueError) as error:
        raise InputError(f"{file} is damaged ({error}): remove it and {path.name}, then prepare again") from error


def _write(
    sequence: Sequence, image_config: ImageConfig, directory: Path, progress: Progress | None, threads: int
) -> None:
    """Write one sequence, the description last."""
    path = directory / f"{_file_name(sequence.name)}.json"
    # A description of older frames must not stand beside the new ones.
    path.unlink(missing_ok=True)
    for suffix in (".npy", ".flow.npy"):
        remove_remnants(path.with_suffix(suffix))
    shape = (sequence.count, image_config.height, image_config.width, image_config.channels)
    first = sequence.read(0)
    with whole_file(path.with_suffix(".npy")) as temporary:
        frames = np.lib.format.open_memmap(temporary, mode="w+", dtype=np.uint8, shape=shape)
        if hasattr(os, "posix_fallocate"):
            # Else a disk that fills up meanwhile would end the process without a word, at a write to the map.
            with temporary.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, temporary.stat().st_size)

        def prepare(index: int) -> None:
            frames[index] = images.prepare(sequence.read(index), sequence.camera, image_config)

        with concurrent.futures.ThreadPoolExecutor(max(1, threads)) as pool:
            try:
                for done, _ in enumerate(pool.map(prepare, range(sequence.count)), 1):
                    if progress is not None:
                        progress(sequence.name, done, sequence.count)
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        frames.flush()
    if sequence.flow is not None:
        with whole_file(path.with_suffix(".flow.npy")) as temporary:
            np.save(temporary, np.stack([sequence.flow(index) for index in range(sequence.count)]).astype(np.float16))
    description = {
        "flow": sequence.flow is not None,
        "name": sequence.name,
        "count": sequence.count,
        "camera": images.prepared_camera((first.shape[0], first.shape[1]), sequence.camera, image_config),
        "timestamps": None if sequence.timestamps is None else sequence.timestamps.tolist(),
        "poses": None if sequence.poses is None else sequence.poses[:, :3].reshape(-1, 12).tolist(),
        "image": dataclasses.asdict(image_config),
        "source": _fingerprint(sequence),
    }
    write_text(path, json.dumps(description))


def _finished(sequence: Sequence, image_config: ImageConfig, directory: Path) -> bool:
    """Return whether `directory` holds this sequence, from the same source, for the same images."""
    path = directory / f"{_file_name(sequence.name)}.json"
    if not (path.is_file() and path.with_suffix(".npy").is_file()):
        return False
    stored = _load(path)
    same_images = all(_plain(stored["image"][field]) == _plain(getattr(image_config, field)) for field in _FIELDS)
    return same_images and stored["source"] == _fingerprint(sequence)


def _fingerprint(sequence: Sequence) -> str:
    """Return a hash of what a sequence is made of: names and sizes of its files, camera, poses and times.

    Not of the pixels: reading them all is what resuming is to save.
    """
    digest = hashlib.sha256()
    for name in sequence.paths:
        path = Path(name)
        digest.update(f"{path.name} {path.stat().st_size if path.is_file() else ''}\n".encode())
    digest.update(repr((sequence.count, sequence.camera)).encode())
    for values in (sequence.poses, sequence.timestamps):
        digest.update(b"none" if values is None else np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _check_fields(stored: dict[str, Any], image_config: ImageConfig, path: Path, *, any_camera: bool) -> None:
    """Raise an `InputError` that names the first field in which `stored` differs from `image_config`."""
    for field in _FIELDS:
        wanted = getattr(image_config, field)
        if field == "camera" and (any_camera or not image_config.rectify):
            continue
        if _plain(stored[field]) != _plain(wanted):
            raise InputError(
                f"the cache at {path} was prepared for image.{field} {_plain(stored[field])}, but {_plain(wanted)} is "
                f"asked for: set image.{field} to match, or prepare another cache"
            )


def _plain(value: Any) -> Any:
    """Return `value` with sequences as lists of numbers rounded to 1e-6, as JSON gives them back."""
    return [round(number, 6) for number in value] if isinstance(value, (list, tuple)) else value


def _load(path: Path) -> dict[str, Any]:
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        missing = {"name", "count", "camera", "timestamps", "poses", "image", "source"} - set(stored)
        missing |= set(_FIELDS) - set(stored.get("image", ()))
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path} cannot be read ({error}): expected a description by bin/prepare_kitti") from error
    if missing:
        raise InputError(f"{path} lacks {', '.join(sorted(missing))}: expected a description by bin/prepare_kitti")
    return stored


def _file_name(name: str) -> str:
    """Return the name of a sequence, which may be a path such as that of a raw drive, as a file name."""
    return name.replace("/", "+")
