"""The command line bin/prepare_kitti: decode and resize KITTI or nuScenes, or render worlds, once for all."""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mdnvo_jax.errors import InputError, Parser


def main(arguments: Sequence[str]) -> None:
    """Write the cache that `arguments` ask for.

    Raises:
      InputError: an argument is unusable, the data are missing or malformed, or the disk is too small.
    """
    parser = Parser(prog="prepare_kitti", description="Decode and resize sequences once, for data.cache.")
    parser.add_argument("--root", help="folder that holds sequences/ and poses/, or nuScenes' samples/")
    parser.add_argument("--output", required=True, help="folder to write into; what is finished there is kept")
    parser.add_argument("--dataset", choices=("kitti", "nuscenes", "synthetic"), help="kind (default: kitti)")
    parser.add_argument(
        "--sequences", nargs="+", metavar="NAME", help="such as 00 01 or scene-0061 (default: all that can be used)"
    )
    parser.add_argument("--camera-folder", metavar="NAME", help="image_0 to image_3 (default: image_2)")
    parser.add_argument(
        "--nuscenes-version", dest="version", metavar="NAME", help="such as v1.0-mini (default: v1.0-trainval)"
    )
    parser.add_argument("--height", type=int, help="rows of the network's input (default: 184)")
    parser.add_argument("--width", type=int, help="columns of the network's input (default: 608)")
    parser.add_argument("--channels", type=int, choices=(1, 3), help="1 for grey, 3 for RGB (default: 3)")
    parser.add_argument("--config", metavar="FILE", help="config to take these from instead, such as configs/paper.py")
    parser.add_argument("--threads", type=int, default=2, help="threads that decode (default: 2)")
    options = parser.parse_args(arguments)

    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from mdnvo_jax.config import Config, load_config
    from mdnvo_jax.data import cache, load, windows

    config = load_config(options.config) if options.config else Config()
    image = dataclasses.replace(config.image, **_given(options, ("height", "width", "channels")))
    if min(image.height, image.width) < 1:
        raise InputError(f"--height {image.height} --width {image.width}: expected 1 or more")
    given = _given(options, ("dataset", "camera_folder", "version"))
    data = dataclasses.replace(config.data, root=options.root or "", cache="", **given)
    config = dataclasses.replace(config, image=image, data=data)
    names = options.sequences
    if data.dataset == "synthetic":
        if options.root or names:
            raise InputError("--dataset synthetic takes its worlds from --config: leave out --root and --sequences")
        train, validation, _ = load.load_split(config)
        sequences = [*train, *validation]
    elif not options.root:
        raise InputError(f"--root is missing: give the folder of {data.dataset}")
    elif data.dataset == "nuscenes":
        sequences = load.nuscenes_sequences(names, config) if names else load.usable_scenes(config, least=2)
        if not sequences:
            raise InputError(f"{data.root} has no scene of {data.version} with two frames and all its images on disk")
    else:
        names = names or sorted(path.stem for path in (Path(options.root) / "poses").glob("*.txt"))
        if not names:
            raise InputError(f"no poses/*.txt in {options.root}: expected the folder of KITTI's odometry benchmark")
        sequences = load.kitti_sequences(names, config)
    image = windows.resolve_camera(sequences, cache.with_cached_camera(options.output, image))
    total, missing = cache.cache_bytes(sequences, image, options.output)
    free = cache.check_disk(missing, options.output)
    frames = sum(sequence.count for sequence in sequences)
    print(
        f"{len(sequences)} sequences, {frames} frames as {image.width}x{image.height}x{image.channels}: "
        f"{cache.megabytes(total)} in {options.output}, of which {cache.megabytes(missing)} are to be written "
        f"({cache.megabytes(free)} free)"
    )
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns) as bar:
        tasks = {sequence.name: bar.add_task(sequence.name, total=sequence.count) for sequence in sequences}
        cache.prepare_cache(
            sequences,
            image,
            options.output,
            lambda name, done, _: bar.update(tasks[name], completed=done),
            threads=options.threads,
        )
    print(f"done: train with --data.cache {options.output}")


def _given(options: argparse.Namespace, fields: tuple[str, ...]) -> dict[str, Any]:
    """Return those of `fields` that the user gave."""
    return {field: getattr(options, field) for field in fields if getattr(options, field) is not None}
