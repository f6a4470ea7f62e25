"""Reads a config from TOML as plain data, changes single keys, and checks the data against dataclasses."""

import difflib
import json
import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import TypeAdapter, ValidationError

from cosim.base.durable import open_regular

_MOST_BYTES = 10_000_000


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Read a TOML file as plain data. A file that cannot be read raises a ValueError of one line."""
    try:
        with open_regular(path) as file:
            text = file.read(_MOST_BYTES + 1)
        if len(text) > _MOST_BYTES:
            raise ValueError(f"{path}: larger than {_MOST_BYTES:,} bytes, too large for a {what}.")
        return tomllib.loads(text.decode("utf-8-sig"))  # editors of Windows begin files with a mark
    except FileNotFoundError:
        raise ValueError(f"{path}: no such {what}. Give the path of a TOML file.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read as a {what}: {error}.") from None
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path}: not valid TOML: {error}.") from None
    except RecursionError:
        raise ValueError(f"{path}: nested too deeply.") from None


def leaves(
    section: Mapping[str, Any],
    prefix: str = "",
) -> Iterator[tuple[str, Any]]:
    """Dotted keys of a section and of those in it, whether they are quoted or not, and their values."""
    for name, value in section.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def override(data: Any, text: str) -> None:
    """Set one key from a text `key=value`.

    `encounters.0.radius_m` names an item of a list. The number after the last item appends a new item.
    """
    name, sign, value = text.partition("=")
    if not sign or not name.strip():
        raise ValueError(f"--set {text}: not of the form key=value. Write for example --set radio.range_m=150.")
    if not text.isprintable():
        raise ValueError(
            f"--set {text!r} contains a line break or a control character. Repeat --set to set several keys."
        )
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value
    except RecursionError:
        raise ValueError(f"--set {name}: its value is nested too deeply.") from None
    assign(data, name.strip(), parsed, f"--set {text}")


def assign(data: Any, name: str, value: Any, said: str) -> None:
    """Set the key `name` in plain data. `said` is the user's text, for error messages."""
    *sections, last = name.split(".")
    for section, inner in pairwise([*sections, last]):
        if sections[0] == "attacks" and section == str(len(data)) and inner != "attack":
            raise ValueError(
                f"{said}: attacks has {section} sections, numbered from 0. To add one, say first what it is: "
                f"attacks.{section}.attack."
            )
        data = _item(data, section, said, inner.isdecimal())
        if not isinstance(data, dict | list):
            raise ValueError(f"{said}: {section} is a value, not a section.")
    if isinstance(data, list):
        raise ValueError(f"{said}: {sections[-1]} is a list; name an item and a key, as in {sections[-1]}.0.KEY.")
    data[last] = value


def _item(data: Any, name: str, said: str, is_list: bool) -> Any:
    """The section of this name, or the list of sections. It is created if it does not exist."""
    if isinstance(data, dict):
        return data.setdefault(name, [] if is_list else {})
    if not name.isdecimal() or int(name) > len(data):
        raise ValueError(f"{said}: the list has {len(data)} items, numbered from 0, and {name} is not one of them.")
    if int(name) == len(data):
        data.append({})
    return data[int(name)]


def validated(model: Any, data: Any, prefix: str, where: str) -> Any:
    """Build typed parameters from plain data. A mistake raises a ValueError of one line."""
    try:
        return _adapter(model).validate_json(json.dumps(data, default=str), strict=True)
    except ValidationError as error:
        first, *more = error.errors()
        keys = _keys(first["loc"], data)
        name = ".".join([prefix, *keys] if prefix else keys)
        if first["type"] == "value_error":
            raise ValueError(first["msg"].removeprefix("Value error, ")) from None
        if first["type"] == "missing" and keys[-1].isdecimal():
            listed = name.rpartition(".")[0]
            said = f"{listed} = {first['input']}: too few values. `cosim explain {listed}` says which."
            raise ValueError(said) from None
        if first["type"] == "missing":
            raise ValueError(f"{name}: missing. Set {name} in {where}.") from None
        of_same_key = [one for one in more if _keys(one["loc"], data) == keys]  # one of each type that it can have
        reasons = [one["msg"].removeprefix("Input should be ") for one in (first, *of_same_key)]
        reasons = ["a list" if reason == "a valid array" else reason for reason in reasons]
        reason = " or ".join(dict.fromkeys(reasons))
        raise ValueError(f"{name} = {first['input']!r} should be {reason}. Set {name} in {where}.") from None


def _keys(loc: Sequence[Any], data: Any) -> list[str]:
    """The keys of a place in the data, without pydantic's names of the alternatives that a value can be."""
    found = []
    for number, part in enumerate(loc, 1):
        if isinstance(data, dict):
            can_be_key, is_there = True, part in data
        else:
            can_be_key = isinstance(data, list) and isinstance(part, int)
            is_there = can_be_key and part < len(data)
        if is_there:
            data = data[part]
        elif not can_be_key or number < len(loc):  # only the last one can be missing
            continue
        found.append(str(part))
    return found


@cache
def _adapter(model: Any) -> TypeAdapter:
    return TypeAdapter(model)


def check_keys(data: dict[str, Any], model: Any, prefix: str, where: str) -> None:
    """Raise a ValueError of one line for a key that the dataclass lacks, or a value where a section is expected."""
    known = {f.name: f for f in fields(model) if not f.metadata.get("internal")}
    for name, value in data.items():
        if name not in known:
            raise unknown_key(name, list(known), prefix, where)
        full, type_ = prefix + name, known[name].type
        of_items = get_args(type_)[0] if get_origin(type_) is tuple else None
        if is_dataclass(of_items):
            if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
                raise ValueError(f"{full} should be a list of sections [[{full}]] in {where}.")
            for number, item in enumerate(value):
                check_keys(item, of_items, f"{full}.{number}.", where)
        elif is_dataclass(type_):
            if not isinstance(value, dict):
                raise ValueError(f"{full} = {value!r} should be a section [{full}] in {where}.")
            check_keys(value, type_, full + ".", where)
        else:
            check_finite(value, full, where)


def unknown_key(name: str, known: Sequence[str], prefix: str, where: str) -> ValueError:
    """The error for a key that is not one of the known ones, with the nearest of these."""
    near = difflib.get_close_matches(name, known, 1)
    hint = f"Did you mean {prefix}{near[0]}?" if near else f"Known: {', '.join(known)}."
    return ValueError(f"{prefix}{name}: unknown key in {where}. {hint}")


def check_finite(data: Any, name: str, where: str) -> None:
    """Raise a ValueError for numbers that are not finite or exceed 63 bits, at any depth of the data."""
    if isinstance(data, int) and not isinstance(data, bool) and abs(data) >= 2**63:
        raise ValueError(f"{name} is a whole number of more than 63 bits. Set a smaller {name} in {where}.")
    if isinstance(data, float) and not math.isfinite(data):
        raise ValueError(f"{name} = {data}: not a finite number. Set {name} in {where}.")
    items: Iterable[tuple[Any, Any]] = ()
    if isinstance(data, dict):
        items = data.items()
    elif isinstance(data, list):
        items = enumerate(data)
    for key, value in items:
        check_finite(value, f"{name}.{key}", where)


def is_plain(data: Any) -> bool:
    """Whether a config file can contain this value."""
    if isinstance(data, dict):
        has_text_keys = all(isinstance(key, str) for key in data)
        return has_text_keys and all(map(is_plain, data.values()))
    if isinstance(data, list | tuple):
        return all(map(is_plain, data))
    return data is None or isinstance(data, bool | int | float | str)
