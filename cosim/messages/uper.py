"""Unaligned packed encoding (UPER): types of a message as data, and encoders of one message and of many records.

Notes
-----
The rules are those of ITU-T X.691. A type states the name and the module that the standard gives it. A value is a whole
number (or an array of them, one for each record), a dict of the members that are there, a pair of an alternative and
its value, or a list. Extension bits are always 0: nothing beyond the root of a type is written.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

Field = tuple[Any, int]
"""A whole number of at least 0, or an array of them, and the bits that it takes."""

LONGEST_OPEN = 16383
"""Longest content of an open type whose length takes two bytes; longer content would be fragmented [B]."""


@dataclass(frozen=True, slots=True)
class Integer:
    """INTEGER from `low` to `high`."""

    name: str
    module: str
    low: int
    high: int

    @property
    def bits(self) -> int:
        """Width [bit]."""
        return (self.high - self.low).bit_length()


@dataclass(frozen=True, slots=True)
class Enumerated:
    """ENUMERATED with these numbers in ascending order; the index of a number is written."""

    name: str
    module: str
    values: tuple[int, ...]
    is_extensible: bool = False

    @property
    def bits(self) -> int:
        """Width [bit], without the extension bit."""
        return (len(self.values) - 1).bit_length()


class Member(NamedTuple):
    """One member of a SEQUENCE. A member without a type is never written; it has a bit among the optional ones."""

    name: str
    of: "Type | None" = None
    is_optional: bool = False


@dataclass(frozen=True, slots=True)
class Record:
    """SEQUENCE."""

    name: str
    module: str
    members: tuple[Member, ...]
    is_extensible: bool = False


@dataclass(frozen=True, slots=True)
class ListOf:
    """SEQUENCE OF, with `low` to `high` elements."""

    name: str
    module: str
    element: "Type"
    low: int
    high: int
    is_extensible: bool = False

    @property
    def bits(self) -> int:
        """Width of the number of elements [bit], without the extension bit."""
        return (self.high - self.low).bit_length()


@dataclass(frozen=True, slots=True)
class UperChoice:
    """CHOICE; an alternative without a type is never written."""

    name: str
    module: str
    alternatives: Mapping[str, "Type | None"]
    is_extensible: bool = False

    @property
    def bits(self) -> int:
        """Width of the index [bit], without the extension bit."""
        return (len(self.alternatives) - 1).bit_length()


@dataclass(frozen=True, slots=True)
class Wrapped:
    """An identifier, and an open type that it selects: whole bytes behind their number."""

    name: str
    module: str
    identifier: Integer
    contents: Mapping[int, "Type"]


Type = Integer | Enumerated | Record | ListOf | UperChoice | Wrapped


class Encoded(NamedTuple):
    """Elements of a list that are encoded already."""

    n: int
    value: int
    bits: int


def fields(of: Type, value: Any) -> Iterator[Field]:
    """The fields of a value in the order in which they are written.

    Parameters
    ----------
    of, value
        A type and its value; numbers in it may be arrays of one length, but not inside a `Wrapped`.

    Raises
    ------
    ValueError
        In one line: a number out of range, a list too long, a member or an alternative that the type does not have.
    """
    match of:
        case Integer():
            _check(of, value, of.low, of.high)
            yield value - of.low, of.bits
        case Enumerated():
            index = np.searchsorted(of.values, value) if isinstance(value, ndarray) else _index(of, value)
            if of.is_extensible:
                yield 0, 1
            yield index, of.bits
        case Record():
            yield from _record(of, value)
        case ListOf():
            yield from _list(of, value)
        case UperChoice():
            name, inside = value
            chosen = of.alternatives.get(name)
            if chosen is None:
                raise ValueError(f"{of.name} has no alternative {name} here; {', '.join(of.alternatives)}.")
            if of.is_extensible:
                yield 0, 1
            yield list(of.alternatives).index(name), of.bits
            yield from fields(chosen, inside)
        case Wrapped():
            identifier, inside = value
            if identifier not in of.contents:
                raise ValueError(f"{of.name} has no content {identifier} here.")
            yield from fields(of.identifier, identifier)
            content = encode(of.contents[identifier], inside)
            if len(content) > LONGEST_OPEN:
                raise ValueError(f"{of.name}: {len(content)} bytes do not fit into one open type. Send fewer objects.")
            if len(content) < 128:
                yield len(content), 8
            else:
                yield 1 << 15 | len(content), 16
            yield int.from_bytes(content), 8 * len(content)


def _record(of: Record, value: Mapping[str, Any]) -> Iterator[Field]:
    if left := value.keys() - {m.name for m in of.members if m.of is not None}:
        raise ValueError(f"{of.name} has no member {', '.join(sorted(left))} here.")
    if of.is_extensible:
        yield 0, 1
    for member in of.members:
        if member.is_optional:
            yield int(member.name in value), 1
    for member in of.members:
        if member.of is not None and (member.name in value or not member.is_optional):
            yield from fields(member.of, value[member.name])


def _list(of: ListOf, value: Sequence[Any] | Encoded) -> Iterator[Field]:
    n = value.n if isinstance(value, Encoded) else len(value)
    _check(of, n, of.low, of.high)
    if of.is_extensible:
        yield 0, 1
    yield n - of.low, of.bits
    if isinstance(value, Encoded):
        yield value.value, value.bits
        return
    for one in value:
        yield from fields(of.element, one)


def _check(of: Type, value: Any, low: int, high: int) -> None:
    if isinstance(value, ndarray):
        outside = (value < low) | (value > high)
        if not outside.any():
            return
        value = value[outside][0]
    elif low <= value <= high:
        return
    raise ValueError(f"{of.name} is {value}, but {of.module} allows {low} to {high}.")


def _index(of: Enumerated, value: int) -> int:
    if value not in of.values:
        known = ", ".join(map(str, of.values))
        raise ValueError(f"{of.name} is {value}, but {of.module} has {known}.")
    return of.values.index(value)


def packed(parts: Iterator[Field]) -> tuple[int, int]:
    """Fields of one record as one number, and its width [bit]."""
    whole = n = 0
    for value, bits in parts:
        whole, n = whole << bits | int(value), n + bits
    return whole, n


def encode(of: Type, value: Any) -> bytes:
    """One value as whole bytes, filled up with zeros at the end; at least one byte.

    Raises
    ------
    ValueError
        As `fields` does.
    """
    whole, bits = packed(fields(of, value))
    n_bytes = max(1, -(-bits // 8))
    return (whole << 8 * n_bytes - bits).to_bytes(n_bytes)


def rows(of: Type, value: Any, n: int) -> UInt8[ndarray, "n b"]:
    """The bits of `n` records that have the same members; numbers in `value` are arrays [n] or hold for all."""
    columns = []
    for number, bits in fields(of, value):
        numbers = np.broadcast_to(np.asarray(number, np.int64), n)
        places = np.arange(bits)[::-1]
        column = numbers[:, None] >> places & 1
        columns.append(column.astype(np.uint8))
    return np.concatenate(columns, axis=1)


def least(of: Type) -> Any:
    """The value with no optional member, first alternatives, and least numbers, but no empty list."""
    match of:
        case Integer():
            return of.low
        case Enumerated():
            return of.values[0]
        case Record():
            needed = (m for m in of.members if not m.is_optional)
            return {m.name: least(m.of) for m in needed if m.of is not None}
        case ListOf():
            return [least(of.element)] * max(1, of.low)
        case UperChoice():
            here = ((name, kind) for name, kind in of.alternatives.items() if kind is not None)
            name, kind = next(here)
            return name, least(kind)
        case Wrapped():
            identifier, kind = next(iter(of.contents.items()))
            return identifier, least(kind)


def n_bits(of: Type, value: Any) -> int:
    """Length of a value [bit]."""
    return sum(bits for _, bits in fields(of, value))


class UperRow(NamedTuple):
    """One row of the table of widths."""

    field: str
    type: str
    module: str
    range: str
    bits: int


def table(of: Type, field: str = "") -> Iterator[UperRow]:
    """Width of every number, and of the bits that say what follows, of all that is ever written of a type."""
    match of:
        case Integer():
            span = f"{of.low} to {of.high}"
            yield UperRow(field, of.name, of.module, span, of.bits)
        case Enumerated():
            span = f"one of {len(of.values)}"
            yield UperRow(field, of.name, of.module, span, of.bits + of.is_extensible)
        case Record():
            optional = sum(m.is_optional for m in of.members)
            if optional or of.is_extensible:
                span = ("extension bit, " if of.is_extensible else "") + f"{optional} optional"
                yield UperRow(field, of.name, of.module, span, optional + of.is_extensible)
            for member in of.members:
                if member.of is not None:
                    yield from table(member.of, f"{field}.{member.name}".lstrip("."))
        case ListOf():
            span = ("extension bit, " if of.is_extensible else "") + f"{of.low} to {of.high} elements"
            yield UperRow(field, of.name, of.module, span, of.bits + of.is_extensible)
            yield from table(of.element, f"{field}[]")
        case UperChoice():
            span = ("extension bit, " if of.is_extensible else "") + f"{len(of.alternatives)} alternatives"
            yield UperRow(field, of.name, of.module, span, of.bits + of.is_extensible)
            for name, kind in of.alternatives.items():
                if kind is not None:
                    yield from table(kind, f"{field}.{name}")
        case Wrapped():
            yield UperRow(field, of.identifier.name, of.identifier.module, "selects a container", of.identifier.bits)
            yield UperRow(field, "open type", of.module, "number of bytes", 8)
            for identifier, kind in of.contents.items():
                yield from table(kind, f"{field}({identifier})")
