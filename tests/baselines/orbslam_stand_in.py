"""What stands in for pyorbslam3, frames that tell it what to do, and a run of the command line; no test itself."""

import numpy as np

from mdnvo_jax.baselines import orbslam
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import exit_code

CAMERA = (700.0, 710.5, 4.0, 3.0)
WORDS = "10 6 0 0\n" + "0 0 " + "7 " * 32 + "0.5\n"

# What stands in for pyorbslam3 does with a frame what the frame's grey level says.
NONE, OK, UNSURE, LOST, CRASH, HANG, WORK, LATE = range(8)
STAND_IN = """
import enum, hashlib, os, signal, threading, time, types
import numpy as np

os.write(1, b"C++ prints at import\\n")
State = enum.Enum("State", "NOT_INITIALIZED OK RECENTLY_LOST LOST")
Sensor = types.SimpleNamespace(MONOCULAR=0)
NONE, OK, UNSURE, LOST, CRASH, HANG, WORK, LATE = range(8)

def turned(angle, z):
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[2, 3] = z
    return pose

class Slam:
    def __init__(self, vocabulary, settings, sensor, use_viewer):
        assert open(vocabulary).readline() == "10 6 0 0\\n" and "loopClosing: 0" in open(settings).read()
        assert sensor == 0 and not use_viewer
        self.saved, self.work = [], None

    def track_monocular(self, image, stamp):
        os.write(1, b"C++ prints what it likes\\n")
        assert image.shape == (6, 8) and image.dtype == np.uint8 and (image[:, 0] == image[0, 0]).all()
        assert list(image[0, 1:]) == list(range(1, 8)), "rows and columns in order"
        do = int(image[0, 0])
        if do == CRASH:
            os.kill(os.getpid(), signal.SIGSEGV)
        if do == HANG:
            time.sleep(60)
        if do == WORK:
            self.work = threading.Thread(target=hashlib.pbkdf2_hmac, args=("sha256", b"", b"", 1_000_000))
            self.work.start()
        if do == LATE and self.work.is_alive():
            do = LOST
        state = {NONE: State.NOT_INITIALIZED, UNSURE: State.RECENTLY_LOST, LOST: State.LOST}.get(do, State.OK)
        valid = state in (State.OK, State.RECENTLY_LOST)
        if state is State.NOT_INITIALIZED:
            self.saved = []
        elif valid:
            self.saved.append(stamp)
        return types.SimpleNamespace(state=state, pose_valid=valid, pose_wc=turned(stamp, stamp) if valid else None)

    def shutdown(self):
        self.stopped = True

    def save_trajectory_euroc(self, name):
        assert self.stopped
        if not self.saved:
            os.kill(os.getpid(), signal.SIGSEGV)
        with open(name, "w") as file:
            for stamp in self.saved:
                q = f"0 {np.sin(stamp / 2):.9f} 0 {np.cos(stamp / 2):.9f}"
                file.write(f"{stamp * 1e9:.6f} 0.000000000 0.000000000 {2 * stamp:.9f} {q}\\n")
"""


def frame(do):
    image = np.tile(np.arange(8, dtype=np.uint8), (6, 1))
    image[:, 0] = do
    return image[..., None]


def sequence(what, *, rate_hz=100.0, **known):
    given = {"camera": CAMERA, "timestamps": 1000 + np.arange(len(what)) / rate_hz, **known}
    return Sequence("drive", len(what), lambda index: frame(what[index]), **given)


def turned(angle, z):
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[2, 3] = z
    return pose


def run(tmp_path, images, vocabulary, *options):
    """Return the exit code of the command line, and its output folder."""
    output = tmp_path / "out"
    try:
        code = exit_code(
            orbslam.main, [images, "--vocabulary", str(vocabulary), "--output", str(output), "--rate", "200", *options]
        )
    except SystemExit as end:
        code = end.code
    return code, output
