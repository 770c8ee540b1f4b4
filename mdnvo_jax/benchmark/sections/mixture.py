"""Section mixture: the NLL with its gradient, beside torch.distributions and numpyro."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from mdnvo_jax import mixture
from mdnvo_jax.benchmark import peers
from mdnvo_jax.benchmark.agreement import agree
from mdnvo_jax.benchmark.outcome import Outcome, Settings, compared
from mdnvo_jax.benchmark.timing import Contender, fastest, interleaved, ratio
from mdnvo_jax.evaluation.tables import Column, Row, Table
from mdnvo_jax.mixture import Mixture

_ROUNDS = 31
_DIMENSIONS = 6
_TOLERANCE = 1e-4
OURS, TORCH, NUMPYRO = "ours, joint", "torch.distributions", "numpyro"

# Value and gradients to logits, mean, log_scale.
Result = tuple[Any, tuple[Any, Any, Any]]


def measure(settings: Settings) -> Outcome:
    """Measure the negative log-likelihood."""
    outcome = Outcome()
    found = [module for module in ("torch", "numpyro") if peers.available(module, outcome)]
    count = 500 if settings.short else 100_000
    rows: list[Row] = []
    for components in [3] if settings.short else [3, 5, 10]:
        rows += _one(count, components, found, settings, outcome)
    outcome.tables.append(
        Table(
            title=f"Mean NLL of {count:,} steps in {_DIMENSIONS} dimensions: value and gradient to logits, mean and "
            "log-scale",
            columns=[
                Column("size", "components"),
                Column("contender", "contender"),
                Column("ms", "ms", digits=2),
                Column("ratio", "time over ours, joint", digits=2),
                Column("n", "rounds"),
            ],
            rows=rows,
            notes=[
                "Peers: MixtureSameFamily of Categorical and Independent(Normal), without checks of arguments; numpyro "
                "under jit. That is our coupling `joint`; `independent` is the paper's, which neither peer has.",
                f"Value and gradients were asserted to agree to {_TOLERANCE:g} of their norm.",
            ],
        )
    )
    return outcome


def _one(count: int, components: int, found: list[str], settings: Settings, outcome: Outcome) -> list[Row]:
    """Return the rows of one number of components."""
    size = f"M = {components}"
    rng = np.random.default_rng(components)
    shape = (count, components, _DIMENSIONS)
    logits, mean, log_scale = (jax.numpy.asarray(rng.normal(size=s), "float32") for s in (shape[:2], shape, shape))
    given = Mixture(logits, mean, 0.3 * log_scale)
    value = rng.normal(size=(count, _DIMENSIONS)).astype(np.float32)
    runs: dict[str, Callable[[], Result]] = {OURS: _ours(given, value, "joint")}
    if "torch" in found:
        runs[TORCH] = _torch(given, value, settings)
    if "numpyro" in found:
        runs[NUMPYRO] = _numpyro(given, value)
    expected = runs[OURS]()
    for name, run in runs.items():
        theirs = run()
        differences = [agree(f"NLL, {name}", expected[0], theirs[0], _TOLERANCE)]
        for what, a, b in zip(Mixture._fields, expected[1], theirs[1], strict=True):
            differences.append(agree(f"gradient to {what}, {name}", a, b, _TOLERANCE))
        outcome.agreement[f"mixture {size}: {name}"] = max(differences)
    contenders: dict[str, Contender] = {**runs, "ours, independent": _ours(given, value, "independent")}
    times = interleaved(contenders, settings.rounds(_ROUNDS), warm_up=2, budget_s=30)
    outcome.times(f"mixture {size}", times)
    rivals = [name for name in (TORCH, NUMPYRO) if name in times]
    if rivals:
        rival = fastest(times, rivals)
        outcome.target("mixture", f"{size}, {rival}", ratio(times[rival], times[OURS]))
    return [{"size": size, **compared(name, times, OURS)} for name in contenders]


def _ours(given: Mixture, value: np.ndarray, coupling: mixture.Coupling) -> Callable[[], Result]:
    """Return our value and gradient."""

    @jax.jit
    def run(given: Mixture, value: jax.Array) -> Any:
        return jax.value_and_grad(lambda m: mixture.nll(m, value, coupling=coupling))(given)

    steps = jax.numpy.asarray(value)
    return lambda: run(given, steps)


def _numpyro(given: Mixture, value: np.ndarray) -> Callable[[], Result]:
    """Return numpyro's value and gradient, compiled."""
    import numpyro.distributions as dist

    def loss(given: Mixture, value: jax.Array) -> jax.Array:
        parts = dist.Normal(given.mean, jax.numpy.exp(given.log_scale)).to_event(1)
        family = dist.MixtureSameFamily(dist.Categorical(logits=given.logits), parts)
        return -family.log_prob(value).mean()

    run = jax.jit(jax.value_and_grad(loss))
    steps = jax.numpy.asarray(value)
    return lambda: run(given, steps)


def _torch(given: Mixture, value: np.ndarray, settings: Settings) -> Callable[[], Result]:
    """Return torch's value and gradient."""
    import torch
    from torch import distributions as dist

    torch.set_num_threads(settings.threads)
    leaves = [torch.from_numpy(np.array(leaf)).requires_grad_() for leaf in given]
    steps = torch.from_numpy(value)

    def run() -> Result:
        for leaf in leaves:
            leaf.grad = None
        logits, mean, log_scale = leaves
        parts = dist.Independent(dist.Normal(mean, log_scale.exp(), validate_args=False), 1, validate_args=False)
        weights = dist.Categorical(logits=logits, validate_args=False)
        family = dist.MixtureSameFamily(weights, parts, validate_args=False)
        loss = -family.log_prob(steps).mean()
        loss.backward()
        to_logits, to_mean, to_log_scale = (leaf.grad for leaf in leaves)
        return loss.detach(), (to_logits, to_mean, to_log_scale)

    return run
