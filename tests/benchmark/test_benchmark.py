import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy import stats

import mdnvo_jax
from mdnvo_jax.benchmark import agreement, child, growth, machine, material, memory, peers, targets, timing
from mdnvo_jax.benchmark.__main__ import SECTIONS, main
from mdnvo_jax.benchmark.outcome import Outcome
from mdnvo_jax.benchmark.report import Report
from mdnvo_jax.config import Config
from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation.tables import Column, Table, Value
from mdnvo_jax.model.network import build
from mdnvo_jax.training.state import Model

ROOT = Path(__file__).parents[2]


def test_contenders_take_turns_and_each_round_begins_with_another_one() -> None:
    order: list[str] = []
    found = timing.interleaved({name: lambda name=name: order.append(name) for name in "abc"}, 4, warm_up=1)
    assert "".join(order) == "abc" + "abc" + "bca" + "cab" + "abc"
    assert {name: len(values) for name, values in found.items()} == {"a": 4, "b": 4, "c": 4}


def test_a_budget_cuts_rounds_but_not_below_the_least() -> None:
    def slow() -> None:
        time.sleep(0.01)

    assert len(timing.interleaved({"slow": slow}, 50, budget_s=0.0)["slow"]) == 3
    assert len(timing.interleaved({"slow": slow}, 50, budget_s=0.0, least=5)["slow"]) == 5
    assert len(timing.interleaved({"slow": slow}, 2, budget_s=0.0)["slow"]) == 2
    assert 3 < len(timing.interleaved({"slow": slow}, 50, budget_s=0.1)["slow"]) < 15


def test_what_is_not_to_be_timed_is_taken_off() -> None:
    def half() -> timing.Untimed:
        began = time.perf_counter()
        time.sleep(0.05)
        return timing.Untimed(time.perf_counter() - began)

    assert timing.seconds(half) < 0.02
    assert timing.seconds(lambda: time.sleep(0.05)) > 0.04


def test_ratios_are_medians_over_rounds_of_the_peer_over_ours() -> None:
    # A drift of the machine that meets both alike leaves the ratio alone: here everything slows down tenfold.
    found = timing.ratio(peer=[2.0, 4.0, 60.0], ours=[1.0, 2.0, 20.0])
    assert (found.value, found.low, found.high) == (2.0, 2.0, 2.5)
    # The ratio of the medians would be another.
    assert timing.ratio([1.0, 10.0, 12.0], [4.0, 2.0, 3.0]).value == 4.0
    assert timing.rate([0.5, 0.25, 1.0], count=10).value == 20.0
    # Neither by the best round nor by the mean, and of those asked for.
    assert timing.fastest({"a": [1.0, 5.0, 5.0], "b": [2.0, 3.0, 99.0], "c": [0.0] * 3}, ["a", "b"]) == "b"
    assert timing.spread([1.0, 2.0, 3.0, 4.0, 5.0], 1e3) == Value(3000.0, low=2000.0, high=4000.0)
    with pytest.raises(ValueError, match="zip"):
        timing.ratio([1.0, 2.0], [1.0])


def test_exponents_are_those_of_a_line_through_logarithms() -> None:
    sizes = [2, 4, 8, 16]
    exact = growth.exponent(sizes, [3 * size**1.5 for size in sizes])
    assert exact.value == pytest.approx(1.5, abs=1e-12)
    assert exact.spread == pytest.approx(0, abs=1e-12)
    seconds = [1.0, 2.5, 4.0, 9.0]
    expected = stats.linregress(np.log(sizes), np.log(seconds))
    found = growth.exponent(sizes, seconds)
    assert (found.value, found.spread) == pytest.approx((expected.slope, expected.stderr))
    assert math.isnan(growth.exponent([1, 2], [1.0, 2.0]).spread)


@pytest.mark.parametrize("theirs", [[1.0, 2.0, 3.01], [1.0, 2.0, math.nan], [1.0, 2.0], [-1.0, -2.0, -3.0]])
def test_what_disagrees_is_not_timed(theirs: list[float]) -> None:
    with pytest.raises(agreement.DisagreementError, match=r"outputs|one shape"):
        agreement.agree("outputs", [1.0, 2.0, 3.0], theirs, 1e-3)
    assert agreement.agree("outputs", [1.0, 2.0, 3.0], [1.0, 2.0, 3.001], 1e-3) == pytest.approx(
        0.001 / 14**0.5, rel=1e-3
    )
    assert agreement.relative_difference(([0.0, 0.5], [0.0, 0.0])) == 0.5
    assert agreement.relative_difference(([3.0], [0.0]), ([4.0, 5.0], [0.0, 10.0])) == pytest.approx(50**0.5 / 10)


def test_a_missing_peer_is_a_line_and_no_crash() -> None:
    outcome = Outcome()
    assert not peers.available("no_such_module", outcome)
    assert not peers.available("no_such_module.within", outcome)
    assert peers.available("json", outcome)
    assert outcome.lines[0] == (
        "no_such_module is not installed, so its rows are left out: pip install 'mdnvo_jax[bench]'"
    )


def test_what_is_too_slow_is_said_with_what_it_took() -> None:
    outcome = Outcome()
    outcome.left_out("256x80", "the slow one", 31.26, "the quick one", 4.0)
    assert outcome.lines == [
        "256x80: the slow one took 31.3 s in its first run, and the quick one 4.0 s: it was left out of the rounds"
    ]


def test_a_child_runs_what_this_process_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "of/the/user")
    script = "import os, mdnvo_jax as m; print(m.__file__, os.environ['A'], 'JAX_COMPILATION_CACHE_DIR' in os.environ)"
    assert child.run(["-c", script], {"A": "b"}).split() == [mdnvo_jax.__file__, "b", "False"]
    with pytest.raises(RuntimeError, match=r"^python -c .* failed: (.|\n)*ZeroDivisionError"):
        child.run(["-c", "1 / 0"])


def test_targets_are_all_there_and_judged() -> None:
    table = targets.table(
        {"lstm": [("small", Value(1.3)), ("large", Value(1.1))], "memory": [("x", Value(1.0))]}, short=False
    )
    rows = {(row["what"], row["where"]): row["met"] for row in table.rows}
    assert len(table.rows) == len(targets.TARGETS) + 1 == 14
    assert rows["BiLSTM with gradient vs torch.nn.LSTM", "small"] == "yes"
    assert rows["BiLSTM with gradient vs torch.nn.LSTM", "large"] == "NO"
    assert rows["memory, 5,000 frames over 500", "x"] == "yes, aim reached"
    assert rows["--help", ""] == "not measured in this run"
    assert targets.verdict(targets.TARGETS["help"], 0.9) == "yes"
    assert targets.verdict(targets.TARGETS["help"], 1.1) == "NO"
    assert targets.verdict(targets.TARGETS["help"], math.nan) == "NO"
    toys = targets.table({"lstm": [("toy", Value(9.0))]}, short=True)
    assert "yes" not in {row["met"] for row in toys.rows}


def test_every_section_that_is_done_is_on_disk(tmp_path: Path) -> None:
    report = Report(tmp_path, machine.describe(2), short=False)
    first = Outcome(tables=[Table("first table", [Column("a", "a")], [{"a": Value(math.nan)}])])
    first.times("what", {"ours": [1.0, 2.0]})
    first.target("help", "predict --help", Value(0.2))
    report.add("start", first, {"load_average": 0.5, "seconds": 3.0})
    stored = json.loads((tmp_path / "benchmark.json").read_text())
    assert list(stored["sections"]) == ["start"]
    assert stored["sections"]["start"]["tables"][0]["rows"] == [{"a": None}]
    assert stored["sections"]["start"]["seconds"]["what"]["ours"] == [1.0, 2.0]
    report.add("lstm", Outcome(lines=["left out"]), {"load_average": None, "seconds": 1.0})
    text = (tmp_path / "benchmark.md").read_text()
    for part in (
        "first table",
        "load average at its start 0.5",
        "- left out",
        "yes, aim reached",
        "not measured",
        "jax ",
    ):
        assert part in text
    assert list(json.loads((tmp_path / "benchmark.json").read_text())["sections"]) == ["start", "lstm"]


def test_the_machine_is_described() -> None:
    found = machine.describe(3)
    assert found["threads"] == 3
    assert found["cores"] == os.cpu_count()
    assert found["versions"]["jax"] == jax.__version__
    assert {"python", "mdnvo_jax", "torch", "openvino", "numpyro"} <= set(found["versions"])
    assert not set(found["flags"]) & set(found["flags_missing"])
    held = np.ones(30_000_000)
    before = machine.peak_memory_mb()
    assert before > held.nbytes / 2**20
    del held
    # The kernel's count is off by a few pages a thread.
    assert machine.peak_memory_mb() > before - 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sections", "none"], "invalid choice"),
        (["--repeats", "-1"], "--repeats"),
        (["--threads", "9999"], "expected 1 to"),
        (["--threads", "-1"], "expected 1 to"),
    ],
)
def test_unusable_arguments_are_named(arguments: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        main([*arguments, "--output", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_an_earlier_run_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "benchmark.md").write_text("of yesterday")
    with pytest.raises(InputError, match="--force"):
        main(["--output", str(tmp_path)])
    assert (tmp_path / "benchmark.md").read_text() == "of yesterday"


def test_frames_are_textured_like_real_ones_and_always_the_same(tmp_path: Path) -> None:
    sequence = material.drawn(3, 1)
    folder = material.write_pngs(sequence, tmp_path)
    share = np.mean([path.stat().st_size for path in folder.iterdir()]) / (376 * 1241)
    assert 0.5 < share < 0.65
    np.testing.assert_array_equal(sequence.read(1), material.drawn(3, 1).read(1))
    assert (sequence.read(1) != sequence.read(2)).mean() > 0.5


@pytest.fixture(scope="module")
def toy() -> tuple[Config, Model]:
    config = material.small_config(32, 64, 1 / 32)
    return config, material.untrained_model(config)


def test_the_memory_of_a_prediction_is_printed(
    toy: tuple[Config, Model], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, model = toy
    memory.main([str(material.write_checkpoint(model, config, tmp_path)), "9"])
    assert 50 < float(capsys.readouterr().out) < 100_000


def test_an_untrained_network_tells_frames_apart(toy: tuple[Config, Model]) -> None:
    # At the initial statistics of batch normalisation, the signal fades from layer to layer: all agree on nothing then.
    config, model = toy
    read = material.frame_reader(1, (32, 64))
    images = np.stack([[read(7 * row + index) for index in range(3)] for row in range(4)])
    network = build(config.image, config.model)
    variables = {"params": model.params, "batch_stats": model.batch_stats}
    outputs = np.asarray(jax.jit(network.apply)(variables, images, np.ones((4, 2), bool)))
    assert np.median(outputs.std((0, 1))) > 0.01


@pytest.fixture(scope="module")
def short_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The whole of `bin/benchmark --short` on a machine without PyTorch and numpyro."""
    folder = tmp_path_factory.mktemp("run") / "results"
    code = (
        "import runpy, sys; sys.modules |= {'torch': None, 'numpyro': None}; "
        f"sys.argv = ['benchmark', '--short', '--output', {str(folder)!r}]; "
        f"runpy.run_path({str(ROOT / 'bin' / 'benchmark')!r}, run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_the_short_form_fills_every_table(short_run: tuple[Path, str]) -> None:
    folder, printed = short_run
    stored = json.loads((folder / "benchmark.json").read_text())
    assert set(stored["sections"]) == set(SECTIONS)
    for name, section in stored["sections"].items():
        assert section["tables"], name
        assert all(table["rows"] for table in section["tables"]), name
        assert section["seconds"], name
        assert f"== {name}" in printed
    assert len(stored["targets"]["rows"]) >= len(targets.TARGETS)
    markdown = (folder / "benchmark.md").read_text()
    assert "Short form" in markdown
    assert "ours, JAX float32" in markdown
    assert "Targets" in printed


def test_ratios_in_the_report_follow_from_its_single_times(short_run: tuple[Path, str]) -> None:
    stored = json.loads((short_run[0] / "benchmark.json").read_text())
    section = stored["sections"]["mixture"]
    times = section["seconds"]["mixture M = 3"]
    rows = {row["contender"]: row for row in section["tables"][0]["rows"]}
    expected = times["ours, independent"][0] / times["ours, joint"][0]
    assert rows["ours, independent"]["ratio"]["value"] == pytest.approx(expected)
    assert rows["ours, joint"]["ratio"]["value"] == 1.0
    assert rows["ours, joint"]["ms"]["value"] == pytest.approx(1e3 * times["ours, joint"][0])


def test_missing_peers_are_said_and_everything_else_measured(short_run: tuple[Path, str]) -> None:
    stored = json.loads((short_run[0] / "benchmark.json").read_text())
    for name in ("train", "predict", "mixture", "input", "lstm"):
        assert any(line.startswith("torch is not installed") for line in stored["sections"][name]["lines"]), name
    assert any(line.startswith("numpyro is not installed") for line in stored["sections"]["mixture"]["lines"])


def test_our_variants_are_compared_before_they_are_timed(short_run: tuple[Path, str]) -> None:
    stored = json.loads((short_run[0] / "benchmark.json").read_text())
    found = stored["sections"]["predict"]["agreement"]
    assert [value for name, value in found.items() if name.endswith("ours, JAX float32")] == [0.0]
    assert all(0 <= value < 0.5 for name, value in found.items() if "bfloat16" in name)
    assert len(found) >= 2


def test_help_needs_no_heavy_import() -> None:
    check = """
import sys
try:
    from mdnvo_jax.benchmark.__main__ import main
    main(["--help"])
except SystemExit as done:
    assert not done.code
assert not {'jax', 'cv2', 'flax', 'torch', 'numpy'} & set(sys.modules), sorted(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--sections" in done.stdout
