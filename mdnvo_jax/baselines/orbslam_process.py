"""The process that ORB-SLAM runs in: its C++ prints to stdout, and what goes wrong in it ends the process it is in.

`orbslam.py` starts this file as a program and asks it one thing at a time; each answer is a line of JSON.

| asked on stdin | answer on stdout |
|---|---|
| a line of JSON: vocabulary, settings, trajectory, height, width, patience_s | `{}` once ORB-SLAM has loaded them |
| time, float64, s; then `height * width` bytes of grey pixels, row by row | what became of that frame |
| the end of the stream | `{}` once the trajectory is saved in the file `trajectory` |

An answer `{"error": text}` says that it cannot go on. Nothing of the package is imported here, so that it starts fast.
"""

import json
import os
import struct
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any, BinaryIO

# Linux tells here what each thread of this process does.
_THREADS = Path("/proc/self/task")
_SAMPLE_EVERY_S = 1e-3
# ORB-SLAM's threads look for work every 3 to 5 ms: over twice that, one that sees some has begun it. Looking itself is
# short, but hit by a sample now and then.
_SAMPLES = 12
_BUSY_AT_MOST = 2


def settle(patience_s: float) -> bool:
    """Wait until the other threads of this process have nothing to do.

    Tracking returns the pose of a frame while local mapping is still at work on the map. As long as it is, ORB-SLAM
    turns new key frames down, and the next ones find too few points: rushed, or on a loaded machine, it loses track.
    No call tells when mapping is done, but then it sleeps, whereas a thread with work is running or ready to run,
    whatever else the machine does.

    Args:
      patience_s: how long to wait at most.

    Returns:
      False if they were still busy after that time. Where the system is not Linux nothing can be told: True at once.
    """
    if not _THREADS.is_dir():
        return True
    end = time.monotonic() + patience_s
    busy: deque[bool] = deque(maxlen=_SAMPLES)
    while time.monotonic() < end:
        busy.append(_others_run())
        if len(busy) == _SAMPLES and sum(busy) <= _BUSY_AT_MOST:
            return True
        time.sleep(_SAMPLE_EVERY_S)
    return False


def _others_run() -> bool:
    """Return whether another thread than this one is running or ready to run."""
    own = str(threading.get_native_id())
    for thread in _THREADS.iterdir():
        if thread.name == own:
            continue
        try:
            # The name, which precedes the state, is in brackets and may itself hold any sign.
            state = (thread / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue  # it ended meanwhile
        if state in "RD":
            return True
    return False


def main() -> None:
    """Answer until stdin ends."""
    # What C++ prints to stdout goes where stderr goes; the answers go where stdout went.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        _serve(sys.stdin.buffer, answers)
    except Exception as error:
        _answer(answers, {"error": f"{type(error).__name__}: {error}"})
    # Destructors of ORB-SLAM have nothing more to give, and may crash.
    sys.stdout.flush()
    os._exit(0)


def _serve(questions: BinaryIO, answers: BinaryIO) -> None:
    """Run ORB-SLAM over the frames in `questions`."""
    setup = json.loads(questions.readline())

    import numpy as np
    import pyorbslam3

    slam = pyorbslam3.Slam(setup["vocabulary"], setup["settings"], pyorbslam3.Sensor.MONOCULAR, use_viewer=False)
    _answer(answers, {})
    shape = (setup["height"], setup["width"])
    while len(stamp := questions.read(8)) == 8:
        (time_s,) = struct.unpack("<d", stamp)
        image = np.frombuffer(questions.read(shape[0] * shape[1]), np.uint8).reshape(shape)
        begin = time.monotonic()
        result = slam.track_monocular(image, time_s)
        tracked = time.monotonic()
        settled = settle(setup["patience_s"])
        _answer(
            answers,
            {
                "state": result.state.name,
                "pose": np.asarray(result.pose_wc, float).tolist() if result.pose_valid else None,
                "track_s": tracked - begin,
                "settle_s": time.monotonic() - tracked,
                "settled": settled,
            },
        )
    slam.shutdown()
    slam.save_trajectory_euroc(setup["trajectory"])
    _answer(answers, {})


def _answer(answers: BinaryIO, answer: dict[str, Any]) -> None:
    """Send one answer."""
    answers.write(json.dumps(answer).encode() + b"\n")
    answers.flush()


if __name__ == "__main__":
    main()
