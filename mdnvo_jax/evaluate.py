"""Judge poses: `python -m mdnvo_jax.evaluate trajectory ESTIMATE... --reference FILE --output DIR`, or `... model`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from mdnvo_jax import files
from mdnvo_jax.errors import Parser, exit_code

# Repeated here from what they belong to, since importing that takes longer than --help may.
ALIGNMENTS = ("none", "scale", "se3", "sim3")
FORMATS = ("kitti", "indexed", "tum", "euroc", "output")


def main(arguments: Sequence[str]) -> None:
    """Evaluate as the command line says."""
    options = _parser().parse_args(arguments)
    output = files.claim_output(options.output, force=options.force)

    from mdnvo_jax.evaluation import compare, model, report

    found = compare.from_options(options) if options.what == "trajectory" else model.from_options(options)
    written = report.write(found, output)
    print(report.as_text(found))
    print(f"{len(written)} files in {output}: {', '.join(written)}")


def _parser() -> Parser:
    """Return the parser of both subcommands."""
    parser = Parser("python -m mdnvo_jax.evaluate", description="Measure poses, and how sure they are, against truth.")
    subcommands = parser.add_subparsers(dest="what", required=True, metavar="{trajectory,model}")

    files_help = "judge files of poses, made by anything"
    trajectory = subcommands.add_parser("trajectory", help=files_help, description=files_help)
    add = trajectory.add_argument
    add("estimates", nargs="+", metavar="ESTIMATE", help="KITTI, frame number + KITTI, TUM, EuRoC csv, or our folder")
    add("--reference", required=True, metavar="FILE", help="the true poses, in any of the same formats")
    add("--align", action="append", default=[], choices=ALIGNMENTS, help="for all, or repeated, one an ESTIMATE [none]")
    add("--format", action="append", default=[], choices=FORMATS, help="for all, or one an ESTIMATE [by content]")
    add("--reference-format", choices=FORMATS, help="of the reference [by content]")
    add("--reference-times", metavar="FILE", help="a time in s a line, if the reference has none (KITTI's times.txt)")
    add("--tolerance", type=float, default=0.01, metavar="S", help="between times that belong together [%(default)s]")
    add("--first-frame", type=int, metavar="N", help="frame number of the first pose, where files miss frames")
    add("--names", nargs="+", default=[], metavar="NAME", help="what to call the estimates [file names]")
    add("--split", metavar="TEXT", help="what to call the data [name of the reference]")
    add("--constant-from", nargs="+", default=[], metavar="FILE", help="training poses for the constant predictor")
    add("--delta", type=float, default=1.0, metavar="N", help="how far the poses of a pair are apart [1]")
    add("--delta-unit", choices=("frames", "metres"), default="frames", help="unit of --delta [%(default)s]")
    _add_common(trajectory)

    model_help = "predict sequences with a checkpoint and judge poses and uncertainty"
    model = subcommands.add_parser("model", help=model_help, description=model_help)
    add = model.add_argument
    add("--dataset", choices=("kitti", "nuscenes", "synthetic"), default="kitti", help="kind of data [%(default)s]")
    add("--root", metavar="DIR", help="the folder of the data set; any folder in KITTI layout")
    add(
        "--sequences",
        nargs="+",
        required=True,
        metavar="NAME",
        help="such as 03 05, scene-0768, or seeds of synthetic worlds",
    )
    add("--checkpoint", required=True, metavar="DIR", help="the --workdir of a training")
    add("--camera-folder", metavar="NAME", help="such as image_2 [that of the training]")
    add("--nuscenes-version", metavar="NAME", help="such as v1.0-mini [that of the training]")
    add("--mode", choices=("offline", "streaming"), default="offline", help="streaming: past alone [%(default)s]")
    add("--estimate", choices=("mean", "strongest"), default="mean", help="what a mixture is reported by [%(default)s]")
    _add_common(model)
    return parser


def _add_common(parser: argparse.ArgumentParser) -> None:
    """Add what both subcommands take."""
    parser.add_argument("--output", required=True, type=Path, metavar="DIR", help="the files are written here")
    parser.add_argument("--force", action="store_true", help="overwrite files in --output")
    parser.add_argument("--block", type=int, default=100, metavar="N", help="frames in a bootstrap block [%(default)s]")


if __name__ == "__main__":
    raise SystemExit(exit_code(main))
