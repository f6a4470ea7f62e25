"""Renders the page of the command line as Markdown from the program itself."""

from typing import Any

import typer

from cosim.cli.main import app

_NAMES = {
    "str": "text", "Path": "path", "int": "whole number", "float": "number", "int range": "whole number",
    "float range": "number",
}  # fmt: skip


def markdown() -> str:
    """The page."""
    lines = [
        "# The command line",
        "",
        "If you make a mistake, the command prints one line on standard error and exits with status 2. The status is 1",
        "for damaged files and failed runs, and 130 or 143 for a run that a signal stopped. With `--json`, a command",
        "prints only JSON on standard output. `cosim --install-completion` installs completion for your shell.",
        "",
    ]
    for words, command in commands():
        lines += _command(words, command)
    return "\n".join(lines) + "\n"


def commands() -> list[tuple[str, Any]]:
    """Every command with its full name; groups of commands are left out."""
    found: list[tuple[str, Any]] = []

    def walk(words: str, command: Any) -> None:
        if hasattr(command, "commands"):
            for name in sorted(command.commands):
                walk(f"{words} {name}", command.commands[name])
        else:
            found.append((words, command))

    walk("cosim", typer.main.get_command(app))
    return found


def _command(words: str, command: Any) -> list[str]:
    context = command.make_context(words, [], resilient_parsing=True)
    rows = [
        f"| {_spelled(one)} | {_kind(one, context)} | {_default(one)} | {(one.help or '').replace('|', '/')} |"
        for one in command.params if one.name != "help" and not one.hidden
    ]  # fmt: skip
    usage = command.get_usage(context).removeprefix("Usage: ")
    head = ["| argument or option | takes | default | meaning |", "|---|---|---|---|"]
    return [f"## {words}", "", command.help or "", "", "```text", usage, "```", "", *head, *rows, ""]


def _spelled(one: Any) -> str:
    if one.param_type_name == "argument":
        return f"`{(one.metavar or one.name).upper()}`"
    return ", ".join(f"`{name}`" for name in (*one.opts, *one.secondary_opts))


def _kind(one: Any, context: Any) -> str:
    if getattr(one, "is_flag", False):
        return "nothing"
    kind = one.display_type(context).strip("<>")
    many = kind.startswith("list[")
    choices = kind.removeprefix("list[").removesuffix("]").split("|")
    kind = choices[0] if len(choices) == 1 else ", ".join(f"`{choice}`" for choice in choices)
    kind = _NAMES.get(kind, kind)
    low, high = getattr(one, "min", None), getattr(one, "max", None)
    if low is not None or high is not None:
        kind += f", {low:g} to {high:g}" if low is not None and high is not None else f", ≥ {low:g}"
    return f"{kind}, several" if many else kind


def _default(one: Any) -> str:
    if one.required:
        return "required"
    return "" if one.default in (None, (), [], False, "") or callable(one.default) else f"`{one.default}`"
