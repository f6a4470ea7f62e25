"""The commands, as a user meets them: what they print, what they leave behind, and how they say no."""

import json
from pathlib import Path

import pytest

from cosim import __version__
from tests.drive import SHORT, assert_refused, cosim
from tests.processes import manifest_of, set_words
from tests.slow import slow

SETS = set_words((*SHORT, "traffic.duration_s=10"))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run by the command line, and what was printed."""
    folder = tmp_path_factory.mktemp("cli")
    done = cosim("run", *SETS, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, done


@pytest.fixture(scope="module")
def measured(run):
    """All that is measured of the run: rows of JSON."""
    folder, _ = run
    return json.loads(cosim("measure", "runs/helsinki-1", "--json", cwd=folder).stdout)["runs/helsinki-1"]


def test_run_ends_in_a_summary_and_a_picture(run):
    folder, done = run
    run_folder = folder / "runs" / "helsinki-1"
    assert (run_folder / "trust.png").stat().st_size > 10_000
    manifest = manifest_of(run_folder)
    assert manifest["status"] == "finished" and manifest["steps"] == 10
    assert len(done.stdout.splitlines()) == 8
    for words in (
        "encounters",
        "malicious",
        "fresh",
        "frames received",
        "real time",
        "runs/helsinki-1",
        "cosim report",
    ):
        assert words in done.stdout
    assert done.stderr == ""  # no progress bar where nobody watches, no warnings


def test_a_run_can_be_repeated_from_its_own_config(run):
    folder, _ = run
    config = folder / "runs" / "helsinki-1" / "config.toml"
    done = cosim("run", str(config), "--out", "again", "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    from tests.fingerprint import fingerprint

    assert fingerprint(folder / "again") == fingerprint(config.parent)
    answer = json.loads(done.stdout)
    assert answer["run"] == "again" and any(row["metric"] == "radio.pdr.cpm" for row in answer["measures"])


def test_measure(run, measured):
    folder, _ = run
    assert "radio.pdr.all" in cosim("measure", "runs/helsinki-1", cwd=folder).stdout
    ratio = next(row["value"] for row in measured if row["metric"] == "radio.pdr.all")
    assert 0.3 < ratio < 0.9  # most neighbours are behind walls


def test_measure_of_named_metrics(run, measured):
    folder, _ = run
    names = ("radio.pdr.cpm", "trust.final.median:honest")
    words = ["measure", "runs/helsinki-1", "--json", *(word for name in names for word in ("--metric", name))]
    rows = json.loads(cosim(*words, cwd=folder).stdout)["runs/helsinki-1"]
    assert {(row["metric"], row["group"]) for row in rows} == {("trust.final.median", "honest"), ("radio.pdr.cpm", "")}
    assert all(row in measured for row in rows)
    topic = json.loads(cosim("measure", "runs/helsinki-1", "--metric", "encounters", "--json", cwd=folder).stdout)
    assert {row["metric"].partition(".")[0] for row in topic["runs/helsinki-1"]} == {"encounters"}
    some = json.loads(cosim("measure", "runs/helsinki-1", "--metric", "radio.pdr", "--json", cwd=folder).stdout)
    names = {row["metric"] for row in some["runs/helsinki-1"]}
    assert names == {"radio.pdr.all", "radio.pdr.cpm", "radio.pdr.evaluation"}
    done = cosim("measure", "runs/helsinki-1", "--metric", "radio.pdr.cmp", cwd=folder)
    assert_refused(done, "Near: radio.pdr.cpm")


def test_metrics_are_explained():
    text = cosim("measure", "--explain").stdout
    assert "misbehaviour.time_to_detection.median_s [s]: Time from the first step in which a subject is watched" in text
    assert "misbehaviour.time_to_detection.median_s" in json.loads(cosim("measure", "--explain", "--json").stdout)


@pytest.mark.parametrize("what", [slow("encounters"), "radio"])
def test_plot(run, what):
    folder, _ = run
    done = cosim("plot", what, "runs/helsinki-1", "--out", f"{what}.svg", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert (folder / f"{what}.svg").read_text().lstrip().startswith("<?xml")


def test_check_prints_the_resolved_experiment(tmp_path):
    done = cosim("check", "--set", "radio.range_m=123.5", cwd=tmp_path)
    assert done.returncode == 0 and "range_m = 123.5" in done.stdout
    assert json.loads(cosim("check", "--json").stdout)["traffic"]["scenario"] == "helsinki"
    assert list(tmp_path.iterdir()) == []


def test_nets_list():
    assert "ODbL" in cosim("nets", "list").stdout
    assert json.loads(cosim("nets", "list", "--json").stdout)[0]["name"] == "helsinki"


NET = '<net version="1.20"><location netOffset="0,0" convBoundary="0,0,9,9" origBoundary="0,0,9,9" projParameter="!"/>'
FOOTPATH = NET + (
    '<edge id="e" from="a" to="b"><lane id="e_0" index="0" allow="pedestrian" speed="1" length="9" shape="0,0 9,0"/>'
    "</edge></net>"
)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("run --set radio.raneg_m=3", "radio.raneg_m: unknown key"),
        ("run --set radio.range_m=-1", "should be greater than 0"),
        ("run nowhere.toml", "nowhere.toml: no such config file"),
        ("run --set traffic.scenario=atlantis", "no city of that name"),
        ("run --set traffic.scenario=nowhere.sumocfg", "no such file"),
        ("run --set traffic.scenario=footpath.sumocfg", "no car can drive"),
        ("run --set traffic.scenario=lost.sumocfg", "gone.net.xml"),
        ("run --set traffic.scenario=refused.sumocfg", "SUMO refuses it: Unknown from-node"),
        ("run --out taken", "already holds a run"),
        ("run --out full", "is not empty"),
        ("run --out file", "is a file"),
        ("run --set lidar.elevation_deg=[3,1]", "lidar.elevation_deg = [3.0, 1.0]: beams must"),
        ("run --set lidar.fov_deg=400", "lidar.fov_deg"),
        ("run --set radio.range_m=4e4", "radio.range_m = 40000.0 should be less than or equal to 32000"),
        ("run --set rsu.at=[[1,1]]", "rsu.at.0 = [1, 1]: too few values. `cosim explain rsu.at.0`"),
        ("measure full --threshold 7", "threshold"),
        ("run --frobnicate", "No such option"),
        ("nets build town.osm --out x", "takes no more without the name of an option"),
        ("frobnicate", "No such command"),
        ("measure nowhere", "nowhere is not a folder"),
        ("plot trust full", "is not a run"),
        ("resume study", "study is a study. Continue it with: cosim sweep"),
        ("plot love full", "love"),
        ("plot scene full --radius-m 100", "goes with `cosim plot durations or map`"),
        ("measure full ./full", "full is named twice"),
        ("sweep file.toml --out x", "file.toml: not valid TOML"),
    ],
)
def test_a_mistake_gets_one_line_and_status_2(tmp_path, words, says):
    for name, text in {
        "footpath.sumocfg": '<configuration><input><net-file value="footpath.net.xml"/></input></configuration>',
        "footpath.net.xml": FOOTPATH,
        "lost.sumocfg": '<configuration><input><net-file value="gone.net.xml"/></input></configuration>',
        "refused.sumocfg": '<configuration><input><net-file value="car.net.xml"/></input></configuration>',
        "car.net.xml": FOOTPATH.replace('allow="pedestrian" ', "").replace('to="b"', 'to="missing"'),
        "file": "", "file.toml": "[grid", "full/something": "", "study/index.parquet": "", "taken/manifest.json": "{}",
    }.items():  # fmt: skip
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    before = sorted(tmp_path.rglob("*"))
    done = cosim(*words.split(), cwd=tmp_path)
    assert done.returncode == 2
    assert says in done.stderr and "Traceback" not in done.stderr
    assert done.stderr.count("\n") == 1 and done.stdout == ""
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("words", ["measure", "report", "plot trust", "verify", "resume"])
def test_damage_gets_one_line_and_status_1(tmp_path, words):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "manifest.json").write_text("{}")
    done = cosim(*words.split(), "taken", cwd=tmp_path)
    said = done.stderr + done.stdout
    assert done.returncode == 1
    assert "manifest.json is damaged" in said and "Traceback" not in said
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["manifest.json", "taken"]


def test_version_and_completion():
    assert cosim("--version").stdout.strip() == f"cosim {__version__}"
    assert "--show-completion" in cosim("--help").stdout
    about = (Path(__file__).parents[3] / "CITATION.cff").read_text().splitlines()
    assert f"version: {__version__}" in about
