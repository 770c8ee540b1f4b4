import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation.association import pair
from mdnvo_jax.evaluation.formats import PoseFile


def file(count, *, frames=None, timestamps=None, format="kitti", path="estimate"):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.arange(count)
    as_array = lambda values: None if values is None else np.asarray(values)  # noqa: E731
    return PoseFile(path, format, poses, as_array(frames), as_array(timestamps))


def test_row_by_row_where_the_counts_agree():
    paired = pair(file(5), file(5))
    assert paired.how == "row" and paired.frames.tolist() == [0, 1, 2, 3, 4]


def test_by_frame_number():
    paired = pair(file(3, frames=[1, 2, 4]), file(5))
    assert paired.frames.tolist() == [1, 2, 4]
    assert paired.rows_of_reference.tolist() == [1, 2, 4]
    assert paired.how == "frame number"


def test_by_frame_number_where_the_reference_misses_frames_too():
    paired = pair(file(4, frames=[10, 11, 12, 14]), file(4, frames=[10, 12, 13, 14]))
    assert paired.frames.tolist() == [10, 12, 14]
    assert paired.rows_of_reference.tolist() == [0, 1, 3]
    assert paired.rows_of_estimate.tolist() == [0, 2, 3]


def test_first_frame_says_where_a_shorter_file_begins():
    paired = pair(file(3), file(6), first_frame=2)
    assert paired.frames.tolist() == [2, 3, 4]


def test_a_shorter_file_is_not_guessed_at():
    with pytest.raises(InputError, match=r"3 poses, truth has 6, and nothing says which frames.*--first-frame"):
        pair(file(3), file(6, path="truth"))


def test_frames_outside_the_reference():
    with pytest.raises(InputError, match=r"frame 6 is outside the reference, whose frames are 0 to 5"):
        pair(file(2, frames=[0, 6]), file(6))
    with pytest.raises(InputError, match=r"frame 6 is outside"):
        pair(file(2), file(6), first_frame=5)


def test_by_time_within_the_tolerance_each_frame_once():
    estimate = file(5, timestamps=[0.001, 0.099, 0.102, 0.25, 0.31], format="tum")
    paired = pair(estimate, file(4, timestamps=[0.0, 0.1, 0.2, 0.3], format="tum"))
    assert paired.frames.tolist() == [0, 1, 3]
    # Of 0.099 and 0.102 the nearer one stays; 0.31 is exactly as far away as allowed.
    assert paired.rows_of_estimate.tolist() == [0, 1, 4]
    np.testing.assert_array_equal(paired.estimate[:, 2, 3], [0, 1, 4])
    assert paired.how == "time within 0.01 s"


def test_times_from_a_file_of_their_own():
    paired = pair(file(2, timestamps=[0.2, 0.4]), file(3), reference_times=np.array([0.0, 0.2, 0.4]))
    assert paired.frames.tolist() == [1, 2]
    with pytest.raises(InputError, match="2 times for the 3 poses"):
        pair(file(2), file(3), reference_times=np.array([0.0, 0.2]))


def test_clocks_that_differ_are_said_so():
    estimate = file(3, timestamps=[100.0, 100.1, 100.2], format="tum")
    with pytest.raises(InputError, match=r"0 of 3 timestamps.*100 to 100.2 s, the reference 0 to 2 s.*--tolerance"):
        pair(estimate, file(3, timestamps=[0.0, 1.0, 2.0], format="tum"))


def test_our_own_folder_goes_by_row_even_with_other_times():
    estimate = file(3, timestamps=[7.0, 8.0, 9.0], format="output")
    assert pair(estimate, file(3, timestamps=[0.0, 1.0, 2.0])).how == "row"


def test_one_common_frame_is_not_enough():
    with pytest.raises(InputError, match="1 poses match frames"):
        pair(file(1, frames=[2]), file(5))


@given(st.sets(st.integers(0, 40), min_size=2), st.floats(-0.004, 0.004))
def test_time_finds_what_frame_numbers_find(frames, jitter):
    numbers = sorted(frames)
    reference = file(41, timestamps=0.1 * np.arange(41))
    estimate = file(len(numbers), timestamps=0.1 * np.array(numbers) + jitter, format="tum")
    assert pair(estimate, reference).frames.tolist() == numbers
