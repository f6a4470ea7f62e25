"""Renders the page of the command line as Markdown from the program itself."""

import typer
from typer.cli import get_docs_for_click

from cosim.cli.main import app

_HEAD = """# The command line

If you make a mistake, the command prints one line on standard error and exits with status 2. The status is 1
for damaged files and failed runs, and 130 or 143 for a run that a signal stopped. With `--json`, a command
prints only JSON on standard output. `cosim --install-completion` installs completion for your shell.
"""


def markdown() -> str:
    """The page."""
    command = typer.main.get_command(app)
    docs = get_docs_for_click(obj=command, ctx=typer.Context(command, info_name="cosim"), name="cosim")
    return _HEAD + docs.removeprefix("# `cosim`\n")
