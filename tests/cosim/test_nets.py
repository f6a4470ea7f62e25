"""The commands about cities."""

import json

import pytest

from tests.cosim.mobility import odd
from tests.drive import cosim
from tests.sumo_nets.test_town import grid_town


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A town built by command, and what was said of it."""
    folder = tmp_path_factory.mktemp("nets")
    (folder / "a.osm").write_text(grid_town(), encoding="utf-8")
    done = cosim("nets", "build", "--osm", "a.osm", "--out", "town", "--density", "4", "--json", cwd=folder)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return folder, json.loads(done.stdout)


def test_build_reports_and_draws(built):
    folder, said = built
    assert said["verdict"] == "it flows" and said["teleports"] == 0 and said["buildings"] == 4
    assert (folder / "town" / "city.png").stat().st_size > 10_000


def test_what_was_built_is_driven(built):
    folder, _ = built
    (folder / "mine.toml").write_text('[traffic]\nscenario = "town"\nduration_s = 5\nwarmup_s = 60\n')
    done = cosim("run", str(folder / "mine.toml"), "--json", "--out", "run", cwd=folder)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    manifest = json.loads((folder / "run" / "manifest.json").read_text())
    assert manifest["net"]["attribution"] == "© OpenStreetMap contributors"


def test_list_knows_what_was_built_here(built):
    folder, _ = built
    rows = json.loads(cosim("nets", "list", "--json", cwd=folder).stdout)
    assert {row["name"] for row in rows} >= {"helsinki", "adlershof", "braunschweig", "koenigs-wusterhausen", "town"}
    assert "town" in cosim("nets", "list", cwd=folder).stdout


def test_show(built, tmp_path):
    folder, _ = built
    said = json.loads(cosim("nets", "show", "helsinki", "--json", cwd=tmp_path).stdout)
    assert said["buildings"] == 653 and said["licence"] == "ODbL-1.0"
    assert (tmp_path / "helsinki.png").stat().st_size > 10_000
    config = odd.write(tmp_path / "odd")
    done = cosim("nets", "show", str(config), "--out", "odd.svg", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["buildings"] == 1 and (tmp_path / "odd.svg").is_file()
    assert "vehicles per hour" in cosim("nets", "show", str(folder / "town"), cwd=tmp_path).stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["show", "atlantis"], "no city of that name"),
        (["build", "--out", "x"], "wants one of --osm FILE and --bbox"),
        (["build", "--out", "x", "--osm", "gone.osm"], "gone.osm: no such file"),
        (["build", "--out", "x", "--osm", "bad.osm"], "bad.osm"),
        (["build", "--out", ".", "--osm", "bad.osm"], "is not empty"),
        (["build", "--out", "x", "--osm", "bad.osm", "--density", "0"], "--density 0"),
        (["build", "--out", "x", "--osm", "bad.osm", "--hour", "24"], "--hour 24"),
        (["build", "--out", "x", "--bbox", "1,2,3"], "four numbers are wanted"),
        (["list", "gone"], "gone is not a folder"),
    ],
)
def test_a_mistake_gets_one_line_and_status_2(tmp_path, words, says):
    (tmp_path / "bad.osm").write_text("<osm>")
    done = cosim("nets", *words, cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == ""
    assert says in done.stderr and done.stderr.count("\n") == 1 and "Traceback" not in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["bad.osm"]
