"""Ablations: real trainings of a tiny network, kept and gone on with, and the table's arithmetic."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from mdnvo_jax.config import from_json, load_config
from mdnvo_jax.data import cache, load
from mdnvo_jax.evaluation import ablation

CONFIG = """
from mdnvo_jax.config import *
config = Config(
    image=ImageConfig(16, 32, 1, camera=(18.0, 18.0, 15.5, 7.0)),
    model=ModelConfig(width=1 / 64, lstm_hidden=4, lstm_layers=1, flow_weight=0.5),
    data=DataConfig(dataset="synthetic", worlds=1, world_frames=9, validation_worlds=1, window=2),
    training=TrainingConfig(batch_size=2, epochs=1, steps_per_epoch=2, reduction="mean", beta=0.5),
)
"""


def test_a_variant_is_trained_once_and_tabulated(tmp_path, capsys):
    config = tmp_path / "config.py"
    config.write_text(CONFIG)
    train, validation, image = load.load_split(load_config(str(config)))
    cache.prepare_cache([*train, *validation], image, tmp_path / "cache")
    arguments = [str(config), "--cache", str(tmp_path / "cache"), "--output", str(tmp_path / "out"), "--seeds", "3"]
    arguments += ["--variants", "coupling joint"]
    ablation.main(arguments)
    text = (tmp_path / "out" / "table.md").read_text()
    assert text in capsys.readouterr().out and "| coupling joint | 0." in text and "over the seeds 3;" in text
    (metrics,) = (tmp_path / "out").rglob("metrics.csv")
    assert from_json((metrics.parent / "config.json").read_text()).model.coupling == "joint"
    before = metrics.stat().st_mtime_ns
    # What is done is not done again.
    ablation.main(arguments)
    assert metrics.stat().st_mtime_ns == before


def row(translation, rotation=1.0, loss=-5.0):
    return {
        "validation_translation_rmse_m": translation,
        "validation_rotation_rmse_deg": rotation,
        "validation_loss": loss,
    }


def test_differences_are_taken_seed_by_seed():
    found = {"base": [row(0.1), row(0.3), row(0.5)], "other": [row(0.2), row(0.4), row(0.6)]}
    base, other = ablation.table(found, [0, 1, 2]).rows
    assert base["validation_translation_rmse_m"].value == pytest.approx(0.3)
    assert "validation_translation_rmse_m_more" not in base
    more = other["validation_translation_rmse_m_more"]
    # Seeds differ by far more than the variants do: what is common to them cancels.
    assert (more.value, more.low, more.high) == pytest.approx((0.1, 0.1, 0.1))


def test_the_squared_error_of_a_regression_is_no_nll():
    regression = next(name for name in ablation.VARIANTS if "regression" in name)
    base, other = ablation.table({"base": [row(0.1)], regression: [row(0.2)]}, [0]).rows
    assert base["validation_loss"].value == -5 and "validation_loss" not in other


def test_the_interval_is_students():
    values = np.random.default_rng(0).normal(size=5)
    found = ablation.interval(values)
    low, high = stats.t.interval(0.95, 4, values.mean(), values.std(ddof=1) / np.sqrt(5))
    assert (found.low, found.high) == pytest.approx((low, high), rel=1e-3)
    assert np.isnan(ablation.interval(values[:1]).low)


def test_a_variant_that_is_not_there_is_refused():
    script = Path(__file__).parents[2] / "bin" / "ablate"
    command = [sys.executable, str(script), "--cache", "c", "--output", "o", "--variants", "none such"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and "no variant 'none such'" in done.stderr and "Traceback" not in done.stderr
