"""Recorded traffic is replayed where neither SUMO nor Embree is installed; here, the modules are hidden.

One process without these modules carries out several commands, each in a child.
"""

import pytest

from tests.drive import assert_refused, in_turn, simulate
from tests.hostile.scenes import write_trace
from tests.processes import manifest_of, set_words

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
"""


REFUSED = {
    "a city": (["run"], "libsumo is not installed. Install it: pip install libsumo==1.28.0"),
    "a city of SUMO's": (["run", "--set", "traffic.scenario=adlershof"], "make extra NAME=build"),
    "no trace": (["check", "--set", "lidar.engine=embree", "--set", "traffic.trace=x"], "traffic.trace"),
}


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """The folder of some commands, and how each of them ended: those that are refused, a list, and a run."""
    folder = tmp_path_factory.mktemp("hidden")
    trace = write_trace(folder)
    run = [
        "run",
        *set_words([f"traffic.scenario={trace}", "traffic.duration_s=5", "compute.threads=1"]),
        "--out",
        "run",
    ]
    done = in_turn(*(words for words, _ in REFUSED.values()), ["nets", "list"], run, cwd=folder, before=HIDE)
    return folder, dict(zip((*REFUSED, "list", "run"), done, strict=True))


def test_a_trace_runs_and_nothing_else_is_written(ended):
    folder, done = ended
    assert done["run"].returncode == 0, done["run"].stderr
    manifest = manifest_of(folder / "run")
    assert manifest["status"] == "finished" and "libsumo" not in manifest["versions"]
    assert sorted(path.name for path in folder.iterdir()) == ["run", "street.csv"]


@pytest.mark.verify
def test_a_shipped_city_replays_a_run(tmp_path):
    """The city's files are read as SUMO's, and the traffic is that of a run that another machine made."""
    recorded = simulate(tmp_path / "first", "traffic.duration_s=10", "traffic.warmup_s=60", "sensing=false")
    sets = ["preset=v0.2", "traffic.scenario=helsinki", f"traffic.trace={recorded}", "traffic.duration_s=5"]
    words = set_words(sets)
    commands = ["check", *words], ["run", *words, "--out", "again"], ["measure", "again"]
    for done in in_turn(*commands, cwd=tmp_path, before=HIDE):
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("what", REFUSED)
def test_what_needs_sumo_says_so_in_one_line(ended, what):
    done = ended[1][what]
    assert_refused(done, REFUSED[what][1])


def test_cities_are_listed(ended):
    assert "adlershof" in ended[1]["list"].stdout
