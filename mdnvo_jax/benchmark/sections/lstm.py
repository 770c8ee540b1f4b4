"""Section lstm: value and gradient of the stacked BiLSTM, beside `torch.nn.LSTM`."""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mdnvo_jax.benchmark import peers
from mdnvo_jax.benchmark.agreement import agree
from mdnvo_jax.benchmark.outcome import Outcome, Settings, compared
from mdnvo_jax.benchmark.timing import Contender, interleaved, ratio
from mdnvo_jax.evaluation.tables import Column, Row, Table
from mdnvo_jax.model.bilstm import LstmParams, bilstm, init_lstm

_ROUNDS = 21
_BUDGET_S = 40.0
# A peer that takes so many times as long as its own float32 form is not run again.
_HOPELESS = 3
_LAYERS = 2
# Batch and steps of a training batch.
_BATCH, _STEPS = 8, 6
OURS, TORCH, TORCH_BF16 = "ours, float32", "torch.nn.LSTM, float32", "torch.nn.LSTM, bf16 autocast"


def measure(settings: Settings) -> Outcome:
    """Measure the LSTM."""
    outcome = Outcome()
    has_torch = peers.available("torch", outcome)
    rows: list[Row] = []
    # Features of the paper's network at 608x184, and of its quarter at about 320x96.
    for features, hidden in [(24, 8)] if settings.short else [(1024, 1000), (30720, 1000)]:
        rows += _one(features, hidden, settings, outcome, has_torch)
    outcome.tables.append(
        Table(
            title=f"BiLSTM of {_LAYERS} layers, batch {_BATCH} x {_STEPS} steps: value and gradient to all parameters "
            "and the inputs",
            columns=[
                Column("size", "size"),
                Column("contender", "contender"),
                Column("ms", "ms", digits=1),
                Column("ratio", "time over ours", digits=2),
                Column("n", "rounds"),
            ],
            rows=rows,
            notes=["Outputs and gradients were asserted to agree to 1e-3 of their norm, those of bf16 to 0.05."],
        )
    )
    return outcome


def _one(features: int, hidden: int, settings: Settings, outcome: Outcome, has_torch: bool) -> list[Row]:
    """Return the rows of one size."""
    size = f"{features} inputs, {hidden} units"
    params = init_lstm(jax.random.key(0), features, hidden, _LAYERS)
    keys = jax.random.split(jax.random.key(1))
    inputs = jax.random.normal(keys[0], (_BATCH, _STEPS, features))
    weights = jax.random.normal(keys[1], (_BATCH, _STEPS, 2 * hidden))
    mask = jnp.ones((_BATCH, _STEPS), bool)

    @jax.jit
    def ours(params: LstmParams, inputs: jax.Array) -> Any:
        def value(params: LstmParams, inputs: jax.Array) -> jax.Array:
            return jnp.sum(bilstm(params, inputs, mask) * weights)

        return jax.value_and_grad(value, argnums=(0, 1))(params, inputs)

    contenders: dict[str, Contender] = {OURS: lambda: ours(params, inputs)}
    if has_torch:
        contenders |= _torch(params, inputs, weights, ours(params, inputs), settings, outcome, size)
    found = interleaved(contenders, settings.rounds(_ROUNDS), warm_up=2, budget_s=_BUDGET_S, least=5)
    outcome.times(f"lstm {size}", found)
    if TORCH in found:
        outcome.target("lstm", size, ratio(found[TORCH], found[OURS]))
    return [{"size": size, **compared(name, found, OURS)} for name in contenders]


def _torch(
    params: LstmParams,
    inputs: jax.Array,
    weights: jax.Array,
    ours: Any,
    settings: Settings,
    outcome: Outcome,
    size: str,
) -> dict[str, Contender]:
    """Return the peer's contenders, once they are shown to compute what we do."""
    import torch

    torch.set_num_threads(settings.threads)
    features, hidden = inputs.shape[-1], weights.shape[-1] // 2
    lstm = torch.nn.LSTM(features, hidden, _LAYERS, batch_first=True, bidirectional=True)
    named = dict(lstm.named_parameters())
    # Name of torch's parameter -> where ours is, and whether it is transposed. Its second bias stays zero: we have one.
    places = {
        f"{theirs}_l{layer}{end}": (f"layer{layer}", direction, mine)
        for layer in range(_LAYERS)
        for direction, end in (("forward", ""), ("backward", "_reverse"))
        for theirs, mine in (("weight_ih", "input_kernel"), ("weight_hh", "recurrent_kernel"), ("bias_ih", "bias"))
    }
    with torch.no_grad():
        for name, parameter in named.items():
            if name in places:
                layer, direction, mine = places[name]
                parameter.copy_(torch.from_numpy(np.array(params[layer][direction][mine]).T))
            else:
                parameter.zero_().requires_grad_(False)
    given = torch.from_numpy(np.array(inputs)).requires_grad_()
    cotangent = torch.from_numpy(np.array(weights))

    def run(autocast: bool) -> Any:
        lstm.zero_grad(set_to_none=True)
        given.grad = None
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            outputs, _ = lstm(given)
        value = (outputs.float() * cotangent).sum()
        value.backward()
        return value.detach()

    value, (gradient, to_inputs) = ours
    took = {}
    for name, autocast, tolerance in ((TORCH, False, 1e-3), (TORCH_BF16, True, 0.05)):
        began = time.perf_counter()
        theirs = run(autocast)
        took[name] = time.perf_counter() - began
        agree("value", value, theirs, tolerance)
        found = [agree("gradient to the inputs", to_inputs, given.grad.numpy(), tolerance)]
        for parameter, (layer, direction, mine) in places.items():
            slope = named[parameter].grad.numpy().T
            found.append(agree(f"gradient of {parameter}", gradient[layer][direction][mine], slope, tolerance))
        outcome.agreement[f"lstm {size}: gradients, {name}"] = max(found)
    contenders: dict[str, Contender] = {TORCH: lambda: run(False), TORCH_BF16: lambda: run(True)}
    if took[TORCH_BF16] > _HOPELESS * took[TORCH]:
        del contenders[TORCH_BF16]
        outcome.left_out(size, TORCH_BF16, took[TORCH_BF16], TORCH, took[TORCH])
    return contenders
