"""Every command shown on a page is run, page by page, in an empty folder; files with a title are written first."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cosim.docs import fences
from tests.cosim.docs.fences import PAGES, ROOT

RUNNABLE = {
    path.relative_to(ROOT).as_posix(): path
    for path in [ROOT / "README.md", *sorted(PAGES.rglob("*.md"))]
    if fences.commands(path.read_text(encoding="utf-8"))
}

SHORT = "--set traffic.duration_s=30 --set attacks.0.start_s=10 --set attacks.1.start_s=10"

INSTEAD = {
    "make run": f"cosim run {SHORT} --set traffic.warmup_s=120 --set record.level=full",
    "make test": "true",  # this is it
    "source .venv/bin/activate": "true",
    "python3 -m venv": "true",
    "cosim validate --full": "cosim validate --list",
}
"""What stands for a command that sets up an environment, or takes minutes."""

QUICK = ("cosim nets list", "cosim --version", "cosim measure --explain", "cosim sweep freshness --out fresh --dry-run")


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
    env = os.environ | {"PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-euc", script], cwd=folder / "work", env=env, capture_output=True, text=True, timeout=1200
    )
    assert done.returncode == 0, f"{script}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout


@pytest.mark.verify
@pytest.mark.parametrize("page", RUNNABLE)
def test_a_page(folder, page):
    """All of a page in the order in which a reader meets it."""
    if page.endswith("meshes.md"):
        trimesh = pytest.importorskip("trimesh")
        trimesh.creation.box((12, 2, 5)).export(folder / "work" / "arch.obj")
        trimesh.creation.box((4, 2, 1.5)).export(folder / "work" / "wedge.obj")
    if page.endswith("look.md"):
        pytest.importorskip("rerun")
    for block in fences.blocks(RUNNABLE[page].read_text(encoding="utf-8")):
        if block.title:
            (folder / "work" / block.title).write_text(block.text)
        elif block.language == "sh":
            said = run(folder, "\n".join(_instead(line) for line in block.text.replace("\\\n", " ").splitlines()))
        elif block.language == "python" and "open_run" in block.text:
            (folder / "script.py").write_text(block.text)
            said = run(folder, f"python {folder / 'script.py'}")
        elif block.language == "output":
            assert fences.is_printed(block.text, said), f"{page} shows\n{block.text}\nbut this is printed:\n{said}"


def _instead(line: str) -> str:
    return next((new for old, new in INSTEAD.items() if line.startswith(old)), line)


@pytest.mark.verify
def test_the_notebook(folder):
    run(folder, f"cosim run {SHORT} --set traffic.warmup_s=120 --out runs/mine")
    said = run(folder, f"python {PAGES / 'howto/python.py'}")
    assert "mean speed" in said and (folder / "work/trust.svg").exists()


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_the_notebook_of_the_tutorial(folder, monkeypatch):
    """From nothing to a figure, a step with its clouds, a model of one's own: every cell runs in an empty folder."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    book = nbformat.read(PAGES / "tutorial/start.ipynb", 4)
    assert not any(cell.get("outputs") for cell in book.cells), "it is kept without outputs"
    nbformat.validate(book)
    nbclient.NotebookClient(book, timeout=1200, resources={"metadata": {"path": str(folder / "work")}}).execute()
    printed = "".join(out.get("text", "") for cell in book.cells for out in cell.get("outputs", []))
    assert "fused objects" in printed and "mean trust" in printed and (folder / "work/trust.svg").exists()


@pytest.mark.parametrize("command", QUICK)
def test_a_quick_command(folder, command):
    shown = [line for path in RUNNABLE.values() for line in fences.commands(path.read_text(encoding="utf-8"))]
    assert command in shown
    assert run(folder, command)
