"""The commands about cities."""

import json

import pytest

from cosim.addons.netbuild.counts import _edges as read_edges
from cosim.addons.netbuild.osm_files import read
from tests.addons.netbuild.test_build_from_osm import grid_town
from tests.cosim.traffic import mixed_scenario
from tests.drive import assert_refused, cosim
from tests.processes import manifest_of


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A town built by command, and what was said of it."""
    folder = tmp_path_factory.mktemp("nets")
    (folder / "a.osm").write_text(grid_town(), encoding="utf-8")
    done = cosim("nets", "build", "--osm", "a.osm", "--out", "town", "--density", "4", "--json", cwd=folder)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return folder, json.loads(done.stdout)


def test_the_extract_that_ships(tmp_path):
    """It has streets and buildings; an existing file is not replaced."""
    done = cosim("nets", "example", "kotka.osm.pbf", cwd=tmp_path)
    assert done.returncode == 0 and "OpenStreetMap contributors" in done.stdout
    ways = read(tmp_path / "kotka.osm.pbf").ways.values()
    assert [sum(key in way.tags for way in ways) for key in ("highway", "building")] == [144, 747]
    for name in ("kotka.osm.pbf", "kotka.osm", "no/folder.osm.pbf"):
        done = cosim("nets", "example", name, cwd=tmp_path)
        assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, name
    assert [path.name for path in tmp_path.iterdir()] == ["kotka.osm.pbf"]


def test_build_reports_and_draws(built):
    folder, said = built
    assert said["assessment"] == "it flows" and said["teleports"] == 0 and said["buildings"] == 4
    assert (folder / "town" / "city.png").stat().st_size > 10_000


def test_what_was_built_is_driven(built):
    folder, _ = built
    (folder / "mine.toml").write_text('[traffic]\nscenario = "town"\nduration_s = 5\nwarmup_s = 60\n')
    done = cosim("run", str(folder / "mine.toml"), "--json", "--out", "run", cwd=folder)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    manifest = manifest_of(folder / "run")
    assert manifest["net"]["attribution"] == "© OpenStreetMap contributors"


def test_list_knows_what_ships_what_sumo_brings_and_what_was_built_here(built, tmp_path, monkeypatch):
    folder, _ = built
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))  # nothing has been made there
    (folder / "soup").mkdir(exist_ok=True)
    (folder / "soup" / "recipe.toml").write_text('title = "soup"')
    done = cosim("nets", "list", "--json", cwd=folder)
    rows = {row["name"]: row for row in json.loads(done.stdout)}
    assert set(rows) == {"helsinki", "adlershof", "braunschweig", "koenigs-wusterhausen", "town"}
    assert "soup: not a city" in done.stderr and done.stderr.count("\n") == 1
    assert {name for name, row in rows.items() if row["on_disk"]} == {"helsinki", "town"}
    assert [row["picture"] for row in rows.values() if row["picture"]] == ["town/city.png"]
    assert all(row["km2"] > 0.1 and row["vehicles_per_hour"] > 100 and row["licence"] for row in rows.values())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("columns", [80, 120])
def test_the_list_fits_the_screen_and_no_word_is_cut(built, columns):
    folder, _ = built
    lines = cosim("nets", "list", cwd=folder, COLUMNS=str(columns)).stdout.splitlines()
    assert max(map(len, lines)) <= columns and "…" not in "".join(lines)
    for name in ("helsinki", "adlershof", "braunschweig", "koenigs-wusterhausen", "town"):
        rows = [line.split() for line in lines if line.startswith(f"  {name} ")]
        (row,) = [row for row in rows if row[-1] == "ODbL-1.0"]
        assert len(row) == 6  # name, km², vehicles, size in two words or "when used", licence


def test_show(built, tmp_path):
    folder, _ = built
    said = json.loads(cosim("nets", "show", "helsinki", "--json", cwd=tmp_path).stdout)
    assert said["buildings"] == 653 and said["licence"] == "ODbL-1.0"
    assert (tmp_path / "helsinki.png").stat().st_size > 10_000
    config = mixed_scenario.write(tmp_path / "odd")
    done = cosim("nets", "show", str(config), "--out", "odd.svg", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["buildings"] == 1 and (tmp_path / "odd.svg").is_file()
    assert "lanes" in cosim("nets", "show", str(folder / "town"), cwd=tmp_path).stdout


@pytest.mark.verify
def test_the_demand_of_a_built_city_is_fitted_to_counts(built):
    folder, _ = built
    edge = next(iter(read_edges(folder / "town" / "net.net.xml.gz")))
    (folder / "counts.csv").write_text(f"edge,per_hour\n{edge},80\n")
    words = ("nets", "counts", "town", "counts.csv", "--out", "counted", "--hold-out", "0")
    done = cosim(*words, "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["fitted_drawn"]["places"] == 1 and said["kept_back_driven"]["places"] == 0
    done = cosim(*words, cwd=folder)
    assert_refused(done, "is not empty")
    done = cosim("run", "--set", "traffic.scenario=counted", "--set", "traffic.duration_s=2", "--out", "r", cwd=folder)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("counts helsinki gone.csv --out x", "gone.csv: not a CSV file that can be read"),
        ("counts atlantis bad.osm --out x", "atlantis: not a city"),
        ("counts helsinki bad.osm --out x", "bad.osm has no rows"),
        ("show atlantis", "no city of that name"),
        ("build --out x", "needs --osm FILE, --bbox west"),
        ("build --out x --osm gone.osm", "gone.osm: no such file"),
        ("build --out x --osm bad.osm", "bad.osm"),
        ("build --out . --osm bad.osm", "is not empty"),
        ("build --out x --osm bad.osm --density 0", "--density 0"),
        ("build --out x --osm bad.osm --hour 24", "--hour 24"),
        ("build --out x --bbox 1,2,3", "four numbers are wanted"),
        ("list gone", "gone is not a folder"),
    ],
)
def test_a_mistake_gets_one_line_and_status_2(tmp_path, words, says):
    (tmp_path / "bad.osm").write_text("<osm>")
    done = cosim("nets", *words.split(), cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == ""
    assert says in done.stderr and done.stderr.count("\n") == 1 and "Traceback" not in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["bad.osm"]
