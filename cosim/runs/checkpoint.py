"""Encodes states as bytes and decodes them, so that a run can be resumed.

The format holds numbers, text and containers. It holds an object as the name of its class and the values of its fields.
Reading a checkpoint executes no code: a class is taken only from modules that are already loaded and belong to this
program or to the user's own classes, objects are made without their constructors, and arrays are copied from raw bytes.
"""

import enum
import json
import sys
import types
from collections.abc import Collection, Iterable
from typing import Any

import numpy as np

_MAGIC = b"cosim state 1\n"
_ROOMS = ("cosim", "sensors", "trust", "results")
_PLAIN_KINDS = "biufcSUmM"


class CannotCheckpoint(TypeError):
    """A state contains something that is neither data nor an object of plain fields."""


def encode(state: Any, own_modules: Collection[str] = ()) -> list[bytes | memoryview]:
    """Encode a state as a list of byte strings.

    Most of them are the memory of the state's own arrays. Write them before the state changes.

    Raises
    ------
    CannotCheckpoint
        If something in the state cannot be kept; the message names it.
    """
    writer = _Writer(frozenset(own_modules))
    tree = writer.node(state, "state")
    head = json.dumps({"tree": tree, "arrays": writer.heads}, separators=(",", ":"), allow_nan=False).encode()
    return [_MAGIC, len(head).to_bytes(8, "little"), head, *writer.buffers]


def decode(content: bytes, own_modules: Collection[str] = ()) -> Any:
    """Decode a state.

    No array becomes larger than its bytes in the file.

    Raises
    ------
    ValueError
        If the bytes are not an encoded state.
    """
    try:
        if not content.startswith(_MAGIC):
            raise ValueError("it does not begin as one")
        begin = len(_MAGIC) + 8
        end = begin + int.from_bytes(content[len(_MAGIC) : begin], "little")
        head = json.loads(content[begin:end])
        reader = _Reader(head["arrays"], memoryview(content)[end:], frozenset(own_modules))
        return reader.value(head["tree"])
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError, OverflowError) as error:
        raise ValueError(f"not a state of this program: {' '.join(str(error).split())}") from None


def _slots(of: type) -> dict[str, types.MemberDescriptorType]:
    """Fields of a class that are stored in slots."""
    return {
        name: member
        for base in reversed(of.__mro__)
        for name, member in vars(base).items()
        if isinstance(member, types.MemberDescriptorType) and not issubclass(base, BaseException)
    }


def _described(dtype: np.dtype) -> Any:
    """A dtype as plain data: its name, or a list of its fields with names, dtypes and shapes."""
    if dtype.fields is None:
        return dtype.str
    described = []
    for name in dtype.fields:
        of = dtype[name]
        described.append([name, _described(of.base), list(of.shape)])
    return described


def _dtype_of(about: Any) -> np.dtype:
    """The dtype from its description; ValueError if it holds anything but numbers, text and times."""
    if isinstance(about, list):
        fields = []
        for name, of, shape in about:
            fields.append((str(name), _dtype_of(of), tuple(shape)))
        return np.dtype(fields)
    dtype = np.dtype(str(about))
    if dtype.kind not in _PLAIN_KINDS or dtype.hasobject:
        raise ValueError(f"an array of dtype {about}")
    return dtype


class _Writer:
    def __init__(self, own: frozenset[str]) -> None:
        self.own = own
        self.heads: list[list[Any]] = []
        self.buffers: list[memoryview] = []
        self._seen: dict[int, tuple[int, Any]] = {}

    def node(self, value: Any, where: str) -> Any:
        if value is None or type(value) in (bool, str):
            return value
        if type(value) is int:
            return ["i", str(value)]
        if type(value) is float:
            return ["f", value.hex()]
        if type(value) is bytes:
            return ["b", value.hex()]
        if isinstance(value, enum.Enum):
            return ["e", self._class(type(value), where), value.name]
        if isinstance(value, np.generic):
            return ["n", self._array(np.asarray(value), where)]
        if id(value) in self._seen:
            return ["r", self._seen[id(value)][0]]
        number = len(self._seen)
        self._seen[id(value)] = (number, value)  # the reference keeps other objects from getting the same id
        if type(value) is np.ndarray:
            return ["a", number, self._array(value, where)]
        if type(value) in (list, tuple, set, frozenset):
            items = sorted(value, key=repr) if isinstance(value, set | frozenset) else value
            return [type(value).__name__, number, self._items(items, where)]
        if type(value) is dict:
            pairs = []
            for key, content in value.items():
                key_node = self.node(key, f"{where} key")
                pairs.append([key_node, self.node(content, f"{where}[{key!r}]")])
            return ["dict", number, pairs]
        name = self._class(type(value), where)
        if isinstance(value, tuple):
            return ["t", number, name, self._items(value, where)]
        slots, fields = _slots(type(value)), {}
        for field, member in slots.items():
            if hasattr(value, field):
                fields[field] = self.node(member.__get__(value), f"{where}.{field}")
        for field, content in getattr(value, "__dict__", {}).items():
            fields[field] = self.node(content, f"{where}.{field}")
        return ["o", number, name, fields]

    def _items(self, values: Iterable[Any], where: str) -> list[Any]:
        return [self.node(value, f"{where}[{i}]") for i, value in enumerate(values)]

    def _array(self, array: np.ndarray, where: str) -> int:
        try:
            about = _described(array.dtype)
            if _dtype_of(about) != array.dtype:
                raise ValueError
        except ValueError:
            raise CannotCheckpoint(f"{where} is an array of dtype {array.dtype}") from None
        self.heads.append([about, list(array.shape)])
        self.buffers.append(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
        return len(self.heads) - 1

    def _class(self, of: type, where: str) -> str:
        name = f"{of.__module__}:{of.__qualname__}"
        try:
            if _class_of(name, self.own) is not of:
                raise ValueError
        except ValueError:
            raise CannotCheckpoint(f"{where} is a {of.__module__}.{of.__qualname__}") from None
        return name


class _Reader:
    def __init__(self, heads: list[list[Any]], raw: memoryview, own: frozenset[str]) -> None:
        self.own = own
        self._made: dict[int, Any] = {}
        self._arrays: list[np.ndarray] = []
        at = 0
        for about, shape in heads:
            dtype = _dtype_of(about)
            if not all(type(n) is int and n >= 0 for n in shape):
                raise ValueError(f"an array of shape {shape}")
            n = 1
            for length in shape:
                n *= length
            end = at + n * dtype.itemsize
            if end > len(raw):
                raise ValueError("it is cut off")
            if n and not dtype.itemsize:
                raise ValueError(f"an array of {n} items without a size")  # NumPy would allocate memory for them
            flat = np.frombuffer(raw[at:end], dtype) if n else np.empty(0, dtype)
            self._arrays.append(flat.reshape(shape).copy())
            at = end
        if at != len(raw):
            raise ValueError("it has more bytes than arrays")

    def value(self, node: Any) -> Any:
        if node is None or isinstance(node, bool | str):
            return node
        kind, *rest = node
        if kind == "i":
            return int(rest[0])
        if kind == "f":
            return float.fromhex(rest[0])
        if kind == "b":
            return bytes.fromhex(rest[0])
        if kind == "e":
            of = _class_of(rest[0], self.own)
            if not issubclass(of, enum.Enum):
                raise ValueError(f"{rest[0]} has no members")
            return of[rest[1]]
        if kind == "n":
            return self._arrays[rest[0]][()]
        if kind == "r":
            return self._made[rest[0]]
        number = rest[0]
        if kind == "a":
            self._made[number] = self._arrays[rest[1]]
        elif kind == "list":
            made: list[Any] = []
            self._made[number] = made
            made.extend(self.value(item) for item in rest[1])
        elif kind == "dict":
            filled: dict[Any, Any] = {}
            self._made[number] = filled
            for key, item in rest[1]:
                filled[self.value(key)] = self.value(item)
        elif kind in ("tuple", "set", "frozenset"):
            of = {"tuple": tuple, "set": set, "frozenset": frozenset}[kind]
            self._made[number] = of(self.value(item) for item in rest[1])
        elif kind == "t":
            of = _class_of(rest[1], self.own)
            if not issubclass(of, tuple):
                raise ValueError(f"{rest[1]} is no tuple")
            items = [self.value(item) for item in rest[2]]
            self._made[number] = tuple.__new__(of, items)
        elif kind == "o":
            self._made[number] = self._object(number, *rest[1:])
        else:
            raise ValueError(f"an item of kind {kind!r}")
        return self._made[number]

    def _object(self, number: int, name: str, fields: dict[str, Any]) -> Any:
        of = _class_of(name, self.own)
        if of.__flags__ & (1 << 9) == 0 or issubclass(of, type | enum.Enum):  # not defined by a class statement
            raise ValueError(f"{name} is no class of plain fields")
        made = self._made[number] = object.__new__(of)
        slots = _slots(of)
        for field, node in fields.items():
            if field in slots:
                slots[field].__set__(made, self.value(node))
            else:
                made.__dict__[field] = self.value(node)
        return made


def _class_of(name: str, own: frozenset[str]) -> type:
    """A class by name, from a loaded module of this program or of the user's own classes."""
    module, _, path = name.partition(":")
    if module.split(".")[0] not in _ROOMS and module not in own:
        raise ValueError(f"{name} is no class of this program")
    found: Any = sys.modules.get(module)
    for part in path.split("."):
        found = vars(found).get(part) if found is not None else None
    if not isinstance(found, type) or found.__module__ != module:
        raise ValueError(f"{name} is no class of this program")
    return found
