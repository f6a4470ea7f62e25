"""Type, default, bounds and meaning of every key of the config, from the dataclasses."""

import ast
import inspect
import sys
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cache
from itertools import pairwise
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import annotated_types as at

from cosim.config import preset
from cosim.config.config import Config, TrustVariant
from cosim.door.kinds import SECTIONS
from trust.params import TrustParams

_SIGNS = {
    at.Ge: ("ge", "≥"),
    at.Gt: ("gt", ">"),
    at.Le: ("le", "≤"),
    at.Lt: ("lt", "<"),
}
_NAMES = {str: "text", int: "whole number", float: "number", bool: "true or false", NoneType: "unset", dict: "section"}


@dataclass(frozen=True, slots=True)
class KeyDoc:
    """A key of the config."""

    name: str
    """Full name; keys in lists of sections have no number: `attacks.share_p`."""
    kind: str
    """Type in words; values in a list of choices are in backquotes."""
    bounds: str
    default: str
    meaning: str


@dataclass(frozen=True, slots=True)
class SectionDoc:
    """A section of the config, or the keys of one choice in it."""

    title: str
    about: str
    keys: tuple[KeyDoc, ...]


def sections() -> Iterator[SectionDoc]:
    """All sections with their keys, in the order of the config, then the keys that belong to choices."""
    parts: list[tuple[str, Any]] = []
    yield _of_model("Top level", "", Config, parts, "")
    while parts:
        name, model = parts.pop(0)
        title = name if "[" in name else f"[{name}]"
        yield _of_model(title, name.strip("[]"), model, parts, _about(model))
    yield _of_variant()
    yield from _of_choices()


def _of_model(
    title: str,
    prefix: str,
    model: Any,
    parts: list[tuple[str, Any]],
    about: str,
) -> SectionDoc:
    """The keys of a section; sections inside it are put in front of `parts`."""
    rows, inner = [], []
    for one in _shown(model):
        name = f"{prefix}.{one.name}" if prefix else one.name
        nested = _section_of(one.type)
        if nested is None:
            rows.append(_key(name, one, model))
        else:
            header = f"[[{name}]]" if get_origin(one.type) is tuple else name
            inner.append((header, nested))
    parts[:0] = inner
    return SectionDoc(title, about, tuple(rows))


def _of_variant() -> SectionDoc:
    rows = [_key(f"trust_variant.{n}", _field(TrustVariant, n), TrustVariant) for n in ("name", "fused")]
    about = "Another trust model or window on the same evidence, in the same run. It can also set any key of `[trust]`."
    return SectionDoc("[[trust_variant]]", about, tuple(rows))


def _of_choices() -> Iterator[SectionDoc]:
    """The keys that belong to the choices of a section."""
    for section, kind in SECTIONS.items():
        for name, made in kind.shipped.items():
            params = getattr(made, "Params", None)
            shared = {f.name for f in fields(TrustParams)} if section == "trust" else set()
            if params is None or _is_section(params, section):
                continue
            own = [one for one in fields(params) if one.name not in shared]
            rows = [_key(f"{section}.{one.name}", one, params) for one in own]
            title = f"[[{section}]]" if section == "attacks" else f"[{section}]"
            yield SectionDoc(f'{title} {kind.key} = "{name}"', _about(made), tuple(rows))


def _key(name: str, one: Field[Any], model: Any) -> KeyDoc:
    kind, bounds = _kind(_hints(model)[one.name])
    return KeyDoc(name, kind, bounds, _default(name, one), meanings(model).get(one.name, ""))


def keys() -> list[str]:
    """Every key. Keys in lists of sections have no number: `attacks.share_p`."""
    found: list[str] = []

    def walk(model: Any, prefix: str) -> None:
        for one in _shown(model):
            nested = _section_of(one.type)
            if nested is None:
                found.append(prefix + one.name)
            else:
                walk(nested, f"{prefix}{one.name}.")

    walk(Config, "")
    return found


def _shown(model: Any) -> list[Field[Any]]:
    hidden = ("own", "trust_variant") if model is Config else ()
    return [one for one in fields(model) if one.name not in hidden]


def _is_section(params: Any, section: str) -> bool:
    """Whether these keys are those of the section itself, which have a table already."""
    types = {one.name: one.type for one in fields(Config)}
    return types.get(section) is params


def _kind(hint: Any) -> tuple[str, str]:
    """A type and its bounds in words."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        kind, bounds = _kind(inner[0])
        marks = [bounds, *map(_bound, inner[1:])]
        return kind, ", ".join(mark for mark in marks if mark)
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in inner), ""
    if origin in (Union, UnionType):
        kinds, bounds_of = zip(*map(_kind, inner), strict=True)
        return " or ".join(dict.fromkeys(kinds)), " ".join(filter(None, bounds_of))
    if origin is tuple:
        of = [part for part in inner if part is not Ellipsis]
        kind, bounds = _kind(of[0])
        is_list = len(of) < len(inner)
        return f"list of: {kind}" if is_list else f"{len(of)} × {kind}", bounds
    if origin is dict:
        return "section", ""
    return _NAMES.get(hint, getattr(hint, "__name__", str(hint))), ""


def _bound(mark: Any) -> str:
    if isinstance(mark, at.Interval):
        found = []
        for name, sign in _SIGNS.values():
            bound = getattr(mark, name)
            if bound is not None:
                found.append(f"{sign} {_figure(bound)}")
        return ", ".join(found)
    for kind, (name, sign) in _SIGNS.items():
        if isinstance(mark, kind):
            return f"{sign} {_figure(getattr(mark, name))}"
    return ""


def _figure(bound: float) -> str:
    """A bound as text, with all digits of a whole number."""
    return str(int(bound)) if bound == int(bound) else f"{bound:g}"


def _default(name: str, one: Field[Any]) -> str:
    """The default of a key: that of the preset which holds if a config names none, else that of the class."""
    value = preset.default_of(name)
    if value is None:
        if one.default is MISSING and one.default_factory is MISSING:
            return "required"
        value = one.default if one.default_factory is MISSING else one.default_factory()
    if value is None:
        return "unset"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        return f"`{_written(value)}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def _written(value: Any) -> str:
    """A list, also one of lists, as TOML."""
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_written, value)) + "]"
    return f'"{value}"' if isinstance(value, str) else f"{value:g}"


def _section_of(kind: Any) -> Any:
    """The dataclass of a section, or of the sections of a list; None for a value."""
    if get_origin(kind) is tuple:
        kind = get_args(kind)[0]
    return kind if isinstance(kind, type) and is_dataclass(kind) else None


def _field(model: Any, name: str) -> Field[Any]:
    return next(one for one in fields(model) if one.name == name)


def _hints(model: Any) -> dict[str, Any]:
    return get_type_hints(model, include_extras=True)


def _about(model: Any) -> str:
    """The first paragraph of a class's docstring."""
    return " ".join((inspect.getdoc(model) or "").split("\n\n")[0].split())


@cache
def meanings(model: type) -> Mapping[str, str]:
    """The docstring below each field of a dataclass and of its bases."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if not is_dataclass(base):
            continue
        body = _source_of(base).body
        for one, after in pairwise(body):
            if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name):
                if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                    found[one.target.id] = " ".join(str(after.value.value).split())
    return found


def _source_of(model: type) -> ast.ClassDef:
    """A class as it is written in its module."""
    found: ast.AST = _parsed(model.__module__)
    for name in model.__qualname__.replace("<locals>.", "").split("."):
        below = ast.walk(found)
        inside = [one for one in below if isinstance(one, ast.ClassDef | ast.FunctionDef)]
        found = next(one for one in inside if one.name == name)
    assert isinstance(found, ast.ClassDef)
    return found


@cache
def _parsed(module: str) -> ast.Module:
    """A module, parsed once for all of its classes; `inspect.getsource` would parse it for each."""
    return ast.parse(inspect.getsource(sys.modules[module]))
