"""Judge poses, and how sure they are: `python -m mdnvo_jax.evaluate trajectory|model|recalibrate|paper ...`."""

import importlib
from collections.abc import Sequence
from pathlib import Path

from mdnvo_jax import files
from mdnvo_jax.errors import exit_code
from mdnvo_jax.evaluation import commands


def main(arguments: Sequence[str]) -> None:
    """Evaluate as the command line says."""
    options = commands.parser().parse_args(arguments)
    if options.what == "recalibrate":
        from mdnvo_jax.evaluation import recalibrate, tables

        table, path = recalibrate.run(options)
        print(f"{tables.as_text(table)}\n{path}: predict and evaluate apply it from now on (--no-recalibration: not)")
        return
    output = files.claim_output(options.output or Path(f"paper-{options.dataset}"), force=options.force)

    from mdnvo_jax.evaluation import report

    home = {"trajectory": "compare", "model": "model", "paper": "paper"}[options.what]
    found = importlib.import_module(f"mdnvo_jax.evaluation.{home}").from_options(options)
    written = report.write(found, output)
    print(report.as_text(found))
    print(f"{len(written)} files in {output}: {', '.join(written)}")


if __name__ == "__main__":
    raise SystemExit(exit_code(main))
