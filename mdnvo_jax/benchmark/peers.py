"""Programs that we are measured against: an extra, never needed elsewhere."""

import importlib.util

from mdnvo_jax.benchmark.outcome import Outcome


def available(module: str, outcome: Outcome) -> bool:
    """Return whether a peer can be imported; where not, `outcome` gets a line that says what is left out and why."""
    try:
        found = importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        found = False
    if not found:
        outcome.line(f"{module} is not installed, so its rows are left out: pip install 'mdnvo_jax[bench]'")
    return found
