"""benchmark.md and benchmark.json: written anew after every section, so that an interrupted run keeps what it has."""

import json
from pathlib import Path
from typing import Any

from mdnvo_jax import files
from mdnvo_jax.benchmark import targets
from mdnvo_jax.benchmark.outcome import Outcome
from mdnvo_jax.benchmark.timing import RATIO
from mdnvo_jax.evaluation.tables import Table, as_data, as_markdown, as_text, finite


class Report:
    """The two files of a run in `output`."""

    def __init__(self, output: Path, machine: dict[str, Any], *, short: bool) -> None:
        self._output, self._machine, self._short = output, machine, short
        self._sections: dict[str, tuple[Outcome, dict[str, Any]]] = {}

    def add(self, name: str, outcome: Outcome, about: dict[str, Any]) -> None:
        """Take in a finished section with its load average and duration, and write both files."""
        self._sections[name] = (outcome, about)
        files.write_text(self._output / "benchmark.md", self._markdown())
        files.write_text(self._output / "benchmark.json", json.dumps(finite(self._data()), indent=1) + "\n")

    def targets(self) -> Table:
        """Return the table of targets as far as sections have been measured."""
        measured: dict[str, list[Any]] = {}
        for outcome, _ in self._sections.values():
            for key, found in outcome.targets.items():
                measured.setdefault(key, []).extend(found)
        return targets.table(measured, short=self._short)

    def _markdown(self) -> str:
        machine = self._machine
        lines = ["# Benchmark", ""]
        if self._short:
            lines += ["Short form: toy sizes, hardly any repeats. It shows that everything runs, not how fast.", ""]
        lines += [
            f"- {machine['date']}: `{machine['command']}`",
            f"- {machine['processor']} (family, model, stepping {machine['processor_family_model_stepping']}), "
            f"{machine['cores']} cores, {machine['threads']} threads for every contender, {machine['memory_gb']} GB",
            f"- has {', '.join(machine['flags']) or 'none of the flags looked for'}; "
            f"lacks {', '.join(machine['flags_missing']) or 'none'}",
            f"- {', '.join(f'{name} {version}' for name, version in machine['versions'].items())}",
            f"- Contenders take turns within one process. {RATIO} Every other figure: median [quartiles].",
            "",
        ]
        for name, (outcome, about) in self._sections.items():
            load = "" if about["load_average"] is None else f"; load average at its start {about['load_average']}"
            lines += [f"## {name}", "", f"Took {about['seconds']} s{load}.", ""]
            lines += [as_markdown(table) for table in outcome.tables]
            lines += [*(f"- {line}" for line in outcome.lines), *([""] if outcome.lines else [])]
        return "\n".join([*lines, "## targets", "", as_markdown(self.targets())])

    def _data(self) -> dict[str, Any]:
        return {
            "machine": self._machine,
            "short": self._short,
            "ratio": RATIO,
            "sections": {
                name: {
                    **about,
                    "tables": [as_data(table) for table in outcome.tables],
                    "lines": outcome.lines,
                    "agreement": outcome.agreement,
                    "seconds": outcome.seconds,
                }
                for name, (outcome, about) in self._sections.items()
            },
            "targets": as_data(self.targets()),
        }


def printed(outcome: Outcome) -> str:
    """Return a section as plain text for a terminal."""
    return "\n".join([*(as_text(table) for table in outcome.tables), *outcome.lines])
