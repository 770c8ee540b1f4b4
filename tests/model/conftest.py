"""What the tests of the model share: PyTorch's recorded results, a measure of agreement, a writer of checkpoints."""

import io
import pickle
import sys
import types
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest

GOLDEN = Path(__file__).resolve().parents[1] / "golden"


@pytest.fixture
def golden():
    """The folder of recorded files; tests/golden/make_torch_golden.py made those that come from PyTorch."""
    return GOLDEN


@pytest.fixture
def assert_close():
    """Largest difference relative to the largest value expected."""

    def check(found, expected, relative):
        found, expected = np.asarray(found, np.float64), np.asarray(expected, np.float64)
        assert found.shape == expected.shape
        assert np.abs(found - expected).max() <= relative * np.abs(expected).max()

    return check


@pytest.fixture
def write_checkpoint(monkeypatch):
    """Write what torch.save would, in either layout, without torch: arrays become tensors."""
    # pickle checks that what it names can be imported.
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    rebuild = types.FunctionType((lambda: None).__code__, {}, "_rebuild_tensor_v2")
    rebuild.__module__, rebuild.__qualname__ = "torch._utils", "_rebuild_tensor_v2"
    utils._rebuild_tensor_v2 = rebuild
    kinds = {np.dtype("f4"): "FloatStorage", np.dtype("f8"): "DoubleStorage", np.dtype("i8"): "LongStorage"}
    for name in kinds.values():
        setattr(torch, name, type(name, (), {"__module__": "torch"}))

    class Storage:
        def __init__(self, key, array):
            self.identity = ("storage", getattr(torch, kinds[array.dtype]), key, "cpu", array.size)

    def write(path, content, *, zipped=True, protocol=2):
        storages = {}

        class Pickler(pickle.Pickler):
            def persistent_id(self, value):
                return value.identity if isinstance(value, Storage) else None

            def reducer_override(self, value):
                if not isinstance(value, np.ndarray):
                    return NotImplemented
                key = str(len(storages))
                storages[key] = value
                strides = tuple(stride // value.itemsize for stride in value.strides)
                return rebuild, (Storage(key, value), 0, value.shape, strides, False, OrderedDict())

        program = io.BytesIO()
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, "torch", torch)
            patch.setitem(sys.modules, "torch._utils", utils)
            Pickler(program, protocol).dump(content)
        if zipped:
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr("archive/data.pkl", program.getvalue())
                archive.writestr("archive/byteorder", "little")
                for key, array in storages.items():
                    archive.writestr(f"archive/data/{key}", array.ravel(order="K").tobytes())
        else:
            with path.open("wb") as file:
                for value in (0x1950A86A20F9469CFC6C, 1001, {"protocol_version": 1001, "little_endian": True}):
                    pickle.dump(value, file, protocol=2)
                file.write(program.getvalue())
                pickle.dump(list(storages), file, protocol=2)
                for array in storages.values():
                    file.write(array.size.to_bytes(8, "little") + array.ravel(order="K").tobytes())
        return path

    return write
