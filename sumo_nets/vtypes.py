"""Vehicle types by name: SUMO's vehicle class and size."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from itertools import pairwise
from math import nan
from pathlib import Path
from typing import NamedTuple

from sumo_nets.xml import Attributes, stream


class VehicleType(NamedTuple):
    """SUMO's vehicle class, and length, width and height in metres."""

    vclass: str
    lwh_m: tuple[float, float, float]


_TABLES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
SIZES_M: dict[str, tuple[float, float, float]]
SIZES_M = {vclass: tuple(size) for vclass, size in _TABLES["size_m"].items()}
"""Length, width and height that SUMO gives to a class by default [m]."""
_DEFAULT, _NAMED, _WORDS = _TABLES["default"], _TABLES["named"], _TABLES["word"]
_NAMES = (*SIZES_M, *_DEFAULT, *_NAMED, *_WORDS, "car")
_PLAIN = frozenset(map(str.lower, _NAMES))


def is_plain(name: str) -> bool:
    """Whether the name of a type is that of a class. For any other name, the class is a guess."""
    return name.partition("@")[0].lower() in _PLAIN


LARGEST_M = {"length": 1000.0, "width": 100.0, "height": 100.0}
"""Largest size of an actor; trains, ships and aircraft are left out before they are placed."""
SMALLEST_M = 0.001
"""Smallest size of an actor; positions are kept to the millimetre, sizes in single precision."""


def check_size(where: str, what: str, value: str | float) -> float:
    """A length, width or height [m]; ValueError where it is not a positive number of a possible size."""
    try:
        size_m = float(value)
    except ValueError:
        size_m = nan
    largest_m = LARGEST_M[what]
    if not SMALLEST_M <= size_m <= largest_m:
        raise ValueError(f"{where}: {what} = {value} m should be {SMALLEST_M:g} to {largest_m:g} m.")
    return size_m


def read(paths: Iterable[Path]) -> dict[str, VehicleType]:
    """The types that additional or route files define."""
    found: dict[str, VehicleType] = {}
    for path in paths:

        def start(name: str, attributes: Attributes, path: Path = path) -> None:
            if name == "vType":
                vclass = attributes.get("vClass", "passenger")
                usual = zip(("length", "width", "height"), SIZES_M.get(vclass, SIZES_M["passenger"]), strict=True)
                where = f"{path}: vType {attributes.get('id', '?')!r}"
                sizes = []
                for what, size in usual:
                    sizes.append(check_size(where, what, attributes.get(what, size)))
                length, width, height = sizes
                found[attributes.get("id", "")] = VehicleType(vclass, (length, width, height))

        stream(path, start)
    return found


def guess(name: str) -> VehicleType:
    """The class of a type that no file defines, by the whole words of its name; a passenger car without a match.

    Words are separated by anything but letters, and by changes of case. What follows `@` is the name of the one vehicle
    for which SUMO copied the type.
    """
    name = name.partition("@")[0]
    lower = name.lower()
    vclass = _DEFAULT.get(name) or _NAMED.get(lower) or (lower if lower in SIZES_M else None)
    if vclass is None:
        words = _words(name)
        vclass = next((c for word, c in _WORDS.items() if word in words), "passenger")
    return VehicleType(vclass, SIZES_M[vclass])


def _words(name: str) -> set[str]:
    """The words of a name in lower case, also without the ending of a plural, and any two neighbours as one word."""
    apart = re.sub(r"(?<=[^\W\d_A-Z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", name)
    words = [word.lower() for word in re.findall(r"[^\W\d_]+", apart)]
    words += [a + b for a, b in pairwise(words)]
    return {form for word in words for form in (word, word.removesuffix("s"), word.removesuffix("es"))}
