"""What is said of frames: each word at its threshold, in the steps it belongs to, and nowhere else."""

import gc
from pathlib import Path

import jax
import numpy as np
import pytest
import small_model

from mdnvo_jax import predictor, watch
from mdnvo_jax.data.sequence import Sequence

FRAMES = small_model.FRAMES[:14]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> predictor.Predictor:
    return predictor.load(small_model.save(tmp_path_factory.mktemp("model")))


def words_of(frames, times=None) -> list[str]:
    looker = watch.Watch()
    times = [None] * len(frames) if times is None else times
    return ["; ".join(looker.look(frame, time)) for frame, time in zip(frames, times, strict=True)][1:]


@pytest.mark.parametrize(
    ("level", "others", "share", "word"),
    [
        (16, 17, 0.99, "dark"),
        (16, 17, 0.98, ""),
        (17, 18, 1.0, ""),
        (250, 249, 0.9, "saturated"),
        (250, 249, 0.89, ""),
        (249, 248, 1.0, ""),
    ],
)
def test_blindness_begins_at_its_threshold(level: int, others: int, share: float, word: str) -> None:
    frame = np.full(1000, others, np.uint8)
    frame[: round(1000 * share)] = level
    assert watch.blindness(frame.reshape(10, 100, 1)) == word


def test_a_blind_frame_is_in_both_of_its_steps() -> None:
    frames = [*FRAMES[:3], np.zeros_like(FRAMES[0]), FRAMES[4], np.full_like(FRAMES[0], 255), FRAMES[6], FRAMES[7]]
    assert words_of(frames) == ["", "", "dark", "dark", "saturated", "saturated", ""]


def test_equal_frames_are_duplicates_and_then_frozen() -> None:
    almost = FRAMES[1].copy()
    almost[0, 0, 0] ^= 1
    frames = [FRAMES[0], FRAMES[0], FRAMES[1], almost, *[FRAMES[2]] * 5, FRAMES[3], FRAMES[3]]
    frozen = ["duplicate", "duplicate", "frozen", "frozen"]
    assert words_of(frames) == ["duplicate", "", "", "", *frozen, "", "duplicate"]


def test_a_frame_that_could_not_be_read_equals_none() -> None:
    assert words_of([FRAMES[0], None, FRAMES[0], FRAMES[0]]) == ["", "", "duplicate"]


def test_times_that_are_wrong() -> None:
    times = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.6, 0.55, 0.72, 0.9, 1.0]
    found = words_of(FRAMES[: len(times)], times)
    assert found == [*[""] * 6, "time stands still", "time goes back", "", "gap", ""]
    # Half the usual rate from the first step on is no gap, and jitter is none.
    assert not any(words_of(FRAMES, np.arange(14) * 0.2 + 0.03 * (np.arange(14) % 2)))


@pytest.mark.parametrize("mode", ["offline", "streaming"])
def test_predict_flags_steps_and_leaves_their_estimate_alone(
    model: predictor.Predictor, mode: str, tmp_path: Path
) -> None:
    frames = FRAMES.copy()
    frames[3] = frames[2]
    frames[6] = 0
    times = np.arange(14) * 0.1
    times[11] = 0.95
    whole = predictor.predict(model, frames, mode=mode)
    path = predictor.predict(model, Sequence("x", 14, frames.__getitem__, timestamps=times), mode=mode)
    expected = {2: "duplicate", 5: "dark", 6: "dark", 10: "time goes back", 11: "gap"}
    assert {step: flag for step, flag in enumerate(path.flags) if flag} == expected
    assert [flag for flag in whole.flags if flag] == ["duplicate", "dark", "dark"]
    np.testing.assert_array_equal(path.steps, whole.steps)
    np.testing.assert_array_equal(path.sigma, whole.sigma)

    def read(index: int) -> np.ndarray:
        if index == 8:
            raise predictor.InputError("bad")
        return frames[index]

    bad = predictor.predict(model, Sequence("x", 14, read, timestamps=times), mode=mode, bad_frames="hold")
    assert {step: flag for step, flag in enumerate(bad.flags) if flag} == expected | {7: "held", 8: "held"}
    bad.save(tmp_path)
    assert (tmp_path / "steps.csv").read_text().splitlines()[12].endswith(",gap")


def test_a_stream_keeps_nothing_of_the_frames_that_are_over(model: predictor.Predictor) -> None:
    state, looker, counts = model.stream_start(model.model), watch.Watch(), []
    for index in range(60):
        frame = FRAMES[index % 14]
        state, step = model.stream_step(model.model, state, frame, True)
        looker.look(frame, 0.1 * index)
        if index % 20 == 19:
            jax.block_until_ready((state, step))
            gc.collect()
            counts.append((len(jax.live_arrays()), sum(leaf.nbytes for leaf in jax.tree.leaves(state))))
    assert counts[0] == counts[1] == counts[2]
