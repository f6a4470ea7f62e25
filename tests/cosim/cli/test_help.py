"""The help: commands in groups, and what people use of each on one screen."""

import subprocess
import sys

import pytest
import typer
from typer.testing import CliRunner

from cosim.cli.help import Commands, in_groups
from cosim.cli.main import GROUPS, app
from tests.drive import cosim

COMMAND = typer.main.get_command(app)


def every_command(words, command):
    yield words
    for name, inner in getattr(command, "commands", {}).items():
        yield from every_command([*words, name], inner)


def a_program(names, groups):
    made = Commands(cls=in_groups(groups))
    for name in names:
        made.command(name)(lambda: None)
    return typer.main.get_command(made)


@pytest.mark.parametrize("names", [["d", "c", "b", "a"], ["a", "b", "c", "d"]])
def test_groups_do_not_depend_on_the_order_of_registration(names):
    command = a_program(names, {"First": ("b", "hidden", "a"), "Empty": ("gone",), "Second": ("c",)})
    assert command.by_group() == {"First": ["b", "a"], "Second": ["c"], "More": ["d"]}
    assert command.list_commands(None) == ["b", "a", "c", "d"]


def test_help_begins_with_the_first_hour_and_has_a_line_for_each_command():
    lines = cosim("--help", COLUMNS="80").stdout.splitlines()
    assert max(map(len, lines)) <= 80
    groups = [line for line in lines if line in GROUPS]
    assert groups == list(GROUPS)
    first_words = [line.split()[0] for line in lines if line.startswith("  ")]
    listed = [word for word in first_words if word in COMMAND.commands]
    assert sorted(listed) == sorted(COMMAND.commands) and listed[:2] == ["run", "measure"]
    assert len(lines) <= len(listed) + len(groups) + 9
    assert "More" not in lines, "GROUPS of cosim/cli/main.py names every command that ships"


@pytest.mark.parametrize("words", [words for words in every_command([], COMMAND) if words], ids=" ".join)
def test_help_of_a_command_fits_on_a_screen(words):
    command = COMMAND
    context = typer.Context(command, info_name="cosim", terminal_width=78)
    for word in words:
        command = command.commands[word]
        context = typer.Context(command, info_name=word, parent=context, terminal_width=78)
    lines = command.get_help(context).splitlines()
    assert len(lines) <= 24 and max(map(len, lines)) <= 80
    names = [name for option in command.params for name in option.opts if name.startswith("--")]
    assert [name for name in names if name not in "\n".join(lines)] == []


def test_help_loads_no_arrays():
    code = "import sys, cosim.cli.main; print(*sorted({'numpy', 'pandas', 'numba', 'libsumo'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("words", [[], ["nets"], ["predict"]], ids=" ".join)
def test_a_group_without_a_command_prints_its_help(words):
    bare, asked = (CliRunner().invoke(app, typed) for typed in (words, [*words, "--help"]))
    assert bare.exit_code == 0 and bare.stdout == asked.stdout != ""
