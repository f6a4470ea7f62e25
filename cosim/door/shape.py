"""Checks that a class fits its kind: its methods, their parameters, the constructor, and `Params`."""

import difflib
import inspect
import sys
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from types import ModuleType
from typing import Any

from cosim.door.blame import Refused, definition_line
from cosim.door.kinds import Kind

_OURS = {"cosim", "sensors", "trust", "results", "builtins", "typing", "abc", "enum"}
"""Packages whose classes a user's class may inherit from. Methods that they define are not checked."""
_NEAR = 0.7
"""Similarity from which a name counts as misspelt."""


def kind_of(of: type, file: str, kinds: Mapping[str, Kind]) -> Kind:
    """The kind whose methods a class has. If there is none, or more than one, `Refused` is raised."""
    found = [kind for kind in kinds.values() if _has_hooks(of, kind)]
    if len(found) == 1:
        return found[0]
    where = f"{file}:{definition_line(of, '', file)}: class {of.__name__}"
    if found:
        titles = ", ".join(kind.title for kind in found)
        raise Refused(f"{where} has the methods of several kinds: {titles}. Say which one is meant.")
    hooks = {hook for kind in kinds.values() for hook in kind.hooks}
    hints = [did_you_mean(name, hooks, f"{name}(): ") for name in _own_methods(of)]
    hint = next(filter(None, hints), "")
    due = []
    for kind in kinds.values():
        names = ", ".join(kind.required or kind.hooks)
        due.append(f"{kind.title}: {names}")
    raise Refused(f"{where} has the methods of no kind of extension. {hint}Methods of each: {'; '.join(due)}.")


def check_class(of: type, kind: Kind, file: str) -> None:
    """Raise `Refused` with one line if a user's class does not fit a kind.

    Parameters
    ----------
    file
        File of the class, for messages.
    """

    def where(name: str = "") -> str:
        return f"{file}:{definition_line(of, name, file)}: {kind.title} {of.__name__}"

    lacking = [name for name in kind.hooks if inspect.getattr_static(of, name, None) is None]
    for name in _own_methods(of):
        if name not in kind.hooks and (hint := did_you_mean(name, lacking)):
            raise Refused(
                f"{where(name)}: {name}() is not a method that {kind.a_title} is asked for. {hint}Rename it; the name "
                "of a method for your own use begins with an underscore."
            )
    missing = [name for name in kind.required if name in lacking]
    if missing or len(lacking) == len(kind.hooks):
        due = []
        for name in missing or kind.hooks:
            parameters = ", ".join(kind.hooks[name].parameters)
            due.append(f"{name}({parameters})")
        raise Refused(f"{where()} has no method {' or '.join(due)}, which {kind.a_title} needs. Write it.")
    for name in kind.hooks.keys() - set(lacking):
        _check_method(of, name, kind.hooks[name].parameters, where(name))
    params = inspect.getattr_static(of, "Params", None)
    if params is None:
        _check_absent_params(of, where())
    else:
        _check_params(params, f"{where()}: Params")
    _check_constructor(of, params is not None, kind, where("__init__"))
    for name, what in kind.numbers.items():
        value = getattr(of, name, 1.0)
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise Refused(f"{where()}: {name} = {value!r} is not a positive number. It is {what}.")


def did_you_mean(name: str, known: Iterable[str], begin: str = "") -> str:
    """The text "Did you mean X? " if a name is similar to a known one; empty otherwise."""
    plain = {other.lower().replace("_", ""): other for other in known}
    near = difflib.get_close_matches(name.lower().replace("_", ""), plain, 1, _NEAR)
    return f"{begin}Did you mean {plain[near[0]]}? " if near else ""


def classes_of(module: ModuleType) -> list[str]:
    """Names of the classes that a module defines."""
    classes = {name: of for name, of in vars(module).items() if isinstance(of, type)}
    return [name for name, of in classes.items() if of.__module__ == module.__name__]


def n_arguments(of: type, arguments: tuple[Any, ...]) -> int:
    """Number of arguments that a constructor takes. Its signature may omit the last ones."""
    parameters = _parameters(of)
    if parameters is None or _takes_any(parameters):
        return len(arguments)
    return min(len(arguments), len(_positional(parameters)))


def _has_hooks(of: type, kind: Kind) -> bool:
    has = [name for name in kind.hooks if inspect.getattr_static(of, name, None) is not None]
    return bool(has) and set(kind.required) <= set(has)


def _own_methods(of: type) -> list[str]:
    """Public methods that the user's own classes define, without those of included base classes."""
    ours: set[str] = set()
    own = []
    for base in of.__mro__:
        if base.__module__.split(".")[0] in _OURS:
            ours |= vars(base).keys()
        else:
            own.append(base)
    found = []
    for base in own:
        for name, value in vars(base).items():
            is_method = callable(value) or isinstance(value, staticmethod | classmethod | property)
            if is_method and not isinstance(value, type) and not name.startswith("_") and name not in ours:
                found.append(name)
    return found


def _parameters(called: Any) -> list[inspect.Parameter] | None:
    """Parameters of a callable; None if they cannot be found."""
    try:
        return list(inspect.signature(called).parameters.values())
    except (ValueError, TypeError):
        return None


def _positional(parameters: list[inspect.Parameter]) -> list[inspect.Parameter]:
    return [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]


def _takes_any(parameters: list[inspect.Parameter]) -> bool:
    """Whether any number of arguments can follow, as with `*arguments`."""
    return any(p.kind is p.VAR_POSITIONAL for p in parameters)


def _check_method(of: type, name: str, due: tuple[str, ...], where: str) -> None:
    """Raise `Refused` if a method cannot be called with the arguments of its kind."""
    raw = inspect.getattr_static(of, name)
    function = raw.__func__ if isinstance(raw, staticmethod | classmethod) else raw
    cure = f"Write def {name}({', '.join(('self', *due))})."
    if not callable(function):
        what = "a property" if isinstance(raw, property) else f"{type(raw).__name__}, not a method"
        raise Refused(f"{where}: {name} is {what}. {cure}")
    for is_it, what in (
        (inspect.iscoroutinefunction, "is asynchronous"),
        (inspect.isgeneratorfunction, "is a generator: it has yield"),
        (inspect.isasyncgenfunction, "is an asynchronous generator"),
    ):
        if is_it(function):
            raise Refused(f"{where}: {name}() {what}. Write a plain method that returns its result.")
    parameters = _parameters(function)
    if parameters is None or not inspect.isfunction(inspect.unwrap(function)):
        return  # the signature of another kind of callable is not known before the call
    if not isinstance(raw, staticmethod):
        own = _positional(parameters)
        has_self = _takes_any(parameters)
        if own:
            has_self = own[0].name not in due or len(own) != len(due)
        if not has_self:
            raise Refused(f"{where}: {name}({_shown(parameters)}) has no self. {cure}")
        if own:
            parameters.remove(own[0])
    if problem := _misfit(parameters, due, exactly=True):
        called = ", ".join(due)
        shown = _shown(parameters)
        raise Refused(f"{where}: {name}({shown}) {problem}: it is called with ({called}). {cure}")


def _shown(parameters: list[inspect.Parameter]) -> str:
    return ", ".join(p.name for p in parameters)


def _misfit(parameters: list[inspect.Parameter], due: tuple[str, ...], exactly: bool) -> str:
    """Why parameters cannot take the arguments `due`; empty if they can.

    With `exactly`, all arguments are given. Otherwise only as many of the first as there are parameters.
    """
    own = _positional(parameters)
    needed = [p.name for p in own if p.default is p.empty]
    if len(needed) > len(due):
        return f"needs {', '.join(needed[len(due) :])} too"
    if exactly and not _takes_any(parameters) and len(own) < len(due):
        return "takes too few arguments"
    by_keyword = [p for p in parameters if p.kind is p.KEYWORD_ONLY]
    if forced := [p.name for p in by_keyword if p.default is p.empty]:
        return f"needs {', '.join(forced)} by keyword"
    for at, parameter in enumerate(own[: len(due)]):
        if parameter.name in due and due.index(parameter.name) != at:
            return "has its parameters in another order"
    return ""


def _check_constructor(of: type, has_params: bool, kind: Kind, where: str) -> None:
    due = kind.arguments if has_params or kind.section_params else ()
    parameters = _parameters(of)
    if parameters is None:
        return
    takes = _positional(parameters)
    if not has_params and not due and any(p.default is p.empty for p in takes):
        raise Refused(
            f"{where}: the constructor takes {_shown(takes)}, but the class has no Params. Name a frozen dataclass in "
            "it, Params = ..., or write def __init__(self)."
        )
    if has_params and not takes and not _takes_any(parameters):
        raise Refused(
            f"{where}: the class has Params, but its constructor does not take them. Write "
            f"def __init__(self, {', '.join(due)})."
        )
    if problem := _misfit(parameters, due, exactly=False):
        raise Refused(
            f"{where}: the constructor {problem}: it is called with ({', '.join(due)}). Write "
            f"def __init__({', '.join(('self', *due))}); the last ones may be left out."
        )


def _check_absent_params(of: type, where: str) -> None:
    """Raise `Refused` if a class has no `Params`, but probably should have."""
    for name, value in vars(of).items():
        if name.lower() in ("params", "param", "parameters") and isinstance(value, type):
            raise Refused(f"{where}: {name} is not read. Did you mean Params? Rename it.")
    beside = getattr(sys.modules.get(of.__module__), "Params", None)
    takes = [p.name for p in _parameters(of) or ()]
    if isinstance(beside, type) and is_dataclass(beside) and "params" in takes:
        raise Refused(
            f"{where}: the file has a class Params that {of.__name__} does not name. Write Params = Params in it."
        )


def _check_params(params: Any, where: str) -> None:
    """Raise `Refused` if `Params` is not a dataclass, or has attributes that are not fields."""
    if not isinstance(params, type):
        what = "an instance" if is_dataclass(params) else f"{type(params).__name__}"
        raise Refused(f"{where} is {what}, not a class. Name the class itself, without brackets.")
    if not is_dataclass(params):
        raise Refused(f"{where} is not a dataclass. Write @dataclass(frozen=True, kw_only=True) above it.")
    if vars(params).get("__annotations__") and "__dataclass_fields__" not in vars(params):
        raise Refused(f"{where}: what it adds to its base class is not read. Write @dataclass(frozen=True) above it.")
    known = {f.name for f in fields(params)}
    for name, value in vars(params).items():
        is_method = callable(value) or hasattr(value, "__get__")
        if name[0] != "_" and name == name.lower() and not is_method and name not in known:
            if name not in vars(params).get("__annotations__", {}):
                raise Refused(
                    f"{where}.{name} has no type, so that no config can set it. Write {name}: "
                    f"{type(value).__name__} = {value!r}."
                )
