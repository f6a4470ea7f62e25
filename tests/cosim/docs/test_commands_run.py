"""Every command shown on a page is run, page by page, in an empty folder; files with a title are written first."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from cosim.studies.study import SHIPPED
from tests.cosim.docs import fences, short
from tests.cosim.docs.fences import PAGES, ROOT

SHORT = "--set traffic.duration_s=30 --set attacks.0.start_s=10 --set attacks.1.start_s=10"
FIRST_RUN = f"cosim run {SHORT} --set traffic.warmup_s=120 --set record.level=full"

MINUTE = "cosim run --set traffic.duration_s=60 --set attacks.0.start_s=20 --set attacks.1.start_s=20"

INSTEAD = {
    "make run": FIRST_RUN,
    "make test": "true",  # this is it
    "source .venv/bin/activate": "true",
    "python3 -m venv": "true",
    "python -m pip install .": "true",
    "cosim sweep question --out out": "python -m tests.cosim.docs.short question out",
    **{
        f"cosim sweep {name} && ": f"python -m tests.cosim.docs.short {name} runs/{name}"
        for name in ("question", "encounters", "freshness")
    },
    **{f"{MINUTE} --out runs/{name}": f"{FIRST_RUN} --out runs/{name}" for name in ("gallery", "paper")},
}
"""What stands for a command that sets up an environment, or takes minutes."""

SOLID = "from trimesh.creation import box; box(({})).export('{}.obj')"
BEFORE = {
    "cosim/docs/pages/howto/meshes.md": f"""
        python -c "{SOLID.format("12, 2, 5", "arch")}"
        python -c "{SOLID.format("4, 2, 1.5", "wedge")}"
    """,
    "results/README.md": FIRST_RUN,
}
"""What makes the files that a page's commands take from its reader."""

QUICK = ("cosim nets list", "cosim --version", "cosim measure --explain")

OFFLINE = dict.fromkeys(("http_proxy", "https_proxy", "all_proxy"), "http://127.0.0.1:9") | {"PIP_NO_INDEX": "1"}
"""Nothing can be fetched with these."""


def _is_run(block):
    return not block.excuse and block.language in ("sh", "python") and not block.title


PAGES_THAT_RUN = [
    name for name, path in fences.SOURCES.items() if any(map(_is_run, fences.blocks(path.read_text(encoding="utf-8"))))
]

SHOWN = [line for path in fences.SOURCES.values() for line in fences.commands(path.read_text(encoding="utf-8"))]


@pytest.fixture
def folder(tmp_path):
    """An empty folder with `cosim` and `python` on the path."""
    (tmp_path / "bin").mkdir()
    for name, module in (("cosim", "-m cosim "), ("python", "")):
        shim = tmp_path / "bin" / name
        shim.write_text(f'#!/bin/sh\nexec {sys.executable} {module}"$@"\n')
        shim.chmod(0o755)
    (tmp_path / "work").mkdir()
    return tmp_path


def run(folder: Path, script: str):
    env = os.environ | OFFLINE | {"PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-euc", script], cwd=folder / "work", env=env, capture_output=True, text=True, timeout=3600
    )
    assert done.returncode == 0, f"{script}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


@pytest.mark.verify
@pytest.mark.parametrize("page", PAGES_THAT_RUN)
def test_a_page(folder, page, record_pages):
    """All of a page in the order in which a reader meets it; `make pages` records its blocks `output` anew."""
    source = fences.SOURCES[page]
    text = source.read_text(encoding="utf-8")
    found = fences.blocks(text)
    if record_pages and not any(block.language == "output" for block in found):
        pytest.skip("it shows no output")
    said, records, script, printed = run(folder, BEFORE.get(page, "true")), {}, "", ""
    for number, block in enumerate(found):
        if block.title:
            (folder / "work" / block.title).write_text(block.text)
        elif _is_run(block) and block.language == "sh":
            said = run(folder, "\n".join(_instead(line) for line in block.text.replace("\\\n", " ").splitlines()))
        elif _is_run(block):
            script += block.text  # a block goes on from those before it
            (folder / "script.py").write_text(script)
            whole = run(folder, f"python {folder / 'script.py'}")
            said, printed = whole.removeprefix(printed), whole
        elif block.language == "output" and not fences.is_printed(block.text, said):
            records[number] = fences.recorded(block.text, said)
            assert record_pages, f"{page} shows\n{block.text}\nbut this is printed:\n{said}"
    if records:
        source.write_text(fences.with_texts(text, records), encoding="utf-8")


def _instead(line: str) -> str:
    first, joined, rest = line.partition(" && ")
    return next((new for old, new in INSTEAD.items() if (first + joined).startswith(old)), first) + joined + rest


@pytest.mark.verify
def test_the_notebook(folder):
    run(folder, f"cosim run {SHORT} --set traffic.warmup_s=120 --out runs/mine")
    said = run(folder, f"python {PAGES / 'howto/python.py'}")
    assert "mean speed" in said and (folder / "work/trust.svg").exists()


@pytest.fixture
def carried_out(folder, monkeypatch):
    """What a notebook of the tutorial prints whose cells are carried out in an empty folder, one text replaced."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))

    def run(name, *instead):
        book = nbformat.read(PAGES / f"tutorial/{name}.ipynb", 4)
        assert not any(cell.get("outputs") for cell in book.cells), "it is kept without outputs"
        nbformat.validate(book)
        for cell in book.cells if instead else ():
            cell.source = cell.source.replace(*instead)
        nbclient.NotebookClient(book, timeout=3600, resources={"metadata": {"path": str(folder / "work")}}).execute()
        return "".join(out.get("text", "") for cell in book.cells for out in cell.get("outputs", []))

    return run


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_the_notebook_of_the_tutorial(folder, carried_out):
    """From nothing to a figure, a step with its clouds, a model of one's own: every cell runs in an empty folder."""
    printed = carried_out("start")
    assert "fused objects" in printed and "mean trust" in printed and (folder / "work/trust.svg").exists()


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_the_notebook_of_the_question(folder, carried_out):
    """The notebook as it ships, with a shorter study of the same keys: a sentence of each quantity, and two figures."""
    (folder / "work" / "short.toml").write_text(short.shortened("question"))
    printed = carried_out("question", 'STUDY = "question"', 'STUDY = "short.toml"')
    assert printed.count("\n- ") + printed.startswith("- ") == 6 and "encounters per vehicle and hour" in printed
    assert (folder / "work/durations.svg").exists() and (folder / "work/ages.svg").exists()


def test_the_question_on_its_page_is_the_one_that_ships():
    shown = fences.blocks((PAGES / "tutorial/question.md").read_text(encoding="utf-8"))
    (text,) = (block.text for block in shown if block.title == "question.toml")
    assert text == (SHIPPED / "question.toml").read_text(encoding="utf-8")


def test_the_gallery_has_a_line_for_each_of_its_nine_pictures():
    text = (PAGES / "tutorial/gallery.md").read_text(encoding="utf-8")
    pictures = re.findall(r"!\[[^\]]+\]\([./]+results/pictures/([^)]+)\)", text)
    assert len(pictures) == len(set(pictures)) == 9
    assert all((ROOT / "results" / "pictures" / name).is_file() for name in pictures)
    assert sum(line.startswith("cosim plot") or "&& cosim plot" in line for line in fences.commands(text)) == 9


@pytest.mark.parametrize("command", QUICK)
def test_a_quick_command(folder, command):
    assert command in SHOWN
    assert run(folder, command)


def test_what_stands_for_a_command_stands_for_one_that_is_shown():
    assert all(any(line.startswith(old) for line in SHOWN) for old in INSTEAD) and BEFORE.keys() <= set(PAGES_THAT_RUN)
