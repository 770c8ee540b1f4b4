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
    configuration.add_overrides(parser)
    options = parser.parse_args(arguments)
    config = configuration.apply_overrides(configuration.load_config(options.config), options)

    from mdnvo_jax import compilation
    from mdnvo_jax.training import loop

    compilation.keep_compiled()
    try:
        print(loop.train(config, Path(options.workdir), resume=options.resume))
    except loop.NonFiniteError as error:
        raise InputError(str(error)) from error
    except loop.Stopped as stopped:
        print(stopped)
        # As shells report a process that a signal ended.
        raise SystemExit(128 + stopped.signal_number) from None


if __name__ == "__main__":
    raise SystemExit(exit_code(main))
