"""The trials of bin/soak in short: they pass, and what they are to find, they find."""

import gc
import shutil
import subprocess
from pathlib import Path

import jax.numpy as jnp
import pytest
import small_model
from small_model import CONFIG, LABELS

from mdnvo_jax import config as configuration
from mdnvo_jax.errors import exit_code
from mdnvo_jax.model.network import build
from mdnvo_jax.soak import __main__ as command
from mdnvo_jax.soak import damage, kills, scale, stream
from mdnvo_jax.soak.tally import Tally, as_line, from_line, table
from mdnvo_jax.training import checksum
from mdnvo_jax.training.state import initial_state, initial_variables
from mdnvo_jax.training.store import Store


@pytest.fixture(scope="module")
def workdir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    workdir = tmp_path_factory.mktemp("soak") / "run"
    store = Store(workdir, keep_latest=2)
    state = initial_state(initial_variables(build(CONFIG.image, CONFIG.model), CONFIG), CONFIG, LABELS)
    for step in (1, 2):
        state = state._replace(model=small_model.trained(), step=jnp.asarray(step), epoch=jnp.asarray(step))
        store.save(state, {"next_index": step}, CONFIG, 1.0)
    store.close()
    (workdir / "config.json").write_text(configuration.as_json(CONFIG))
    return workdir


# Where orbax's own description of the arrays is damaged, it abandons reads that are under way, which then complain.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_damage_is_survived(workdir: Path) -> None:
    found = damage.run(0.5, 0, workdir)
    assert found.tried >= 1 and found.lost == []
    gc.collect()


def test_damage_that_goes_unnoticed_is_lost(workdir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def other_step(step: Path, draw: object) -> str:
        shutil.rmtree(step / "training")
        shutil.copytree(step.parent / "1" / "training", step / "training")
        return "the training of another step"

    monkeypatch.setattr(damage, "_damage", other_step)
    monkeypatch.setattr(checksum, "check_stored", lambda *_: None)
    found = damage.run(0.01, 1, workdir)
    assert found.lost == ["the training of another step: step 2 is not what was saved"]


def test_a_stream_is_measured_and_its_growth_is_lost(workdir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "_WARM_UP", 100)
    monkeypatch.setattr(stream, "MOST_GROWTH_BYTES", -(1 << 40))
    found = stream.run(0, 0, workdir)
    # Any growth is too much here, and nothing else was lost.
    assert found.tried == 200 and len(found.lost) == 1 and "memory grew by" in found.lost[0]
    assert "ms a frame" in found.note and " 0 frames flagged" not in found.note


def test_trainings_that_end_elsewhere_are_lost(workdir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = iter([{"rows": "a"}, {"rows": "b"}])
    monkeypatch.setattr(kills.training, "result", lambda _: next(results))
    monkeypatch.setattr(kills, "_KILLS", 0)

    class Done:
        returncode = 0

        def communicate(self, timeout: float) -> tuple[str, str]:
            return "", ""

    monkeypatch.setattr(kills.training, "start", lambda *_: Done())
    monkeypatch.setattr(kills.tempfile, "tempdir", str(tmp_path))
    assert kills._chain(tmp_path, tmp_path, None, {"rows": "b"}, 0) == ([], "ends elsewhere: rows")
    assert kills._chain(tmp_path, tmp_path, None, {"rows": "b"}, 0) == ([], "")


class Ended:
    """A process that has ended, or never does."""

    def __init__(self, returncode: int | None) -> None:
        self.returncode, self.killed = returncode, False

    def kill(self) -> None:
        self.killed = True

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        if self.returncode is None and not self.killed:
            raise subprocess.TimeoutExpired("train", timeout or 0)
        return "", "error: something"


def test_processes_that_live_on_or_train_something_else_are_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = "step,loss,validation_loss\n1,-2.0,-3.0\n"
    (tmp_path / "metrics.csv").write_text(rows)
    # Of a run: the processes that lose one, those that go on, and what the latter leave behind.
    runs = [
        ([3, -9], [0], rows, ""),
        ([None, -9], [0], rows, "lived on for 60 s"),
        ([3, -9], [2], rows, "exit 2: error: something"),
        ([3, -9], [0], rows.replace("-2.0", "-2.1"), "losses differ by 5.0e-02"),
        ([3, -9], [0], rows.replace("1,", "2,"), "losses differ by inf"),
    ]
    monkeypatch.setattr(scale.time, "sleep", lambda _: None)
    for number, (losing, going, left, expected) in enumerate(runs):
        codes = iter([losing, going])

        def start(config: Path, workdir: Path, count: int, codes=codes, left=left) -> list[Ended]:
            workdir.mkdir(exist_ok=True)
            (workdir / "metrics.csv").write_text(left)
            # The first is the one that lives on, whichever is killed.
            return [Ended(code) for code in next(codes)]

        monkeypatch.setattr(scale.training, "start_together", start)
        monkeypatch.setattr(scale.random.Random, "choice", lambda self, of: of[-1])
        found = scale.run(0, number, tmp_path, tmp_path)
        assert found.tried == 1
        assert expected in (found.lost or [""])[0] and bool(found.lost) == bool(expected)


def test_the_table_counts_and_any_loss_is_the_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = Tally("kills", 7, [], "7 SIGKILL"), Tally("stream", 9, ["memory grew"], "1 ms")
    assert from_line(as_line(bad)) == bad
    assert table([good, bad]).splitlines()[2:] == [
        "| kills | 7 | 7 | 0 | 7 SIGKILL |",
        "| stream | 9 | 8 | 1 | 1 ms |",
        "lost, stream: memory grew",
    ]
    for tallies, code in (([good], 0), ([good, bad], 1)):
        monkeypatch.setattr(command, "soak", lambda *_, tallies=tallies: tallies)
        if code:
            with pytest.raises(SystemExit) as caught:
                exit_code(command.main, ["--minutes", "1", "--seed", "3"])
            assert caught.value.code == code
        else:
            assert exit_code(command.main, ["--minutes", "1", "--seed", "3"]) == 0
        assert capsys.readouterr().out.startswith("seed 3, 1 minutes\n| part | tried | survived | lost |")
    assert exit_code(command.main, ["--minutes", "0"]) == 2
