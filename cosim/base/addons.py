"""Add-ons: features in folders under `cosim/addons`, which the core never imports.

The `__init__` of an add-on says what it adds, as names with addresses of code: "cosim.addons.law.commands:predict". The
code is imported when its name is first used. If the folder of an add-on is deleted, its names are gone, and nothing
else changes.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True, slots=True)
class Addon:
    """What an add-on adds. Every value is an address of code, `module:name`; a module's own is `module`."""

    commands: Mapping[str, str] = field(default_factory=dict)
    """Commands and groups of commands, by name. "nets build" is the command `build` of the group `nets`."""
    choices: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """Included classes by the kind of choice (`cosim.door.kinds`) and by their name in the config. The kind "figure"
    has pictures of runs; the kind "topic" has modules of metrics; "measure" has functions that facts of `cosim compare`
    name."""
    hooks: Mapping[str, str] = field(default_factory=dict)
    """What the core calls if it is there, by the name that the core gives it."""


@cache
def addons() -> dict[str, Addon]:
    """All add-ons that are installed, by the name of their folder."""
    folder = import_module("cosim.addons")
    names = sorted(found.name for found in iter_modules(folder.__path__) if found.ispkg)
    return {name: import_module(f"cosim.addons.{name}").ADDON for name in names}


def data_files(name: str) -> Iterator[Path]:
    """Files of this name in the folders of add-ons: `metrics.toml` declares metrics."""
    (folder,) = import_module("cosim.addons").__path__
    paths = (Path(folder, addon, name) for addon in addons())
    yield from (path for path in paths if path.is_file())


def loaded(address: str) -> Any:
    """The code at an address."""
    module, _, name = address.partition(":")
    found = import_module(module)
    return getattr(found, name) if name else found


def hook(name: str, purpose: str) -> Any:
    """The code that an add-on gives for a hook of the core.

    Parameters
    ----------
    name
        Name of the hook.
    purpose
        What needs it, as the subject of a sentence: "cosim run --watch".

    Raises
    ------
    ValueError
        In one line: no add-on that is installed has this hook.
    """
    for addon in addons().values():
        if name in addon.hooks:
            return loaded(addon.hooks[name])
    raise ValueError(f"{purpose} needs an add-on, and this installation lacks it. Install all of cosim.")


class Choices(Mapping[str, T], Generic[T]):
    """Choices of one kind by name: the core's own, then those of add-ons, which are imported when they are taken."""

    def __init__(self, kind: str, own: Mapping[str, T]) -> None:
        self._own = dict(own)
        self._added: dict[str, str] = {}
        for addon in addons().values():
            self._added.update(addon.choices.get(kind, {}))

    def __getitem__(self, name: str) -> T:
        return self._own[name] if name in self._own else loaded(self._added[name])

    def __iter__(self) -> Iterator[str]:
        yield from self._own
        yield from self._added

    def __len__(self) -> int:
        return len(self._own) + len(self._added)
