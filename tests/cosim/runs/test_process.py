"""Processes of the program take no code and no settings from the current folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cosim.runs import process

ROOT = Path(process.__file__).parents[2]
TRAP = "from pathlib import Path\nPath({!r}).write_text('code ran')\n"


@pytest.fixture
def hostile(tmp_path):
    """A folder with packages of the program's names, and of names that its libraries import."""
    for name in ("cosim", "numpy", "pydantic"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(TRAP.format(str(tmp_path / "sentinel")))
    return tmp_path


@pytest.mark.parametrize("module", ["cosim.studies.worker"])
def test_a_process_does_not_look_into_the_current_folder(hostile, module):
    """It gets no words, so it fails when it has imported the program."""
    ended = subprocess.run(
        process.command(module), cwd=hostile, env=process.environment(), capture_output=True, text=True
    )
    assert not (hostile / "sentinel").exists()
    assert ended.returncode and "No module" not in ended.stderr, ended.stderr


def test_the_trap_works(hostile):
    subprocess.run([sys.executable, "-c", "import cosim"], cwd=hostile, env=process.environment(), check=False)
    assert (hostile / "sentinel").exists()


def test_a_checkout_that_is_used_through_pythonpath_is_found(monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", str(tmp_path), ""]))
    assert process.environment()["PYTHONPATH"] == f"{ROOT}{os.pathsep}{tmp_path}", "an empty entry is this folder"
    assert process.environment(A="1")["A"] == "1"


def test_settings_of_libraries_in_the_current_folder_are_ignored(tmp_path):
    """Numba's settings can name a folder of pickles, Matplotlib's a program that writes movies."""
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: pickles\n")
    (tmp_path / "matplotlibrc").write_text("animation.ffmpeg_path: ./code\n")
    code = "import numba, matplotlib; print(numba.config.CACHE_DIR, matplotlib.rcParams['animation.ffmpeg_path'])"
    read = "from cosim.runs.process import ignore_settings_here as i; i(); "
    environment = process.environment()
    environment.pop("NUMBA_CACHE_DIR", None)  # it would come before that of the file
    for before, said in (("", "pickles ./code"), (read, " ffmpeg")):
        ended = subprocess.run(
            [sys.executable, "-c", before + code], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert ended.stdout.rstrip("\n") == said, ended.stderr
