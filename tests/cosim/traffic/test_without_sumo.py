"""Recorded traffic is replayed where neither SUMO nor Embree is installed; here, the modules are hidden."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.drive import simulate
from tests.hostile.scenes import write_trace

HIDE = """
import importlib.metadata, sys

class Hidden:
    names = {"libsumo", "sumo", "sumolib", "sumo_data", "traci", "embreex", "osmium", "rerun", "trimesh", "mcap"}
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Hidden())
import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in Hidden.names else found(name, package)
version = importlib.metadata.version
def hidden(name):
    if name.replace("-", "_") in ("libsumo", "eclipse_sumo", "embreex"):
        raise importlib.metadata.PackageNotFoundError(name)
    return version(name)
importlib.metadata.version = hidden
from cosim.cli.main import main
sys.argv[0] = "cosim"
main()
"""


def hidden(*words: str, cwd: Path) -> subprocess.CompletedProcess:
    """`cosim` with these words, without SUMO, Embree and the libraries of extras."""
    return subprocess.run([sys.executable, "-c", HIDE, *words], cwd=cwd, capture_output=True, text=True, check=False)


def test_a_trace_runs(tmp_path):
    trace = write_trace(tmp_path)
    done = hidden(
        "run", "--set", f"traffic.scenario={trace}", "--set", "traffic.duration_s=5", "--out", "run", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["status"] == "finished" and "libsumo" not in manifest["versions"]


@pytest.mark.verify
def test_a_shipped_city_replays_a_run(tmp_path):
    """The city's files are read as SUMO's, and the traffic is that of a run that another machine made."""
    recorded = simulate(tmp_path / "first", "traffic.duration_s=10", "traffic.warmup_s=60", "sensing=false")
    sets = ["preset=v0.2", "traffic.scenario=helsinki", f"traffic.trace={recorded}", "traffic.duration_s=5"]
    words = [word for text in sets for word in ("--set", text)]
    assert hidden("check", *words, cwd=tmp_path).returncode == 0
    done = hidden("run", *words, "--out", "again", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert hidden("measure", "again", cwd=tmp_path).returncode == 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["run"], "libsumo is not installed. Install it: pip install libsumo==1.28.0"),
        (["run", "--set", "traffic.scenario=adlershof"], "make extra NAME=build"),
        (["check", "--set", "lidar.engine=embree", "--set", "traffic.trace=x"], "traffic.trace"),
    ],
)
def test_what_needs_sumo_says_so_in_one_line(tmp_path, words, says):
    hidden("nets", "example", cwd=tmp_path)
    before = sorted(tmp_path.iterdir())
    done = hidden(*words, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert says in done.stderr
    assert sorted(tmp_path.iterdir()) == before


def test_cities_are_listed(tmp_path):
    assert "adlershof" in hidden("nets", "list", cwd=tmp_path).stdout
