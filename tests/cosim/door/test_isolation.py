"""What a user's own class must leave as it is: sweeps, the current folder, standard output, and names of others."""

import json
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from cosim.door import isolation
from cosim.door.blame import ExtensionError, Refused
from cosim.door.kinds import KINDS
from cosim.door.load import load_own
from tests.cosim.door import tiny
from tests.cosim.door.test_mistakes import GOOD, source
from tests.drive import cosim
from tests.processes import set_words
from tests.slow import slow


@dataclass(frozen=True, slots=True)
class Poses:
    origin_m: np.ndarray


@dataclass(frozen=True, slots=True)
class Images:
    observers: np.ndarray
    range_steps: np.ndarray
    poses: Poses


@pytest.mark.parametrize(
    "line", ["sweeps.range_steps[...] = 7", "sweeps.poses.origin_m[0] += 3", "sweeps.range_steps.sort()"]
)
def test_a_detector_cannot_change_sweeps(tmp_path, monkeypatch, line):
    path = tmp_path / "mine.py"
    path.write_text(source(GOOD["detector"].replace("draws):\n", f"draws):\n    {line}\n")))
    images = Images(np.arange(2), np.arange(8, dtype=np.uint16)[::-1].copy(), Poses(np.zeros((2, 3))))
    given = tiny.detector()["detect"][1:]
    monkeypatch.setitem(tiny.SCENES, "detector", lambda: {"detect": (images, *given)})
    with pytest.raises(ExtensionError, match=r"mine.py:7: detector Mine: detect\(\) raised ValueError: .*read-only"):
        tiny.play(path, "detector")
    assert images.range_steps.flags.writeable and images.range_steps[0] == 7 and not images.poses.origin_m.any()


def test_a_class_leaves_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "mine.py"
    path.write_text(source(GOOD["trust"].replace("now_step=None):\n", "now_step=None):\n    os.chdir('/')\n")))
    path.write_text("import os" + path.read_text())
    with pytest.raises(ExtensionError, match=r"mine.py:\d+: trust model Mine: scores\(\) changed the current folder"):
        tiny.play(path, "trust")
    path.write_text("import os\nos.chdir('/')\n" + source(GOOD["trust"]))
    with pytest.raises(Refused, match=r"mine.py:.*changed the current folder"):
        load_own(f"{path}:Mine", KINDS["trust"])
    assert str(tmp_path) == isolation._folder()


MODEL = """
import sys
from dataclasses import replace

from trust.models import MODELS


class Mine(MODELS["beta"]):
    def scores(self, now_step=None):
        found = super().scores(now_step)
        {line}
        return found
"""


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("found = replace(found, subject=found.subject + 10**6)", "returned a score of subject 1000"),
        slow("found = replace(found, holder=0 * found.holder + 7)", "returned a score for holder 7, but SERVER"),
        ("sys.stdout.close()", "standard output is cosim's and stays open"),
    ],
)
def test_mistakes_that_were_silent(tmp_path, line, said):
    (tmp_path / "mine.py").write_text(MODEL.format(line=line))
    ended = cosim("run", *SETS, "--set", "trust.model=mine.py:Mine", "--out", "run", cwd=tmp_path)
    assert ended.returncode == 1 and ended.stderr.count("\n") == 1, ended.stderr
    assert f"mine.py:8: trust model Mine: scores() {said}" in ended.stderr or said in ended.stderr, ended.stderr
    assert "mine.py:" in ended.stderr


SETS = set_words(("traffic.duration_s=8", "traffic.warmup_s=60"))


def test_what_a_class_prints_is_not_in_the_json(tmp_path):
    (tmp_path / "mine.py").write_text(MODEL.format(line="print('hello')"))
    ended = cosim("run", *SETS, "--json", "--set", "trust.model=mine.py:Mine", "--out", "run", cwd=tmp_path)
    assert json.loads(ended.stdout)["run"] == "run" and "hello" in ended.stderr


def test_several_threads_share_standard_error(monkeypatch, capsys):
    """The last one that ends gives standard output back; that of a notebook or of a test is never taken."""
    output = isolation._Output()
    output.divert(1)
    assert type(isolation.sys.stdout) is not isolation._ToStandardError
    output.divert(-1)
    real = SimpleNamespace(write=lambda text: None)
    monkeypatch.setattr(isolation.sys, "stdout", real)
    monkeypatch.setattr(isolation.sys, "__stdout__", real)
    for by in (1, 1, -1):
        output.divert(by)
        assert type(isolation.sys.stdout) is isolation._ToStandardError
    output.divert(-1)
    assert isolation.sys.stdout is real
