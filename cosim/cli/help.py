"""Help of the commands: what people use first, on one screen; commands in groups, one line each."""

from collections.abc import Iterator, Mapping, Sequence
from textwrap import fill
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

MORE = "More"
"""Panel of the options that the help of a command only names. `cosim explain COMMAND` prints them whole."""
LAST_GROUP = "More"
"""Group of the commands that no group names."""
_COMPLETION = ("--install-completion", "--show-completion")


class Command(TyperCommand):
    """A command whose help has its main options in full and names the others."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments and the options."""
        write_options(self.get_params(ctx), ctx, formatter)


class Commands(typer.Typer):
    """Commands and groups of commands, all with this help."""

    def __init__(self, **how: Any) -> None:
        super().__init__(**{"cls": in_groups({}), "rich_markup_mode": None} | how)

    def command(self, name: str | None = None, **how: Any) -> Any:
        """A decorator that registers a command; see `typer.Typer.command`."""
        return super().command(name, **{"cls": Command} | how)


def in_groups(
    groups: Mapping[str, Sequence[str]],
    renamed: Mapping[str, str] = {},
) -> type[TyperGroup]:
    """A class of the program, whose help lists its commands in these groups, in this order.

    The order in which commands are registered has no effect. A name without a command is skipped, and commands that no
    group names are listed last.

    Parameters
    ----------
    groups
        Names of commands by group.
    renamed
        What to type now, by the name of a command that is gone.
    """

    class InGroups(TyperGroup):
        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            """Read the words of a command line. Without any, the help is printed."""
            asks = not args and not ctx.resilient_parsing  # resilient: the shell completes words
            return super().parse_args(ctx, ["--help"] if asks else args)

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            """The command that words name. One that is gone is refused with what to type now."""
            for name in renamed.keys() & args[:1]:
                raise ValueError(f"There is no cosim {name} any more. Now: cosim {renamed[name]}")
            return super().resolve_command(ctx, args)

        def list_commands(self, ctx: Any) -> list[str]:
            """The names of the commands in the order of the groups."""
            return [name for names in self.by_group().values() for name in names]

        def by_group(self) -> dict[str, list[str]]:
            """The names of the commands of each group that has any."""
            rest = list(self.commands)
            found = {}
            for group, names in groups.items():
                found[group] = [name for name in names if name in self.commands]
                rest = [name for name in rest if name not in names]
            found[LAST_GROUP if groups else "Commands"] = rest
            return {group: names for group, names in found.items() if names}

        def format_options(self, ctx: Any, formatter: Any) -> None:
            """Write the commands by group, and the options."""
            formatter.write_paragraph()
            for group, names in self.by_group().items():
                formatter.write(f"{group}\n")
                formatter.indent()
                rows = [(f"{name:<9}", first_sentence(self.commands[name])) for name in names]
                formatter.write_dl(rows)
                formatter.dedent()
            write_options(self.get_params(ctx), ctx, formatter)

    return InGroups


def first_sentence(command: Any) -> str:
    """The line that stands for a command in a list of commands."""
    text = " ".join((command.short_help or command.help or "").split())
    head, mark, _ = text.partition(". ")
    return head + "." if mark else text


def write_options(params: Sequence[Any], ctx: Any, formatter: Any, whole: bool = False) -> None:
    """Write arguments and options; with `whole`, also the text of those that are else only named."""
    arguments = [p for p in params if p.param_type_name == "argument" and not p.hidden]
    options = [p for p in params if p.param_type_name == "option" and not p.hidden]
    named = [] if whole else [p for p in options if _is_named_only(p)]
    shown = [p for p in options if p not in named]
    rows = [*map(_argument, arguments), *map(_option, shown)]
    if rows:
        formatter.write_paragraph()
        formatter.indent()
        formatter.write_dl(rows, col_max=22)
        formatter.dedent()
    if named:
        formatter.write_paragraph()
        names = ", ".join(p.opts[-1] for p in named)
        about = "" if len(named) == 1 or ctx.parent is None else f" (cosim explain {ctx.info_name})"
        formatter.write(fill(f"More: {names}{about}", formatter.width, break_on_hyphens=False) + "\n")


def _is_named_only(option: Any) -> bool:
    return option.rich_help_panel == MORE or option.opts[-1] in ("--help", *_COMPLETION)


def _argument(argument: Any) -> tuple[str, str]:
    return argument.display_name_raw.upper(), _text(argument)


def _option(option: Any) -> tuple[str, str]:
    words = [*option.opts, *option.secondary_opts]
    return f"{'/'.join(words)} {_value(option)}".rstrip(), _text(option)


def _value(option: Any) -> str:
    """What is written after an option: a metavariable by its type, nothing for a switch."""
    if option.metavar is not None:
        return option.metavar
    if option.is_flag:
        return ""
    described = option.type_descriptor
    if described.is_choice:
        return "|".join(str(choice) for choice in described.choices)
    kind = str(described.annotation).lower()
    return next((name for part, name in _VALUES.items() if part in kind), "TEXT")


_VALUES = {"path": "PATH", "int": "N", "float": "X", "str": "TEXT"}


def _text(param: Any) -> str:
    """The meaning of a parameter, its limits and its default."""
    parts = "; ".join(_remarks(param))
    text = param.help or ""
    return f"{text} [{parts}]".strip() if parts else text


def _remarks(param: Any) -> Iterator[str]:
    choices = param.type_descriptor.choices
    if choices and param.param_type_name == "argument":
        yield ", ".join(map(str, choices))
    if param.required and param.param_type_name == "option":
        yield "required"
    is_said = "default" in (param.help or "")
    if param.default not in (None, "", False, True, ()) and not callable(param.default) and not is_said:
        yield f"default: {param.default}"
