import os
import pickle
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mdnvo_jax.errors import InputError
from mdnvo_jax.model.torch_file import Tensor, open_tensors


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("protocol", [2, 4])
def test_tensors_come_back(write_checkpoint, tmp_path, zipped, protocol):
    grid = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    arrays = {
        "plain": grid,
        "strided": np.asfortranarray(grid),  # as a channels-last tensor: other strides, same values
        "double": np.linspace(0, 1, 5),
        "count": np.array(7, np.int64),
    }
    content = {"epoch": 3, "lr": 1e-4, "arch": "flownets", "flag": True, "none": None, "list": [1, 2**40], "t": (1, 2)}
    path = write_checkpoint(tmp_path / "x.pth", {**content, "state_dict": arrays}, zipped=zipped, protocol=protocol)
    found, read = open_tensors(path)
    tensors = found.pop("state_dict")
    assert found == content
    assert list(tensors) == list(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(read(tensors[name]), array)
        assert read(tensors[name]).dtype == array.dtype


@pytest.mark.parametrize("name", ["flownets_zip.pth", "flownets_legacy.pth.tar"])
def test_files_of_torch_itself(golden, name):
    content, read = open_tensors(golden / name)
    assert content["arch"] == "flownets"
    weight = read(content["state_dict"]["conv6.0.weight"])
    assert weight.shape[1:] == (8 if "zip" in name else 16, 3, 3)
    assert weight.std() == pytest.approx(np.sqrt(2 / 1.01 / weight[0].size), rel=0.1)  # Kaiming, slope 0.1


def test_nothing_unpickles(golden, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("unpickled")

    for name in ("load", "loads", "Unpickler", "_Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    open_tensors(golden / "flownets_zip.pth")
    open_tensors(golden / "flownets_legacy.pth.tar")


# Hostile files. Each would, if it were unpickled, make the file `evidence` or import the module `trap`.


class Call:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def trap_module(folder):
    (folder / "trap.py").write_text(f"import os; os.mknod({str(folder / 'evidence')!r})\nclass Bait: pass\nbait = 1\n")


def programs(folder):
    command = f"touch {folder / 'evidence'}"
    return {
        "system": pickle.dumps(Call(os.system, command), protocol=2),
        "inside a state dictionary": pickle.dumps(
            {"state_dict": {"conv1.0.weight": Call(os.system, command)}}, protocol=2
        ),
        "exec, protocol 4": pickle.dumps(Call(exec, f"import os; os.system({command!r})"), protocol=4),
        "protocol 0": pickle.dumps(Call(os.system, command), protocol=0),
        "import alone": b"\x80\x02ctrap\nbait\n.",
        "import by protocol 4": b"\x80\x04\x8c\x04trap\x8c\x04bait\x93.",
        "instance": b"(itrap\nBait\n.",
        "object": b"\x80\x02(ctrap\nBait\no.",
        "new object": b"\x80\x02ctrap\nBait\n)\x81.",
        "dotted": b"\x80\x04\x8c\x0btorch._utils\x8c\x12os.system\x93.",
        "allowed function, hostile arguments": b"\x80\x02ccollections\nOrderedDict\n(cos\nsystem\ntR.",
        "build on a class": b"\x80\x02ccollections\nOrderedDict\n}b.",
        "called text": b"\x80\x02X\x09\x00\x00\x00os.system)R.",
        "extension": b"\x80\x02\x82\x01.",
    }


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("kind", programs(Path()))
def test_a_hostile_file_runs_nothing(tmp_path, monkeypatch, kind, zipped):
    trap_module(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    program = programs(tmp_path)[kind]
    path = tmp_path / "hostile.pth"
    if zipped:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("archive/data.pkl", program)
    else:
        head = (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True})
        path.write_bytes(b"".join(pickle.dumps(value, protocol=2) for value in head) + program + pickle.dumps([], 2))
    with pytest.raises(InputError, match=r"hostile\.pth is not readable as a PyTorch checkpoint"):
        open_tensors(path)
    assert not (tmp_path / "evidence").exists()
    assert "trap" not in sys.modules


def test_the_traps_would_work(tmp_path, monkeypatch):
    """So that the tests above prove something."""
    trap_module(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for kind in ("system", "exec, protocol 4", "import alone", "instance"):
        pickle.loads(programs(tmp_path)[kind])
        assert (tmp_path / "evidence").exists(), kind
        (tmp_path / "evidence").unlink()
        sys.modules.pop("trap", None)


# Files that are wrong in one place.


def push(value):
    """Instructions that put a plain value on the stack."""
    return pickle.dumps(value, protocol=2)[2:-1]


def tensor_program(offset=0, shape=(4,), strides=(1,), size=4, kind=b"FloatStorage", view=()):
    identity = [push("storage"), b"ctorch\n" + kind + b"\n", *map(push, ("0", "cpu", size, *view))]
    arguments = [b"(" + b"".join(identity) + b"tQ", *map(push, (offset, shape, strides, False, {}))]
    return b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(" + b"".join(arguments) + b"tR."


NUMBERS = np.arange(4, dtype=np.float32).tobytes()


def archive_file(path, program, byteorder="little", compression=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("x/data.pkl", program)
        archive.writestr("x/byteorder", byteorder)
        archive.writestr("x/data/0", NUMBERS)
    return path


def test_views_of_a_storage(tmp_path):
    content, read = open_tensors(archive_file(tmp_path / "x", tensor_program(1, (2, 1), (2, 7))))
    assert isinstance(content, Tensor)
    np.testing.assert_array_equal(read(content), [[1.0], [3.0]])
    content, read = open_tensors(archive_file(tmp_path / "x", tensor_program(4, (0, 3), (3, 1))))
    assert read(content).shape == (0, 3)


def test_tensors_saved_from_a_gpu(tmp_path):
    program = tensor_program().replace(b"ctorch\nFloat", b"ctorch.cuda\nFloat").replace(push("cpu"), push("cuda:0"))
    content, read = open_tensors(archive_file(tmp_path / "x", program))
    np.testing.assert_array_equal(read(content), [0, 1, 2, 3])


@pytest.mark.parametrize(
    "wrong",
    [
        {"offset": 1},
        {"shape": (5,)},
        {"shape": (3,), "strides": (2,)},
        {"shape": (5,), "strides": (0,)},
        {"shape": (10**12,), "strides": (0,)},
        {"offset": -1},
        {"strides": (-1,), "offset": 3},
        {"shape": (2, 2)},
        {"shape": (2.0,)},
        {"offset": "0"},
        {"shape": 4},
        {"size": 5},
        {"size": -4},
        {"kind": b"DoubleStorage"},
        {"kind": b"BFloat16Storage"},
        {"kind": b"load"},
        {"view": ((0, 1),)},
    ],
)
def test_a_tensor_never_reaches_outside_its_storage(tmp_path, wrong):
    with pytest.raises(InputError):  # on opening or on reading, either will do
        content, read = open_tensors(archive_file(tmp_path / "x.pth", tensor_program(**wrong)))
        read(content)


def test_a_missing_storage_is_named(tmp_path):
    program = tensor_program().replace(push("0"), push("7"))
    content, read = open_tensors(archive_file(tmp_path / "x.pth", program))
    with pytest.raises(InputError, match=r"x\.pth is damaged .*7"):
        read(content)


def test_a_damaged_storage_is_found(tmp_path):
    path = archive_file(tmp_path / "x.pth", tensor_program())
    data = path.read_bytes()
    spot = data.index(NUMBERS) + 2
    path.write_bytes(data[:spot] + b"\xff" + data[spot + 1 :])
    content, read = open_tensors(path)
    with pytest.raises(InputError, match="CRC"):
        read(content)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "begins with b''"),
        (b"<!DOCTYPE html><html>", "begins with b'<!DOCTYPE html>"),
        (b"\x89PNG\r\n", "begins with"),
        (b"PK\x03\x04 not a zip", "BadZipFile"),
        (b"\0" * 257 + b"ustar" + b"\0" * 250, "no tar archives"),
        (pickle.dumps({"a": 1}, protocol=2), "not of torch.save"),
        (pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(1000, 2), "protocol 1000"),
        (
            pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(1001, 2) + pickle.dumps({"little_endian": False}, 2),
            "big-endian",
        ),
    ],
)
def test_other_files_are_refused_with_the_reason(tmp_path, data, message):
    (tmp_path / "x.pth").write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        open_tensors(tmp_path / "x.pth")
    assert "expected a file that torch.save wrote" in str(caught.value)


def test_other_archives_are_refused_with_the_reason(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(InputError, match=r"without one data\.pkl"):
        open_tensors(tmp_path / "a.zip")
    with pytest.raises(InputError, match="big-endian"):
        open_tensors(archive_file(tmp_path / "b.zip", tensor_program(), byteorder="big"))
    with pytest.raises(InputError, match="compressed"):
        open_tensors(archive_file(tmp_path / "c.zip", tensor_program(), compression=zipfile.ZIP_DEFLATED))


def test_no_file_and_a_folder(tmp_path):
    for path in (tmp_path / "absent.pth", tmp_path):
        with pytest.raises(InputError, match=f"cannot read {path}"):
            open_tensors(path)


def test_a_stream_that_is_cut_short(golden, tmp_path):
    data = (golden / "flownets_legacy.pth.tar").read_bytes()
    for length in (10, 300, 3000, len(data) - 1):
        (tmp_path / "x.pth").write_bytes(data[:length])
        with pytest.raises(InputError, match="not readable"):
            open_tensors(tmp_path / "x.pth")


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_any_damage_is_an_input_error_or_does_not_matter(golden_bytes, tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp()
    zipped = data.draw(st.booleans())
    original = golden_bytes["program"] if zipped else golden_bytes["stream"]
    damaged = bytearray(original)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, min(len(damaged), 4000) - 1))] = data.draw(st.integers(0, 255))
    path = folder / "damaged.pth"
    if zipped:
        archive_file(path, bytes(damaged))
    else:
        path.write_bytes(damaged)
    try:
        content, read = open_tensors(path)
        state = content.get("state_dict") if isinstance(content, dict) else None
        for value in state.values() if isinstance(state, dict) else ():
            if isinstance(value, Tensor):
                read(value)
    except InputError:
        pass


def test_an_escape_in_damaged_text_is_damage_and_no_warning(golden_bytes, tmp_path):
    damaged = bytearray(golden_bytes["program"])
    damaged[damaged.index(b"ccollections") + 1] = ord("\\")  # a global's name "\\ollections"
    with pytest.raises(InputError, match="not readable"):
        open_tensors(archive_file(tmp_path / "x.pth", bytes(damaged)))


@pytest.fixture(scope="module")
def golden_bytes():
    folder = Path(__file__).resolve().parents[1] / "golden"
    with zipfile.ZipFile(folder / "flownets_zip.pth") as archive:
        program = archive.read(next(name for name in archive.namelist() if name.endswith("/data.pkl")))
    return {"program": program, "stream": (folder / "flownets_legacy.pth.tar").read_bytes()}
