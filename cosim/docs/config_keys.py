"""Renders the page of the config keys as Markdown from the dataclasses: type, default, bounds and meaning."""

import ast
import inspect
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import annotated_types as at

from cosim.config import preset
from cosim.config.config import Config, TrustVariant
from cosim.door.kinds import SECTIONS
from trust.params import TrustParams

_SIGNS = {at.Ge: ("ge", "≥"), at.Gt: ("gt", ">"), at.Le: ("le", "≤"), at.Lt: ("lt", "<")}
_NAMES = {str: "text", int: "whole number", float: "number", bool: "true or false", NoneType: "unset", dict: "section"}


def markdown() -> str:
    """The page."""
    lines = [
        "# Every key of the config",
        "",
        "A config is a TOML file. A dot in a key separates section and key: `radio.range_m` is `range_m` in `[radio]`.",
        "`--set KEY=VALUE` changes a key on the command line. Items of lists have numbers: `attacks.0.share_p`.",
        f"A key that you leave out has its default, that of the preset `{preset.DEFAULT}`. Another `preset` has other",
        "defaults. An unknown key is an error. `cosim check FILE` prints all values.",
        "",
    ]
    parts: list[tuple[str, Any]] = []
    lines += _table("Top level", "", Config, parts, "")
    while parts:
        name, model = parts.pop(0)
        lines += _table(f"[{name}]" if "[" not in name else name, name.strip("[]"), model, parts, _about(model))
    lines += [*_variant(), *_own()]
    return "\n".join(lines) + "\n"


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


def _table(title: str, prefix: str, model: Any, parts: list[tuple[str, Any]], about: str) -> list[str]:
    rows, inner = [], []
    said = meanings(model)
    for one in _shown(model):
        name = f"{prefix}.{one.name}" if prefix else one.name
        nested = _section_of(one.type)
        if nested is None:
            rows.append(_row(name, one, said.get(one.name, ""), _hints(model)[one.name]))
        else:
            inner.append((f"[[{name}]]" if get_origin(one.type) is tuple else name, nested))
    parts[:0] = inner
    return _section(title, about, rows)


def _section(title: str, about: str, rows: list[str]) -> list[str]:
    if not rows:
        return []
    head = ["| key | type | default | meaning |", "|---|---|---|---|"]
    return [f"## {title}", "", *([about, ""] if about else []), *head, *rows, ""]


def _shown(model: Any) -> list[Field[Any]]:
    return [one for one in fields(model) if not (model is Config and one.name in ("own", "trust_variant"))]


def _variant() -> list[str]:
    said = meanings(TrustVariant)
    rows = [
        _row(f"trust_variant.{n}", _field(TrustVariant, n), said[n], _hints(TrustVariant)[n]) for n in ("name", "fused")
    ]
    about = "Another trust model or window on the same evidence, in the same run. It can also set any key of `[trust]`."
    return _section("[[trust_variant]]", about, rows)


def _own() -> Iterator[str]:
    """Tables of the keys that belong to the choices of a section."""
    for section, kind in SECTIONS.items():
        listed = section == "attacks"
        for name, made in kind.shipped.items():
            params = getattr(made, "Params", None)
            shared = {f.name for f in fields(TrustParams)} if section == "trust" else set()
            if params is None or _is_section(params, section):
                continue
            said, hints = meanings(params), _hints(params)
            mine = [one for one in fields(params) if one.name not in shared]
            rows = [_row(f"{section}.{one.name}", one, said.get(one.name, ""), hints[one.name]) for one in mine]
            title = f"[[{section}]]" if listed else f"[{section}]"
            yield from _section(f'{title} {kind.key} = "{name}"', _about(made), rows)


def _is_section(params: Any, section: str) -> bool:
    """Whether these keys are those of the section itself, which have a table already."""
    return any(one.name == section and one.type is params for one in fields(Config))


def _row(name: str, one: Field[Any], meaning: str, hint: Any) -> str:
    kind, bounds = _kind(hint)
    cells = [f"`{name}`", "; ".join(x for x in (kind, bounds) if x), _default(name, one), meaning]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _kind(hint: Any) -> tuple[str, str]:
    """A type and its bounds in words."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        kind, bounds = _kind(inner[0])
        return kind, ", ".join(x for x in (bounds, *(_bound(mark) for mark in inner[1:])) if x)
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in inner), ""
    if origin in (Union, UnionType):
        kinds = [_kind(part) for part in inner]
        return " or ".join(dict.fromkeys(k for k, _ in kinds)), " ".join(b for _, b in kinds if b)
    if origin is tuple:
        of = [part for part in inner if part is not Ellipsis]
        kind, bounds = _kind(of[0])
        return (f"list of: {kind}" if len(of) < len(inner) else f"{len(of)} × {kind}"), bounds
    if origin is dict:
        return "section", ""
    return _NAMES.get(hint, getattr(hint, "__name__", str(hint))), ""


def _bound(mark: Any) -> str:
    if isinstance(mark, at.Interval):
        return ", ".join(
            f"{sign} {_figure(v)}" for name, sign in _SIGNS.values() if (v := getattr(mark, name)) is not None
        )
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
    return f'`"{value}"`' if isinstance(value, str) else f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


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


def meanings(model: type) -> Mapping[str, str]:
    """The docstring below each field of a dataclass and of its bases."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if not is_dataclass(base):
            continue
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(body, ast.ClassDef)
        for one, after in zip(body.body, body.body[1:], strict=False):
            if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name):
                if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                    found[one.target.id] = " ".join(str(after.value.value).split())
    return found
