"""The documentation: links lead somewhere, every key and command is there, every command shown is accepted."""

import ast
import importlib
import importlib.util
import json
import posixpath
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from rich.text import Text

from cosim.addons.explain import key_docs
from cosim.addons.tryout import templates
from cosim.cli.main import RENAMED, app
from cosim.config.config import Config, load
from cosim.docs import site
from cosim.studies import study
from cosim.studies.points import points_of
from results.metrics.registry import METRICS
from results.tables import TABLES
from tests.cosim.docs import fences
from tests.cosim.docs.fences import ROOT

SOURCES = fences.SOURCES
COMMAND = typer.main.get_command(app)
OTHERS = ("source", "pip", "dask", "rerun", "python", "python3", "netedit", "timeout", "docker", "apptainer")
"""Programs of others that pages call."""


@pytest.fixture(scope="module")
def pages():
    """Texts of all pages by name."""
    return site.pages()


def test_every_page_is_in_the_navigation(pages):
    nav = (ROOT / "cosim/docs/mkdocs.yml").read_text().split("\nnav:")[1]
    assert sorted(re.findall(r": ([\w/-]+\.md)$", nav, flags=re.MULTILINE)) == sorted(pages)


MAX_WORDS = 25_000
"""Words of the handbook outside of its blocks. It only falls: who adds a page cuts another one."""


def test_the_handbook_keeps_its_words(pages):
    """All pages but those that are generated and the READMEs of the packages."""
    own = {path.relative_to(fences.PAGES).with_suffix(".md").as_posix() for path in fences.PAGES.rglob("*.[mp][dy]")}
    n_words = {page: len(re.sub(r"^```.*?^```$", "", pages[page], flags=re.S | re.M).split()) for page in own}
    assert sum(n_words.values()) <= MAX_WORDS, sorted(n_words.items(), key=lambda item: -item[1])


def test_python_on_pages_reads_one_trust_variant():
    """The default run has two. Tables with a column `variant` hold the rows of both."""
    of_variants = "|".join(name for name, table in TABLES.items() if "variant" in table.columns)
    of_all = re.compile(rf"\brun\.({of_variants})(\[|\.(?!subject))|FROM ({of_variants})\b(?!.*variant)")
    for path in {*SOURCES.values(), *fences.PAGES.rglob("*.py")}:
        assert not of_all.search(path.read_text(encoding="utf-8")), path


@pytest.mark.parametrize("source", SOURCES)
def test_links_lead_to_files(source):
    """Links and pictures can be followed in a checkout too."""
    path = SOURCES[source]
    text = re.sub(r"^```.*?^```$", "", path.read_text(encoding="utf-8"), flags=re.S | re.M)
    for target in re.findall(r"\]\(([^)\s#]+)", text):
        assert "://" in target or (path.parent / target).exists(), target


def test_links_lead_to_pages(pages):
    for page, text in pages.items():
        prose = re.sub(r"```.*?```", "", text, flags=re.S)
        for target in re.findall(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)", prose):
            where = posixpath.normpath(posixpath.join(posixpath.dirname(page), target.partition("#")[0]))
            assert "://" in target or target.startswith("#") or where in pages, f"{page}: {target}"


def test_every_key_has_a_row_with_a_meaning(pages):
    text = pages["reference/config.md"]
    for key in key_docs.keys():  # noqa: SIM118
        (row,) = [line for line in text.splitlines() if line.startswith(f"| `{key}` |")]
        assert len(row.split(" | ")[3]) > 5, f"{key} has no meaning"
    assert {"seed", "radio.range_m", "trust.freshness_s", "attacks.share_p", "server.cellular.n_retries"} <= {
        *key_docs.keys()
    }
    stated = Config().to_dict()
    for section, values in stated.items():
        names = [section] if not isinstance(values, dict) else [f"{section}.{name}" for name in values]
        for name in names if not isinstance(values, list | tuple) else ():
            assert f"`{name}" in text, name
    assert "| `radio.range_m` | number; > 0, ≤ 32000 | `300` |" in text
    assert '## [[attacks]] attack = "sybil"' in text and "| `attacks.n_ghosts` |" in text


def every_command(words, command):
    """Full names and commands; groups of commands are left out."""
    if not hasattr(command, "commands"):
        yield words, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from every_command(f"{words} {name}", inner)


def test_every_command_and_option_is_there(pages):
    text = pages["reference/cli.md"]
    found = dict(every_command("cosim", COMMAND))
    assert {"cosim run", "cosim nets build", "cosim export", "cosim sweep"} <= found.keys()
    for words, command in found.items():
        section = text.split(f"# `{words}`\n")[1].split("\n##")[0]
        for option in command.params:
            assert all(f"`{name}" in section for name in option.opts if name.startswith("--"))
            assert (option.help or "").replace("\n", " ") in section


def test_help_swallows_nothing():
    """Rich takes words in brackets for styles and leaves them out."""
    for words, command in every_command("cosim", COMMAND):
        for text in (command.help or "", *(getattr(option, "help", "") or "" for option in command.params)):
            assert Text.from_markup(text).plain == text, words


def test_every_table_and_metric_is_there(pages):
    text = pages["reference/tables.md"]
    assert all(f"\n## {name}\n" in text for name in TABLES) and all(f"`{name}`" in text for name in METRICS)


@pytest.mark.parametrize("source", SOURCES)
def test_commands_are_accepted(source):
    """Every command of every page is one of the program's, with options that it has and values that they take."""
    text = SOURCES[source].read_text(encoding="utf-8")
    for line in fences.commands(text):
        words = shlex.split(line.split(" || ")[0].split(" && ")[0])
        if "cosim" in words:
            words = words[words.index("cosim") :]
        if words[0] == "make":
            done = subprocess.run(["make", "-n", *words[1:]], cwd=ROOT, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
        elif words[0] == "cosim":
            command, name, words = _found(words[1:])
            try:
                command.make_context(name, list(words))
            except typer.Exit:  # --version, --help
                assert words[0] in ("--version", "--help")
        else:
            assert words[0] in OTHERS, line
    for inline in re.findall(r"`cosim ([^`\n]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)):
        if source == "CHANGELOG.md" and inline.split()[0] in RENAMED:
            continue  # an entry of a version that had it
        command, name, words = _found(shlex.split(inline))
        options = {option for one in command.params for option in one.opts} | {"--help"}
        assert {word for word in words if word.startswith("--")} <= options, f"{source}: cosim {inline}"
        is_place = not words or not hasattr(command, "commands") or words[0].startswith("--")
        assert is_place, f"{source}: cosim {inline}"


def _found(words):
    """The command that these words name, its name and the words that remain."""
    command, name = COMMAND, "cosim"
    while hasattr(command, "commands") and words and words[0] in command.commands:
        name, command, words = f"{name} {words[0]}", command.commands[words[0]], words[1:]
    return command, name, list(words)


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


N_EXCUSED = 8
"""Blocks of all pages that say why they are not run."""


def test_no_block_escapes():
    """A block is run, written to a file, read as a config, compared, for the eye alone, or says why not."""
    found = {name: fences.blocks(path.read_text(encoding="utf-8")) for name, path in SOURCES.items()}
    for name, path in SOURCES.items():
        n_fences = len(re.findall(r"^\s*(?:```|~~~)", path.read_text(encoding="utf-8"), re.MULTILINE))
        assert n_fences == 2 * len(found[name]), f"{name}: a block has no language, or is indented"
        for block in found[name]:
            known = block.title or block.language in ("sh", "python", "toml", "output", *fences.SHOWN)
            assert known, f"{name}: nothing is done with a block {block.language}"
            if block.language in fences.SHOWN:
                assert not block.excuse and not re.search(r"^(cosim|make|python) ", block.text, re.MULTILINE), name
    excused = [(name, block.excuse) for name in found for block in found[name] if block.excuse]
    assert len(excused) == N_EXCUSED, f"another number of blocks is not run: {excused}"


def test_a_reason_is_read_and_a_block_is_recorded():
    page = "a\n<!-- not run: it needs a scheduler -->\n```sh\nrun\n```\nb\n\n```output\nold 1 in ... s\n```\n"
    first, second = fences.blocks(page)
    assert (first.excuse, first.language) == ("it needs a scheduler", "sh")
    assert (second.excuse, second.text) == ("", "old 1 in ... s\n")
    new = fences.recorded(second.text, "old 2 in 7 s\n")
    assert new == "old 2 in 7 s\n" and fences.with_texts(page, {1: new}) == page.replace("1 in ...", "2 in 7")
    assert fences.recorded("n 1\n... s\n", "n 2\n9 s\n") == "n 2\n... s\n"
    assert fences.recorded("n 1\n...\nend\n", "n 2\na\nb\nend\n") == "n 2\n...\nend\n"
    shown = "...\nbuildings  746\n...\nspeed  39 km/h\nteleports  0\n...\nit flows\n"
    printed = "streets  9\nbuildings  747\nheights  3\nspeed  40 km/h\nstops  8\nteleports  1\nfile  town\nit flows\n"
    new = "...\nbuildings  747\n...\nspeed  40 km/h\nstops  8\nteleports  1\n...\nit flows\n"
    assert fences.recorded(shown, printed) == new and fences.is_printed(new, printed)


@pytest.mark.parametrize("source", SOURCES)
def test_files_and_configs_are_accepted(source, tmp_path, monkeypatch):
    """Every config and study, and every file that a reader is told to write, is one that the program takes."""
    monkeypatch.chdir(tmp_path)
    found = fences.blocks(SOURCES[source].read_text(encoding="utf-8"))
    for block in found:
        if block.title:
            Path(block.title).write_text(block.text)
        if block.language == "python":
            assert compile(block.text, block.title or source, "exec").co_names, block.text
    for line in fences.commands(SOURCES[source].read_text(encoding="utf-8")):
        if line.startswith("cosim new "):
            kind, path = line.split()[2:]
            Path(path).write_text((Path(templates.__file__).parent / f"{kind}.py").read_text(encoding="utf-8"))
    for number, block in enumerate(found):
        if block.language == "toml" and not block.excuse:
            path = Path(block.title or f"{number}.toml")
            path.write_text(block.text)
            assert points_of(study.load(path), path.name) if "[study]" in block.text else load(path)


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


def _python_texts():
    """Python of the pages, of those blocks that are run, and of the notebooks."""
    for name, path in SOURCES.items():
        for block in fences.blocks(path.read_text(encoding="utf-8")):
            if block.language == "python" and not block.excuse:
                yield name, block.text
    for path in fences.PAGES.rglob("*.ipynb"):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                yield path.name, "".join(cell["source"])


def test_what_the_pages_import_is_there():
    """A notebook imported a module that had moved; running it takes minutes, so that nobody saw it."""
    ours = {"cosim", "results", "sensors", "sumo_nets", "trust"}
    gone = [
        f"{name}: {node.module}.{alias.name}"
        for name, text in _python_texts()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] in ours
        for alias in node.names
        if not _is_there(node.module, alias.name)
    ]
    assert not gone


def _is_there(module: str, name: str) -> bool:
    try:
        return hasattr(importlib.import_module(module), name) or bool(importlib.util.find_spec(f"{module}.{name}"))
    except ModuleNotFoundError:
        return False


def test_tables_of_files_name_files_that_are_there():
    """The first column of a table in the README of a room, where it holds names of Python files."""
    gone = [
        f"{readme.relative_to(ROOT)}: {name}"
        for readme in (*ROOT.glob("*/README.md"), *(ROOT / "cosim").rglob("README.md"))
        if "build" not in readme.relative_to(ROOT).parts
        for cell in re.findall(r"^\| (`\w+\.py`(?:, `\w+\.py`)*) \|", readme.read_text(), re.MULTILINE)
        for name in re.findall(r"`(\w+\.py)`", cell)
        if not (readme.parent / name).is_file()
    ]
    assert not gone
