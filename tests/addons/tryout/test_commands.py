"""`cosim new`, `cosim try`, and exporters and metrics of a user's own on the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.addons.tryout import templates
from cosim.addons.tryout.templates.detector import MyDetector, Params
from cosim.cli.main import app
from sensors.evidence import Observability
from sensors.reports import DetectorDraws
from tests.results import tiny
from tests.sensors.test_rotation import passing
from tests.slow import slow

KINDS = ("trust", "attack", "policy", "medium", "detector", "driver", "exporter", "metric")
FOLDER = Path(templates.__file__).parent


OWN = """
from cosim.extend import MetricRow

class Own:
    def rows(self, run): return [MetricRow("{name}", {value})]
"""


def call(*words):
    """What a command prints; its exit status and the error that it ends with."""
    done = CliRunner().invoke(app, [str(word) for word in words])
    return done.stdout, done.exit_code, done.exception


@pytest.mark.parametrize("kind", KINDS)
def test_new_writes_a_working_example_and_says_how_to_go_on(tmp_path, kind):
    path = tmp_path / "mine.py"
    said, status, _ = call("new", kind, path)
    assert status == 0 and path.read_text() == (FOLDER / f"{kind}.py").read_text()
    assert f"cosim try {path}:My{kind.capitalize()}" in said.replace("\n", "")
    assert len([line for line in path.read_text().splitlines() if line.strip()]) < 45


def test_commands_that_new_names_can_be_pasted(tmp_path):
    said, *_ = call("new", "metric", tmp_path / "my own.py")
    assert said.replace("\n", "").count("my own.py:MyMetric'") == 2


def test_new_writes_over_nothing(tmp_path):
    (tmp_path / "mine.py").write_text("mine")
    _, status, error = call("new", "trust", tmp_path / "mine.py")
    assert status == 1 and "is there already" in str(error) and (tmp_path / "mine.py").read_text() == "mine"
    assert "ends in .py" in str(call("new", "trust", tmp_path / "mine")[2])
    assert "cannot be written" in str(call("new", "trust", tmp_path / "no" / "mine.py")[2])
    for name in ("trust", "numpy", "statistics"):
        assert f"would hide the package {name}" in str(call("new", "trust", tmp_path / f"{name}.py")[2])


@pytest.mark.parametrize("kind", [k if k == "policy" else slow(k) for k in KINDS])
def test_an_example_keeps_all_laws(tmp_path, kind):
    call("new", kind, tmp_path / "mine.py")
    said, status, error = call("try", tmp_path / f"mine.py:My{kind.capitalize()}")
    assert (status, error) == (0, None), said
    assert "broken" not in said and said.count("ok ") >= 3


def test_try_reports_as_json_with_exit_status_1():
    said, status, _ = call("try", "tests.addons.tryout.bad:OldestChanges", "--json")
    found = json.loads(said)
    assert status == 1 and found["kind"] == "policy" and not found["holds"]
    (broken,) = [one for one in found["laws"] if not one["holds"]]
    assert broken["law"] == "each vehicle changes for itself" and "alone" in broken["found"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("try", "nowhere.py:Mine"), "no such file"),
        (("try", "gossip"), "no such choice"),
        (("try", "random", "--kind", "detector"), "no such choice"),
        (("try", "none"), "several kinds"),
        (("try", "random", "--set", "change_p=2"), "change_p"),
        (("try", "tests.addons.tryout.bad:LastOnDisk", "--set", "x=2"), "has no parameters"),
    ],
)
def test_what_cannot_be_tried_is_one_line(words, told):
    _, _, error = call(*words)
    assert isinstance(error, ValueError) and told in str(error) and "\n" not in str(error)


@pytest.fixture
def run(tmp_path):
    actors = [{"step": s, "actor": 0, "x_m": 2.0 * s, "speed_mps": 2.0} for s in range(3)]
    (tmp_path / "run").mkdir()
    tiny.make(tmp_path / "run", 3, actors=actors, vehicles=tiny.fleet("honest", vehicle_class="car", last_step=2))
    return tmp_path / "run"


def test_an_own_metric_is_measured(tmp_path, run):
    call("new", "metric", tmp_path / "mine.py")
    name = f"{tmp_path / 'mine.py'}:MyMetric"
    (rows,) = json.loads(call("measure", run, "--metric", name, "--json")[0]).values()
    assert [(row["metric"], row["group"], row["value"], row["unit"]) for row in rows] == [
        ("my_speed.mean", "car", 2.0, "m/s")
    ]
    (rows,) = json.loads(call("measure", run, "--metric", name, "--set", "least_mps=3.0", "--json")[0]).values()
    assert rows == []
    for wrong in ("float('inf')", "10**400"):
        (tmp_path / "own.py").write_text(OWN.format(name="own.x", value=wrong))
        own = f"{tmp_path / 'own.py'}:Own"
        assert "but a number of at most 1e+100" in str(call("measure", run, "--metric", own)[2])
    (tmp_path / "own.py").write_text(OWN.format(name="trust.final.median", value=1))
    assert "a metric that cosim has" in str(call("measure", run, "--metric", f"{tmp_path / 'own.py'}:Own")[2])
    nothing = CliRunner().invoke(app, ["measure", str(run), "--metric", "encounters.n"])
    assert nothing.stderr == f"note: {run} has no value of encounters.n.\n"
    assert "least_mps" in str(call("measure", run, "--metric", name, "--set", "last_mps=3.0")[2])
    assert "there is no such metric. Near: " in str(call("measure", run, "--metric", "trust.final.medan")[2])
    assert str(call("measure", run, "--metric", "traffic.equipped.n:all")[2]) == (
        "--metric traffic.equipped.n:all: there is no such group. There are: honest; unreliable; malicious."
    )
    assert "There are: " in str(call("measure", run, "--metric", "traffic:nobody")[2])
    refused = CliRunner().invoke(app, ["measure", str(run), "--metric", "traffic:nobody"])
    assert not refused.stdout + refused.stderr
    assert "goes with a metric of your own" in str(call("measure", run, "--set", "a=1")[2])


def test_the_example_of_a_detector_reports_where_the_sensor_looked():
    """A car at 20 m/s beside the sensor is seen a quarter of a turn, 0.025 s, after the time of the sweep."""
    sweeps, boxes = passing(20.0, rotation_hz=10.0)
    observer, actor, n = (np.array([number]) for number in (0, 1, 100))
    seen, key = Observability(observer, actor, n, n, np.array([10.0])), np.arange(2, dtype=np.uint64)
    draws = DetectorDraws(5.0, key, key, key, np.uint64(1), key, key)
    found = MyDetector(Params(error_m=0.0)).detect(sweeps, seen, boxes, np.zeros(2, np.uint8), draws)
    np.testing.assert_allclose(found.boxes.xyz_m - boxes.xyz_m[1:], [[0.5, 0.0, 0.0]])
