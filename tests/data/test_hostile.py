"""Files that are damaged, made up or hostile: each is read, or refused in one line; nothing hangs, grows or is run."""

import ast
import contextlib
import json
import os
import pickle
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from nuscenes_fixture import VERSION, Spec, write_nuscenes
from PIL import Image

import mdnvo_jax
from mdnvo_jax.config import ImageConfig
from mdnvo_jax.data import images, kitti, nuscenes, picture_header
from mdnvo_jax.data.cache import prepare_cache, read_cache
from mdnvo_jax.data.folder import Video, read_frames
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation import formats
from mdnvo_jax.model import flownet

PICTURE = cv2.GaussianBlur(np.random.default_rng(2).integers(0, 256, (24, 32, 3), dtype=np.uint8), (0, 0), 2)
SUFFIXES = ("png", "jpg", "webp", "tiff", "bmp", "ppm", "pgm")
# A soak asks for more than an ordinary run of the tests.
EXAMPLES = int(os.environ.get("MDNVO_FUZZ_EXAMPLES", "60"))
quickly = settings(
    max_examples=EXAMPLES,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def in_one_line(read: Callable[[], object]) -> object:
    """Return what `read` gives, or None where it refuses as it should."""
    try:
        return read()
    except InputError as error:
        assert len(str(error)) < 1000
        return None


# Pictures


def encoded(suffix: str, picture: np.ndarray = PICTURE) -> bytes:
    return cv2.imencode(f".{suffix}", picture[..., 0] if suffix == "pgm" else picture)[1].tobytes()


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """Bytes of a whole file with some changed, some cut out, some put in, and perhaps the end missing."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(0, 4))):
        at = draw(st.integers(0, len(data) - 1))
        # The first bytes say most.
        at = draw(st.sampled_from([at, at % 64]))
        kind = draw(st.sampled_from(["flip", "cut", "insert"]))
        if kind == "flip":
            data[at] ^= draw(st.integers(1, 255))
        elif kind == "cut" and len(data) > 8:
            del data[at : at + draw(st.integers(1, 4))]
        else:
            data[at:at] = draw(st.binary(max_size=4))
        if not data:
            break
    return bytes(data[: draw(st.sampled_from([len(data), draw(st.integers(0, len(data)))]))])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damaged_pictures_are_read_or_refused(suffix: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    whole = encoded(suffix)
    path = tmp_path / f"a.{suffix}"

    @quickly
    @given(damaged(whole), st.sampled_from([1, 3]))
    def check(data: bytes, channels: int) -> None:
        path.write_bytes(data)
        image = in_one_line(lambda: images.read_image(path, channels))
        assert image is None or (image.dtype == np.uint8 and image.shape[2] == channels)
        assert image is None or image.size <= 3 * images.MOST_PIXELS

    check()


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_bomb(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    rows = zlib.compress(bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def patched(suffix: str, find: bytes, replace: bytes) -> bytes:
    whole = encoded(suffix)
    assert whole.count(find) >= 1
    return whole.replace(find, replace, 1)


BIG = 20_000
BOMBS = {
    "png": png_bomb(BIG, BIG),
    "jpg": patched("jpg", struct.pack(">HH", 24, 32), struct.pack(">HH", BIG, BIG)),
    "tiff": patched("tiff", struct.pack("<HHII", 256, 3, 1, 32), struct.pack("<HHII", 256, 4, 1, BIG * BIG)),
    "bmp": patched("bmp", struct.pack("<ii", 32, 24), struct.pack("<ii", BIG, -BIG)),
    "ppm": patched("ppm", b"32 24", b"20000\n# a comment\n20000"),
    "webp": b"RIFF\x20\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0" + (BIG - 1).to_bytes(3, "little") * 2 + bytes(40),
}


@pytest.mark.parametrize("suffix", BOMBS)
def test_a_header_that_asks_for_too_much_is_refused_before_decoding(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(BOMBS[suffix])
    monkeypatch.setattr(images.cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
    with pytest.raises(InputError, match=r"states 20000x20000 pixels|states 400000000x24 pixels"):
        images.read_image(path, 3)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
def test_the_size_in_every_kind_of_tiff(order: str, big: bool) -> None:
    mark = b"II" if order == "<" else b"MM"
    if big:
        head = mark + struct.pack(f"{order}HHHQ", 43, 8, 0, 16) + struct.pack(f"{order}Q", 2)
        entries = [struct.pack(f"{order}HHQQ", 257, 16, 1, 480), struct.pack(f"{order}HHQI4x", 256, 4, 1, 640)]
    else:
        head = mark + struct.pack(f"{order}HI", 42, 8) + struct.pack(f"{order}H", 2)
        entries = [struct.pack(f"{order}HHIH2x", 256, 3, 1, 640), struct.pack(f"{order}HHII", 257, 4, 1, 480)]
    data = head + b"".join(entries)
    assert picture_header.size(data) == (640, 480)
    assert picture_header.size(data[:-12]) is None


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("shape", [(1, 1), (300, 7), (3, 500)])
def test_the_size_in_the_header_is_that_of_the_picture(suffix: str, shape: tuple[int, int]) -> None:
    assert picture_header.size(encoded(suffix, np.zeros((*shape, 3), np.uint8))) == shape[::-1]


def test_the_size_of_lossless_and_lossy_webp() -> None:
    for quality in (50, 101):
        data = cv2.imencode(".webp", PICTURE, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
        assert picture_header.size(data) == (32, 24), data[12:16]


def test_pictures_that_are_unusual(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(PICTURE).convert("CMYK").save(path, quality=95)
    assert np.abs(images.read_image(path, 3).astype(int) - PICTURE).mean() < 30
    path.write_bytes(encoded("png"))
    assert (images.read_image(path, 3) == PICTURE[..., ::-1]).all(), "the content counts, not the name"
    for suffix in SUFFIXES:
        path.write_bytes(encoded(suffix, PICTURE[:1, :1]))
        assert images.read_image(path, 1).shape == (1, 1, 1)
        assert images.prepare(images.read_image(path, 3), None, ImageConfig()).shape == (184, 608, 3)
    for suffix in ("webp", "png"):
        film = cv2.Animation()
        film.frames, film.durations = [PICTURE, 255 - PICTURE], np.array([100, 100])
        path.write_bytes(cv2.imencodeanimation(f".{suffix}", film)[1].tobytes())
        first = images.read_image(path, 3)[..., ::-1]
        assert np.abs(first.astype(int) - PICTURE).mean() < 6, "the first picture of a film"


def test_what_is_no_picture_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    gif = cv2.imencode(".gif", PICTURE)[1].tobytes()
    exr = b"\x76\x2f\x31\x01" + bytes(100)
    for content in (b"", b"\0" * 100, gif, exr, b"P6", b"BM", b"II*\0", b"RIFF\0\0\0\0WEBP"):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"a\.png (cannot be decoded|is cut short)"):
            images.read_image(path, 3)
    for values in (np.full((4, 4), np.nan, np.float32), np.full((4, 4), 1e30, np.float64)):
        cv2.imwrite(str(tmp_path / "a.tiff"), values)
        with pytest.raises(InputError, match=r"samples of type float"):
            images.read_image(tmp_path / "a.tiff", 1)
    with pytest.raises(InputError, match="is no file"):
        images.read_image(tmp_path, 3)
    fifo = tmp_path / "pipe.png"
    os.mkfifo(fifo)
    with pytest.raises(InputError, match="is no file"):
        images.read_image(fifo, 3)
    with pytest.raises(InputError, match="cannot read"):
        images.read_image(f"{tmp_path}/nul\0.png", 3)
    with pytest.raises(InputError, match="cannot read"):
        images.read_image(tmp_path / ("x" * 5000), 3)


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # takes no room
    with pytest.raises(InputError, match="has 1099511627776 bytes"):
        images.read_image(path, 3)


@given(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False) | st.floats(-2000, 2000)] * 4))
@quickly
def test_any_camera_is_taken_or_refused(camera: tuple[float, float, float, float]) -> None:
    config = ImageConfig(height=20, width=40, channels=1, camera=(30.0, 30.0, 19.5, 9.5))

    def read() -> np.ndarray:
        sequence = Sequence("toy", 1, lambda _: np.zeros((24, 32, 1), np.uint8), camera=camera)
        return images.prepare(sequence.read(0), sequence.camera, config)

    frame = in_one_line(read)
    assert frame is None or frame.shape == (20, 40, 1)


# Text

numbers = st.floats(allow_nan=True).map(repr) | st.integers(-(10**25), 10**25).map(str) | st.floats(-2, 2).map(str)
words = numbers | st.sampled_from(
    ["1_0", "0x1", "#", "NaT", "inf", "-", "1e999", "\ud800".encode("utf-8", "replace").decode()]
)
lines = st.lists(words, min_size=0, max_size=14).map(" ".join)
rotations = st.sampled_from(["1 0 0 {} 0 1 0 {} 0 0 1 {}", "1 0 0 {} 0 0 -1 {} 0 1 0 {}", "{} 0 0 1 0 1 0 1 0 0 1 1"])
poses = st.tuples(rotations, numbers, numbers, numbers).map(lambda item: item[0].format(*item[1:]))
texts = st.lists(lines | poses | st.text(max_size=20), max_size=5).map("\n".join).map(str.encode) | st.binary(
    max_size=60
)


@given(data=texts)
@quickly
def test_any_pose_file_is_read_or_refused(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_bytes(data)
    found = in_one_line(lambda: kitti.read_poses(path))
    assert found is None or np.isfinite(found).all()
    for format in (None, "kitti", "indexed", "tum", "euroc"):
        read = in_one_line(lambda format=format: formats.read_trajectory(path, format=format))
        assert read is None or np.isfinite(read.poses).all()


@given(data=texts | st.lists(numbers, min_size=3, max_size=3).map("\n".join).map(str.encode))
@quickly
def test_any_file_of_times_is_read_or_refused(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "times.txt"
    path.write_bytes(data)
    found = in_one_line(lambda: kitti.read_times(path, 3))
    assert found is None or (found.shape == (3,) and np.isfinite(found).all())
    in_one_line(lambda: formats.read_times(path))


@given(
    data=texts
    | st.lists(poses | lines, max_size=4)
    .map(lambda rows: "\n".join(f"P{i}: {row}" for i, row in enumerate(rows)))
    .map(str.encode)
)
# Its offset from camera 0 is beyond all numbers.
@example(data=b"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nP1: 2.2e-311 0 0 1 0 1 0 1 0 0 1 1")
@quickly
def test_any_calibration_is_read_or_refused(data: bytes, tmp_path: Path) -> None:
    folder = tmp_path / "sequences" / "00"
    for camera in ("image_0", "image_1"):
        if not (folder / camera).is_dir():
            (folder / camera).mkdir(parents=True)
            for number in range(2):
                cv2.imwrite(str(folder / camera / f"{number:06}.png"), PICTURE)
            (tmp_path / "poses").mkdir(exist_ok=True)
            (tmp_path / "poses" / "00.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 1\n")
    (folder / "calib.txt").write_bytes(data)
    config = ImageConfig(height=20, width=40, channels=1, camera=(30.0, 30.0, 19.5, 9.5))
    for camera in ("image_0", "image_1"):
        sequence = in_one_line(lambda camera=camera: kitti.read_kitti(tmp_path, "00", camera_folder=camera, channels=1))
        if sequence is not None:
            assert np.isfinite(sequence.poses).all()
            in_one_line(lambda sequence=sequence: images.prepare(sequence.read(0), sequence.camera, config))
        in_one_line(lambda camera=camera: read_frames(folder / camera, 1))


# nuScenes


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("nuscenes")
    write_nuscenes(root, [Spec("scene-0001", "Rain", frames=4)])
    return root


@contextlib.contextmanager
def put_back(path: Path) -> Iterator[str]:
    """Give the text of a table, which the table has again in the end."""
    whole = path.read_text()
    try:
        yield whole
    finally:
        path.write_text(whole)


def deep(levels: int) -> str:
    return "[" * levels + "]" * levels


HOSTILE = (
    *('"../../../etc/passwd"', '"/etc/passwd"', '"\\u0000"', '"x"', "[]", "{}", "null", "true", "1e999", "-1", "NaN"),
    *("9" * 400, "9" * 5000, f"[{'9' * 400},0,0]", deep(3), deep(100_000)),
    *('[[1,0,0],[0,1,0],[0,0,"a"]]', "[1e308,1e308,1e308]"),
)
hostile_values = st.sampled_from(HOSTILE)


@pytest.mark.parametrize("name", ["sensor", "calibrated_sensor", "scene", "sample", "sample_data", "ego_pose"])
def test_any_table_is_read_or_refused(name: str, tables: Path) -> None:
    path = tables / VERSION / f"{name}.json"
    whole = path.read_text()
    rows = json.loads(whole)

    @quickly
    @given(st.data())
    def check(data: st.DataObject) -> None:
        if data.draw(st.booleans()):
            index = data.draw(st.integers(0, len(rows) - 1))
            field = data.draw(st.sampled_from(sorted(rows[index])))
            row = dict(rows[index]) | {field: "HERE"}
            text = json.dumps([*rows[:index], row, *rows[index + 1 :]]).replace('"HERE"', data.draw(hostile_values))
            path.write_text(text)
        else:
            path.write_bytes(data.draw(damaged(whole.encode())))
        for interpolate in (False, True):
            sequence = in_one_line(
                lambda interpolate=interpolate: nuscenes.read_nuscenes(
                    tables, "scene-0001", version=VERSION, interpolate=interpolate
                )
            )
            if sequence is not None:
                assert all(Path(name).resolve().is_relative_to(tables.resolve()) for name in sequence.paths)
                assert np.isfinite(sequence.poses).all()
        in_one_line(lambda: nuscenes.scenes(tables, VERSION))

    with put_back(path):
        check()


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("scene", lambda whole: "[]", r"scene\.json has no scene"),
        ("scene", lambda whole: "[]" + whole[1:], r"scene\.json, line 1: something comes after the last row"),
        (
            "sample_data",
            lambda whole: re.sub(r'("timestamp": )\d+', rf"\g<1>{'9' * 400}", whole),
            r"timestamp 9{40}: exp",
        ),
    ],
)
def test_tables_that_fuzzing_found(name: str, damage: Callable[[str], str], message: str, tables: Path) -> None:
    path = tables / VERSION / f"{name}.json"
    with put_back(path) as whole:
        path.write_text(damage(whole))
        with pytest.raises(InputError, match=message):
            nuscenes.read_nuscenes(tables, "scene-0001", version=VERSION)


@pytest.mark.parametrize("file", ["../outside.jpg", "samples/../../outside.jpg", "/etc/hostname"])
def test_a_name_in_a_table_does_not_lead_out_of_the_data_set(tables: Path, file: str) -> None:
    path = tables / VERSION / "sample_data.json"
    with put_back(path) as whole:
        rows = json.loads(whole)
        next(row for row in rows if "CAM_FRONT" in row["filename"])["filename"] = file
        path.write_text(json.dumps(rows))
        with pytest.raises(InputError, match=r"filename .*: expected a path below the data set's root"):
            nuscenes.read_nuscenes(tables, "scene-0001", version=VERSION)


# Video


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("film") / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (32, 24))
    for _ in range(6):
        writer.write(PICTURE)
    writer.release()
    return path.read_bytes()


def test_damaged_videos_are_read_or_refused(film: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.avi"

    @quickly
    @given(damaged(film))
    def check(data: bytes) -> None:
        path.write_bytes(data)
        sequence = in_one_line(lambda: read_frames(path, 1))
        for index in range(0 if sequence is None else sequence.count):
            frame = in_one_line(lambda index=index: sequence.read(index))
            assert frame is None or frame.dtype == np.uint8

    check()


def test_a_playlist_is_no_video(film: bytes, tmp_path: Path) -> None:
    (tmp_path / "secret.avi").write_bytes(film)
    lists = {
        "m3u8": f"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{tmp_path}/secret.avi\n#EXT-X-ENDLIST\n",
        "ffconcat": f"ffconcat version 1.0\nfile {tmp_path}/secret.avi\n",
        "sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 26\n",
        "mp4": f"#EXTM3U\n#EXTINF:10,\n{tmp_path}/secret.avi\n\0",
    }
    for suffix, text in lists.items():
        path = tmp_path / f"list.{suffix}"
        path.write_text(text)
        with pytest.raises(InputError, match="is no video of a kind that is read"):
            read_frames(path, 1)
    assert Video(tmp_path / "secret.avi", 1).count == 6


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", ""])
def test_names_that_no_file_can_have(name: str) -> None:
    with pytest.raises(InputError):
        read_frames(name, 1)


# Nothing is run


class Marker:
    """What, unpickled, makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


def test_hostile_files_are_not_run(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    payload = np.array([Marker(marker)], dtype=object)
    np.savez(tmp_path / "a.npz", logits=payload, mean=payload, log_scale=payload, conv1=payload)
    (tmp_path / "a.pth").write_bytes(pickle.dumps({"state_dict": Marker(marker)}))
    sequence = Sequence("toy", 2, lambda _: np.zeros((4, 8, 1), np.uint8))
    config = ImageConfig(height=4, width=8, channels=1)
    prepare_cache([sequence], config, tmp_path / "cache")
    np.save(tmp_path / "cache" / "toy.npy", payload)
    output = tmp_path / "output"
    output.mkdir()
    (output / "trajectory_kitti.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    (tmp_path / "a.npz").rename(output / "mixture.npz")
    for read in (
        lambda: formats.read_trajectory(output),
        lambda: flownet.load_stack(output / "mixture.npz", {"params": {"stack": {}}}),
        lambda: read_cache(tmp_path / "cache", config),
        lambda: flownet.read_flownet(tmp_path / "a.pth", order="rgb"),
    ):
        with pytest.raises(InputError):
            read()
        assert not marker.exists()
    pickle.loads((tmp_path / "a.pth").read_bytes())
    assert marker.exists(), "the files would do harm if they were unpickled"


def test_nothing_of_the_package_unpickles() -> None:
    package = Path(mdnvo_jax.__file__).parent
    for path in [*package.rglob("*.py"), *(package.parent / "bin").glob("*")]:
        text = path.read_text()
        if path.suffix != ".py" and "python" not in text.splitlines()[0]:
            continue
        for node in ast.walk(ast.parse(text)):
            named = [alias.name for alias in node.names] if isinstance(node, (ast.Import, ast.ImportFrom)) else []
            named += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            bad = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"} & set(named)
            assert not bad, f"{path}:{node.lineno} imports {bad}"
            if not isinstance(node, ast.Call):
                continue
            call = ast.unparse(node.func)
            assert call not in ("eval", "exec", "torch.load", "pd.read_pickle"), f"{path}:{node.lineno}"
            if call in ("np.load", "numpy.load"):
                given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
                assert given.get("allow_pickle", "False") == "False", f"{path}:{node.lineno}"
