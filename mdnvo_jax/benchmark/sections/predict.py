"""Section predict: frames a second offline, milliseconds a frame streaming, memory, beside the twin in PyTorch."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mdnvo_jax.benchmark import child, contest, material
from mdnvo_jax.benchmark.agreement import agree
from mdnvo_jax.benchmark.contest import CACHING, OURS, RECOMPUTING, Contest
from mdnvo_jax.benchmark.outcome import Outcome, Settings, compared
from mdnvo_jax.benchmark.timing import Contender, fastest, interleaved, rate, ratio
from mdnvo_jax.config import Config
from mdnvo_jax.data.images import prepare
from mdnvo_jax.evaluation.tables import Column, Row, Table, Value

_ROUNDS = 7
_BUDGET_S = 90.0


@dataclasses.dataclass(frozen=True)
class _Case:
    """A network, and how many frames it is given.

    Attributes:
      config: the network.
      frames: of the offline comparison. At the ends of a run a pair lies in fewer windows: few frames would spare the
        twin that recomputes more than they should.
      streamed: frames of the streaming comparison.
      memory: frames of the two processes whose memory is compared; empty leaves it out.
      live: whether streaming from disk is measured, for the project's target.
    """

    config: Config
    frames: int
    streamed: int
    memory: tuple[int, ...] = ()
    live: bool = False


def measure(settings: Settings) -> Outcome:
    """Measure prediction."""
    outcome = Outcome()
    if settings.short:
        cases = [_Case(material.small_config(32, 64, 1 / 32), 17, 6, live=True)]
        outcome.line("short form: memory is left out, for every measurement of it is a process")
    else:
        small = _Case(material.small_config(), 97, 400, (500, 5000), live=True)
        cases = [small, _Case(material.paper_config(184, 608, 1.0), 49, 40)]
    rows: dict[str, list[Row]] = {"decoded": [], "disk": [], "stream": [], "memory": []}
    for case in cases:
        entered = contest.enter(case.config, case.frames, settings, outcome)
        entered.assert_agreement(settings, outcome)
        rows["decoded"] += _decoded(entered, settings, outcome)
        rows["disk"] += _from_disk(entered, case, settings, outcome)
        rows["stream"] += _streaming(entered, case.streamed, settings, outcome)
        rows["memory"] += _memory(entered, case.memory, settings, outcome)
    outcome.tables += _tables(rows, settings)
    return outcome


def _rows(size: str, found: Mapping[str, Sequence[float]], frames: int) -> list[Row]:
    return [{"size": size, **compared(name, found, OURS), "rate": rate(found[name], frames)} for name in found]


def _decoded(entered: Contest, settings: Settings, outcome: Outcome) -> list[Row]:
    """Return rows of frames a second from decoded frames."""
    size = entered.size
    # All of them ran when they were compared.
    found = interleaved(entered.decoded(outcome), settings.rounds(_ROUNDS), warm_up=0, budget_s=_BUDGET_S)
    outcome.times(f"predict {size}, decoded", found)
    if entered.twins:
        best = fastest(found, entered.ours)
        cached = CACHING + "float32"
        halved = fastest(found, [CACHING + precision for precision in entered.twins if precision != "float32"])
        outcome.target("predict deepvo", size, ratio(found[RECOMPUTING + "float32"], found[OURS]))
        outcome.target("predict float32", size, ratio(found[cached], found[OURS]))
        outcome.target("predict best", f"{size}: {best}", ratio(found[cached], found[best]))
        outcome.target("predict best bf16", f"{size}: {best}; {halved}", ratio(found[halved], found[best]))
    return _rows(size, found, entered.sequence.count)


def _from_disk(entered: Contest, case: _Case, settings: Settings, outcome: Outcome) -> list[Row]:
    """Return rows of frames a second from files, offline and live."""
    live = entered.live() if case.live else {}
    found = interleaved(entered.from_disk() | live, settings.rounds(_ROUNDS), budget_s=_BUDGET_S / 3)
    outcome.times(f"predict {entered.size}, from disk", found)
    if live:
        best = fastest(found, live)
        outcome.target("live", best, rate(found[best], case.frames))
    return _rows(entered.size, found, case.frames)


def _streaming(entered: Contest, frames: int, settings: Settings, outcome: Outcome) -> list[Row]:
    """Return rows of the time a frame takes when frames come one by one, already decoded."""
    size, sequence = entered.size, entered.sequence

    def contender(stream: Callable[[np.ndarray], Any]) -> Contender:
        numbers = iter(range(10**9))

        def run() -> Any:
            frame = sequence.read(next(numbers) % sequence.count)
            return stream(prepare(frame, sequence.camera, entered.config.image))

        return run

    contenders = {name: contender(stream) for name, stream in entered.streams().items()}
    # The first frames compile, and fill the window.
    found = interleaved(contenders, frames, warm_up=entered.config.data.window + 2)
    means = {name: (run() - material.LABELS.mean) / material.LABELS.std for name, run in contenders.items()}
    for name, mean in means.items():
        agree(f"streaming, {name}", means[OURS], mean, contest.tolerance(name, settings))
    outcome.times(f"predict {size}, streaming", found)
    return [
        {"size": size, **compared(name, found, OURS), "late": Value(1e3 * float(np.quantile(found[name], 0.99)))}
        for name in contenders
    ]


def _memory(entered: Contest, counts: Sequence[int], settings: Settings, outcome: Outcome) -> list[Row]:
    """Return rows of the peak memory of fresh processes that predict few and many frames."""
    if not counts:
        return []
    size = entered.size
    checkpoint = material.write_checkpoint(entered.model, entered.config, settings.folder / "network")
    peaks = []
    for count in counts:
        printed = child.run(["-m", "mdnvo_jax.benchmark.memory", str(checkpoint), str(count)])
        peaks.append(float(printed.split()[-1]))
    outcome.times(f"predict {size}, peak memory, MB", {f"{n}": [peak] for n, peak in zip(counts, peaks, strict=True)})
    outcome.target("memory", f"{size}, {counts[-1]:,} over {counts[0]:,} frames", Value(peaks[-1] / peaks[0]))
    return [{"size": size, "frames": f"{n:,}", "mb": Value(peak)} for n, peak in zip(counts, peaks, strict=True)]


def _tables(rows: Mapping[str, list[Row]], settings: Settings) -> list[Table]:
    size, contender = Column("size", "size"), Column("contender", "contender")
    against = [Column("ratio", "time over ours, JAX float32", digits=2), Column("n", "rounds")]
    offline = [size, contender, Column("rate", "frames/s", digits=1), Column("ms", "ms in all", digits=1), *against]
    each = [Column("ms", "ms a frame", digits=2), Column("late", "99th percentile", digits=2)]
    source = settings.data or "drawn by the benchmark, 1241x376"
    notes = [
        "Densities were asserted to agree with ours: float32 to "
        f"{contest.TOLERANCE:g} of their norm in standardised units, others to {contest.BF16_TOLERANCE:g}.",
        "PyTorch: BatchNorm folded, channels_last, oneDNN, inference_mode, 8 pairs (DeepVO-style: 8 windows) at a "
        "time. bf16: weights and activations of the stack in bf16; bf16 autocast: weights in float32. LSTM and head in "
        "float32 in all, as in ours.",
        "DeepVO-style: a window of 6 pairs for every step, 5 of them shared with the window before, all recomputed. "
        "Caching: every pair once, the LSTM over the windows that ours uses, half a window apart.",
        "All: frames read and resized ahead by the same function on as many threads, trajectory with covariance at the "
        "end. Compilation and trial runs before the first frame are not counted; section start has them.",
    ]
    found = [
        Table(f"Offline from decoded frames ({source})", offline, rows["decoded"], notes=notes),
        Table(f"From files on disk ({source if settings.data else source + ', PNG'})", offline, rows["disk"]),
        Table(
            "Streaming, a frame at a time, from decoded frames, resizing included",
            [size, contender, *each, *against],
            rows["stream"],
        ),
    ]
    if rows["memory"]:
        columns = [size, Column("frames", "frames"), Column("mb", "peak memory, MB", digits=0)]
        notes = ["Each in a process of its own; frames are drawn when they are read."]
        found.append(Table("Memory of offline prediction", columns, rows["memory"], notes=notes))
    return found
