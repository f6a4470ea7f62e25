"""The adapter between the program and a user's own class. All calls go through it, and it checks every result.

`make` builds an instance of any choice. For an included class it returns the instance itself. For a user's own class it
returns a `Guarded` instance with the same interface. An exception in a user's class, or a wrong result, raises
`ExtensionError`.
"""

import zlib
from dataclasses import fields, is_dataclass
from functools import partial
from inspect import getattr_static
from typing import Any

import numpy as np
from numpy import ndarray

from cosim.door import blame, isolation, shape
from cosim.door.load import Choice
from cosim.door.returns import Call, Wrong


def make(choice: Choice, *arguments: Any) -> Any:
    """Build an instance of a choice. An instance of a user's own class is guarded.

    Parameters
    ----------
    arguments
        Arguments of the constructor, in the order of `choice.kind.arguments`. None for a class without parameters.

    Raises
    ------
    ValueError
        The constructor failed. The message is one line.
    """
    made = construct(choice, *arguments)
    return Guarded(choice, made, arguments) if choice.is_own else made


def construct(choice: Choice, *arguments: Any) -> Any:
    """Build an instance of a choice without checks. If this fails, a ValueError of one line is raised."""
    if not choice.is_own:
        return choice.of(*arguments)
    file = choice.source.file
    place = choice.title
    with blame.at_load(file, place, "cannot be made", blame.definition_line(choice.of, "__init__", file)):
        return choice.of(*arguments[: shape.n_arguments(choice.of, arguments)])


class Guarded:
    """An instance of a user's own class whose calls are checked. Other attributes are those of the instance.

    Parameters
    ----------
    inside
        The instance.
    made_with
        Arguments of its constructor.
    latest_step
        Step of the call, for methods that have no argument with the step.
    """

    __slots__ = ("_choice", "_inside", "_latest_step", "_made_with")

    def __init__(
        self, choice: Choice, inside: Any, made_with: tuple[Any, ...] = (), latest_step: int | None = None
    ) -> None:
        self._choice, self._inside, self._made_with, self._latest_step = choice, inside, made_with, latest_step

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if name not in self._choice.kind.hooks:
            return getattr(self._inside, name)
        if getattr_static(self._inside, name, None) is None:
            raise AttributeError(name)
        return partial(self._call, name, getattr(self._inside, name))

    def _call(self, name: str, method: Any, *given: Any) -> Any:
        """Call a method and check its result."""
        choice, file = self._choice, self._choice.source.file
        what = f"{choice.title}: {name}()"
        defined = blame.definition_line(choice.of, name, file)
        place = f"{file}:{defined}: {what}"
        hook = choice.kind.hooks[name]
        before = _content(hook.parameters, given)
        try:
            with isolation.kept():
                returned = method(*map(_shown, hook.parameters, given))
        except isolation.FolderChanged as moved:
            raise blame.ExtensionError(f"{place} {moved}.") from None
        except BaseException as error:  # whatever a user's class does
            if blame.is_interrupt(error):
                raise
            line = blame.line_of(error, file) or defined
            raise blame.ExtensionError(
                f"{file}:{line}: {what} raised {blame.reason(error)}. cosim --debug shows the traceback."
            ) from error
        after = _content(hook.parameters, given)
        if changed := [argument for argument, content in before.items() if after.get(argument) != content]:
            raise blame.ExtensionError(
                f"{place} changed its argument {changed[0]} in place; arguments are to be left as they are. Work on a "
                "copy: .copy()."
            )
        try:
            return hook.check(Call(given, self._made_with, self._latest_step), returned)
        except Wrong as wrong:
            raise blame.ExtensionError(f"{place} {wrong}.") from None
        except Exception as error:  # a result of the right type that is not what its type says
            raise blame.ExtensionError(f"{place} returned what cannot be read: {blame.reason(error)}.") from error


_UNWATCHED = frozenset({"state", "sweeps"})
"""Parameters without checksums: a class's own state, and range images, which are too large to be read twice."""
_READ_ONLY = frozenset({"sweeps"})
"""Parameters whose arrays cannot be written to."""


def refuse(own: Any, name: str, what: str) -> None:
    """Raise `ExtensionError` for what a method of a guarded instance returned."""
    choice = own._choice
    file = choice.source.file
    line = blame.definition_line(choice.of, name, file)
    raise blame.ExtensionError(f"{file}:{line}: {choice.title}: {name}() {what}.")


def _shown(name: str, value: Any) -> Any:
    """An argument as a user's class gets it."""
    return _read_only(value) if name in _READ_ONLY else value


def _read_only(value: Any) -> Any:
    """An array, or a dataclass of arrays, with the same content, which cannot be written to."""
    if isinstance(value, ndarray):
        view = value.view()
        view.flags.writeable = False
        return view
    if is_dataclass(value) and not isinstance(value, type):
        made = object.__new__(type(value))
        for field in fields(value):
            object.__setattr__(made, field.name, _read_only(getattr(value, field.name)))
        return made
    return value


def _content(
    names: tuple[str, ...],
    given: tuple[Any, ...],
) -> dict[str, int]:
    """Checksums of all arrays in the arguments of a call, by name. Arrays within dataclasses are included."""
    found: dict[str, int] = {}

    def add(name: str, value: Any) -> None:
        if isinstance(value, ndarray):
            flat = np.ascontiguousarray(value).reshape(-1)
            found[name] = zlib.crc32(flat.view(np.uint8).data)
        elif is_dataclass(value) and not isinstance(value, type):
            for field in fields(value):
                add(f"{name}.{field.name}", getattr(value, field.name, None))

    for name, value in zip(names, given, strict=True):
        if name not in _UNWATCHED:
            add(name, value)
    return found
