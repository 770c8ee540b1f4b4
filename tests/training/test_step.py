"""The train step: it learns, its schedule is PyTorch's, its sums add up, and devices do not change its result."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnvo_jax import mixture
from mdnvo_jax.config import Config, DataConfig, ImageConfig, ModelConfig, TrainingConfig
from mdnvo_jax.model.head import Labels
from mdnvo_jax.model.network import build
from mdnvo_jax.training import step
from mdnvo_jax.training.state import (
    SKIPPED,
    TRAIN_METRICS,
    State,
    initial_state,
    initial_variables,
    make_optimiser,
    make_plateau,
    schedule_scale,
)

CONFIG = Config(
    image=ImageConfig(height=32, width=64, channels=1),
    model=ModelConfig(width=1 / 16, lstm_hidden=8, lstm_layers=1, components=2),
    data=DataConfig(window=3),
    training=TrainingConfig(batch_size=4, learning_rate=3e-3),
)
LABELS = Labels(np.array([0, 0, 1, 0, 0, 0.0]), np.array([0.02, 0.02, 0.5, 0.005, 0.02, 0.005]))


def with_(config: Config, **sections: dict) -> Config:
    from dataclasses import replace

    return replace(config, **{name: replace(getattr(config, name), **fields) for name, fields in sections.items()})


def first_state(config: Config) -> State:
    return initial_state(initial_variables(build(config.image, config.model), config), config, LABELS)


def make_batch(seed: int = 0, batch: int = 4) -> step.Batch:
    """Random frames; the labels are a function of them, so that there is something to learn."""
    generator = np.random.default_rng(seed)
    images = generator.integers(0, 256, (batch, 4, 32, 64, 1), dtype=np.uint8)
    images = (images * np.linspace(0.3, 1, batch)[:, None, None, None, None]).astype(np.uint8)
    strength = images[:, 1:].mean((2, 3, 4)) / 128 - 0.6
    steps = np.asarray(LABELS.mean + LABELS.std * strength[..., None], np.float32)
    mask = np.ones((batch, 3), bool)
    mask[0, 2] = False
    return {"images": jnp.asarray(images), "steps": jnp.asarray(steps), "mask": jnp.asarray(mask)}


Step = Callable[[State, step.Batch], tuple[State, step.Metrics]]


def compiled(config: Config) -> Step:
    return jax.jit(step.bind(step.train_step, build(config.image, config.model), config))


@pytest.fixture(scope="module")
def mixture_step() -> Step:
    """The step of `CONFIG`, compiled once."""
    return compiled(CONFIG)


@pytest.mark.parametrize("head", ["mixture", "regression"])
def test_training_on_one_batch_learns_it(mixture_step: Step, head: str) -> None:
    config = with_(CONFIG, model={"head": head})
    state = first_state(config)
    batch = make_batch()
    train_step = mixture_step if head == "mixture" else compiled(config)
    losses = []
    for _ in range(40):
        state, metrics = train_step(state, batch)
        losses.append(float(metrics["loss"]))
    assert int(state.step) == 40
    if head == "mixture":
        assert np.mean(losses[-5:]) < losses[0] - 2
    else:
        assert np.mean(losses[-5:]) < 0.5 * losses[0]
    for name in TRAIN_METRICS:
        assert np.isfinite(metrics[name])
    np.testing.assert_allclose(state.sums["loss"], sum(losses), rtol=1e-4)


class Linear:
    """A network whose outputs are its parameter times the brightness of a frame: it compiles in no time."""

    def apply(self, variables, images, mask, **_):
        brightness = images[:, 1:].mean((2, 3, 4))[..., None] / 255
        outputs = brightness * variables["params"]["head"]
        return (outputs, None), {"batch_stats": {"mean": brightness.mean()}}


def full_batch(seed: int = 0) -> step.Batch:
    """A batch without padding, in which every part of equal size weighs the same."""
    batch = make_batch(seed)
    return {**batch, "mask": jnp.ones_like(batch["mask"])}


def linear_state(config: Config) -> State:
    size = mixture.outputs_size(config.model.components)
    variables = {"params": {"head": jnp.linspace(-0.2, 0.3, size)}, "batch_stats": {"mean": jnp.zeros(())}}
    return initial_state(variables, config, LABELS)


def test_a_step_that_is_not_finite_is_skipped_and_counted() -> None:
    config = with_(CONFIG, training={"skip_nonfinite": 2})
    good, bad = make_batch(), make_batch()
    bad["steps"] = bad["steps"].at[1, 0, 3].set(jnp.nan)
    train_step = jax.jit(step.bind(step.train_step, Linear(), config))
    before, metrics = train_step(linear_state(config), good)
    assert metrics[SKIPPED] == 0
    after, metrics = train_step(before, bad)
    assert not np.isfinite(metrics["loss"]) and metrics[SKIPPED] == 1
    counted = before._replace(step=before.step + 1, sums={**before.sums, SKIPPED: 1.0})
    jax.tree.map(np.testing.assert_array_equal, after, counted)
    # Training goes on from there, and the sums are those of the steps that counted.
    later, metrics = train_step(after, good)
    assert np.isfinite(metrics["loss"]) and metrics[SKIPPED] == 1
    np.testing.assert_allclose(later.sums["loss"], before.sums["loss"] + metrics["loss"], rtol=1e-6)
    assert (later.model.params["head"] != before.model.params["head"]).any()
    # Without the option nothing is hidden: whoever looks at the metrics stops.
    spoilt, metrics = jax.jit(step.bind(step.train_step, Linear(), CONFIG))(before, bad)
    assert metrics[SKIPPED] == 0 and np.isnan(spoilt.model.params["head"]).any()


def test_every_step_draws_its_own_dropout_and_the_same_one_again(mixture_step: Step) -> None:
    state = first_state(CONFIG)
    _, first = mixture_step(state, make_batch())
    _, second = mixture_step(state._replace(step=state.step + 1), make_batch())
    _, again = mixture_step(state, make_batch())
    assert first["loss"] != second["loss"]
    assert first["loss"] == again["loss"]


def test_clipping_bounds_the_gradient_that_adam_sees() -> None:
    moments = []
    for clip in (0.0, 1e-3):
        config = with_(CONFIG, training={"gradient_clip": clip})
        state, metrics = jax.jit(step.bind(step.train_step, Linear(), config))(linear_state(config), make_batch())
        first_moments = [
            leaf for path, leaf in jax.tree.leaves_with_path(state.optimiser) if ".mu" in jax.tree_util.keystr(path)
        ]
        moments.append(float(jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in first_moments))))
    assert float(metrics["gradient_norm"]) > 1e-2
    # Adam's first moment after one step is (1 - beta1) times the gradient.
    np.testing.assert_allclose(moments[1], 0.1 * 1e-3, rtol=1e-3)
    np.testing.assert_allclose(moments[0], 0.1 * float(metrics["gradient_norm"]), rtol=1e-3)


def test_validation_does_not_see_padding() -> None:
    network = build(CONFIG.image, CONFIG.model)
    model = first_state(CONFIG).model
    validate = jax.jit(step.bind(step.validation_step, network, CONFIG))
    batch = make_batch()
    whole = validate(model, batch)
    # The same windows in two batches, filled up with windows that do not count.
    padded = []
    for rows, count in (([0, 1, 2, 2], 3), ([3, 0, 0, 0], 1)):
        part = {name: value[jnp.array(rows)] for name, value in batch.items()}
        padded.append({**part, "mask": part["mask"].at[count:].set(False)})
    sums = jax.tree.map(jnp.add, *[validate(model, part) for part in padded])
    for name, value in step.validation_metrics(whole).items():
        np.testing.assert_allclose(step.validation_metrics(sums)[name], value, rtol=1e-4)
    assert int(sums["count"]) == 11


def test_validation_metrics_are_root_mean_squares() -> None:
    sums = {"loss": jnp.array(6.0), "count": jnp.array(3), "squares": jnp.array([3.0, 0, 9, 0, 0.03, 0])}
    metrics = step.validation_metrics(sums)
    np.testing.assert_allclose(metrics["validation_loss"], 2)
    np.testing.assert_allclose(metrics["validation_translation_rmse_m"], 2)
    np.testing.assert_allclose(metrics["validation_rotation_rmse_deg"], np.degrees(0.1), rtol=1e-6)


def test_the_plateau_is_that_of_pytorch() -> None:
    """The scales are torch's ReduceLROnPlateau's, recorded by tests/golden/make_torch_golden.py."""
    golden = json.loads((Path(__file__).parents[1] / "golden" / "plateau.json").read_text())
    for case in golden:
        plateau = make_plateau(
            TrainingConfig(
                plateau_patience=case["patience"], plateau_factor=case["factor"], plateau_threshold=case["threshold"]
            )
        )
        update = jax.jit(lambda state, value, plateau=plateau: plateau.update({}, state, value=value)[1])
        state = plateau.init({"w": jnp.zeros(())})
        scales = []
        for value in case["values"]:
            state = update(state, value)
            scales.append(float(state.scale))
        np.testing.assert_allclose(scales, case["scales"], rtol=1e-6)
        assert min(case["scales"]) < 1, "the case must lower the rate at least once"


def test_the_end_of_an_epoch_renews_the_residual_scale_and_forgets_the_sums() -> None:
    state = first_state(CONFIG)
    state = state._replace(sums={name: jnp.ones(()) for name in state.sums})
    squares = jnp.asarray(LABELS.std**2 * 4 * 7)
    state = step.end_epoch(state, {"loss": jnp.array(7.0), "count": jnp.array(7), "squares": squares}, config=CONFIG)
    np.testing.assert_allclose(state.model.residual_scale, 2 * np.ones(6), rtol=1e-5)
    np.testing.assert_allclose(state.plateau.best_value, 1)
    assert not any(state.sums.values())
    assert int(state.epoch) == 1


def test_a_batch_in_parts_gives_the_step_of_the_whole() -> None:
    config = with_(CONFIG, training={"reduction": "mean", "optimiser": "sgd"})
    found = []
    for parts in (1, 2, 4):
        chosen = with_(config, training={"accumulate": parts})
        train_step = jax.jit(step.bind(step.train_step, Linear(), chosen))
        found.append(train_step(linear_state(chosen), full_batch()))
    for state, metrics in found[1:]:
        np.testing.assert_allclose(state.model.params["head"], found[0][0].model.params["head"], rtol=1e-5)
        for name in TRAIN_METRICS:
            np.testing.assert_allclose(metrics[name], found[0][1][name], rtol=1e-5, err_msg=name)


def test_plain_gradient_descent_is_the_gradient_times_the_rate() -> None:
    config = with_(CONFIG, training={"optimiser": "sgd", "gradient_clip": 0.0, "learning_rate": 0.01})
    after, metrics = jax.jit(step.bind(step.train_step, Linear(), config))(linear_state(config), full_batch())
    moved = np.linalg.norm(after.model.params["head"] - linear_state(config).model.params["head"])
    np.testing.assert_allclose(moved, 0.01 * metrics["gradient_norm"], rtol=1e-4)


DEVICES_SCRIPT = """
import sys
sys.path[:0] = {path!r}
import jax, jax.numpy as jnp, numpy as np, optax
from test_step import CONFIG, first_state, make_batch, with_
from mdnvo_jax.errors import InputError
from mdnvo_jax.model.network import build
from mdnvo_jax.training import parallel, state, step
# Adam hides a gradient that is wrong by a factor: plain gradient descent does not.
step.make_optimiser = state.make_optimiser = lambda config: optax.sgd(1e-3)
config = with_(CONFIG, model={{"conv_dropout": 0.0, "lstm_dropout": 0.0}})
network = build(config.image, config.model)
mesh = parallel.make_mesh(4)
current = jax.device_put(first_state(config), parallel.replicated(mesh))
train_step = parallel.compile_step(step.bind(step.train_step, network, config), mesh, donate=True)
losses = []
for seed in range(5):
    batch = parallel.place({{k: np.asarray(v) for k, v in make_batch(seed).items()}}, mesh)
    current, metrics = train_step(current, batch)
    losses.append(float(metrics["loss"]))
devices = len(batch["images"].sharding.device_set)
flat = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves((current.model.params, current.model.batch_stats))])
refused = []
for arguments in ({{"batch_size": 3}}, {{"batch_size": 4, "accumulate": 4}}):
    try:
        parallel.make_mesh(**arguments)
        refused.append("")
    except InputError as error:
        refused.append(str(error))
# The same by jax.pmap, as its users would do it.
count = len(jax.devices())
mapped = build(config.image, config.model, axis_name="shares")
pmapped = jax.pmap(lambda s, b: step.train_step(s, b, network=mapped, config=config, axis_name="shares"), "shares")
spread = jax.tree.map(lambda leaf: jnp.stack([leaf] * count), first_state(config))
for seed in range(5 if count > 1 else 0):
    batch = {{k: np.asarray(v).reshape(count, 4 // count, *v.shape[1:]) for k, v in make_batch(seed).items()}}
    spread, _ = pmapped(spread, batch)
leaves = jax.tree.leaves((spread.model.params, spread.model.batch_stats))
by_pmap = np.concatenate([np.ravel(leaf[-1]) for leaf in leaves])
np.savez(sys.argv[1], refused=refused, losses=losses, flat=flat, by_pmap=by_pmap, devices=devices)
"""


def test_two_devices_compute_what_one_computes(tmp_path: Path) -> None:
    found = []
    for count in (1, 2):
        flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={count}"
        environment = {**os.environ, "XLA_FLAGS": flags}
        script = DEVICES_SCRIPT.format(path=[str(Path(__file__).parent)])
        result = tmp_path / f"{count}.npz"
        subprocess.run([sys.executable, "-c", script, str(result)], env=environment, check=True)
        found.append(np.load(result))
    assert [int(item["devices"]) for item in found] == [1, 2]
    assert list(found[0]["refused"]) == ["", ""]
    assert "batch_size is 3: expected a multiple of the 2 devices" in found[1]["refused"][0]
    assert "that share it, in 4 parts each (training.accumulate)" in found[1]["refused"][1]
    np.testing.assert_allclose(found[1]["losses"], found[0]["losses"], rtol=1e-4)
    np.testing.assert_allclose(found[1]["flat"], found[0]["flat"], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(found[1]["by_pmap"], found[0]["flat"], rtol=1e-3, atol=1e-5)


# What training may lower instead of the NLL


def gaussians(sigma: np.ndarray, error: np.ndarray) -> mixture.Mixture:
    """One Gaussian a step, its mean off the label 0 by `error`."""
    return mixture.Mixture(jnp.zeros((*sigma.shape[:-1], 1)), error[..., None, :], jnp.log(sigma)[..., None, :])


@pytest.mark.parametrize("coupling", ["independent", "joint"])
def test_beta_nll_weights_each_gaussian_by_its_sigma(coupling: str) -> None:
    generator = np.random.default_rng(0)
    sigma, error = generator.uniform(0.1, 2, (2, 3, 6)), generator.normal(size=(2, 3, 6))
    mask = np.array([[True, True, False], [True, False, True]])
    unit = Labels(np.zeros(6), generator.uniform(0.5, 2, 6))
    nll = 0.5 * (error / sigma) ** 2 + np.log(sigma) + 0.5 * np.log(2 * np.pi)
    share = sigma / unit.std
    for beta in (0.0, 0.5, 1.0):
        if coupling == "joint":
            expected = np.exp(2 * beta * np.log(share).mean(-1)) * nll.sum(-1)
        else:
            expected = (share ** (2 * beta) * nll).sum(-1)
        found = step.beta_nll(gaussians(sigma, error), jnp.zeros((2, 3, 6)), jnp.asarray(mask), unit, coupling, beta)
        np.testing.assert_allclose(found, expected[mask].mean(), rtol=1e-5)


def test_at_beta_one_the_gradient_of_the_mean_is_that_of_the_squared_error() -> None:
    generator = np.random.default_rng(1)
    sigma, error = generator.uniform(0.1, 2, (1, 2, 6)), generator.normal(size=(1, 2, 6))
    unit = Labels(np.zeros(6), np.ones(6))

    def loss(error: jax.Array) -> jax.Array:
        return step.beta_nll(
            gaussians(sigma, error), jnp.zeros((1, 2, 6)), jnp.ones((1, 2), bool), unit, "independent", 1.0
        )

    np.testing.assert_allclose(jax.grad(loss)(jnp.asarray(error)), error / 2, rtol=1e-5)


def test_the_loss_on_flow_is_the_mean_length_of_its_error_where_it_is_known() -> None:
    flow = np.zeros((1, 2, 2, 3, 2), np.float32)
    flow[0, 0] = np.nan
    flow[0, 1, 0, 0] = (np.nan, 1)
    flow[0, 1, 0, 1] = (30, -30)  # cut to 8 cells
    found, gradient = jax.value_and_grad(step.flow_loss)(jnp.full(flow.shape, 3.0).at[..., 1].set(4.0), flow)
    np.testing.assert_allclose(found, (4 * 5 + np.hypot(5, 12)) / 5, rtol=1e-4)
    assert np.isfinite(gradient).all() and (gradient[0, 0] == 0).all() and (gradient[0, 1, 0, 0] == 0).all()
    np.testing.assert_allclose(gradient[0, 1, 1, 0], np.array([0.6, 0.8]) / 5, rtol=1e-4)
    assert step.flow_loss(jnp.zeros(flow.shape), np.full(flow.shape, np.nan)) == 0
    # An exact flow is a minimum, not a kink without a gradient.
    assert (jax.grad(step.flow_loss)(jnp.zeros(flow.shape), np.zeros(flow.shape)) == 0).all()


def test_a_network_with_flow_learns_it_beside_the_steps_and_predicts_without_it() -> None:
    config = with_(CONFIG, model={"flow_weight": 1.0}, training={"beta": 0.5, "reduction": "mean"})
    network = build(config.image, config.model)
    state = first_state(config)
    batch = make_batch()
    shade = batch["images"][:, 1:, ::8, ::8, 0] / 64.0
    batch["flow"] = jnp.stack([shade, -shade], -1).at[0, 0].set(jnp.nan)
    train_step = jax.jit(step.bind(step.train_step, network, config))

    @jax.jit
    def losses(state: State) -> jax.Array:
        variables = {"params": state.model.params, "batch_stats": state.model.batch_stats}
        outputs, flow = network.apply(
            variables, batch["images"], batch["mask"], method="with_flow", train=True,
            mutable=["batch_stats"], rngs={"dropout": jax.random.key(0)},
        )[0]  # fmt: skip
        assert flow.shape == batch["flow"].shape
        return jnp.stack([step.objective(outputs, batch, LABELS, config, "mean"), step.flow_loss(flow, batch["flow"])])

    before = losses(state)
    for _ in range(30):
        state, _ = train_step(state, batch)
    after = losses(state)
    # Both go down; the beta-NLL itself says little: its weights fall with sigma.
    assert after[0] < before[0] - 1 and after[1] < 0.7 * before[1]
    validated = jax.jit(step.bind(step.validation_step, network, config))(state.model, make_batch())
    assert np.isfinite(validated["loss"])


def test_the_cosine_ends_at_zero_after_all_steps() -> None:
    config = TrainingConfig(schedule="cosine", epochs=4, steps_per_epoch=25)
    plateau = make_plateau(config).init({"w": jnp.zeros(())})
    scales = [float(schedule_scale(config, plateau, jnp.asarray(number))) for number in (0, 25, 50, 100, 120)]
    np.testing.assert_allclose(scales, [1, (1 + np.sqrt(0.5)) / 2, 0.5, 0, 0], atol=1e-6)
    assert float(schedule_scale(TrainingConfig(), plateau, jnp.asarray(99))) == 1


def test_weight_decay_pulls_weights_to_zero_apart_from_the_gradient() -> None:
    params = {"w": jnp.array([2.0, -4.0])}
    optimiser = make_optimiser(TrainingConfig(weight_decay=0.1, learning_rate=0.5, gradient_clip=0))
    update, _ = optimiser.update({"w": jnp.zeros(2)}, optimiser.init(params), params)
    np.testing.assert_allclose(update["w"], -0.5 * 0.1 * params["w"])
