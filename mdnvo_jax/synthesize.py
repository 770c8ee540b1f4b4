"""Render synthetic drives into a folder laid out like KITTI: `python -m mdnvo_jax.synthesize DIR`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mdnvo_jax.errors import InputError, Parser, exit_code
from mdnvo_jax.files import claim_output, whole_file, write_text


def main(arguments: Sequence[str]) -> None:
    """Write the drives that `arguments` ask for.

    Raises:
      InputError: an argument is unusable, or the folder holds files and there is no --force.
    """
    parser = Parser(
        prog="python -m mdnvo_jax.synthesize",
        description="Render procedural drives into a folder laid out like KITTI's odometry benchmark.",
    )
    parser.add_argument("directory", metavar="DIR", help="folder to write sequences/ and poses/ into")
    parser.add_argument("--sequences", type=int, default=4, metavar="N", help="drives (default: 4)")
    parser.add_argument(
        "--frames", type=int, default=120, metavar="N", help="frames a drive, 10 a second (default: 120)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of the first world; the next follow (default: 0)"
    )
    parser.add_argument("--height", type=int, default=188, metavar="N", help="rows of a frame (default: 188)")
    parser.add_argument("--width", type=int, default=620, metavar="N", help="columns of a frame (default: 620)")
    parser.add_argument(
        "--channels",
        type=int,
        choices=(1, 3),
        default=1,
        help="1: grey, in image_0; 3: colour, in image_2 (default: 1)",
    )
    parser.add_argument("--samples", type=int, choices=(1, 2, 4), default=4, help="rays a pixel (default: 4)")
    parser.add_argument("--flow", action="store_true", help="also write optical flow as KITTI's 16-bit PNG, in flow/")
    parser.add_argument("--force", action="store_true", help="write even if DIR holds files already")
    options = parser.parse_args(arguments)
    if not 1 <= options.sequences <= 100:
        raise InputError(f"--sequences {options.sequences}: expected 1 to 100, for names of two digits")
    if options.frames < 2:
        raise InputError(f"--frames {options.frames}: expected 2 or more, for a drive to have a step")

    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from mdnvo_jax.data import synthetic

    drives = [
        synthetic.drive(
            options.seed + number,
            options.frames,
            height=options.height,
            width=options.width,
            channels=options.channels,
            samples=options.samples,
        )
        for number in range(options.sequences)
    ]
    root = claim_output(options.directory, force=options.force)
    (root / "poses").mkdir(exist_ok=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns) as bar:
        for number, drive in enumerate(drives):
            name, folder = f"{number:02d}", root / "sequences" / f"{number:02d}"
            images = folder / ("image_0" if options.channels == 1 else "image_2")
            images.mkdir(parents=True, exist_ok=True)
            task = bar.add_task(f"{name} (seed {options.seed + number})", total=drive.count)
            for index in range(drive.count):
                _write_image(images / f"{index:06d}.png", drive.read(index)[..., ::-1])
                if options.flow and index + 1 < drive.count:
                    size = {"height": options.height, "width": options.width}
                    flow = synthetic.optical_flow(options.seed + number, options.frames, index, **size)
                    (folder / "flow").mkdir(exist_ok=True)
                    _write_image(folder / "flow" / f"{index:06d}.png", _kitti_flow(flow))
                bar.advance(task)
            assert drive.camera is not None and drive.timestamps is not None and drive.poses is not None
            fx, fy, cx, cy = drive.camera
            rows = " ".join(f"{value:.12e}" for value in (fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0))
            write_text(folder / "calib.txt", "".join(f"P{camera}: {rows}\n" for camera in range(4)))
            write_text(folder / "times.txt", "".join(f"{time:e}\n" for time in drive.timestamps))
            # Last: a sequence that has its poses is whole.
            lines = (" ".join(f"{value:.15e}" for value in pose[:3].ravel()) for pose in drive.poses)
            write_text(root / "poses" / f"{name}.txt", "\n".join(lines) + "\n")
    print(f"{root}: {len(drives)} x {options.frames} frames, laid out like KITTI's odometry benchmark")


def _kitti_flow(flow: Any) -> Any:
    """Return KITTI's picture of a flow `[H, W, 2]`: blue is validity, green and red are 64 v and 64 u plus 2^15."""
    import numpy as np

    stored = np.rint(64 * np.nan_to_num(flow, nan=1e6)) + 2**15
    valid = ((stored >= 0) & (stored < 2**16)).all(-1, keepdims=True)
    return np.concatenate([valid, np.where(valid, stored[..., ::-1], 0)], -1).astype(np.uint16)


def _write_image(path: Path, image: Any) -> None:
    """Write `image`, `[H, W, C]` in OpenCV's order of colours, whole or not at all."""
    import cv2

    with whole_file(path) as temporary:
        if not cv2.imwrite(str(temporary), image):
            raise InputError(f"cannot write {path}: is the disk full?")


if __name__ == "__main__":
    raise SystemExit(exit_code(main))
