"""The options of `python -m mdnvo_jax.evaluate`. Imports nothing heavy, so that --help answers at once."""

import argparse
from pathlib import Path

from mdnvo_jax.errors import Parser

# Repeated here from what they belong to, since importing that takes longer than --help may.
ALIGNMENTS = ("none", "scale", "se3", "sim3")
FORMATS = ("kitti", "indexed", "tum", "euroc", "output")


def parser() -> Parser:
    """Return the parser of all subcommands."""
    whole = Parser("python -m mdnvo_jax.evaluate", description="Measure poses, and how sure they are, against truth.")
    subcommands = whole.add_subparsers(dest="what", required=True, metavar="{trajectory,model,recalibrate,paper}")

    files_help = "judge files of poses, made by anything"
    trajectory = subcommands.add_parser("trajectory", help=files_help, description=files_help)
    add = trajectory.add_argument
    add("estimates", nargs="+", metavar="ESTIMATE", help="KITTI, frame number + KITTI, TUM, EuRoC csv, or our folders")
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
    add("--checkpoint", metavar="DIR", help="the --workdir of a training [the weights of the package]")
    add("--camera-folder", metavar="NAME", help="such as image_2 [that of the training]")
    add("--nuscenes-version", metavar="NAME", help="such as v1.0-mini [that of the training]")
    height_help = "of its camera above the road, synthetic: of all worlds' cameras [that of the training]"
    add("--camera-height", type=float, metavar="METRES", help=height_help)
    add("--other-lenses", action="store_true", help="synthetic: a focal length and principal point of its own a world")
    add("--sway", action="store_true", help="turn each frame by some tenths of a degree, as a camera on a bad mount")
    add("--mode", choices=("offline", "streaming"), default="offline", help="streaming: past alone [%(default)s]")
    add("--estimate", choices=("mean", "strongest"), default="mean", help="what a mixture is reported by [%(default)s]")
    add("--scale-sigma", type=float, metavar="SHARE", help="1-sigma error of each path's scale [fitted, or 0]")
    add("--no-recalibration", action="store_true", help="sigmas as the network gave them")
    reference_help = "1 sigma of the reference's own errors in a step, m and deg: steps are judged as seen through them"
    six = ("TX", "TY", "TZ", "RX", "RY", "RZ")
    add("--reference-sigma", type=float, nargs=6, metavar=six, help=reference_help)
    _add_common(model)
    _add_recalibrate(subcommands)
    _add_paper(subcommands)
    return whole


def _add_recalibrate(subcommands: "argparse._SubParsersAction[Parser]") -> None:
    """Add the subcommand that fits a sigma scale."""
    fit_help = "fit sigmas, and errors that steps share, on the training's own validation split, for predict to apply"
    add = subcommands.add_parser("recalibrate", help=fit_help, description=fit_help).add_argument
    add("--checkpoint", required=True, metavar="DIR", help="the --workdir of a training; the factors are kept in it")
    add("--root", metavar="DIR", help="the folder of the training's data set [where the training found it]")
    add("--cache", metavar="DIR", help="its cache of prepared frames [with --root: none; else that of the training]")
    add("--mode", choices=("offline", "streaming"), default="offline", help="predict as this does [%(default)s]")
    widen_help = (
        "factors of 1 or more alone: for weights that will see other roads than the split's, which err more there"
    )
    add("--widen-only", action="store_true", help=widen_help)
    add("--force", action="store_true", help="overwrite factors that are there")


def _add_paper(subcommands: "argparse._SubParsersAction[Parser]") -> None:
    """Add the subcommand that makes the paper's tables and figures."""
    paper_help = "the paper's table and figures of a data set, with as much of it as is there"
    paper = subcommands.add_parser("paper", help=paper_help, description=paper_help)
    add = paper.add_argument
    add("--dataset", choices=("kitti", "nuscenes"), required=True, help="Table I, or Table II")
    add("--root", required=True, metavar="DIR", help="the folder of the data set")
    add("--mdn", metavar="DIR", help="checkpoint of MDN-VO: the --workdir of its training")
    add("--deepvo", metavar="DIR", help="checkpoint of DeepVO, such as configs/deepvo_kitti.py makes")
    add("--orbslam", metavar="DIR", help="holds a folder of mdnvo_jax.baselines.orbslam for each sequence, by name")
    add("--camera-folder", metavar="NAME", help="of KITTI, such as image_2 [that of the training]")
    add("--nuscenes-version", metavar="NAME", help="such as v1.0-mini [that of the training, or v1.0-trainval]")
    add("--scene", default="scene-0768", metavar="NAME", help="of nuScenes, for the uncertainty figure [%(default)s]")
    _add_common(paper, needs_output=False)


def _add_common(parser: argparse.ArgumentParser, *, needs_output: bool = True) -> None:
    """Add what every subcommand that writes a report takes."""
    default = "" if needs_output else " [paper-DATASET]"
    parser.add_argument(
        "--output", required=needs_output, type=Path, metavar="DIR", help=f"the files are written here{default}"
    )
    parser.add_argument("--force", action="store_true", help="overwrite files in --output")
    parser.add_argument("--block", type=int, default=100, metavar="N", help="frames in a bootstrap block [%(default)s]")
