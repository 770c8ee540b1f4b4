"""Section train: steps a second of the real training step, beside the twin in PyTorch."""

import functools
import time
from typing import Any, Literal

import jax
import numpy as np

from mdnvo_jax.benchmark import material, peers
from mdnvo_jax.benchmark.agreement import agree, agree_all
from mdnvo_jax.benchmark.our_training import OurTraining
from mdnvo_jax.benchmark.outcome import Outcome, Settings, compared
from mdnvo_jax.benchmark.timing import Contender, interleaved, rate, ratio, seconds
from mdnvo_jax.config import Config
from mdnvo_jax.evaluation.tables import Column, Row, Table, Value
from mdnvo_jax.model.conv import LAYERS
from mdnvo_jax.training.state import State

_ROUNDS = 9
# For one size: a slow machine gets fewer rounds, never a smaller batch.
_BUDGET_S = 45.0
# Windows by which the layout of PyTorch's tensors is chosen.
_PROBED = 2
OURS, MIXED, TORCH, TORCH_BF16 = "ours, float32", "ours, mixed", "PyTorch, float32", "PyTorch, bf16 autocast"
# Relative difference of gradients, from one layout of torch to its other one: up to 6e-3.
_GRADIENT_TOLERANCE = 2e-2
# bf16 has 8 bits, and nine layers add them up.
_BF16_TOLERANCE = 0.3


def measure(settings: Settings) -> Outcome:
    """Measure training steps."""
    outcome = Outcome()
    has_torch = peers.available("torch", outcome)
    rows: list[Row] = []
    if settings.short:
        # Three windows: with two, a unit lies so near the kink of its LeakyReLU that rounding changes the gradient.
        configs = [material.paper_config(16, 32, 1 / 32, batch=3, window=2)]
    else:
        configs = [material.paper_config(h, w, m) for h, w in ((96, 320), (184, 608)) for m in (0.25, 1.0)]
    for config in configs:
        rows += _one(config, settings, outcome, has_torch)
    batch = f"batch {configs[0].training.batch_size} x window {configs[0].data.window}"
    outcome.tables.append(
        Table(
            title=f"Training step of configs/mdn_vo_kitti.py, {batch}, dropout on",
            columns=[
                Column("size", "size"),
                Column("contender", "contender"),
                Column("rate", "steps/s", digits=3),
                Column("ms", "ms a step", digits=1),
                Column("ratio", "time over ours, float32", digits=2),
                Column("first", "first step, s", digits=1),
                Column("n", "rounds"),
            ],
            rows=rows,
            notes=[
                "Width multiplies the channels of the stack and the units of the LSTM.",
                "First step: with compilation for ours; for PyTorch its first forward and backward pass.",
                "Dropout is on in all; each side draws its own random numbers. Before, with dropout off, loss, "
                "gradient and parameters after a step of Adam were asserted to agree (gradients to "
                f"{_GRADIENT_TOLERANCE:g} of their norm, bf16 to {_BF16_TOLERANCE:g}).",
                "Ours also computes the metrics of the training log: norms of update and parameters, sigmas.",
                "PyTorch: eager, oneDNN, the faster of channels_last and contiguous, Adam(fused=True), "
                "clip_grad_norm_; autocast for the stack, LSTM and head in float32.",
            ],
        )
    )
    return outcome


def _one(config: Config, settings: Settings, outcome: Outcome, has_torch: bool) -> list[Row]:
    """Return the rows of one size."""
    size = material.described(config)
    ours = OurTraining(config)
    contenders: dict[str, Contender] = {}
    first: dict[str, float] = {}
    moments: dict[str, list[jax.Array]] = {}
    variants: tuple[tuple[str, Literal["float32", "mixed"]], ...] = ((OURS, "float32"), (MIXED, "mixed"))
    for name, products in variants:
        if settings.short and name != OURS:
            outcome.line("short form: the mixed step is left out, for it compiles as long as the other")
            continue
        began = time.perf_counter()
        contenders[name] = ours.contender(ours.compiled(material.with_products(config, products)))
        compiling = time.perf_counter() - began
        ours.state = ours.fresh()
        first[name] = compiling + seconds(contenders[name])
        moments[name] = jax.tree.leaves(_moment(ours.state))
    if MIXED in contenders:
        # From one state, the same dropout is drawn: both find one gradient.
        pairs = list(zip(moments[MIXED], moments[OURS], strict=True))
        found = agree_all("gradient, mixed", pairs, _BF16_TOLERANCE)
        outcome.agreement[f"train {size}: gradient, mixed"] = found
        if not found:
            outcome.line(f"{size}: the mixed step gave the bits of the float32 step, so on this machine they are one")
    del moments
    if has_torch:
        _add_torch(ours, config, settings, outcome, contenders, first)
    # All of them took a step already.
    times = interleaved(contenders, settings.rounds(_ROUNDS), warm_up=0, budget_s=_BUDGET_S)
    outcome.times(f"train {size}", times)
    if TORCH in times:
        outcome.target("train float32", size, ratio(times[TORCH], times[OURS]))
        if MIXED in times:
            outcome.target("train mixed", size, ratio(times[TORCH], times[MIXED]))
    return [
        {
            "size": size,
            **compared(name, times, OURS),
            "rate": rate(times[name], 1),
            "first": Value(first[name]),
        }
        for name in contenders
    ]


def _moment(state: State) -> Any:
    """Return Adam's first moment, which after one step is a tenth of the clipped gradient."""
    moments = [leaf.mu for leaf in jax.tree.leaves(state.optimiser, is_leaf=_is_adam) if _is_adam(leaf)]
    return moments[0]


def _is_adam(node: Any) -> bool:
    return hasattr(node, "mu") and hasattr(node, "nu")


def _add_torch(
    ours: OurTraining,
    config: Config,
    settings: Settings,
    outcome: Outcome,
    contenders: dict[str, Contender],
    first: dict[str, float],
) -> None:
    """Add the twin's contenders, once it is shown to compute what we do."""
    import torch

    from mdnvo_jax.benchmark import torch_twin

    torch.set_num_threads(settings.threads)
    size, calm = material.described(config), material.without_dropout(config)
    ours.state = ours.fresh()
    images = torch.from_numpy(np.array(ours.batch["images"]))
    steps = torch.from_numpy(np.array(ours.batch["steps"]))

    def trainer(layout: torch_twin.Layout) -> torch_twin.Trainer:
        twin = torch_twin.Twin(config, layout)
        torch_twin.copy_weights(twin, ours.state.model.params, ours.state.model.batch_stats)
        return torch_twin.Trainer(twin, config, material.LABELS)

    layouts: tuple[torch_twin.Layout, ...] = ("channels_last", "contiguous")
    probes = {}
    for layout in layouts:
        candidate = functools.partial(trainer(layout).gradient, images[:_PROBED], steps[:_PROBED])
        probes[layout] = min(seconds(candidate) for _ in range(2))
        del candidate
    layout = min(layouts, key=lambda name: probes[name])
    outcome.line(
        f"{size}: on {_PROBED} windows, PyTorch's forward and backward in float32 took "
        + ", ".join(f"{value * 1e3:.0f} ms {name}" for name, value in probes.items())
        + f"; {layout} was taken"
    )
    peer = trainer(layout)
    first |= assert_same_step(ours, peer, calm, images, steps, outcome)
    peer.set_dropout(config)
    contenders[TORCH] = lambda: peer.step(images, steps)
    contenders[TORCH_BF16] = lambda: peer.step(images, steps, autocast=True)


def assert_same_step(
    ours: OurTraining, peer: Any, calm: Config, images: Any, steps: Any, outcome: Outcome
) -> dict[str, float]:
    """Assert that one step without dropout finds the same loss, gradient, statistics and parameters on both sides.

    Returns the seconds of the twin's first forward and backward pass, by contender.

    Adam's first step moves every parameter by the sign of its gradient, however small: so its rule is compared on one
    gradient, ours, which leaves the twin with our parameters.
    """
    import torch

    from mdnvo_jax.benchmark.torch_twin import torch_layout

    size = material.described(ours.config)
    ours.state, metrics = ours.compiled(calm)(ours.state, ours.batch)
    peer.set_dropout(calm)
    first, began = {}, time.perf_counter()
    found = peer.gradient(images, steps, autocast=True)
    first[TORCH_BF16] = time.perf_counter() - began
    outcome.agreement[f"train {size}: loss, PyTorch bf16"] = agree(
        "loss, bf16", metrics["loss"], found, _BF16_TOLERANCE
    )
    for block in peer.twin.stack:
        block.norm.reset_running_stats()
    began = time.perf_counter()
    found = peer.gradient(images, steps)
    first[TORCH] = time.perf_counter() - began
    outcome.agreement[f"train {size}: loss"] = agree("loss", metrics["loss"], found, 1e-3)
    clip = ours.config.training.gradient_clip
    share = min(1.0, clip / float(metrics["gradient_norm"])) if clip else 1.0
    gradient = {name: values * np.float32(10 / share) for name, values in torch_layout(_moment(ours.state)).items()}
    named = {name: parameter for name, parameter in peer.twin.named_parameters() if parameter.requires_grad}
    pairs = [(values, named[name].grad.numpy()) for name, values in gradient.items()]
    outcome.agreement[f"train {size}: gradient"] = agree_all("gradient", pairs, _GRADIENT_TOLERANCE)
    outcome.agreement[f"train {size}: gradient, worst parameter"] = max(
        agree("a parameter's gradient", values, grad, 5 * _GRADIENT_TOLERANCE) for values, grad in pairs
    )
    for name, values in gradient.items():
        # Copied, so that it keeps the layout of its parameter: fused Adam relies on that.
        named[name].grad.copy_(torch.from_numpy(np.array(values)))
    peer.update()
    parameters = torch_layout(ours.state.model.params)
    outcome.agreement[f"train {size}: parameters after a step of Adam"] = max(
        agree(f"{name} after a step", values, named[name].detach().numpy(), 1e-4) for name, values in parameters.items()
    )
    statistics = ours.state.model.batch_stats["stack"]
    for layer, block in zip(LAYERS, peer.twin.stack, strict=True):
        mine = statistics[layer.name]
        agree("running mean", mine["mean"], block.norm.running_mean.numpy(), 1e-3)
        agree("running variance", mine["var"], block.norm.running_var.numpy(), 1e-3)
    return first
