"""The loop with real processes, files and signals: what it leaves, and that stopping it changes nothing."""

import csv
import dataclasses
import json
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mdnvo_jax import train
from mdnvo_jax.config import Config, TrainingConfig, from_json, load_config
from mdnvo_jax.errors import exit_code
from mdnvo_jax.soak import training
from mdnvo_jax.training import checkpoint, logs, loop, parallel
from mdnvo_jax.training.state import SKIPPED, TRAIN_METRICS, State, make_plateau
from mdnvo_jax.training.store import Store


@pytest.fixture(scope="module")
def config_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A config on a drive of noisy frames: enough for every part of the loop to turn."""
    return training.write_drive(tmp_path_factory.mktemp("loop") / "drive", epochs=3)


def start(config_file: Path, workdir: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "mdnvo_jax.train", str(config_file), "--workdir", str(workdir), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def last_state(workdir: Path) -> State:
    config = from_json((workdir / "config.json").read_text())
    store = Store(workdir, keep_latest=2)
    try:
        return store.restore(checkpoint.template(config)).state
    finally:
        store.close()


def rows(workdir: Path) -> list[dict[str, str]]:
    with (workdir / "metrics.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def uninterrupted(config_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    workdir = tmp_path_factory.mktemp("runs") / "uninterrupted"
    code, out, err = finish(start(config_file, workdir))
    assert code == 0, err
    assert "trained 3 epochs, 33 steps" in out
    assert err == ""
    return workdir


def test_a_training_leaves_what_it_promises(uninterrupted: Path) -> None:
    assert {entry.name for entry in uninterrupted.iterdir()} == {
        "config.json",
        "environment.json",
        "labels.json",
        "checkpoints",
        "metrics.csv",
        "tensorboard",
    }
    # 48 frames train: 45 windows of three steps, 11 batches of four.
    assert [(row["epoch"], row["step"]) for row in rows(uninterrupted)] == [("1", "11"), ("2", "22"), ("3", "33")]
    # The threshold asks for more than any epoch improves by, so that the second bad epoch lowers the rate.
    assert [float(row["learning_rate"]) for row in rows(uninterrupted)] == pytest.approx([1e-3, 1e-3, 0.7e-3])
    labels = json.loads((uninterrupted / "labels.json").read_text())
    assert set(labels) == {"mean", "std"}
    assert json.loads((uninterrupted / "environment.json").read_text())["versions"]["jax"] == jax.__version__
    assert logs.versions("jax", "no-such-package")["no-such-package"] == "not installed"
    config = from_json((uninterrupted / "config.json").read_text())
    assert config.image.camera == pytest.approx((40, 40, 31.5, 15.5)), "the resolved camera belongs to the experiment"
    assert any((uninterrupted / "tensorboard").iterdir())
    # The two newest checkpoints are kept; the best is one of them or a third.
    losses = [float(row["validation_loss"]) for row in rows(uninterrupted)]
    best = checkpoint.locate(uninterrupted)
    assert best.name == str(11 * (1 + int(np.argmin(losses))))
    assert {22, 33} <= set(checkpoint.steps_in(uninterrupted / "checkpoints"))


def assert_same(first: Path, second: Path) -> None:
    leaves, others = (jax.tree.leaves_with_path(last_state(workdir)) for workdir in (first, second))
    assert len(leaves) == len(others) > 50
    for (path, leaf), (_, other) in zip(leaves, others, strict=True):
        np.testing.assert_array_equal(leaf, other, err_msg=jax.tree_util.keystr(path))
    assert rows(first) == rows(second)


def test_a_kill_in_the_middle_of_a_save_changes_nothing(config_file: Path, uninterrupted: Path, tmp_path: Path) -> None:
    process = start(config_file, tmp_path)
    assert process.stdout is not None
    for epoch in (1, 2):
        assert process.stdout.readline().startswith(f"epoch   {epoch}")
    # The second checkpoint is being written now, and the first one is whole: a save waits for the one before.
    process.kill()
    assert finish(process)[0] == -signal.SIGKILL
    code, out, err = finish(start(config_file, tmp_path, "--resume"))
    assert code == 0, err
    assert "22 steps in this run" in out or "11 steps in this run" in out
    assert_same(tmp_path, uninterrupted)


def test_sigterm_in_the_middle_of_an_epoch_changes_nothing(
    config_file: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    process = start(config_file, tmp_path)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("epoch   1")
    process.send_signal(signal.SIGTERM)
    code, out, err = finish(process)
    assert code == 128 + signal.SIGTERM
    assert "SIGTERM: saving a checkpoint" in err
    assert "go on with --resume" in out
    assert 11 < int(last_state(tmp_path).step) <= 33
    code, _, err = finish(start(config_file, tmp_path, "--resume"))
    assert code == 0, err
    assert_same(tmp_path, uninterrupted)


def test_two_processes_train_as_one_and_any_number_goes_on(
    config_file: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    """Dropout and augmentation included, one of them asked to stop, and the rest done by one process alone."""
    leader, other = training.start_together(config_file, tmp_path, 2)
    assert leader.stdout is not None
    line = leader.stdout.readline()
    assert "[Gloo]" in line or line.startswith("epoch   1")
    if not line.startswith("epoch"):
        assert leader.stdout.readline().startswith("epoch   1")
    other.send_signal(signal.SIGTERM)
    for process in (leader, other):
        code, out, err = finish(process)
        assert code == 128 + signal.SIGTERM, err
        assert "stopped by SIGTERM after step" in out
    stopped = int(last_state(tmp_path).step)
    assert 11 < stopped <= 33
    code, _, err = finish(start(config_file, tmp_path, "--resume"))
    assert code == 0, err
    # What differs is the order of sums over the batch, grown by 33 steps of Adam.
    for row, expected in zip(rows(tmp_path), rows(uninterrupted), strict=True):
        assert row["step"] == expected["step"]
        for name in ("loss", "parameter_norm", "sigma_translation_m_q50", "validation_loss"):
            assert float(row[name]) == pytest.approx(float(expected[name]), rel=2e-3), name
    assert float(rows(tmp_path)[0]["loss"]) == pytest.approx(float(rows(uninterrupted)[0]["loss"]), rel=1e-6)


def test_a_process_that_lost_another_one_ends_and_says_so(config_file: Path, tmp_path: Path) -> None:
    leader, other = training.start_together(config_file, tmp_path, 2, "--training.epochs", "300", "--lost-after", "10")
    assert leader.stdout is not None
    # The first checkpoint is whole then: a save waits for the one before.
    while not leader.stdout.readline().startswith("epoch   2"):
        assert leader.poll() is None
    other.kill()
    code, _, err = finish(leader)
    # By itself as a rule; in the middle of a save by JAX, which has its own words for it.
    assert (code, "error: process 0 lost another process" in err) == (3, True) or (
        (code, "another task died" in err) == (-signal.SIGABRT, True)
    )
    assert "Traceback" not in err
    finish(other)
    # What was saved before is whole.
    assert int(last_state(tmp_path).step) >= 11


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run the command in this process, assert that it is refused, return its one line."""
    assert exit_code(train.main, arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err


def test_what_cannot_be_done_is_refused_in_one_line(
    config_file: Path, uninterrupted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, workdir = str(config_file), str(uninterrupted)
    before = (uninterrupted / "checkpoints").stat().st_mtime_ns
    assert "go on with --resume" in refusal(capsys, config, "--workdir", workdir)
    assert "no checkpoint to resume" in refusal(capsys, config, "--workdir", str(tmp_path), "--resume")
    line = refusal(capsys, config, "--workdir", workdir, "--resume", "--model.components", "5", "--data.mirror", "0.1")
    assert "model.components, data.mirror differ" in line
    assert "no config file" in refusal(capsys, "missing.py", "--workdir", str(tmp_path))
    assert "no sequence" in refusal(capsys, config, "--workdir", str(tmp_path), "--data.train_sequences", "77").lower()
    assert "invalid choice" in refusal(capsys, config, "--workdir", str(tmp_path), "--model.head", "other")
    alone = ["--workdir", str(tmp_path), "--processes", "2"]
    assert "--coordinator and --process missing" in refusal(capsys, config, *alone)
    assert "expected 0 to one less" in refusal(capsys, config, *alone, "--process", "2", "--coordinator", "here:1")
    assert "--cluster finds the processes by itself" in refusal(capsys, config, *alone, "--cluster")
    assert "no cluster that JAX knows" in refusal(capsys, config, "--workdir", str(tmp_path), "--cluster")
    assert "expected true or false" in refusal(capsys, config, "--workdir", str(tmp_path), "--image.rectify", "maybe")
    assert (uninterrupted / "checkpoints").stat().st_mtime_ns == before


def test_a_training_that_diverges_stops_and_keeps_its_last_checkpoint(config_file: Path, tmp_path: Path) -> None:
    assert finish(start(config_file, tmp_path, "--training.epochs", "1"))[0] == 0
    before = last_state(tmp_path)
    # A label of 1e30 m makes the next epoch overflow.
    path = tmp_path / "config.json"
    stored = json.loads(path.read_text())
    stored["training"]["learning_rate"] = 1e38
    path.write_text(json.dumps(stored))
    code, _, err = finish(start(config_file, tmp_path, "--resume", "--training.learning_rate", "1e38"))
    assert code == 2
    assert "not finite at step" in err
    assert "Traceback" not in err
    np.testing.assert_array_equal(
        before.model.params["head"]["kernel"], last_state(tmp_path).model.params["head"]["kernel"]
    )


def test_a_training_that_gets_no_better_ends_early(config_file: Path, tmp_path: Path) -> None:
    config = load_config(str(config_file))
    config = dataclasses.replace(
        config, training=dataclasses.replace(config.training, epochs=40, early_stop_patience=2)
    )
    said = loop.train(config, tmp_path)
    losses = [float(row["validation_loss"]) for row in rows(tmp_path)]
    # The best is the third but last, and nothing before it was followed by two that are no better.
    assert len(losses) < 40 and min(losses) == losses[-3]
    assert all(min(losses[end - 2 : end]) < min(losses[: end - 2]) for end in range(3, len(losses)))
    assert said.startswith(f"trained {len(losses)} epochs, 2 of them without a better one, ")
    assert f"best validation loss {min(losses):.4f}" in said
    assert "nothing was left to do" in loop.train(config, tmp_path, resume=True)
    longer = dataclasses.replace(
        config, training=dataclasses.replace(config.training, epochs=len(losses) + 1, early_stop_patience=0)
    )
    assert " 11 steps in this run" in loop.train(longer, tmp_path, resume=True)


def idle_run(workdir: Path, limit: int) -> loop._Run:
    """What a training is made of, of four steps an epoch, without a network."""
    config = Config(training=TrainingConfig(skip_nonfinite=limit))
    run = object.__new__(loop._Run)
    run.config, run.workdir, run.mesh, run.steps_per_epoch = config, workdir, parallel.make_mesh(1, 1), 4
    run.validation_step = lambda model, batch: {"loss": 1.0, "count": 1, "squares": np.zeros(6)}
    run.end_epoch = lambda state, sums: state
    return run


def metrics_of(skipped: int, **values: float) -> dict[str, np.ndarray]:
    return {name: np.float32(value) for name, value in {**dict.fromkeys(TRAIN_METRICS, 1.0), **values}.items()} | {
        SKIPPED: np.float32(skipped)
    }


def test_steps_that_are_not_finite_are_told_of_up_to_a_limit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = idle_run(tmp_path, limit=2)
    run.inspect(metrics_of(2, loss=np.nan, gradient_norm=np.inf), 7)
    assert capsys.readouterr().err == (
        "warning: step 7 is skipped, loss, gradient_norm not finite: 2 in this epoch, "
        "training.skip_nonfinite allows 2\n"
    )
    run.inspect(metrics_of(2), 8)
    assert capsys.readouterr().err == ""
    with pytest.raises(loop.NonFiniteError, match="loss not finite at step 9, after 2 steps of this epoch were skip"):
        run.inspect(metrics_of(3, loss=np.nan), 9)
    with pytest.raises(loop.NonFiniteError, match="loss not finite at step 1: lower"):
        idle_run(tmp_path, limit=0).inspect(metrics_of(0, loss=np.nan), 1)


def test_skipped_steps_are_in_the_row_of_their_epoch_and_out_of_its_means(tmp_path: Path) -> None:
    sums = {**dict.fromkeys(TRAIN_METRICS, jnp.float32(6.0)), SKIPPED: jnp.float32(1)}
    state = State(None, None, make_plateau(TrainingConfig()).init({}), None, jnp.int32(4), jnp.int32(0), sums)
    _, row = idle_run(tmp_path, limit=2).validate(state, [{"mask": np.ones((1, 1), bool)}], 0)
    assert (row["loss"], row[SKIPPED]) == (2.0, 1)
    assert loop._epoch_line(row).endswith("  skipped 1")
    assert "skipped" not in loop._epoch_line(row | {SKIPPED: 0})


def test_what_cannot_be_written_ends_the_training_or_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = idle_run(tmp_path, limit=0)
    # A file where TensorBoard's folder should be.
    (tmp_path / "tensorboard").write_text("")
    run.logs = logs.Logs(tmp_path, 0)
    with pytest.raises(loop.DiskError, match=r"a log cannot be written .*make room and go on with --resume"):
        run.inspect(metrics_of(0), 10)
    run.config = Config(training=TrainingConfig(full_disk="go_on"))
    run.inspect(metrics_of(0), 10)
    assert "going on, as training.full_disk says" in capsys.readouterr().err
    (tmp_path / "tensorboard").unlink()
    run.inspect(metrics_of(0), 20)
    run.logs.close()
    assert capsys.readouterr().err == ""
    assert len(list((tmp_path / "tensorboard").iterdir())) == 1


def test_rows_of_an_older_release_keep_their_columns(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text("epoch,step,loss\n1,11,0.5\n")
    written = logs.Logs(tmp_path, 11)
    written.epoch({"epoch": 2, "step": 22, "loss": 0.25, "skipped": 1})
    written.close()
    assert [row["skipped"] for row in rows(tmp_path)] == ["", "1"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--training.schedule", "cosine"], "set training.steps_per_epoch"),
        (["--training.beta", "0.5"], "training.beta 0.5 with training.reduction sequence"),
        (["--training.beta", "0.5", "--training.reduction", "mean", "--model.head", "regression"], "head mixture"),
    ],
)
def test_choices_of_the_loss_that_contradict_each_other_are_refused(
    config_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert exit_code(train.main, [str(config_file), "--workdir", str(tmp_path / "w"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "w").exists()
