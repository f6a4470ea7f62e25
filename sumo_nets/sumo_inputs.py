"""Check of the files that SUMO reads: what would open a connection, block, or expand without limit is refused.

SUMO's network, route and additional files can name output files (`file`, `dest`, `output`), and SUMO takes a name
with a colon for an address to connect to. Files can include others. A vehicle type with a length that is not finite
makes SUMO loop.
"""

from __future__ import annotations

import math
import os
import re
from functools import lru_cache
from pathlib import Path

from sumo_nets.vtypes import SMALLEST_M, check_size
from sumo_nets.xml import Attributes, check_prolog, chunks, exists, spelling, stream, version_of

_WRITES = re.compile(rb"file|dest|output")
_FILE = re.compile(rb"(?:file|dest|output)\s*=\s*[\"']([^\"'\0]+)")
_TYPE = re.compile(rb"<vType\b[^<]*")
_NUMBER = re.compile(rb"[\s\"'](length|width|height|minGap|maxSpeed|accel|decel|tau)\s*=\s*[\"']\s*([^\"']*)")
_ASCII = re.compile(rb"\s*<\?xml[^>]*encoding\s*=\s*[\"'](?i:utf-8|us-ascii|iso-8859-1|windows-1252)[\"']")
_READERS = ("rerouter", "variableSpeedSign", "calibrator")
"""Elements whose attribute `file` names a file that SUMO reads."""
_READING = re.compile(rb"<(?:%b)\b" % b"|".join(name.encode() for name in _READERS))
_LONGEST_TAG = 32768
_TEXTS = frozenset(
    (
        "id",
        "vClass",
        "color",
        "guiShape",
        "imgFile",
        "osgFile",
        "emissionClass",
        "carFollowModel",
        "laneChangeModel",
        "latAlignment",
        "speedFactor",
        "parkingBadges",
        "key",
        "value",
    )
)
"""Attributes of a vehicle type that are no plain numbers."""


def check_input(path: Path) -> list[Path]:
    """Refuse a harmful file; the files that it includes, directly or through others.

    Raises
    ------
    ValueError
        Names the file and the cause.
    """
    included: list[Path] = []
    left = [path]
    while left:
        file = left.pop()
        version = version_of(file)
        new = [p for p in _included(file, version) if p != path and p not in included]
        included += new
        left += new
    return included


@lru_cache(maxsize=64)
def _included(path: Path, version: tuple[int, ...]) -> list[Path]:
    """The files that this version of a file includes itself. A run and its SUMO read the same files, one by one."""
    check_prolog(path)
    return _checked(path) if _is_suspicious(path) else []


def _is_suspicious(path: Path) -> bool:
    """Whether the bytes of a file ask for a reading element by element, which is several times slower."""
    left = b""
    for n, chunk in enumerate(chunks(path)):
        head = chunk[:200]
        if not n and (b"\x00" in head or (b"encoding" in head and not _ASCII.match(head))):
            return True
        text = left + chunk
        if b"<include" in text or b"&#" in text:
            return True
        for match in _WRITES.finditer(text):
            begin = max(text.rfind(b"<", 0, match.start()), 0)
            end = text.find(b"<", match.end())
            end = len(text) if end < 0 else end
            tag = text[begin:end]
            names = _FILE.findall(tag)
            is_read = len(tag) > _LONGEST_TAG or bool(_READING.match(tag))
            if is_read or b":" in tag or any(_is_special(path, name) for name in names):
                return True
        for tag in _TYPE.findall(text):
            numbers = _NUMBER.findall(tag)
            if len(tag) > _LONGEST_TAG or any(_is_odd(value) for _, value in numbers):
                return True
        left = text[max(text.rfind(b"<"), len(text) - 2 * _LONGEST_TAG) :]
    return False


def _is_special(path: Path, name: bytes | str) -> bool:
    """Whether a name in a file is that of a device, a pipe or a folder."""
    target = path.parent / os.fsdecode(name)
    return exists(target) and not target.is_file()


def _is_odd(value: bytes) -> bool:
    try:
        return not SMALLEST_M <= float(value) < 1000
    except ValueError:
        return True


def _checked(path: Path) -> list[Path]:
    """The files that a file includes; every element is checked."""
    found: list[Path] = []

    def start(name: str, attributes: Attributes) -> None:
        if name == "include":
            target = path.parent / attributes.get("href", "")
            if not (exists(target) and target.is_file()):
                cure = spelling(target) or " Correct the path."
                raise ValueError(f"{path}: includes {target}, which is no file.{cure}")
            found.append(target)
        if name in _READERS:
            target = path.parent / attributes.get("file", "")
            if exists(target) and target.is_file():
                found.append(target)
        if name == "vType":
            check_type(path, attributes)
        for key, value in attributes.items():
            if key in ("file", "dest", "output"):
                _check_name(path, name, key, value)
        if name == "param" and attributes.get("key", "").endswith(("file", "output")):
            _check_name(path, name, attributes["key"], attributes.get("value", ""))

    stream(path, start)
    return found


def check_type(path: Path, attributes: Attributes) -> None:
    """Refuse a vehicle type with a size that is not positive, or any number that is not finite."""
    what = f"{path}: vType {attributes.get('id', '?')!r}"
    for key, value in attributes.items():
        if key in ("length", "width", "height"):
            check_size(what, key, value)
        elif key not in _TEXTS:
            try:
                number = float(value)
            except ValueError:
                continue
            if not math.isfinite(number):
                raise ValueError(f"{what}: {key} = {value} is not a finite number. Correct it.")


def _check_name(path: Path, element: str, key: str, value: str) -> None:
    if value.find(":") > 1 or value.startswith("["):
        raise ValueError(
            f"{path}: <{element}> has {key} = {value!r}, which SUMO takes for an address to connect to. "
            "Remove it, or give a file name without a colon."
        )
    if value not in ("", "NUL", "/dev/null") and _is_special(path, value):
        raise ValueError(f"{path}: <{element}> has {key} = {value!r}, which is a device, pipe or folder. Remove it.")
