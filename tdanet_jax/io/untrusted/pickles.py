"""Untrusted pickles, as plain values. Nothing is imported and nothing is called.

A small interpreter runs the opcodes, which the standard library's `pickletools` decodes, and
records what the pickle would have built: a `Call` with a name and arguments. Of these, NumPy arrays
and torch tensors are understood. A name that is not on the list is an error.

Both formats of torch.save are read: several pickles followed by the tensors' bytes, and a zip
file. A tensor inside a plain pickle contains the first format as bytes.
"""

from __future__ import annotations

import io
import math
import pickletools
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tdanet_jax.io.untrusted import FileError
from tdanet_jax.io.untrusted.budgets import budgets, excess, unpacking_excess
from tdanet_jax.io.untrusted.npz import METHODS

#: Numbers in the largest array.
LARGEST = 1 << 24
AGENT_STATE = "ThorAgentState"  # of any module: forks of the reference moved it
_STORAGES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8",
    "IntStorage": "<i4", "ShortStorage": "<i2", "ByteStorage": "u1", "CharStorage": "i1",
}  # fmt: skip
_ARRAY = tuple(f"numpy.{core}.multiarray._reconstruct" for core in ("core", "_core"))
_TENSOR = ("torch._utils._rebuild_tensor_v2", "torch._utils._rebuild_tensor")
_BYTES, _NESTED, _DTYPE = "_codecs.encode", "torch.storage._load_from_bytes", "numpy.dtype"
_ALLOWED = {
    *_ARRAY, *_TENSOR, _BYTES, _NESTED, _DTYPE, "numpy.ndarray", "collections.OrderedDict",
    *(f"{module}.{name}" for name in _STORAGES for module in ("torch", "torch.cuda")),
}  # fmt: skip
_MAGIC, _PROTOCOL = 0x1950A86A20F9469CFC6C, 1001


@dataclass
class Name:
    """A class or function that a pickle names; it is never looked up."""

    name: str


@dataclass
class Call:
    """What a pickle would have called, and the state that it would have set afterwards."""

    name: str
    arguments: tuple
    state: Any = None


@dataclass
class Storage:
    """The data of a tensor, which follow later in the file."""

    dtype: str
    key: str
    count: int
    values: np.ndarray | None = None


@dataclass
class _Mark:
    pass


@dataclass
class _Machine:
    """One pickle's stack and memo."""

    path: str
    stack: list = field(default_factory=list)
    memo: dict[int, Any] = field(default_factory=dict)
    storages: dict[str, Storage] = field(default_factory=dict)

    def run(self, stream: io.BytesIO) -> Any:
        """The value of the pickle at the stream's position, which moves past it."""
        most = budgets().values
        for step, (opcode, argument, _) in enumerate(pickletools.genops(stream)):
            if step >= most:
                raise FileError(self.path, excess("values", step + 1, f"over {step} steps"))
            if opcode.name == "STOP":
                return self.stack.pop()
            if opcode.name in _PUSHED:
                self.stack.append(argument)
            elif opcode.name in _EMPTY:
                self.stack.append(_EMPTY[opcode.name]())
            elif opcode.name in _STEPS:
                _STEPS[opcode.name](self, argument)
            elif opcode.name not in ("PROTO", "FRAME"):
                raise FileError(self.path, f"a pickle with {opcode.name}, which is not supported")
        raise FileError(self.path, "a pickle without an end")

    def above_mark(self) -> list:
        """Pops everything above the last mark, and the mark."""
        items = []
        while not isinstance(item := self.stack.pop(), _Mark):
            items.append(item)
        return items[::-1]

    def push_tuple(self, count: int) -> None:
        items = [self.stack.pop() for _ in range(count)]
        self.stack.append(tuple(items[::-1]))

    def push_dict(self, items: list) -> None:
        self.stack.append({})
        self.set_items(items)

    def drop(self) -> None:
        self.stack.pop()

    def push_name(self, name: str) -> None:
        if name not in _ALLOWED and name.rpartition(".")[2] != AGENT_STATE:
            raise FileError(self.path, f"a pickle names {name}, which such a file does not need")
        self.stack.append(Name(name))

    def push_named(self) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        self.push_name(f"{module}.{name}" if isinstance(module, str) else "?")

    def call(self) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        if not isinstance(function, Name) or not isinstance(arguments, tuple):
            raise FileError(self.path, "a pickle calls something that is not a function")
        self.stack.append(Call(function.name, arguments))

    def build(self) -> None:
        state = self.stack.pop()
        if not isinstance(self.stack[-1], Call):
            raise FileError(self.path, "a pickle sets the state of something without one")
        self.stack[-1].state = state

    def append(self, items: list) -> None:
        self._top(list).extend(items)

    def set_items(self, items: list) -> None:
        top = self.stack[-1]
        target = {} if isinstance(top, Call) else self._top(dict)  # an OrderedDict's are not needed
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, str | int | bytes):  # hashing others may recurse too deeply
                raise FileError(self.path, "a pickle with unsupported dictionary keys")
            target[key] = value

    def _top(self, kind: type) -> Any:
        if not isinstance(self.stack[-1], kind):
            raise FileError(
                self.path, f"a pickle adds items to something other than a {kind.__name__}"
            )
        return self.stack[-1]

    def push_storage(self) -> None:
        """A tensor's storage: ("storage", type, key, place, count, None)."""
        identity = self.stack.pop()
        match identity:
            case ("storage", Name(name), str(key), str(), int(count), *rest) if rest in (
                [],
                [None],
            ):
                dtype = _STORAGES.get(name.rpartition(".")[2])
            case _:
                dtype = None
        if dtype is None or not 0 <= count <= LARGEST:
            raise FileError(self.path, "a pickle with an unsupported storage")
        self.stack.append(self.storages.setdefault(key, Storage(dtype, key, count)))


_PUSHED = {
    "INT", "LONG", "LONG1", "LONG4", "BININT", "BININT1", "BININT2", "FLOAT", "BINFLOAT", "STRING",
    "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "UNICODE",
    "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8",
}  # fmt: skip
_EMPTY: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None, "NEWTRUE": lambda: True, "NEWFALSE": lambda: False, "MARK": _Mark,
    "EMPTY_TUPLE": tuple, "EMPTY_LIST": list, "EMPTY_DICT": dict,
}  # fmt: skip


def _put(machine: _Machine, argument: Any) -> None:
    machine.memo[len(machine.memo) if argument is None else argument] = machine.stack[-1]


def _get(machine: _Machine, argument: Any) -> None:
    machine.stack.append(machine.memo[argument])


def _pair(machine: _Machine) -> list:
    value, key = machine.stack.pop(), machine.stack.pop()
    return [key, value]


_STEPS: dict[str, Callable[[_Machine, Any], None]] = {
    "POP": lambda m, _: m.drop(),
    "PUT": _put, "BINPUT": _put, "LONG_BINPUT": _put, "MEMOIZE": _put,
    "GET": _get, "BINGET": _get, "LONG_BINGET": _get,
    "TUPLE": lambda m, _: m.stack.append(tuple(m.above_mark())),
    "TUPLE1": lambda m, _: m.push_tuple(1),
    "TUPLE2": lambda m, _: m.push_tuple(2),
    "TUPLE3": lambda m, _: m.push_tuple(3),
    "LIST": lambda m, _: m.stack.append(m.above_mark()),
    "DICT": lambda m, _: m.push_dict(m.above_mark()),
    "APPEND": lambda m, _: m.append([m.stack.pop()]),
    "APPENDS": lambda m, _: m.append(m.above_mark()),
    "SETITEM": lambda m, _: m.set_items(_pair(m)),
    "SETITEMS": lambda m, _: m.set_items(m.above_mark()),
    "GLOBAL": lambda m, argument: m.push_name(argument.replace(" ", ".")),
    "STACK_GLOBAL": lambda m, _: m.push_named(),
    "REDUCE": lambda m, _: m.call(),
    "NEWOBJ": lambda m, _: m.call(),
    "BUILD": lambda m, _: m.build(),
    "BINPERSID": lambda m, _: m.push_storage(),
}  # fmt: skip


def load(data: bytes, path: object) -> Any:
    """The value of a pickle: plain values, `Call`s and `Name`s.

    Args:
      path: the file's name in messages.

    Raises:
      FileError: it is not a pickle, or holds something that is not on the list.
    """
    return _run(io.BytesIO(data), str(path))[0]


def load_torch(data: bytes, path: object) -> Any:
    """The value of a file that torch.save wrote, in either of its formats.

    Raises:
      FileError: it is not such a file, or holds something that is not on the list.
    """
    if data[:2] == b"PK":
        return _load_zip(data, str(path))
    stream = io.BytesIO(data)
    head = [_run(stream, str(path))[0] for _ in range(3)]
    if head[:2] != [_MAGIC, _PROTOCOL]:
        raise FileError(path, "not a file of torch.save")
    value, storages = _run(stream, str(path))
    keys, _ = _run(stream, str(path))
    if not isinstance(keys, list) or sorted(storages) != _sorted_texts(keys):
        raise FileError(path, "not a file of torch.save (its storages do not match)")
    for key in keys:
        size, storage = int.from_bytes(stream.read(8), "little"), storages[key]
        _fill(storage, stream.read(storage.count * np.dtype(storage.dtype).itemsize))
        if size != storage.count:
            raise FileError(path, "not a file of torch.save (a storage of another size)")
    return value


def _sorted_texts(values: list) -> list[str] | None:
    return sorted(values) if all(isinstance(value, str) for value in values) else None


def _fill(storage: Storage, data: bytes) -> None:
    if len(data) == storage.count * np.dtype(storage.dtype).itemsize:
        storage.values = np.frombuffer(data, storage.dtype)


def _load_zip(data: bytes, path: str) -> Any:
    """torch.save's zip format: <name>/data.pkl, and <name>/data/<key> for each storage."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            unpacked = sum(entry.file_size for entry in entries)
            if reason := unpacking_excess(len(entries), unpacked, len(data)):
                raise FileError(path, reason)
            pickled = [e.filename for e in entries if e.filename.endswith("/data.pkl")]
            if len(pickled) != 1 or any(e.compress_type not in METHODS for e in entries):
                raise FileError(path, "not a file of torch.save")
            value, storages = _run(io.BytesIO(archive.read(pickled[0])), path)
            for storage in storages.values():
                _fill(storage, archive.read(f"{pickled[0][:-4]}/{storage.key}"))
    except FileError:
        raise
    except Exception as error:  # zipfile raises many kinds for a damaged file
        raise FileError(path, f"not a file of torch.save ({error})") from None
    return value


def _run(stream: io.BytesIO, path: str) -> tuple[Any, dict[str, Storage]]:
    machine = _Machine(path)
    try:
        with warnings.catch_warnings(action="ignore"):  # of pickletools, about escapes
            return machine.run(stream), machine.storages
    except FileError:
        raise
    except Exception as error:  # pickletools and an empty stack raise many kinds
        raise FileError(path, f"not a pickle ({error or type(error).__name__})") from None


def array(value: Any, path: object, most: int = LARGEST) -> np.ndarray:
    """The numbers of a pickled NumPy array or torch tensor.

    Args:
      most: numbers that it may have.

    Raises:
      FileError: it is neither, not numeric, or too large.
    """
    try:
        if isinstance(value, Call) and value.name in _ARRAY:
            return _numpy_array(value, most)
        if isinstance(value, Call) and value.name in _TENSOR:
            return _tensor(value, path, most)
    except FileError:
        raise
    except Exception as error:  # whatever does not have the expected form
        raise FileError(path, f"a broken array ({error or type(error).__name__})") from None
    raise FileError(path, "something other than an array")


def _numpy_array(value: Call, most: int) -> np.ndarray:
    _, shape, dtype, by_column, data = value.state
    code: Any = dtype.arguments[0]
    order: Any = dtype.state[1]
    if not isinstance(code, str):  # hashing a tuple of tuples may take for ever
        raise ValueError("not numeric")
    if dtype.name != _DTYPE or code not in _NUMBERS or order not in ("<", ">", "|", "="):
        raise ValueError("not numeric")
    numbers = np.frombuffer(_octets(data, most), np.dtype(code).newbyteorder(order))
    if len(numbers) > most:
        raise ValueError("too large")
    return numbers.reshape(_sizes(shape), order="F" if by_column else "C")


_NUMBERS = {f"{kind}{size}" for kind, sizes in (("f", "248"), ("iu", "1248")) for kind in kind
            for size in sizes}  # fmt: skip


def _octets(data: Any, most: int) -> bytes:
    """The bytes of up to `most` numbers, and of the pickles around them; pickles of protocol 2
    write bytes as text in latin-1 and a call that encodes it."""
    if isinstance(data, Call) and data.name == _BYTES and data.arguments[1:] == ("latin1",):
        data = data.arguments[0]
    if not isinstance(data, bytes | str):
        raise ValueError("not bytes")
    if len(data) > 16 * most + 4096:  # before anything is copied
        raise ValueError("too large")
    return data.encode("latin-1") if isinstance(data, str) else data


def _tensor(value: Call, path: object, most: int) -> np.ndarray:
    storage, first, shape, strides = value.arguments[:4]
    if isinstance(storage, Call) and storage.name == _NESTED:
        storage = load_torch(_octets(storage.arguments[0], most), path)
    elif isinstance(storage, Call) and storage.name.rpartition(".")[2] in _STORAGES:
        kind, numbers = _STORAGES[storage.name.rpartition(".")[2]], storage.arguments[0]
        if len(numbers) > most or not all(
            type(number) in (int, float) for number in numbers
        ):  # lists in lists multiply
            raise ValueError("not numeric")
        storage = Storage(kind, "", 0, np.array(numbers, kind))
    if not isinstance(storage, Storage) or storage.values is None:
        raise ValueError("a tensor without data")
    sizes, steps = _sizes(shape), _sizes(strides)
    held = storage.values
    if len(sizes) != len(steps) or math.prod(sizes) > min(
        len(held), most
    ):  # a step of 0 repeats numbers
        raise ValueError("a tensor with an invalid shape")
    if math.prod(sizes) == 0:
        return np.zeros(sizes, held.dtype)
    last = first + sum((size - 1) * step for size, step in zip(sizes, steps, strict=True))
    if type(first) is not int or not 0 <= first <= last < len(held):
        raise ValueError("a tensor beyond its storage")
    strides = [step * held.itemsize for step in steps]
    return np.lib.stride_tricks.as_strided(held[first:], sizes, strides, writeable=False).copy()


def _sizes(values: Any) -> tuple[int, ...]:
    whole = all(isinstance(v, int) and not isinstance(v, bool) for v in values)
    if not whole or len(values) > 8 or not all(0 <= v <= LARGEST for v in values):
        raise ValueError("an invalid shape")
    return tuple(values)
