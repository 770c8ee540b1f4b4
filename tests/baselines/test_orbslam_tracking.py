"""What ORB-SLAM tracked, frame by frame, and a process of it that crashes, hangs or is interrupted."""

import os
import signal
import time

import numpy as np
import pytest
from orbslam_stand_in import CAMERA, CRASH, HANG, LATE, LOST, NONE, OK, UNSURE, WORK, frame, sequence, turned

from mdnvo_jax.baselines import orbslam, orbslam_system
from mdnvo_jax.data.sequence import Sequence


def test_the_saved_poses_of_tracked_frames(stand_in, vocabulary, capfd):
    tracked = orbslam.track(sequence([NONE, NONE, OK, OK, UNSURE, LOST, OK]), vocabulary)
    # A frame of which ORB-SLAM is not sure is in its file, but has no pose that counts.
    assert tracked.indices.tolist() == [2, 3, 6]
    np.testing.assert_allclose(tracked.poses, [turned(i / 100, 2 * i / 100) for i in (2, 3, 6)], atol=1e-8)
    assert (tracked.kind, tracked.count, tracked.maps, tracked.died) == ("final", 7, [(2, 6, 3)], "")
    assert tracked.states[:5:2] == ["NOT_INITIALIZED", "OK", "RECENTLY_LOST"]
    assert capfd.readouterr() == ("", "")


def test_live_poses_are_of_the_longest_map(stand_in, vocabulary):
    what = [NONE, OK, OK, UNSURE, OK, NONE, OK, OK]
    live = orbslam.track(sequence(what), vocabulary, poses="live")
    assert (live.kind, live.maps, live.indices.tolist()) == ("live", [(1, 4, 3), (6, 7, 2)], [1, 2, 4])
    np.testing.assert_allclose(live.poses, [turned(i / 100, i / 100) for i in (1, 2, 4)], atol=1e-6)
    # The rotations are exact ones, although they come in float32.
    np.testing.assert_allclose(
        live.poses[:, :3, :3] @ live.poses[:, :3, :3].swapaxes(1, 2), [np.eye(3)] * 3, atol=1e-12
    )
    assert orbslam.track(sequence(what), vocabulary).indices.tolist() == [6, 7]


@pytest.mark.parametrize(
    ("what", "died"),
    [
        ([NONE, OK, OK, LOST, NONE, NONE], False),
        ([NONE, OK, OK, LOST, NONE, OK], False),
        ([NONE, OK, OK, LOST, NONE, CRASH], True),
    ],
)
def test_live_poses_stand_in_for_a_map_thrown_away(stand_in, vocabulary, what, died):
    tracked = orbslam.track(sequence(what), vocabulary)
    assert (tracked.kind, tracked.indices.tolist(), bool(tracked.died)) == ("live", [1, 2], died)


@pytest.mark.parametrize(
    ("states", "maps"),
    [
        ("", []),
        ("nnn", []),
        ("nook", [(1, 2, 2)]),
        ("nolloo", [(1, 5, 3)]),
        ("onnooolno", [(0, 0, 1), (3, 5, 3), (8, 8, 1)]),
    ],
)
def test_a_map_ends_when_there_is_none_and_not_when_it_is_lost(states, maps):
    words = {"n": "NOT_INITIALIZED", "o": "OK", "l": "RECENTLY_LOST", "k": "LOST"}
    assert orbslam.maps_of([words[letter] for letter in states]) == maps


def test_a_crash_keeps_what_was_tracked(stand_in, vocabulary):
    tracked = orbslam.track(sequence([NONE, OK, OK, OK, CRASH, OK]), vocabulary)
    assert (tracked.kind, tracked.indices.tolist(), len(tracked.states)) == ("live", [1, 2, 3], 4)
    assert tracked.died == "its process ended with SIGSEGV, its last words 'C++ prints what it likes'"
    assert orbslam.failure(tracked).startswith("ORB-SLAM died after 4 of 6 frames: its process ended with SIGSEGV")


def test_a_process_that_hangs_is_ended(stand_in, vocabulary, monkeypatch):
    monkeypatch.setattr(orbslam_system, "_ANSWER_WITHIN_S", 0.3)
    begin = time.monotonic()
    tracked = orbslam.track(sequence([NONE, OK, HANG, OK]), vocabulary)
    assert tracked.died == "it gave no answer in 0.3 s"
    assert time.monotonic() - begin < 10


def test_an_interrupt_leaves_no_process_behind(stand_in, vocabulary):
    frames = sequence([NONE, OK, OK])

    def interrupted(index):
        if index == 2:
            raise KeyboardInterrupt
        return frame(OK)

    frames = Sequence("drive", 3, interrupted, camera=CAMERA)
    started = []

    class Watched(orbslam_system.System):
        def __enter__(self):
            started.append(self._process.pid)
            return super().__enter__()

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(orbslam, "System", Watched)
        orbslam.track(frames, vocabulary)
    with pytest.raises(ProcessLookupError):
        os.kill(started[0], signal.SIG_DFL)


def test_the_next_frame_waits_for_mapping(stand_in, vocabulary):
    patient = orbslam.track(sequence([NONE, OK, WORK, LATE, OK]), vocabulary, patience_s=30)
    assert patient.indices.tolist() == [1, 2, 3, 4]
    assert patient.unsettled == 0
    assert patient.settle_s.argmax() == 2
    rushed = orbslam.track(sequence([NONE, OK, WORK, LATE, OK]), vocabulary, patience_s=0)
    assert rushed.indices.tolist() == [1, 2, 4]
    assert rushed.unsettled == 5


def test_frames_are_fed_no_faster_than_asked(stand_in, vocabulary):
    times = 1000 + np.array([0, 0.1, 0.2, 0.9, 1.0, 1.1])
    by_times = orbslam.track(sequence([NONE] + [OK] * 5, timestamps=times), vocabulary)
    assert by_times.settings["rate_hz"] == pytest.approx(10)
    np.testing.assert_allclose(by_times.poses[:, 2, 3], 2 * (times[1:] - 1000), atol=1e-6)
    by_default = orbslam.track(sequence([NONE] + [OK] * 5, timestamps=None), vocabulary, rate_hz=50)
    assert by_default.settings["rate_hz"] == 50
    np.testing.assert_allclose(by_default.poses[:, 2, 3], 2 * np.arange(1, 6) / 10)
    begin = time.monotonic()
    orbslam.track(sequence([NONE] * 6), vocabulary, rate_hz=5)
    assert time.monotonic() - begin > 6 / 5
