import gzip
import io
import json
import os
import re
import signal
import tarfile
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from mdnvo_jax.baselines import orbslam, orbslam_system
from mdnvo_jax.data.folder import read_frames
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError, exit_code
from mdnvo_jax.evaluation.association import pair
from mdnvo_jax.evaluation.formats import read_trajectory
from mdnvo_jax.evaluation.scoring import score_path

CAMERA = (700.0, 710.5, 4.0, 3.0)
CAMERA_OPTION = ["--camera", ",".join(map(str, CAMERA))]
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


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Put a stand-in for pyorbslam3 before the real one, here and in processes started here."""
    folder = tmp_path / "site"
    (folder / "pyorbslam3-0.0.7.dist-info").mkdir(parents=True)
    (folder / "pyorbslam3-0.0.7.dist-info" / "METADATA").write_text("Name: pyorbslam3\nVersion: 0.0.7\n")
    (folder / "pyorbslam3.py").write_text(STAND_IN)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    return folder


@pytest.fixture
def vocabulary(tmp_path):
    path = tmp_path / "words.txt.gz"
    path.write_bytes(gzip.compress(WORDS.encode(), mtime=0))
    return path


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


def write_frames(folder, what):
    folder.mkdir()
    for number, do in enumerate(what):
        cv2.imwrite(str(folder / f"{number:03}.png"), frame(do))
    return str(folder)


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


def test_the_files_of_a_run(stand_in, vocabulary, tmp_path, capsys):
    images = write_frames(tmp_path / "frames", [NONE, LOST, NONE, LOST, OK, LOST, OK, LOST, LOST, LOST, OK])
    (tmp_path / "times.txt").write_text("".join(f"{1000 + n / 8}\n" for n in range(11)))
    code, output = run(
        tmp_path, images, vocabulary, *CAMERA_OPTION, "--stride", "2", "--timestamps", str(tmp_path / "times.txt")
    )
    said = capsys.readouterr().out
    assert code == 0
    assert said.startswith("3 of 6 frames tracked, up to scale, final poses, ms a frame ")
    assert sorted(path.name for path in output.iterdir()) == [
        "summary.json",
        "trajectory_kitti_indexed.txt",
        "trajectory_tum.txt",
    ]
    # Frame 4 of the folder is the third that was fed, 0.5 s after the first.
    expected = [turned(n / 8, n / 4) for n in (4, 6, 10)]
    indexed = read_trajectory(output / "trajectory_kitti_indexed.txt")
    assert (indexed.format, indexed.frames.tolist()) == ("indexed", [4, 6, 10])
    np.testing.assert_allclose(indexed.poses, expected, atol=1e-8)
    tum = read_trajectory(output / "trajectory_tum.txt")
    assert (tum.format, tum.timestamps.tolist()) == ("tum", [1000.5, 1000.75, 1001.25])
    np.testing.assert_allclose(tum.poses, expected, atol=1e-8)
    summary = json.loads((output / "summary.json").read_text())
    facts = {
        "frames": 6,
        "tracked": 3,
        "coverage": 0.5,
        "first_tracked": 4,
        "last_tracked": 10,
        "lost_frames": [[0, 2], [8, 8]],
        "maps": [{"first": 4, "last": 10, "tracked": 3}],
        "poses": "final",
        "failure": None,
        "timestamps": "given",
        "stride": 2,
        "images": images,
    }
    assert {key: summary[key] for key in facts} == facts
    assert summary["scale"].startswith("up to an unknown scale")
    assert summary["settings"]["camera"] == list(CAMERA)
    assert summary["settings"]["features"] == orbslam.FEATURES
    assert summary["versions"]["pyorbslam3"] == "0.0.7"
    assert len(summary["vocabulary"]["sha256"]) == 64


def test_no_trajectory_is_an_exit_code_of_its_own(stand_in, vocabulary, tmp_path, capsys):
    images = write_frames(tmp_path / "frames", [NONE] * 3)
    output = tmp_path / "out"
    output.mkdir()
    (output / "trajectory_tum.txt").write_text("of an earlier run")
    code, _ = run(tmp_path, images, vocabulary, *CAMERA_OPTION)
    assert (code, capsys.readouterr().err.count("holds files already")) == (2, 1)
    code, _ = run(tmp_path, images, vocabulary, *CAMERA_OPTION, "--force")
    assert code == orbslam.NO_TRAJECTORY == 3
    assert capsys.readouterr().err == (
        "error: no trajectory: ORB-SLAM did not initialise (3 frames, 2000 features); "
        f"{output / 'summary.json'} says more\n"
    )
    assert [path.name for path in output.iterdir()] == ["summary.json"]
    summary = json.loads((output / "summary.json").read_text())
    assert (summary["tracked"], summary["coverage"], summary["first_tracked"]) == (0, 0, None)
    assert summary["lost_frames"] == [[0, 2]]
    assert summary["failure"].startswith("no trajectory")


def test_a_crash_is_one_line_and_an_exit_code_of_its_own(stand_in, vocabulary, tmp_path, capsys):
    images = write_frames(tmp_path / "frames", [NONE, OK, OK, CRASH, OK])
    code, output = run(tmp_path, images, vocabulary, *CAMERA_OPTION)
    assert code == orbslam.DIED == 4
    assert re.fullmatch(r"error: ORB-SLAM died after 3 of 5 frames: .*SIGSEGV.*\n", capsys.readouterr().err)
    assert read_trajectory(output / "trajectory_kitti_indexed.txt").frames.tolist() == [1, 2]
    assert json.loads((output / "summary.json").read_text())["poses"] == "live"


def test_without_timestamps_the_frame_numbers_are_the_times(stand_in, vocabulary, tmp_path):
    images = write_frames(tmp_path / "frames", [NONE, OK, OK])
    code, output = run(tmp_path, images, vocabulary, *CAMERA_OPTION)
    assert code == 0
    assert read_trajectory(output / "trajectory_tum.txt").timestamps.tolist() == [1, 2]
    assert json.loads((output / "summary.json").read_text())["timestamps"] == "frame numbers"


def test_without_pyorbslam3_the_message_gives_the_pip_line(vocabulary, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    code, output = run(tmp_path, "anything", vocabulary)
    assert code == 2
    assert "pip install 'mdnvo_jax[orbslam]'" in capsys.readouterr().err
    assert not output.exists()


def test_a_library_that_is_missing_is_not_blamed_on_the_vocabulary(stand_in, vocabulary):
    (stand_in / "pyorbslam3.py").write_text("raise ImportError('libOpenGL.so.0: no such file')")
    with pytest.raises(InputError, match=r"libOpenGL.so.0: no such file: install it \(Debian: apt install libgl1"):
        orbslam.track(sequence([OK, OK]), vocabulary)


def test_a_crash_at_the_start_is_blamed_on_the_vocabulary(stand_in, vocabulary):
    (stand_in / "pyorbslam3.py").write_text("print('Loading'); import os; os._exit(255)")
    with pytest.raises(InputError, match=r"ended with exit code 255.*: fetch .*words.txt.gz again"):
        orbslam.track(sequence([OK, OK]), vocabulary)


@pytest.mark.parametrize(
    ("known", "options", "message"),
    [
        ({"camera": None}, {}, "drive has no camera: .* give --camera fx,fy,cx,cy"),
        ({"timestamps": np.array([0.0, 1.0, 1.0])}, {}, "frame 2 of sequence drive is not later than the frame before"),
        ({}, {"features": 0}, "0 features"),
        ({}, {"rate_hz": 0.0}, "0 Hz"),
        ({}, {"rate_hz": float("nan")}, "nan Hz"),
        ({}, {"patience_s": -1.0}, "patience -1 s"),
        ({}, {"poses": "best"}, "'best': expected 'final' or 'live'"),
        ({"read": lambda index: np.zeros((6, 8, 3), np.uint8)}, {}, "expected a grey frame"),
    ],
)
def test_what_a_user_can_mend(stand_in, vocabulary, known, options, message):
    read = known.pop("read", None)
    frames = sequence([NONE, OK, OK], **known)
    if read is not None:
        frames = Sequence("drive", 3, read, camera=CAMERA)
    with pytest.raises(InputError, match=message):
        orbslam.track(frames, vocabulary, **options)


def packed(name, content):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        entry = tarfile.TarInfo(name)
        entry.size = len(content)
        archive.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("ORBvoc.txt", WORDS.encode()),
        ("ORBvoc.txt.gz", gzip.compress(WORDS.encode(), mtime=0)),
        ("ORBvoc.txt.tar.gz", packed("ORBvoc.txt", WORDS.encode())),
    ],
)
def test_a_vocabulary_is_unpacked(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    (tmp_path / "work").mkdir()
    assert orbslam_system.unpack_vocabulary(tmp_path / name, tmp_path / "work").read_text() == WORDS


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("v.txt", None, "no vocabulary at .*v.txt: expected a DBoW2 vocabulary"),
        ("v.txt", b"not a vocabulary\n", "v.txt is no vocabulary: expected DBoW2's text"),
        ("v.txt", b"10 6 0 0\n", "is no vocabulary"),
        ("v.txt", b"\x00\xff" * 5000, "is no vocabulary"),
        ("v.txt.gz", WORDS.encode(), "cannot read the vocabulary"),
        ("v.txt.gz", gzip.compress(WORDS.encode() * 100, mtime=0)[:40], "cannot read the vocabulary"),
        ("v.tar.gz", WORDS.encode(), "cannot read the vocabulary"),
        ("v.tar.gz", packed("readme.md", b"hello"), "holds 0 files .txt"),
    ],
)
def test_what_is_no_vocabulary_is_told_before_orbslam_crashes_on_it(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    (tmp_path / "work").mkdir()
    with pytest.raises(InputError, match=message):
        orbslam_system.unpack_vocabulary(tmp_path / name, tmp_path / "work")


def test_settings_are_typed_as_orbslam_wants_them():
    # It ends the process on `fx: 700` and on `nFeatures: 2000.0`.
    lines = orbslam_system.settings((700.0, 710.5, 601.8873, 183), (370, 1226), 1500, 9.67).splitlines()
    assert lines[:2] == ["%YAML:1.0", "---"]
    written = dict(line.split(": ") for line in lines[2:])
    assert written["Camera1.fx"] == "700.000000000"
    assert written["Camera1.fy"] == "710.500000000"
    assert written["Camera1.cx"] == "601.887300000"
    assert written["Camera1.cy"] == "183.000000000"
    assert (written["Camera.width"], written["Camera.height"], written["Camera.fps"]) == ("1226", "370", "10")
    assert (written["ORBextractor.nFeatures"], written["loopClosing"]) == ("1500", "0")
    assert "." in written["Viewer.PointSize"]


# The real thing.


@pytest.fixture(scope="module")
def real_vocabulary():
    reason = "pyorbslam3 is not installed, or does not load: pip install 'mdnvo_jax[orbslam]'"
    pytest.importorskip("pyorbslam3", reason=reason, exc_type=ImportError)
    default = Path(__file__).resolve().parents[3] / "shared" / "orbslam" / "ORBvoc_small.txt.gz"
    path = Path(os.environ.get("MDNVO_ORB_VOCABULARY", default))
    if not path.is_file():
        pytest.skip(f"no vocabulary at {path}: set MDNVO_ORB_VOCABULARY to a DBoW2 vocabulary of ORB words")
    return path


def test_a_clip_of_kitti_is_tracked_to_half_a_percent(real_vocabulary, data_root, tmp_path, capfd):
    clip = data_root / "kitti" / "sequences" / "06"
    if not clip.is_dir():
        pytest.skip(f"no {clip}")
    # Less patience than by default bounds the time of the test on a busy machine.
    code, output = run(tmp_path, str(clip), real_vocabulary, "--rate", "30", "--patience", "0.3")
    out, err = capfd.readouterr()
    assert (code, out.count("\n"), err) == (0, 1, ""), "one line of ours, none of ORB-SLAM's"
    summary = json.loads((output / "summary.json").read_text())
    assert (summary["frames"], summary["tracked"], summary["lost_frames"]) == (51, 50, [[0, 0]])
    assert summary["poses"] == "final"
    estimate = read_trajectory(output / "trajectory_kitti_indexed.txt")
    reference = read_trajectory(data_root / "kitti" / "poses" / "06.txt")
    score = score_path("ORB-SLAM", "06", pair(estimate, reference), "sim3")
    length_m = np.linalg.norm(np.diff(reference.poses[:, :3, 3], axis=0), axis=1).sum()
    assert np.sqrt((score.absolute_m**2).mean()) < 0.005 * length_m
    assert score.relative.rotation_deg.mean() < 0.2
    # Without a scale the estimate is far off: the alignment is what brings it there.
    assert not 0.5 < np.linalg.norm(estimate.poses[-1, :3, 3]) / length_m < 2


def test_what_does_not_move_does_not_initialise(real_vocabulary, data_root):
    clip = data_root / "kitti" / "sequences" / "06"
    if not clip.is_dir():
        pytest.skip(f"no {clip}")
    frames = read_frames(clip, 1)
    still = Sequence("still", 5, lambda index: frames.read(0), camera=frames.camera)
    tracked = orbslam.track(still, real_vocabulary, rate_hz=30)
    assert (len(tracked.indices), tracked.poses.shape, tracked.died) == (0, (0, 4, 4), "")
    assert orbslam.failure(tracked).startswith("no trajectory: ORB-SLAM did not initialise")


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
