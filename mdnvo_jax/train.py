"""Train a network: `python -m mdnvo_jax.train CONFIG --workdir DIR`."""

from collections.abc import Sequence
from pathlib import Path

from mdnvo_jax import config as configuration
from mdnvo_jax.errors import InputError, Parser, exit_code


def main(arguments: Sequence[str]) -> None:
    """Train as the command line says."""
    parser = Parser("python -m mdnvo_jax.train", description="Train a network and leave everything in a folder.")
    parser.add_argument("config", metavar="CONFIG", help="a Python file that assigns `config`, see configs/")
    parser.add_argument("--workdir", required=True, metavar="DIR", help="checkpoints, metrics and logs go here")
    parser.add_argument("--resume", action="store_true", help="go on from the newest checkpoint in --workdir")
    _add_processes(parser)
    configuration.add_overrides(parser)
    options = parser.parse_args(arguments)
    config = configuration.apply_overrides(configuration.load_config(options.config), options)

    from mdnvo_jax import compilation
    from mdnvo_jax.training import loop, processes

    processes.join(options)
    compilation.keep_compiled()
    try:
        summary = loop.train(config, Path(options.workdir), resume=options.resume)
        if processes.leads():
            print(summary)
    except (loop.NonFiniteError, loop.DiskError) as error:
        raise InputError(str(error)) from error
    except loop.Stopped as stopped:
        print(stopped)
        # As shells report a process that a signal ended.
        raise SystemExit(128 + stopped.signal_number) from None


def _add_processes(parser: Parser) -> None:
    """Add the options by which a process finds those that train with it; see `mdnvo_jax.training.processes`."""
    add = parser.add_argument_group(
        "several processes, on one host or many, each started with this command"
    ).add_argument
    add("--cluster", action="store_true", help="let JAX find them: Slurm, Open MPI, Cloud TPU, GKE")
    add("--coordinator", metavar="HOST:PORT", help="where process 0 listens; with the next two")
    add("--processes", type=int, metavar="N", help="how many there are")
    add("--process", type=int, metavar="I", help="the number of this one, from 0")
    add(
        "--lost-after",
        type=int,
        default=100,
        metavar="S",
        help="seconds of silence that mean one is gone [%(default)s]",
    )


if __name__ == "__main__":
    raise SystemExit(exit_code(main))
