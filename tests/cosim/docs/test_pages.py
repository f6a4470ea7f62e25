"""The documentation: links lead somewhere, every key and command is there, every command shown is accepted."""

import importlib.util
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer

from cosim.cli.main import app
from cosim.config.config import Config, load
from cosim.docs import config_keys, site
from cosim.studies import study
from cosim.studies.points import points_of
from results.metrics.registry import METRICS
from results.tables import TABLES
from tests.cosim.docs import fences
from tests.cosim.docs.fences import ROOT

SOURCES = {
    **{path.relative_to(ROOT).as_posix(): path for path in sorted(fences.PAGES.rglob("*.md"))},
    **{name: ROOT / name for name in ("README.md", *site.TAKEN)},
}
PAGES = site.pages()


def test_every_page_is_in_the_navigation():
    nav = (ROOT / "cosim/docs/mkdocs.yml").read_text().split("\nnav:")[1]
    assert sorted(re.findall(r": ([\w/-]+\.md)$", nav, flags=re.MULTILINE)) == sorted(PAGES)


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_pages(page):
    for label, target in re.findall(
        r"(?<!!)\[([^\]]*)\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", PAGES[page], flags=re.S)
    ):
        if "://" in target or target.startswith("#"):
            continue
        path = (Path("/") / page).parent.joinpath(target.partition("#")[0])
        where = Path(*[p for p in Path(*path.parts[1:]).parts])
        parts: list[str] = []
        for part in where.parts:
            parts = parts[:-1] if part == ".." else [*parts, part]
        assert "/".join(parts) in PAGES, f"{page}: [{label}]({target})"


def test_every_key_has_a_row_with_a_meaning():
    text = PAGES["reference/config.md"]
    for key in config_keys.keys():  # noqa: SIM118
        (row,) = [line for line in text.splitlines() if line.startswith(f"| `{key}` |")]
        assert len(row.split(" | ")[3]) > 5, f"{key} has no meaning"
    assert {"seed", "radio.range_m", "trust.freshness_s", "attacks.share_p", "server.cellular.n_retries"} <= {
        *config_keys.keys()
    }
    stated = Config().to_dict()
    for section, values in stated.items():
        names = [section] if not isinstance(values, dict) else [f"{section}.{name}" for name in values]
        for name in names if not isinstance(values, list | tuple) else ():
            assert f"`{name}" in text, name
    assert "| `radio.range_m` | number; > 0, ≤ 100000 | `300` |" in text
    assert '## [[attacks]] attack = "sybil"' in text and "| `attacks.n_ghosts` |" in text


def every_command(words, command):
    """Full names and commands; groups of commands are left out."""
    if not hasattr(command, "commands"):
        yield words, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from every_command(f"{words} {name}", inner)


def test_every_command_and_option_is_there():
    text = PAGES["reference/cli.md"]
    found = dict(every_command("cosim", typer.main.get_command(app)))
    assert {"cosim run", "cosim nets build", "cosim export", "cosim sweep"} <= found.keys()
    for words, command in found.items():
        section = text.split(f"# `{words}`\n")[1].split("\n##")[0]
        for option in command.params:
            assert all(f"`{name}" in section for name in option.opts if name.startswith("--"))
            assert (option.help or "").replace("\n", " ") in section


def test_every_table_and_metric_is_there():
    text = PAGES["reference/tables.md"]
    assert all(f"\n## {name}\n" in text for name in TABLES) and all(f"`{name}`" in text for name in METRICS)


@pytest.mark.parametrize("source", SOURCES)
def test_commands_are_accepted(source):
    """Every command of every page is one of the program's, with options that it has and values that they take."""
    for line in fences.commands(SOURCES[source].read_text(encoding="utf-8")):
        words = shlex.split(line.split(" || ")[0].split(" && ")[0])
        if "cosim" in words:
            words = words[words.index("cosim") :]
        if words[0] == "make":
            done = subprocess.run(["make", "-n", *words[1:]], cwd=ROOT, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
        elif words[0] == "cosim":
            _accepted(words[1:])
        else:
            assert words[0] in ("source", "pip", "dask", "rerun", "python", "python3", "netedit"), line


def _accepted(words):
    command, name = typer.main.get_command(app), "cosim"
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        name, words = f"{name} {words[0]}", words[1:]
        command = command.commands[name.rpartition(" ")[2]]
    try:
        command.make_context(name, list(words))
    except typer.Exit:  # --version, --help
        assert words[0] in ("--version", "--help")


def test_output_is_compared_with_what_is_printed():
    said = "role\nhonest   45\n15.0 s: median\ntime 17.2 s of computing\n"
    assert fences.is_printed("role\nhonest 45\n15.0 s: median\ntime ... s of computing\n", said)
    assert fences.is_printed("role\n...\ntime 17.2 ...\n", said)
    assert not fences.is_printed("role\nhonest 46\n...\n", said)
    assert not fences.is_printed("role\nhonest 45\n", said), "lines are missing"
    assert not fences.is_printed("role.\n...\n", said), "a dot is a dot"


@pytest.mark.parametrize("source", SOURCES)
def test_shown_output_follows_a_command(source):
    before = ""
    for block in fences.blocks(SOURCES[source].read_text(encoding="utf-8")):
        assert block.language != "output" or before in ("sh", "python"), source
        before = block.language


@pytest.mark.parametrize("source", SOURCES)
def test_configs_are_toml(source):
    for block in fences.blocks(SOURCES[source].read_text(encoding="utf-8")):
        if block.language == "toml":
            assert tomllib.loads(block.text), block.text
        if block.language == "python" and block.title:
            assert compile(block.text, block.title, "exec").co_names, block.title


@pytest.mark.parametrize("source", SOURCES)
def test_files_to_write_are_accepted(source, tmp_path):
    """Every config and study that a reader is told to write is one that the program takes."""
    files = [block for block in fences.blocks(SOURCES[source].read_text(encoding="utf-8")) if block.title]
    for block in files:
        (tmp_path / block.title).write_text(block.text)
    for block in files:
        if block.title.endswith(".toml") and "[study]" in block.text:
            found = study.load(tmp_path / block.title)
            assert points_of(found, block.title)
        elif block.title.endswith(".toml"):
            assert load(tmp_path / block.title)


def test_the_site_is_built_without_a_warning(tmp_path):
    if any(importlib.util.find_spec(name) is None for name in ("mkdocs", "material", "latex2mathml")):
        pytest.skip("MkDocs is not installed: make docs")
    done = subprocess.run(
        [sys.executable, "-m", "cosim.docs.site", str(tmp_path / "site")], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "<math" in (tmp_path / "site/models/index.html").read_text()
    for page in (tmp_path / "site").rglob("*.html"):
        loaded = re.findall(r'(?:src="|<link rel="stylesheet" href=")(https?://[^"]*)', page.read_text())
        assert not loaded, f"{page} loads {loaded}"
