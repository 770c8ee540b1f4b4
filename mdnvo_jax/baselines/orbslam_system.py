"""One run of ORB-SLAM in a process of its own: starting it, asking it frame by frame, and surviving its end."""

import gzip
import importlib.util
import json
import os
import select
import shutil
import signal
import struct
import subprocess
import sys
import tarfile
import tempfile
import zlib
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from mdnvo_jax.errors import InputError

Camera = tuple[float, float, float, float]

# Of ORB-SLAM's own settings for KITTI, as are the 2000 features that `orbslam.py` asks for unless told otherwise.
SCALE_FACTOR = 1.2
LEVELS = 8
FAST_THRESHOLDS = (20, 7)
# Settings of a window that is never opened, but without which ORB-SLAM ends the process.
_VIEWER = (
    *("KeyFrameSize", "KeyFrameLineWidth", "GraphLineWidth", "PointSize", "CameraSize", "CameraLineWidth"),
    *("ViewpointX", "ViewpointY", "ViewpointZ", "ViewpointF"),
)
_UNPACKED = "vocabulary.txt"
# What the wheel of pyorbslam3 expects to find on a machine, and small ones lack.
_LIBRARIES = "Debian: apt install libgl1 libegl1 libopengl0 libsm6 libice6 libx11-6 libxext6"
# The longest that it may take to answer before it counts as hung; the authors' vocabulary loads in half a minute.
_LOAD_WITHIN_S = 600.0
_ANSWER_WITHIN_S = 120.0
# Of the answers about frames.
TRACKED = "OK"
BEFORE_A_MAP = ("SYSTEM_NOT_READY", "NO_IMAGES_YET", "NOT_INITIALIZED")


class ProcessError(Exception):
    """ORB-SLAM's process ended, or stopped to answer. The message says how."""


@dataclass(frozen=True)
class Answer:
    """What became of a frame.

    Attributes:
      state: of tracking after it, in ORB-SLAM's words: OK, NOT_INITIALIZED, RECENTLY_LOST, LOST, ...
      pose: `T_world_camera`, `[4, 4]`, or None; rough where the state is not OK.
      track_s: what tracking it took, s.
      settle_s: how long mapping was waited for, s.
      settled: whether mapping was done by then.
    """

    state: str
    pose: np.ndarray | None
    track_s: float
    settle_s: float
    settled: bool


class System:
    """ORB-SLAM at work on the frames of one camera; a context manager, at whose end the process is gone.

    Args:
      vocabulary: a DBoW2 vocabulary as text, plain or packed.
      camera: fx, fy, cx, cy in pixels; frames are without distortion.
      size: height and width of the frames.
      features: ORB features a frame.
      rate_hz: frames a second by their timestamps; ORB-SLAM makes a key frame once a second at least.
      patience_s: how long mapping may work on one frame before the next is fed regardless; 0 feeds it at once.

    Raises:
      InputError: pyorbslam3 is not there or does not load, or `vocabulary` is none.
    """

    def __init__(
        self,
        vocabulary: str | Path,
        camera: Camera,
        size: tuple[int, int],
        *,
        features: int,
        rate_hz: float,
        patience_s: float,
    ) -> None:
        require()
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mdnvo-orbslam-")))
            words = unpack_vocabulary(vocabulary, folder)
            (folder / "settings.yaml").write_text(settings(camera, size, features, rate_hz), encoding="utf-8")
            self._saved = folder / "trajectory.txt"
            self._log = stack.enter_context((folder / "log.txt").open("w+b"))
            self._process = subprocess.Popen(
                # -P: the folder of that file holds modules of ours, which must not hide others of their names.
                [sys.executable, "-P", str(Path(__file__).with_name("orbslam_process.py"))],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._log,
                # An interrupt is for us, who then end it.
                process_group=0,
                # Its threads are watched one by one, and linear algebra would add one a core.
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            )
            stack.callback(self._end)
            setup = {
                "vocabulary": str(words),
                "settings": str(folder / "settings.yaml"),
                "trajectory": str(self._saved),
                "height": size[0],
                "width": size[1],
                "patience_s": patience_s,
            }
            try:
                self._ask(json.dumps(setup).encode() + b"\n", _LOAD_WITHIN_S)
            except ProcessError as error:
                remedy = f"install it ({_LIBRARIES})" if "ImportError" in str(error) else f"fetch {vocabulary} again"
                raise InputError(f"ORB-SLAM does not start: {error}: {remedy}") from error
            # It is read, and large.
            (folder / _UNPACKED).unlink(missing_ok=True)
            self._stack = stack.pop_all()

    def __enter__(self) -> "System":
        return self

    def __exit__(self, *unused: object) -> None:
        self._stack.close()

    def track(self, image: np.ndarray, time_s: float) -> Answer:
        """Feed one frame, grey uint8 `[height, width]`, taken at `time_s`, and wait until it is worked into the map.

        Raises:
          ProcessError: ORB-SLAM did.
        """
        answer = self._ask(struct.pack("<d", time_s) + image.tobytes(), _ANSWER_WITHIN_S)
        pose = answer.pop("pose")
        return Answer(pose=None if pose is None else np.array(pose), **answer)

    def finish(self) -> tuple[np.ndarray, np.ndarray]:
        """End the run and return the trajectory as ORB-SLAM saves it: each pose as the last optimisation left it.

        Of several maps it is that of the one with most key frames. Tracking must have been OK at least once.

        Returns:
          (times `[n]`, s, as they were fed; `T_world_camera`, `[n, 4, 4]`).

        Raises:
          ProcessError: ORB-SLAM did, or saved nothing.
        """
        from mdnvo_jax import geometry

        cast(IO[bytes], self._process.stdin).close()
        self._answer(_ANSWER_WITHIN_S)
        try:
            rows = np.array([line.split() for line in self._saved.read_text().splitlines()], float)
            # ns tx ty tz qx qy qz qw
            times, positions, quaternions = rows[:, 0] * 1e-9, rows[:, 1:4], rows[:, 4:8]
        except (OSError, ValueError, IndexError) as error:
            raise ProcessError(f"it saved no trajectory ({error})") from error
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3, :3] = geometry.matrix_from_quaternion(quaternions)
        poses[:, :3, 3] = positions
        return times, poses

    def _ask(self, question: bytes, within_s: float) -> dict[str, Any]:
        """Send a question and return its answer."""
        stdin = cast(IO[bytes], self._process.stdin)
        # If it ended, reading finds out how.
        with suppress(BrokenPipeError):
            stdin.write(question)
            stdin.flush()
        return self._answer(within_s)

    def _answer(self, within_s: float) -> dict[str, Any]:
        """Return the next answer."""
        stdout = cast(IO[bytes], self._process.stdout)
        # There is one answer a question: none lies in a buffer that select does not see.
        if not select.select([stdout], [], [], within_s)[0]:
            raise ProcessError(f"it gave no answer in {within_s:g} s")
        line = stdout.readline()
        if not line.endswith(b"\n"):
            raise ProcessError(self._epitaph())
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise ProcessError(answer["error"])
        return answer

    def _epitaph(self) -> str:
        """Return how the process ended, and the last that it said."""
        code = self._process.wait()
        how = f"its process ended with {signal.Signals(-code).name if code < 0 else f'exit code {code}'}"
        self._log.seek(0)
        said = [line.strip() for line in self._log.read().decode(errors="replace").splitlines() if line.strip()]
        return f"{how}, its last words {said[-1][:200]!r}" if said else how

    def _end(self) -> None:
        """End the process, whatever it is doing."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            # What it did not read any more breaks the pipe.
            with suppress(BrokenPipeError):
                cast(IO[bytes], pipe).close()


def require() -> None:
    """Check that pyorbslam3 is installed.

    Raises:
      InputError: it is not; the message gives the pip line.
    """
    if importlib.util.find_spec("pyorbslam3") is None:
        raise InputError(
            "pyorbslam3 is not installed; ORB-SLAM needs it: pip install 'mdnvo_jax[orbslam]' (GPL-3, Linux on x86-64)"
        )


def unpack_vocabulary(path: str | Path, folder: Path) -> Path:
    """Return a vocabulary as the plain text that ORB-SLAM reads, unpacked into `folder` where `path` is packed.

    Args:
      path: .txt, .txt.gz, or .tar.gz with one .txt in it, as ORB-SLAM's authors publish theirs.
      folder: for the unpacked text; 139 MB for the vocabulary of the authors.

    Raises:
      InputError: no such file, a damaged one, or one that is no vocabulary.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no vocabulary at {path}: expected a DBoW2 vocabulary of ORB words, .txt, .txt.gz or .tar.gz")
    words = folder / _UNPACKED
    try:
        if path.name.endswith((".tar.gz", ".tgz")):
            with tarfile.open(path) as archive:
                members = [member for member in archive if member.isfile() and member.name.endswith(".txt")]
                if len(members) != 1:
                    raise InputError(f"{path} holds {len(members)} files .txt: expected one, the vocabulary")
                with cast(IO[bytes], archive.extractfile(members[0])) as source, words.open("wb") as target:
                    shutil.copyfileobj(source, target)
        elif path.suffix == ".gz":
            with gzip.open(path) as source, words.open("wb") as target:
                shutil.copyfileobj(source, target)
        else:
            words = path.absolute()
        with words.open("rb") as text:
            head, first = text.readline(1000).split(), text.readline(1000).split()
    except (OSError, EOFError, zlib.error, tarfile.TarError) as error:
        raise InputError(f"cannot read the vocabulary {path} ({error}): fetch it again") from error
    # Branching, depth, scoring, weighting; then of each node parent, leaf or not, 32 bytes of descriptor, weight.
    # ORB-SLAM itself crashes on a file that is something else.
    if len(head) != 4 or not all(word.isdigit() for word in head) or len(first) != 35:
        raise InputError(
            f"{path} is no vocabulary: expected DBoW2's text for ORB, a line of 4 numbers (such as '10 6 0 0'), "
            "then lines of 35"
        )
    return words


def settings(camera: Camera, size: tuple[int, int], features: int, rate_hz: float) -> str:
    """Return the settings file of ORB-SLAM3, version 1.0, for one pinhole camera without distortion, loops off."""
    fx, fy, cx, cy = camera
    height, width = size
    # A real number must have a point, a whole one must have none.
    numbers: dict[str, float] = {
        "Camera1.fx": float(fx),
        "Camera1.fy": float(fy),
        "Camera1.cx": float(cx),
        "Camera1.cy": float(cy),
        **{f"Camera1.{coefficient}": 0.0 for coefficient in ("k1", "k2", "p1", "p2")},
        "Camera.width": width,
        "Camera.height": height,
        "Camera.fps": max(1, round(rate_hz)),
        "Camera.RGB": 1,
        "ORBextractor.nFeatures": features,
        "ORBextractor.scaleFactor": SCALE_FACTOR,
        "ORBextractor.nLevels": LEVELS,
        "ORBextractor.iniThFAST": FAST_THRESHOLDS[0],
        "ORBextractor.minThFAST": FAST_THRESHOLDS[1],
        **{f"Viewer.{name}": 1.0 for name in _VIEWER},
        "loopClosing": 0,
    }
    lines = ["%YAML:1.0", "---", 'File.version: "1.0"', 'Camera.type: "PinHole"']
    lines += [
        f"{key}: {value:.9f}" if isinstance(value, float) else f"{key}: {value}" for key, value in numbers.items()
    ]
    return "\n".join(lines) + "\n"
