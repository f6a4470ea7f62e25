"""The keys of a config that differ from the default of its preset, as `cosim check` lists them."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from cosim.config.config import Config, chosen, load, resolve_data, with_defaults
from cosim.door.kinds import SECTIONS

NONE = object()


@dataclass(frozen=True, slots=True)
class Change:
    """One key, or one section of a list of sections, that differs."""

    key: str
    value: Any
    default: Any
    """`NONE` where the default config has no such key or section."""
    is_left_out: bool = False
    """Whether it is a section of the default that the config does not have."""

    @property
    def line(self) -> str:
        """The key with its value and the default, as in a config."""
        if self.is_left_out:
            return f"{self.key} of the default is left out: {as_toml(self.default)}"
        if self.default is NONE:
            return f"{self.key} = {as_toml(self.value)}"
        return f"{self.key} = {as_toml(self.value)} (default {as_toml(self.default)})"


def changes(config: Config, path: Path | None) -> list[Change]:
    """What a config that was read from `path` changes against the default run, or a config of one line, `preset`."""
    if path is None:
        base = load(None, [f"preset={config.preset}"])
    else:
        base = resolve_data(with_defaults({"preset": config.preset}), "the default", None)
    now, before = config.to_dict(), base.to_dict()
    found: list[Change] = []
    for section, value in now.items():
        found += _of(section, value, before[section], config)
    return found


def _of(section: str, value: Any, default: Any, config: Config) -> Iterator[Change]:
    """Changes of a key, of the keys of a section, or of a list of sections."""
    if _plain(value) == _plain(default):
        return
    if isinstance(value, Mapping):
        for key, one in value.items():
            was = default.get(key, NONE) if isinstance(default, Mapping) else NONE
            yield from _of(f"{section}.{key}", one, was, config)
    elif _is_sections(value) or _is_sections(default):
        if not value:
            yield Change(section, [], [item.get(next(iter(item))) for item in default])
        for number, item in enumerate(value):
            if number >= len(default) or _plain(item) != _plain(default[number]):
                own = _own_keys(item, _params(config, section, number))
                yield Change(f"{section}.{number}", own, NONE)
        kept = {_named(item) for item in value}
        for number, item in enumerate(default):
            if 0 < len(value) < len(default) and _named(item) not in kept:
                first = next(iter(item))
                yield Change(f"{section}.{number}", None, {first: item[first]}, is_left_out=True)
    else:
        yield Change(section, value, default)


def _named(section: Mapping[str, Any]) -> Any:
    """What says which section of a list it is: the value of its first key."""
    return next(iter(section.values()), None)


def _is_sections(value: Any) -> bool:
    return isinstance(value, list | tuple) and bool(value) and isinstance(value[0], Mapping)


def _params(config: Config, section: str, number: int) -> list[Any]:
    """The parameters of a section of a list, and those of the class that it chooses."""
    found = [getattr(config, section)[number]]
    return [*found, chosen(config, section, number)[1]] if section in SECTIONS else found


def _own_keys(item: Mapping[str, Any], params: list[Any]) -> dict[str, Any]:
    """The keys of a section of a list whose values are not the defaults of their keys, and its first key."""
    defaults: dict[str, Any] = {}
    for one in params:
        if is_dataclass(one):
            defaults |= {f.name: _plain(_default(f)) for f in fields(one)}
    first = next(iter(item), "")
    own = {}
    for key, value in item.items():
        if key == first or _plain(value) != defaults.get(key, NONE):
            own[key] = value
    return own


def _default(field: Any) -> Any:
    return field.default_factory() if field.default_factory is not MISSING else field.default


def _plain(value: Any) -> Any:
    """A value as JSON has it, so that tuples equal lists."""
    return json.loads(json.dumps(value, default=str))


def as_toml(value: Any) -> str:
    """A value as in a config file, in one line."""
    if value is None:
        return "not set"
    if isinstance(value, Mapping):
        pairs = (f"{key} = {as_toml(one)}" for key, one in value.items())
        return "{ " + ", ".join(pairs) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(as_toml, value)) + "]"
    if isinstance(value, float) and value == int(value) and abs(value) < 1e15:
        return f"{value:.0f}"
    return json.dumps(value, ensure_ascii=False, default=str)
