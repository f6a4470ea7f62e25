"""Choices by name: an included class, or a user's own as `path.py:Name` or `package.module:Name`.

`resolve` finds the class that a config names. `load_own` finds a user's own class and, if the kind is not given, its
kind. Both check the class before an instance is built.
"""

import importlib
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from cosim.base.durable import sha256
from cosim.door import blame, isolation, shape
from cosim.door.kinds import KINDS, Kind
from cosim.door.permission import check_code


@dataclass(frozen=True, slots=True)
class Source:
    """Origin of a choice, for the manifest."""

    name: str
    """Its name in the config, with resolved paths."""
    file: str = ""
    """The user's file. Empty for an included class."""
    sha256: str = ""
    """Checksum of that file."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What a key of the config names: a class, its parameters and its origin."""

    kind: Kind
    of: type
    params: type | None
    """Dataclass of its own parameters, which are read from the section of the key. None if it has none."""
    source: Source

    @property
    def is_own(self) -> bool:
        """Whether the class is a user's own."""
        return is_own(self.source.name)

    @property
    def title(self) -> str:
        """The kind and the name of the class, as messages say them."""
        return f"{self.kind.title} {self.of.__name__}"


def is_own(name: str) -> bool:
    """Whether a name refers to a user's own class."""
    return ":" in name


def resolve(kind: Kind, name: str, folder: Path | None = None) -> Choice:
    """Find the class that a name refers to.

    Parameters
    ----------
    folder
        Folder that relative paths refer to. If it is not given or has no such file, the current folder is used.

    Raises
    ------
    ValueError
        There is no such choice, its file cannot be loaded, or its class is not of the kind. The message is one line.
    """
    if is_own(name):
        return load_own(name, kind, folder)
    if name not in kind.shipped:
        raise ValueError(
            f'{kind.place} = "{name}": no such choice. There are {", ".join(kind.shipped)}; '
            "one of your own is named path.py:Name or package.module:Name."
        )
    found = kind.shipped[name]
    return Choice(kind, found, getattr(found, "Params", None), Source(name))


def load_own(name: str, kind: Kind | None = None, folder: Path | None = None) -> Choice:
    """Load and check a user's own class, `path.py:Name` or `package.module:Name`.

    Parameters
    ----------
    kind
        Kind that the class must have. If it is not given, it is found from the methods of the class.
    folder
        As in `resolve`.

    Raises
    ------
    ValueError
        The class cannot be used. The message is one line with the file, the line and what to change.
    """
    place = f"{kind.place} = {name}" if kind else name
    where, _, class_name = name.rpartition(":")
    if not (where and class_name):
        raise ValueError(f"{place}: name a class as path.py:Name or package.module:Name.")
    module, source = _module(place, name, folder)
    with blame.at_load(source.file, place, "the class cannot be read"):
        found = getattr(module, class_name, None)
        if found is None:
            hint = shape.did_you_mean(class_name, shape.classes_of(module))
            raise blame.Refused(
                f"{source.file}:1: {place}: it defines no {class_name}. {hint}Name a class of that file."
            )
        if not isinstance(found, type):
            raise blame.Refused(f"{source.file}:1: {place}: {class_name} is no class. Name a class of that file.")
        kind = kind or shape.kind_of(found, source.file, KINDS)
        shape.check_class(found, kind, source.file)
    return Choice(kind, found, getattr(found, "Params", None), source)


def function(key: str, name: str) -> Callable[..., Any]:
    """The function that `path.py:name` or `package.module:name` names. If it is missing, a ValueError is raised."""
    where, _, of = name.rpartition(":")
    if not where:
        raise ValueError(f"{key} = {name}: name a function as path.py:name or package.module:name.")
    module, _ = _module(f"{key} = {name}", name)
    found = getattr(module, of, None)
    if not callable(found):
        raise ValueError(f"{key} = {name}: {where} defines no function {of}. Name a function of that file.")
    return found


def checksum(key: str, name: str) -> str:
    """Checksum of the file that defines what `path.py:name` or `package.module:name` names."""
    _, source = _module(f"{key} = {name}", name)
    return source.sha256


def _module(place: str, name: str, folder: Path | None = None) -> tuple[ModuleType, Source]:
    """The module of a user's own choice. Messages begin with `place`."""
    check_code(place)
    where, _, of = name.rpartition(":")
    if not where.endswith(".py"):
        return _imported(place, where, of)
    path = Path(where)
    if folder is not None and (folder / path).is_file():
        path = folder / path
    if not path.is_file():
        raise ValueError(f"{place}: no such file. Give the path of a Python file.")
    return _of_file(place, path.resolve(), of)


def _imported(place: str, where: str, of: str) -> tuple[ModuleType, Source]:
    """A module that is imported by its name."""
    file = _file_of_module(place, where)
    with blame.at_load(file or where, place, "cannot be imported"), isolation.kept():
        module = importlib.import_module(where)
    digest = sha256(Path(file)) if file else ""
    return module, Source(f"{where}:{of}", file, digest)


def _file_of_module(place: str, where: str) -> str:
    """The file of a module; empty if it has none, such as `__main__` in a notebook."""
    if where in sys.modules:
        return getattr(sys.modules[where], "__file__", None) or ""
    with blame.at_load(where, place, "cannot be imported"):
        spec = importlib.util.find_spec(where)
    return spec.origin or "" if spec is not None and spec.has_location else ""


def _of_file(place: str, path: Path, of: str) -> tuple[ModuleType, Source]:
    """The module of a file. The same file is the same module in every process."""
    with blame.at_load(str(path), place, "cannot be loaded"):
        digest = sha256(path)
        name = f"cosim_own_{path.stem}_{digest[:12]}"
        if name not in sys.modules:
            spec = importlib.util.spec_from_file_location(name, path)
            assert spec is not None and spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            sys.modules[name] = module
            try:
                with isolation.kept():
                    spec.loader.exec_module(module)
            except BaseException as error:
                del sys.modules[name]
                if isinstance(error, ModuleNotFoundError) and path.with_name(f"{error.name}.py").is_file():
                    line = blame.line_of(error, str(path))
                    raise blame.Refused(
                        f"{path}:{line}: {place}: {error.name}.py beside it is not imported. Put both into one file."
                    ) from error
                raise
    return sys.modules[name], Source(f"{path}:{of}", str(path), digest)
