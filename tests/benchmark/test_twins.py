"""The peers compute what we compute, and it is noticed where they do not. Only where PyTorch is installed."""

from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")

from mdnvo_jax.benchmark import agreement, machine, torch_input, torch_predict, torch_twin  # noqa: E402
from mdnvo_jax.benchmark.outcome import Outcome, Settings  # noqa: E402
from mdnvo_jax.benchmark.sections import input as input_section  # noqa: E402
from mdnvo_jax.benchmark.sections import lstm, mixture, predict, train  # noqa: E402


def measured(section: Any, folder: Path) -> Outcome:
    return section.measure(Settings(folder, threads=machine.usable_cores(), short=True))


def test_a_training_step_is_ours(tmp_path: Path) -> None:
    outcome = measured(train, tmp_path)
    found = {name.partition(": ")[2]: value for name, value in outcome.agreement.items()}
    assert found["loss"] < 1e-5
    assert found["gradient"] < 1e-3
    assert found["parameters after a step of Adam"] < 1e-4
    contenders = [row["contender"] for row in outcome.tables[0].rows]
    assert train.TORCH in contenders
    assert train.TORCH_BF16 in contenders
    assert outcome.targets["train float32"]


def break_slope(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_twin, "LEAKY_SLOPE", 0.11)


def break_epsilon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_twin, "BATCH_NORM_EPSILON", 1e-3)


def break_order_of_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    forward = torch_twin.Twin.forward
    monkeypatch.setattr(torch_twin.Twin, "forward", lambda self, images: forward(self, images.flip(1)))


def break_reduction(monkeypatch: pytest.MonkeyPatch) -> None:
    loss = torch_twin.loss
    monkeypatch.setattr(torch_twin, "loss", lambda *given: 1.002 * loss(*given))


def break_gates(monkeypatch: pytest.MonkeyPatch) -> None:
    copy = torch_twin.copy_weights

    def swapped(twin: Any, *given: Any) -> None:
        copy(twin, *given)
        with torch.no_grad():
            twin.lstm.weight_hh_l0.copy_(twin.lstm.weight_hh_l0.roll(twin.lstm.hidden_size, 0))

    monkeypatch.setattr(torch_twin, "copy_weights", swapped)


def break_adam(monkeypatch: pytest.MonkeyPatch) -> None:
    adam = torch.optim.Adam
    monkeypatch.setattr(torch.optim, "Adam", lambda *given, **options: adam(*given, **options, weight_decay=0.1))


def break_clipping(monkeypatch: pytest.MonkeyPatch) -> None:
    clip = torch.nn.utils.clip_grad_norm_
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", lambda given, norm, **options: clip(given, 1e-9, **options))


BREAKS = [break_slope, break_epsilon, break_order_of_frames, break_reduction, break_gates, break_adam, break_clipping]


@pytest.fixture(scope="module")
def our_step(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Our training with one compiled step, which the broken twins are compared with."""
    from mdnvo_jax.benchmark import material

    config = material.paper_config(16, 32, 1 / 32, batch=3, window=2)
    ours = train._Ours(config)
    function = ours.compiled(material.without_dropout(config))
    ours.compiled = lambda _: function  # type: ignore[method-assign]
    return ours


def compare(ours: Any) -> None:
    from mdnvo_jax.benchmark import material

    ours.state = ours.fresh()
    twin = torch_twin.Twin(ours.config)
    torch_twin.copy_weights(twin, ours.state.model.params, ours.state.model.batch_stats)
    peer = torch_twin.Trainer(twin, ours.config, material.LABELS)
    images, steps = (torch.from_numpy(material.training_batch(ours.config)[name]) for name in ("images", "steps"))
    train.assert_same_step(ours, peer, material.without_dropout(ours.config), images, steps, Outcome())


def test_the_unbroken_twin_passes(our_step: Any) -> None:
    compare(our_step)


@pytest.mark.parametrize("broken", BREAKS)
def test_a_broken_twin_is_not_timed(broken: Any, our_step: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    broken(monkeypatch)
    with pytest.raises(agreement.DisagreementError):
        compare(our_step)


def test_predictions_are_ours(tmp_path: Path) -> None:
    outcome = measured(predict, tmp_path)
    found = {name.partition(": ")[2]: value for name, value in outcome.agreement.items()}
    assert found["PyTorch caching, float32"] < 1e-4
    assert found["PyTorch DeepVO-style, float32"] < 1e-4
    assert {"predict deepvo", "predict float32", "predict best", "predict best bf16", "live"} <= set(outcome.targets)


def test_a_predictor_that_forgets_a_pair_is_not_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outputs = torch_predict.TorchPredictor.outputs
    monkeypatch.setattr(torch_predict.TorchPredictor, "outputs", lambda self, given: outputs(self, given.flip(1)))
    with pytest.raises(agreement.DisagreementError, match="caching"):
        measured(predict, tmp_path)


def test_the_lstm_and_the_mixture_are_ours(tmp_path: Path) -> None:
    for section, tolerance in ((lstm, 1e-4), (mixture, 1e-5)):
        outcome = measured(section, tmp_path)
        exact = [value for name, value in outcome.agreement.items() if "bf16" not in name]
        assert exact
        assert max(exact) < tolerance
        assert outcome.targets


def test_the_windows_of_the_loader_are_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outcome = measured(input_section, tmp_path)
    assert [row["contender"] for row in outcome.tables[0].rows][2].startswith(input_section.LOADER)
    assert outcome.targets["input"]
    get = torch_input.Windows.__getitem__

    def darker(self: Any, start: int) -> Any:
        frames, steps = get(self, start)
        return frames // 2, steps

    monkeypatch.setattr(torch_input.Windows, "__getitem__", darker)
    (tmp_path / "again").mkdir()
    with pytest.raises(agreement.DisagreementError, match="window"):
        measured(input_section, tmp_path / "again")
