"""Embree is an extra: it has no wheels for Linux on ARM, and only one engine needs it."""

import sys
import tomllib
from pathlib import Path

import pytest

from sensors.raycast import embree

ROOT = Path(__file__).parents[2]


def test_without_embree_one_line_says_which_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(ValueError, match=r'lidar.engine = "embree" needs embreex.*cosim-perception\[embree\]'):
        embree.tracer_of(None)


def test_a_plain_installation_does_not_ask_for_it():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert not any("embreex" in line for line in project["dependencies"])
    assert any("embreex" in line for line in project["optional-dependencies"]["embree"])
    lines = (ROOT / "tests/requirements.lock").read_text().splitlines()
    (locked,) = (line for line in lines if line.startswith("embreex"))
    assert "platform_machine == 'x86_64'" in locked, "`make run` works on Linux on ARM too"
    assert "embreex" not in (ROOT / "cosim/docs/requirements.lock").read_text()
