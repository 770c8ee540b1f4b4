"""Measure this machine: `bin/benchmark [--sections train predict ...] --output DIR`."""

import importlib
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from mdnvo_jax import files
from mdnvo_jax.errors import InputError, Parser, exit_code

SECTIONS = ("train", "predict", "mixture", "input", "start", "growth", "lstm", "options", "scaling")


def main(arguments: Sequence[str]) -> None:
    """Measure as the command line says.

    Raises:
      InputError: the arguments are unusable.
    """
    parser = Parser("benchmark", description="Measure this package on this machine, beside what one would use instead.")
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=SECTIONS, help="what to measure (all)")
    parser.add_argument("--output", default="benchmark", metavar="DIR", help="for benchmark.md and .json (benchmark)")
    parser.add_argument("--force", action="store_true", help="overwrite files in --output")
    parser.add_argument("--short", action="store_true", help="toy sizes: shows that everything runs, not how fast")
    parser.add_argument("--repeats", type=int, default=0, metavar="N", help="rounds of every comparison")
    parser.add_argument("--threads", type=int, default=0, metavar="N", help="cores to use (all that there are)")
    parser.add_argument(
        "--data", default="", metavar="FOLDER", help="pictures to predict from, such as KITTI's image_2"
    )
    options = parser.parse_args(arguments)
    if options.repeats < 0:
        raise InputError(f"--repeats is {options.repeats}: expected 1 or more")
    threads = _limit_threads(options.threads)
    output = files.claim_output(options.output, force=options.force)
    # Peers run on the processor, so we do; and what compiling costs shall not depend on an earlier run.
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
    if options.short:
        # Programs that run once or twice: to compile them well takes longer than it saves.
        quick = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {quick}"

    from mdnvo_jax.benchmark import machine
    from mdnvo_jax.benchmark.outcome import Settings
    from mdnvo_jax.benchmark.report import Report, printed
    from mdnvo_jax.evaluation.tables import as_text

    report = Report(output, machine.describe(threads), short=options.short)
    with tempfile.TemporaryDirectory(prefix="mdnvo-benchmark-") as folder:
        settings = Settings(Path(folder), threads, options.short, options.repeats, options.data)
        for name in dict.fromkeys(options.sections):
            load, began = machine.load_average(), time.monotonic()
            print(f"== {name} (load average {load})", flush=True)
            section = importlib.import_module(f"mdnvo_jax.benchmark.sections.{name}")
            outcome = section.measure(settings)
            report.add(name, outcome, {"load_average": load, "seconds": round(time.monotonic() - began, 1)})
            print(printed(outcome), flush=True)
    print(as_text(report.targets()))
    print(f"everything is in {output / 'benchmark.md'} and {output / 'benchmark.json'}")


def _limit_threads(wanted: int) -> int:
    """Keep this process and what it starts on as many cores as wanted (0: all), and return how many those are.

    Raises:
      InputError: there are not as many, or this system cannot do it.
    """
    from mdnvo_jax.benchmark.machine import usable_cores

    cores = usable_cores()
    if wanted in (0, cores):
        return cores
    if not 1 <= wanted <= cores:
        raise InputError(f"--threads is {wanted}: expected 1 to {cores}, the cores this process may use")
    if not hasattr(os, "sched_setaffinity"):
        raise InputError("--threads needs Linux: leave it out to use all cores")
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:wanted])
    return wanted


if __name__ == "__main__":
    raise SystemExit(exit_code(main))
