"""Estimate a trajectory with covariance: `python -m mdnvo_jax.predict IMAGES --output DIR`."""

import json
import shlex
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from mdnvo_jax import files
from mdnvo_jax.config import intrinsics
from mdnvo_jax.errors import InputError, Parser, exit_code


def main(arguments: Sequence[str]) -> None:
    """Predict as the command line says."""
    parser = Parser("python -m mdnvo_jax.predict", description="Estimate a trajectory with covariance from images.")
    parser.add_argument(
        "images",
        metavar="IMAGES",
        help="a folder, a glob in quotes, a video, or a KITTI sequence (such as image_0 with a calib.txt beside it)",
    )
    parser.add_argument("--checkpoint", metavar="DIR", help="the --workdir of a training [weights of the package]")
    parser.add_argument("--output", required=True, metavar="DIR", help="the files are written here")
    parser.add_argument("--force", action="store_true", help="overwrite files in --output")
    parser.add_argument("--stride", type=int, default=1, metavar="N", help="use every Nth frame")
    parser.add_argument("--timestamps", metavar="FILE", help="a time in seconds a line, one for each frame")
    parser.add_argument("--camera", type=intrinsics, metavar="fx,fy,cx,cy", help="intrinsics of the frames in pixels")
    parser.add_argument(
        "--camera-height",
        type=float,
        metavar="METRES",
        help="height of the optical centre above the road surface; translations scale with it [that of the training]",
    )
    parser.add_argument("--mode", choices=("offline", "streaming"), default="offline", help="streaming: past alone")
    parser.add_argument("--bad-frames", choices=("stop", "hold"), default="stop", help="what an unreadable frame does")
    parser.add_argument(
        "--estimate", choices=("mean", "strongest"), default="mean", help="what a mixture is reported by"
    )
    parser.add_argument(
        "--backend",
        choices=("jax", "openvino"),
        default="jax",
        help="what computes the convolutions; openvino: on a processor (pip install 'mdnvo_jax[openvino]')",
    )
    parser.add_argument(
        "--precision", choices=("float32", "bfloat16"), default="float32", help="of the products in the convolutions"
    )
    parser.add_argument(
        "--scale-sigma",
        type=float,
        metavar="SHARE",
        help="1-sigma error of the path's scale, such as 0.05 [fitted]",
    )
    parser.add_argument("--no-recalibration", action="store_true", help="sigmas as the network gave them")
    options = parser.parse_args(arguments)
    if options.stride < 1:
        raise InputError(f"--stride is {options.stride}: expected 1 or more")
    output = files.claim_output(options.output, force=options.force)

    from mdnvo_jax import compilation, predictor
    from mdnvo_jax.data.folder import read_frames
    from mdnvo_jax.training import logs

    def bar(chunks: Iterator[Any], total: int) -> Iterator[Any]:
        return logs.track(chunks, "predicting", total)

    compilation.keep_compiled()
    model = predictor.load(
        options.checkpoint,
        recalibrated=not options.no_recalibration,
        camera_height_m=options.camera_height,
        backend=options.backend,
        precision=options.precision,
    )
    frames = read_frames(
        options.images,
        model.config.image.channels,
        stride=options.stride,
        timestamps=options.timestamps,
        camera=options.camera,
    )
    path = predictor.predict(
        model,
        frames,
        mode=options.mode,
        bad_frames=options.bad_frames,
        estimate=options.estimate,
        scale_sigma=options.scale_sigma,
        progress=bar,
    )
    path.about.update(command=shlex.join(sys.orig_argv), versions=logs.versions())
    path.save(output, force=True)
    print(
        f"{len(path.poses)} frames, {path.distance_m:.1f} m, {sum(map(bool, path.flags))} steps flagged, "
        f"ms a frame {json.dumps(path.about['ms_per_frame'])}; the files are in {output}"
    )


if __name__ == "__main__":
    raise SystemExit(exit_code(main))
