import numpy as np
import pytest

from mdnvo_jax.evaluation import scoring
from mdnvo_jax.evaluation.association import Paired
from mdnvo_jax.evaluation.tables import as_markdown


def straight(count, speed=1.0):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.concatenate([[0.0], np.cumsum(np.broadcast_to(speed, count - 1))])
    return poses


def score(estimate, truth, name="one", split="10", how="none", frames=None, **options):
    frames = np.arange(len(truth)) if frames is None else frames
    return scoring.score_path(
        name, split, Paired(estimate[frames], truth, frames, frames, frames, "row"), how, **options
    )


def noisy(count, size, seed=0):
    return straight(count, 1.0 + size * np.random.default_rng(seed).standard_normal(count - 1))


def test_summary_holds_statistics_and_their_intervals():
    truth = straight(300)
    found = scoring.summarise(score(noisy(300, 0.1), truth), block=1)
    errors = 0.1 * np.abs(np.random.default_rng(0).standard_normal(299))
    rmse = found["rpe_translation_m"]["rmse"]
    assert rmse.value == pytest.approx(np.sqrt((errors**2).mean()))
    assert 0.08 < rmse.low < rmse.value < rmse.high < 0.12
    assert found["rpe_translation_m"]["max"].value == pytest.approx(errors.max())
    assert found["rpe_translation_m"]["std"].value == pytest.approx(errors.std())
    assert found["t_rel_percent"].low <= found["t_rel_percent"].value <= found["t_rel_percent"].high
    assert (found["frames_covered"], found["frames_total"], found["pairs"]) == (300, 300, 299)
    assert found["alignment"] == "none" and found["delta"] == "1 frame"


@pytest.mark.parametrize(("how", "said"), [("none", "none"), ("se3", "se3"), ("scale", "scale 2")])
def test_the_row_says_how_it_was_aligned(how, said):
    assert score(straight(20, 0.5), straight(20), how=how).alignment == said


def test_coverage_and_delta_are_said():
    frames = np.array([2, 3, 4, 7, 8, 9])
    found = scoring.path_row(scoring.summarise(score(straight(12), straight(12), frames=frames, delta=2)))
    assert found["frames"] == "6 of 12" and found["delta"] == "2 frames"


def test_pooled_errors_are_those_of_all_sequences():
    truths = [straight(150), straight(260)]
    parts = [score(noisy(len(truth), 0.1, seed), truth, split=str(seed)) for seed, truth in enumerate(truths)]
    together = scoring.pool(parts, "all")
    assert (together.split, together.covered, together.total) == ("all", 410, 410)
    np.testing.assert_array_equal(
        together.relative.translation_m, np.concatenate([part.relative.translation_m for part in parts])
    )
    assert len(np.unique(together.relative.frames)) == 149 + 259
    assert together.segments.possible == sum(part.segments.possible for part in parts)
    # Starts of different sequences stay apart.
    assert len(np.unique(together.segments.start)) == sum(len(np.unique(part.segments.start)) for part in parts)
    summary = scoring.summarise(together)
    mean = np.concatenate([part.segments.translation for part in parts]).mean()
    assert summary["t_rel_percent"].value == pytest.approx(100 * mean)


def test_blocks_of_starts_span_as_many_frames_as_blocks_of_frames(monkeypatch):
    truth, blocks = straight(400), []
    draw = scoring.bootstrap.draw_blocks

    def recorded(count, *, block, **more):
        blocks.append((count, block))
        return draw(count, block=block, **more)

    monkeypatch.setattr(scoring.bootstrap, "draw_blocks", recorded)
    scoring.summarise(score(noisy(400, 0.1), truth), block=30)
    # Pairs, frames, and those of the 40 starts every tenth frame that a segment of 100 m fits behind.
    assert blocks == [(399, 30), (400, 30), (30, 3)]


class TestDifference:
    def test_a_difference_that_is_noise_looks_like_noise(self):
        truth = straight(160)
        scores = [score(noisy(160, 0.1, seed), truth) for seed in range(40)]
        found = [scoring.rmse_difference(*pair) for pair in zip(scores[::2], scores[1::2], strict=True)]
        # 19 of 20 are expected; less than 16 has a chance of 0.3 %.
        assert sum(value.low < 0 < value.high for value in found) >= 16

    def test_a_difference_that_is_none_does_not(self):
        truth = straight(400)
        found = scoring.rmse_difference(score(noisy(400, 0.1), truth), score(noisy(400, 0.2), truth))
        assert found.value == pytest.approx(-0.1, abs=0.01)
        assert found.low < found.value < found.high < 0

    def test_frames_that_both_have_are_compared(self):
        truth = straight(60)
        speeds = np.full(59, 0.9)
        speeds[:30] = 0.5
        poor_start = straight(60, speeds)
        late = score(straight(60, 0.8), truth, frames=np.arange(31, 60))
        # On frames 31 to 59 the errors are 0.2 and 0.1, whatever happened before.
        assert scoring.rmse_difference(late, score(poor_start, truth)).value == pytest.approx(0.1)

    def test_nothing_in_common(self):
        truth = straight(20)
        early, late = (score(truth, truth, frames=frames) for frames in (np.arange(5), np.arange(10, 15)))
        assert np.isnan(scoring.rmse_difference(early, late).value)


def test_comparison_puts_the_constant_predictor_beside_each():
    truth = straight(300)
    floor = score(straight(300, 0.8), truth, name="constant predictor")
    table, summaries = scoring.comparison(
        "Pose error", [(score(noisy(300, 0.05), truth), floor), (floor, None)], ["where from"]
    )
    text = as_markdown(table)
    assert [row["name"] for row in table.rows] == ["one", "constant predictor"]
    assert summaries[0]["rpe_rmse_minus_constant_m"].high < 0
    assert "where from" in text and "95 % bootstrap" in text and "every tenth frame" in text
    assert [len(t.rows) for t in scoring.segment_tables(summaries)] == [4, 4]


def test_pooled_alignments_are_each_its_own():
    parts = [score(straight(20, speed), straight(20), how="scale") for speed in (0.5, 0.25)]
    assert scoring.pool(parts, "all").alignment == "each scale"


def test_short_paths_have_no_segment_tables():
    _, summaries = scoring.comparison("T", [(score(straight(20), straight(20)), None)], [])
    assert scoring.segment_tables(summaries) == []
    assert np.isnan(summaries[0]["t_rel_percent"].value)
