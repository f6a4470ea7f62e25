"""Choices by name: one of those that ship, or a user's own as `path.py:Name` or `package.module:Name`."""

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from cosim.config.permission import check_code


@dataclass(frozen=True, slots=True)
class Source:
    """Where a choice comes from, for the manifest."""

    name: str
    """As the config names it; paths resolved."""
    file: str = ""
    """File of the user's own; empty for what ships."""
    sha256: str = ""
    """Checksum of that file."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What a key of the config names: a class, its own parameters, and where it comes from."""

    key: str
    """Key of the config, such as `trust.model`."""
    of: type
    params: type | None
    """Frozen dataclass of its own parameters, read from the section of the key; None for none."""
    source: Source


def is_own(name: str) -> bool:
    """Whether a name is a user's own."""
    return ":" in name


def resolve(key: str, name: str, at_hand: Mapping[str, Any], folder: Path | None = None, needs: str = "") -> Choice:
    """The class that a name stands for.

    Parameters
    ----------
    key
        Key of the config, for messages.
    at_hand
        What ships, by name.
    folder
        Where relative paths of files begin; the current folder when not given or when there is no such file.
    needs
        Method that a user's own class must have.

    Raises
    ------
    ValueError
        In one line, where there is no such choice, or its file cannot be loaded.
    """
    if not is_own(name):
        if name not in at_hand:
            raise ValueError(
                f'{key} = "{name}": no such choice. There are {", ".join(at_hand)}; '
                "one of your own is named path.py:Name or package.module:Name."
            )
        found, source = at_hand[name], Source(name)
    else:
        where, _, class_name = name.rpartition(":")
        module, source = _load(key, where, class_name, folder)
        if not hasattr(module, class_name):
            raise ValueError(f"{key} = {name}: {where} defines no {class_name}. Name a class of that file.")
        found = getattr(module, class_name)
        if not isinstance(found, type):
            raise ValueError(f"{key} = {name}: {class_name} is no class.")
        for method in needs.split():
            if not callable(getattr(found, method, None)):
                raise ValueError(f"{key} = {name}: class {class_name} has no method {method}(...), which this needs.")
    params = getattr(found, "Params", None)
    if params is not None and not (is_dataclass(params) and isinstance(params, type)):
        raise ValueError(f"{key} = {name}: {found.__name__}.Params is no dataclass. Make it a frozen dataclass.")
    return Choice(key, found, params, source)


def function(key: str, name: str) -> Callable[..., Any]:
    """The function that `path.py:name` or `package.module:name` names; ValueError in one line where there is none."""
    where, colon, of = name.rpartition(":")
    if not colon:
        raise ValueError(f"{key} = {name}: name a function as path.py:name or package.module:name.")
    module, _ = _load(key, where, of, None)
    found = getattr(module, of, None)
    if not callable(found):
        raise ValueError(f"{key} = {name}: {where} defines no function {of}. Name a function of that file.")
    return found


def make(choice: Choice, *arguments: Any) -> Any:
    """An instance of a choice; ValueError in one line where a user's own class refuses."""
    if not is_own(choice.source.name):
        return choice.of(*arguments)
    try:
        return choice.of(*arguments)
    except Exception as error:  # whatever a user's class does
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"{choice.key} = {choice.source.name}: cannot be made: {reason}.") from error


def _load(key: str, where: str, class_name: str, folder: Path | None) -> tuple[ModuleType, Source]:
    """The module of a user's own choice."""
    check_code(key, f"{where}:{class_name}")
    try:
        if where.endswith(".py"):
            path = Path(where)
            if folder is not None and (folder / path).is_file():
                path = folder / path
            if not path.is_file():
                raise ValueError(f"{key} = {where}:{class_name}: no such file. Give the path of a Python file.")
            path = path.resolve()
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            name = f"cosim_own_{path.stem}_{digest[:12]}"  # the same file is the same module in every process
            if name not in sys.modules:
                spec = importlib.util.spec_from_file_location(name, path)
                assert spec is not None and spec.loader is not None
                module = importlib.util.module_from_spec(spec)
                sys.modules[name] = module
                try:
                    spec.loader.exec_module(module)
                except BaseException:
                    del sys.modules[name]
                    raise
            return sys.modules[name], Source(f"{path}:{class_name}", str(path), digest)
        module = importlib.import_module(where)
        file = Path(module.__file__) if module.__file__ else None
        digest = hashlib.sha256(file.read_bytes()).hexdigest() if file is not None else ""
        return module, Source(f"{where}:{class_name}", str(file or ""), digest)
    except ValueError:
        raise
    except Exception as error:  # whatever a user's file does while it loads
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"{key} = {where}:{class_name}: cannot be loaded: {reason}.") from error
