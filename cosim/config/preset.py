"""Presets: named sets of keys that a config starts from."""

import difflib
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from cosim.config.data import read_toml

DEFAULT = "modern"
"""The preset of a config file that names none."""
RETIRED = {"v0.2": {"sensing_phase": "common", "extrapolate": False}}
"""Presets of earlier versions and their keys. A config that names one still runs, and is told so."""
S = TypeVar("S")
_FOLDER = Path(__file__).parent / "presets"


def names() -> list[str]:
    """Names of all presets."""
    return sorted(path.name.removesuffix(".toml") for path in _FOLDER.glob("*.toml"))


def under(data: dict[str, Any], where: str) -> None:
    """Add the keys of the preset that `data` names, unless `data` sets them itself. `data` is modified.

    Raises
    ------
    ValueError
        There is no preset of that name; the message is one line.
    """
    name = data.setdefault("preset", DEFAULT)
    for key, value in _preset(DEFAULT).items():
        if isinstance(value, Mapping):  # a section that another preset leaves out has the defaults of its keys
            data.setdefault(key, {})
    if not isinstance(name, str) or name not in [*names(), *RETIRED]:
        near = difflib.get_close_matches(str(name), names(), 1)
        hint = f'Did you mean "{near[0]}"?' if near else f"Known: {', '.join(names())}."
        raise ValueError(f"preset = {name!r}: there is no such preset in {where}. {hint}")
    _add(data, _preset(name))


def default_of(key: str, name: str = "") -> Any:
    """What a preset, by default the default one, sets a key such as `lidar.profile` to; None if it leaves it alone."""
    name = name or DEFAULT
    found: Any = {"preset": name} | _preset(name)
    for part in key.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return found


def default_section(params: Callable[..., S], name: str) -> S:
    """A section of a config as the default preset sets it."""
    return params(**_preset(DEFAULT).get(name, {}))


def farewell(name: str) -> list[str]:
    """A note if this preset is one of an earlier version."""
    if name not in RETIRED or name == DEFAULT:
        return []
    return [
        f'note: preset = "{name}" is the world of an earlier version: vehicles sense together, look ahead and know '
        f"their poses exactly. No published figure is of it any more. Leave the preset out for the default, or take "
        f'"paper" for that of TruPercept.'
    ]


@cache
def _preset(name: str) -> dict[str, Any]:
    if name in RETIRED:
        return RETIRED[name]
    return read_toml(_FOLDER / f"{name}.toml", "preset")


def _add(data: dict[str, Any], more: Mapping[str, Any]) -> None:
    for key, value in more.items():
        if isinstance(value, Mapping):
            inner = data.setdefault(key, {})
            if isinstance(inner, dict):  # otherwise validation reports the wrong type
                _add(inner, value)
        else:
            data.setdefault(key, list(value) if isinstance(value, list) else value)
