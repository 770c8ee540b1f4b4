"""Reads the tensors of a file that `torch.save` wrote, without torch and without unpickling.

Such a file holds a pickle: a program that, when Python loads it, may call anything. Here the program's instructions
are listed with `pickletools.genops`, which runs nothing, and followed by a machine that knows those a state dictionary
needs and can build dictionaries, lists, tuples, numbers, text and tensor descriptions. It imports nothing and calls
nothing that the file names: a name that is not in its short table is refused.

Both layouts are read: the zip archive (torch 1.6 and later) and the stream before it, which the public FlowNet
checkpoints may use.
"""

import io
import math
import pickletools
import warnings
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mdnvo_jax.errors import InputError

# Numbers that open the stream layout: torch's magic number and the version of its protocol.
_STREAM_MAGIC = 0x1950A86A20F9469CFC6C
_STREAM_PROTOCOL = 1001

_STORAGE_TYPES: dict[str, np.dtype] = {
    "DoubleStorage": np.dtype("<f8"),
    "FloatStorage": np.dtype("<f4"),
    "HalfStorage": np.dtype("<f2"),
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
    "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("<i1"),
    "ByteStorage": np.dtype("<u1"),
    "BoolStorage": np.dtype("?"),
}


class _RefusedError(ValueError):
    """The file is not what this module reads; the message says where it departs."""


class Storage(NamedTuple):
    """A run of `size` numbers kept in the file under `key`."""

    dtype: np.dtype
    key: str
    size: int


class Tensor(NamedTuple):
    """A strided view, in elements, of a storage."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class TensorFile(NamedTuple):
    """What a file holds: `content`, plain Python values and `Tensor`s, and `read`, which gives a tensor's numbers."""

    content: Any
    read: Callable[[Tensor], np.ndarray]


def open_tensors(path: str | Path) -> TensorFile:
    """Return the content of a file that `torch.save` wrote.

    Raises:
      InputError: there is no such file, or it is no such file, or it names anything but tensors and plain values.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path} ({error.strerror}): expected a checkpoint file of PyTorch") from error
    try:
        with warnings.catch_warnings():
            # Damaged text may hold escapes that Python warns of, at another place than the file.
            warnings.simplefilter("ignore", DeprecationWarning)
            content, storages = (_from_archive if data.startswith(b"PK") else _from_stream)(data)
    except _MALFORMED as error:
        reason = str(error) if isinstance(error, _RefusedError) else f"damaged, {type(error).__name__}"
        raise InputError(
            f"{path} is not readable as a PyTorch checkpoint ({reason}): expected a file that torch.save wrote, with "
            "tensors and plain values only"
        ) from error

    def read(tensor: Tensor) -> np.ndarray:
        try:
            return _read_tensor(tensor, storages)
        except _MALFORMED as error:
            raise InputError(f"{path} is damaged ({error}): download it again") from error

    return TensorFile(content, read)


# What a damaged or hostile file can raise in the parsers below; anything else is a bug of ours and stays loud.
_MALFORMED = (
    ValueError, TypeError, KeyError, IndexError, EOFError, OverflowError, RuntimeError, MemoryError, zipfile.BadZipFile,
)  # fmt: skip


def _from_archive(data: bytes) -> tuple[Any, Mapping[str, bytes]]:
    """Return content and raw storages of the zip layout: NAME/data.pkl, NAME/data/KEY, NAME/byteorder."""
    archive = zipfile.ZipFile(io.BytesIO(data))
    names = archive.namelist()
    programs = [name for name in names if name.split("/")[1:] == ["data.pkl"]]
    if len(programs) != 1:
        raise _RefusedError("a zip archive without one data.pkl")
    folder = programs[0].removesuffix("data.pkl")
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
        # torch never compresses; a compressed entry may unpack to any size.
        raise _RefusedError("a compressed zip archive")
    if f"{folder}byteorder" in names and archive.read(f"{folder}byteorder") != b"little":
        raise _RefusedError("numbers in big-endian order")
    content = _run(io.BytesIO(archive.read(programs[0])))
    prefix = f"{folder}data/"
    return content, _ArchiveStorages(archive, prefix)


class _ArchiveStorages(Mapping[str, bytes]):
    """The raw storages of an archive, read (and checked against their CRC) when asked for."""

    def __init__(self, archive: zipfile.ZipFile, prefix: str) -> None:
        self._archive, self._prefix = archive, prefix

    def __getitem__(self, key: str) -> bytes:
        return self._archive.read(self._prefix + key)

    def __iter__(self) -> Any:
        return (name.removeprefix(self._prefix) for name in self._archive.namelist() if name.startswith(self._prefix))

    def __len__(self) -> int:
        return sum(1 for _ in self)


def _from_stream(data: bytes) -> tuple[Any, Mapping[str, memoryview]]:
    """Return content and raw storages of the layout before torch 1.6.

    Five pickles (magic number, protocol, system, content, list of storage keys), then for every key the number of
    elements as int64 and the elements.
    """
    if data[257:262] == b"ustar":
        raise _RefusedError("a tar archive; names ending in .pth.tar are no tar archives")
    if not data.startswith(b"\x80"):
        raise _RefusedError(f"it begins with {data[:16]!r}")
    stream = io.BytesIO(data)
    if _run(stream) != _STREAM_MAGIC:
        raise _RefusedError("a pickle, but not of torch.save")
    if (protocol := _run(stream)) != _STREAM_PROTOCOL:
        raise _RefusedError(f"protocol {protocol!r}, not {_STREAM_PROTOCOL}")
    if not _plain(_run(stream), dict).get("little_endian"):
        raise _RefusedError("numbers in big-endian order")
    seen: dict[str, Storage] = {}
    content = _run(stream, seen)
    keys = _run(stream)
    storages: dict[str, memoryview] = {}
    start = stream.tell()
    for key in keys:
        size = int.from_bytes(data[start : start + 8], "little", signed=True)
        stop = start + 8 + size * seen[key].dtype.itemsize
        if size != seen[key].size or stop > len(data):
            raise _RefusedError(f"storage {key!r} is cut short or its size disagrees")
        storages[key] = memoryview(data)[start + 8 : stop]
        start = stop
    return content, storages


def _read_tensor(tensor: Tensor, storages: Mapping[str, bytes | memoryview]) -> np.ndarray:
    """Return the numbers of a tensor, in its own type, as a fresh array."""
    storage, offset, shape, strides = tensor
    raw = np.frombuffer(storages[storage.key], storage.dtype)
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    # A tensor is never larger than its storage: a stride of 0 could claim any size.
    if raw.size != storage.size or math.prod(list(shape)) > raw.size or (0 not in shape and last >= raw.size):
        raise _RefusedError(f"a tensor of shape {shape} does not fit its storage of {raw.size} numbers")
    byte_strides = [stride * raw.itemsize for stride in strides]
    return np.lib.stride_tricks.as_strided(raw[offset:], shape, byte_strides).copy()


class _Name(NamedTuple):
    """A global name that the file mentions and the table allows. It is never looked up."""

    module: str
    name: str


class _Unused:
    """The result of something a checkpoint may hold and nobody needs, such as a numpy number."""


def _ordered_dict(*arguments: Any) -> dict[Any, Any]:
    """Return what `collections.OrderedDict(*arguments)` holds."""
    return dict(*arguments)


def _tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> Tensor:
    """Return the description of a tensor, as `torch._utils._rebuild_tensor_v2` would make the tensor."""
    numbers = (offset, *shape, *strides)
    if not isinstance(storage, Storage) or len(shape) != len(strides):
        raise _RefusedError("a malformed tensor")
    if not all(type(number) is int and 0 <= number < 2**48 for number in numbers):
        raise _RefusedError("a tensor of impossible shape")
    return Tensor(storage, offset, tuple(shape), tuple(strides))


def _parameter(data: Any, *_: Any) -> Any:
    """Return the tensor of a parameter."""
    return data


def _unused(*_: Any) -> _Unused:
    """Stand in for a value nobody needs."""
    return _Unused()


_FUNCTIONS: dict[_Name, Callable[..., Any]] = {
    _Name("collections", "OrderedDict"): _ordered_dict,
    _Name("torch._utils", "_rebuild_tensor"): _tensor,
    _Name("torch._utils", "_rebuild_tensor_v2"): _tensor,
    _Name("torch._utils", "_rebuild_parameter"): _parameter,
    # A best score is often kept as a numpy number.
    _Name("numpy.core.multiarray", "scalar"): _unused,
    _Name("numpy._core.multiarray", "scalar"): _unused,
    _Name("numpy", "dtype"): _unused,
    _Name("_codecs", "encode"): _unused,
}


def _name(module: str, name: str) -> _Name:
    """Return a name that the table allows."""
    found = _Name(module, name)
    if found in _FUNCTIONS or (module in ("torch", "torch.cuda") and name in _STORAGE_TYPES):
        return found
    raise _RefusedError(f"it names {module}.{name}, which is neither tensor nor plain value")


def _storage(identity: Any, seen: dict[str, Storage]) -> Storage:
    """Return the storage of a persistent identity: ("storage", type, key, device, size[, view])."""
    kind, storage_type, key, _, size, *view = identity
    if kind != "storage" or not isinstance(storage_type, _Name) or storage_type.name not in _STORAGE_TYPES:
        raise _RefusedError("a persistent object that is no storage")
    if view not in ([], [None]) or type(key) is not str or type(size) is not int:
        raise _RefusedError("a storage of an unknown form")
    seen[key] = Storage(_STORAGE_TYPES[storage_type.name], key, size)
    return seen[key]


class _Mark:
    """The place in the stack where the items of a collection begin."""


_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_LITERALS = {
    "BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8",
    "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES",
}  # fmt: skip
_TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


def _run(stream: io.BytesIO, seen: dict[str, Storage] | None = None) -> Any:
    """Follow one pickle of `stream` and return its value; storages it mentions are noted in `seen`."""
    seen = {} if seen is None else seen
    stack: list[Any] = []
    memo: dict[Any, Any] = {}

    def above_mark() -> list[Any]:
        place = max(index for index, item in enumerate(stack) if isinstance(item, _Mark))
        items = stack[place + 1 :]
        del stack[place:]
        return items

    argument: Any
    for opcode, argument, _ in pickletools.genops(stream):
        match opcode.name:
            case "PROTO" | "FRAME":
                pass
            case "STOP":
                return stack.pop()
            case name if name in _LITERALS:
                stack.append(argument)
            case name if name in _CONSTANTS:
                stack.append(_CONSTANTS[name])
            case "MARK":
                stack.append(_Mark())
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_LIST":
                stack.append([])
            case name if name in _TUPLES:
                size = _TUPLES[name]
                items, stack[len(stack) - size :] = stack[len(stack) - size :], []
                if len(items) != size:
                    raise _RefusedError("a stack that runs empty")
                stack.append(tuple(items))
            case "TUPLE":
                stack.append(tuple(above_mark()))
            case "APPEND":
                item = stack.pop()
                _plain(stack[-1], list).append(item)
            case "APPENDS":
                items = above_mark()
                _plain(stack[-1], list).extend(items)
            case "SETITEM":
                value, key = stack.pop(), stack.pop()
                _plain(stack[-1], dict)[key] = value
            case "SETITEMS":
                items = above_mark()
                _plain(stack[-1], dict).update(zip(items[::2], items[1::2], strict=True))
            case "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "MEMOIZE":
                memo[len(memo)] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "GLOBAL":
                stack.append(_name(*argument.split(" ", 1)))
            case "STACK_GLOBAL":
                attribute, module = stack.pop(), stack.pop()
                stack.append(_name(_plain(module, str), _plain(attribute, str)))
            case "BINPERSID":
                stack.append(_storage(stack.pop(), seen))
            case "REDUCE":
                arguments, function = stack.pop(), stack.pop()
                stack.append(_FUNCTIONS[_plain(function, _Name)](*_plain(arguments, tuple)))
            case "BUILD":
                # Attributes set on an object made before: the version notes of a state dictionary, which nobody needs.
                stack.pop()
                _plain(stack[-1], (dict, _Unused))
            case name:
                raise _RefusedError(f"the instruction {name}, which no state dictionary needs")
    raise _RefusedError("a pickle without an end")


def _plain(value: Any, kind: Any) -> Any:
    """Return `value` if it is of the type that an instruction works on."""
    if not isinstance(value, kind):
        raise _RefusedError(f"an instruction on {type(value).__name__}")
    return value
