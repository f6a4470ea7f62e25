"""A stranger's scenario either runs or is refused in one line that names the file and the cause."""

import gzip
import json
import re

import numpy as np
import pytest

from cosim.config.config import load
from cosim.runs.check import empty_streets, keys_in_vain
from cosim.traffic.remarks import FlowCounts, jumping, overlapping, traffic_remarks
from cosim.traffic.scenario import find
from cosim.world import World
from results.manifest import read_manifest
from results.verify import verify
from sensors.scene import Shape
from tests import SHARED
from tests.cosim.traffic import mixed_scenario
from tests.cosim.traffic.mixed_scenario import edited
from tests.cosim.traffic.worlds import live, same
from tests.drive import cosim
from tests.hostile.scenes import write_town
from tests.processes import manifest_of, set_words
from tests.sensors.town import boxes_at
from tests.slow import slow

BOLOGNA = SHARED / "nets" / "bologna"

BOMB = '<!DOCTYPE a [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
SPY = '<!DOCTYPE a [<!ENTITY a SYSTEM "file:///etc/hosts">]>'


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    return mixed_scenario.write(tmp_path_factory.mktemp("odd"), end=700)


LOST = '<vehicle id="lost" depart="600"><route edges="nowhere"/></vehicle></routes>'
LATE = '<vehicle id="before" depart="450"><route edges="db bc"/></vehicle>' + LOST
"""SUMO reads 200 s ahead: at 250 s it goes on to the vehicle that cannot drive."""

COMPLAINT = '<collision.action value="zz"/></processing>'
"""SUMO reports this as an error, and continues."""

SUNK = '><param key="top_z_m" value="-1"/></poly>'
STATE = '<load-state value="gone.xml"/>'

REFUSED = {
    "a network with a bomb": ("odd net.net.xml", lambda t: BOMB + t[t.index("<net") :], "net.net.xml, line 1: decl"),
    "demand with a bomb": ("odd.rou.xml", lambda t: BOMB + t, "odd.rou.xml, line 1: declares a document type"),
    "demand that spies": ("odd.rou.xml", lambda t: SPY + t, "odd.rou.xml, line 1: declares a document type"),
    "polygons with a bomb": ("odd.poly.xml", lambda t: BOMB + t, "odd.poly.xml, line 1: declares a document type"),
    "a configuration with a bomb": ("odd.sumocfg", lambda t: BOMB + t, "odd.sumocfg, line 1: declares"),
    "a torn configuration": ("odd.sumocfg", lambda t: t[:200], "odd.sumocfg, line"),
    "a torn network": ("odd net.net.xml", lambda t: t[: t.rindex("<junction")], "odd net.net.xml"),
    "a network cut in its head": ("odd net.net.xml", lambda t: t[: t.index("<edge")], "odd net.net.xml, line"),
    "a torn additional file": ("odd.add.xml", lambda t: t[:40], "odd.add.xml"),
    "no configuration": ("odd.sumocfg", lambda t: "<routes/>", "names no network"),
    "missing demand": ("odd.sumocfg", lambda t: t.replace("odd.rou", "gone.rou"), "gone.rou.xml, which does not exist"),
    "an unknown edge": ("odd.rou.xml", lambda t: t.replace('edges="db bc"', 'edges="db xx"'), "'xx'"),
    "an unknown option": ("odd.sumocfg", lambda t: t.replace("verbose", "verbosity"), "verbosity"),
    "a folder that is not there": ("odd.add.xml", lambda t: t.replace("loop", "gone/loop"), "gone/loop.xml' (No such"),
    "a state that is not there": ("odd.sumocfg", lambda t: t.replace("<input>", "<input>" + STATE), "load-state names"),
    "a house on its head": ("odd.poly.xml", lambda t: t.replace("/>", SUNK, 1), "polygon 'h': reaches from"),
    "a house on the globe": ("odd.poly.xml", lambda t: t.replace("<poly", '<poly geo="true"', 1), "no projection"),
    "a torn polygon file": ("odd.poly.xml", lambda t: t[:60], "odd.poly.xml"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_refused_before_anything_is_written(scenario, tmp_path, what):
    name, change, says = REFUSED[what]
    config = edited(scenario, tmp_path, name, change)
    done = cosim("run", "--set", f"traffic.scenario={config}", "--set", "traffic.duration_s=5", "--out",
                 str(tmp_path / "run"))  # fmt: skip
    assert done.returncode == 2, (done.stdout, done.stderr)
    assert says in done.stderr and done.stderr.count("\n") == 1 and "Traceback" not in done.stderr


@pytest.mark.parametrize(("demand", "is_kept"), [(LATE, True), (LOST, False)])
def test_demand_that_turns_out_wrong_later(scenario, tmp_path, demand, is_kept):
    """SUMO reads demand bit by bit: what is recorded until then is kept; a folder without any step is removed."""
    config = edited(scenario, tmp_path, "odd.rou.xml", lambda t: t.replace("</routes>", demand))
    config.write_text(config.read_text().replace("</processing>", COMPLAINT))
    sets = (f"traffic.scenario={config}", "traffic.warmup_s=100", "traffic.duration_s=550", "fleet.penetration_p=0")
    out = tmp_path / "run"
    done = cosim("run", *set_words(sets), "--out", str(out))
    assert done.returncode == 2
    assert re.fullmatch(r"error: .*odd\.sumocfg: SUMO gives up: The edge 'nowhere'.*\n", done.stderr)
    assert out.exists() == is_kept
    if is_kept:
        assert manifest_of(out)["status"] == "failed"
        about, problems = verify(out)
        assert 300 < about["steps"] < 550 and problems == []  # also those of a block that is not complete


def test_what_sumo_complains_of_though_it_goes_on_is_told(scenario, tmp_path):
    config = edited(scenario, tmp_path, "odd.sumocfg", lambda t: t.replace("</processing>", COMPLAINT))
    sets = (f"traffic.scenario={config}", "traffic.duration_s=5", "fleet.penetration_p=0")
    done = cosim("run", *set_words(sets), "--out", str(tmp_path / "run"))
    assert done.returncode == 0
    assert "note: SUMO continued after this error: Invalid collision.action 'zz'" in done.stderr


def test_demand_that_sumo_leaves_out_is_told(scenario, tmp_path):
    """SUMO skips what is not in the order of departure, with a warning."""
    early = '<vehicle id="early" depart="0"><route edges="db bc"/></vehicle></routes>'
    config = edited(scenario, tmp_path, "odd.rou.xml", lambda t: t.replace("</routes>", early))
    report = live(str(config), 0, 3)[1]
    assert report["sumo_warnings"] == ["Route file should be sorted by departure time, ignoring 'early'!"]
    assert "left out a part of the demand" in traffic_remarks(report)[-1] and "'early'" in traffic_remarks(report)[-1]
    assert "sumo_warnings" not in live(str(scenario), 0, 3)[1]


def test_a_run_that_outlives_the_demand_says_so_and_counts_who_was_left_out(scenario, tmp_path):
    sets = ("traffic.scenario=.", "traffic.duration_s=2000", "fleet.penetration_p=0")
    done = cosim("run", *set_words(sets), "--out", str(tmp_path / "run"), cwd=scenario.parent)
    assert done.returncode == 0, done.stderr
    first, second = [line for line in done.stderr.splitlines() if not line.startswith("estimate: ")]
    assert "the traffic ended before the 2000 s asked for" in first
    assert second == "note: left out, because they are not on the road: 1 rail, 1 ship."
    summary = manifest_of(tmp_path / "run")["summary"]
    assert summary["actors_left_out"] == {"rail": 1, "ship": 1}
    assert not list(scenario.parent.glob("*tripinfo*")) and not list(scenario.parent.glob("state*"))


@pytest.mark.parametrize("name", ["odd.poly.xml", "shapes.add.xml", "shapes.xml.gz"])
def test_polygons_become_buildings_where_the_world_is(scenario, tmp_path, name):
    """One house of 20 x 15 m; the park is none. The origin is the network's middle, to the kilometre.

    The street beside it climbs from 3 m to 11 m within 500 m; the house's middle is 110 m from the lower end, so that
    it stands at 3 + 8 * 110 / 500 = 4.8 m, and is 7 m tall. Its walls reach down to the lower end.
    """
    config = edited(scenario, tmp_path, "odd.sumocfg", lambda t: t.replace("odd.poly.xml", name))
    text = (tmp_path / "odd.poly.xml").read_bytes()
    (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
    found = find(str(config))
    assert found.origin_m[0] == pytest.approx(-8_999_000, abs=1000) and found.origin_m[0] % 1000 == 0
    city = found.city()
    (house,) = city.footprints
    west = -8_999_900 - found.origin_m[0]
    assert house.bounds == (west, 130, west + 20, 145)
    assert city.buildings.base_m.tolist() == pytest.approx([3.0], abs=0.2)
    assert city.buildings.top_m.tolist() == pytest.approx([11.8], abs=0.2)  # the street is set back at its ends


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("notes.txt", "", "no .sumocfg, folder or trace"),
        ("bare/x", "", "a folder with no .sumocfg"),
        ("made/recipe.toml", "name = ", "not a city that `cosim nets build` made"),
        ("made/recipe.toml", 'name = "x"', "KeyError"),
        ("run/manifest.json", "{}", "manifest.json is damaged"),
        ("gone.sumocfg/x", "", "a folder with no .sumocfg"),
    ],
)
def test_what_is_no_scenario(tmp_path, name, text, says):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    path = (tmp_path / name).parent if "/" in name else tmp_path / name
    with pytest.raises(ValueError, match=r".") as caught:
        find(str(path))
    assert says in str(caught.value) and str(path) in str(caught.value)


def test_recorded_traffic_in_a_city_is_replayed_from_its_begin(tmp_path):
    """The city's own warm-up fills streets, and those of a recording are as full as they were."""
    (tmp_path / "recorded.xml").write_text("<fcd-export/>")
    assert find("helsinki").warmup_s == 600 and find("helsinki", str(tmp_path / "recorded.xml")).warmup_s == 0


def test_what_is_no_trace(tmp_path):
    with pytest.raises(ValueError, match="no such file or folder"):
        find("helsinki", str(tmp_path / "gone.parquet"))
    with pytest.raises(ValueError, match="neither a run folder nor a trace"):
        find("helsinki", str(tmp_path))


@pytest.mark.verify
@pytest.mark.parametrize("city", ["bologna", "koenigs-wusterhausen"])
def test_half_an_hour_without_a_warning(tmp_path, city):
    if city == "bologna":
        if not BOLOGNA.is_dir():
            pytest.skip(f"{BOLOGNA} is not there")
        city = str(BOLOGNA / "run.sumocfg")
        before = sorted(BOLOGNA.iterdir())
    sets = (f"traffic.scenario={city}", "traffic.duration_s=1800", "record.level=summary", "fleet.penetration_p=0.1",
            "traffic.warmup_s=600")  # fmt: skip
    done = cosim("run", *set_words(sets), "--out", str(tmp_path / "run"))
    assert done.returncode == 0, done.stderr
    assert all(line.startswith("estimate: ") for line in done.stderr.splitlines()), done.stderr
    manifest = manifest_of(tmp_path / "run")
    assert manifest["steps"] == 1800 and manifest["summary"]["vehicles_on_road_mean"] > 50
    if "/" in city:
        assert sorted(BOLOGNA.iterdir()) == before


@pytest.mark.parametrize(
    ("file", "name"), [("osm.sumocfg", "Ghent"), ("run.sumocfg", "Ghent"), ("Scenario.sumocfg", "Ghent"),
                       ("ghent-2.sumocfg", "ghent-2")],
)  # fmt: skip
def test_a_scenario_is_named_after_its_folder_where_the_file_name_is_a_common_word(scenario, tmp_path, file, name):
    folder = tmp_path / "Ghent"
    folder.mkdir()
    edited(scenario, folder, "odd.sumocfg", lambda t: t).rename(folder / file)
    assert find(str(folder / file)).name == find(str(folder)).name == name


def test_traffic_that_begins_later_is_named_with_its_time(scenario, tmp_path):
    def later(text):
        return '<routes><vehicle id="v" depart="3:00:00"><route edges="ab bd"/></vehicle></routes>'

    config = edited(scenario, tmp_path, "odd.rou.xml", later)
    text = config.read_text().replace('<end value="700"/>', "").replace('<route-files value="odd.rou.xml"/>', "")
    config.write_text(text.replace("odd.add.xml", "odd.rou.xml,odd.add.xml"))  # additional files may have demand, too
    sets = (f"traffic.scenario={config}", "traffic.duration_s=20", "traffic.warmup_s=30", "fleet.penetration_p=1")
    done = cosim("run", *set_words(sets), "--out", str(tmp_path / "run"))
    assert done.returncode == 0, done.stderr
    assert "the first of the scenario departs at 10800 s. Set traffic.begin_s = 10770." in done.stderr


@pytest.mark.parametrize("name", [slow("odd.cfg"), "a,b/odd.sumo.cfg"])
@pytest.mark.parametrize("by_folder", [False, True])
def test_what_sumo_opens_is_opened(scenario, tmp_path, name, by_folder):
    """A configuration by its content, and in a folder whose name has a comma, at which SUMO splits lists of files."""
    folder = (tmp_path / name).parent
    folder.mkdir(exist_ok=True)
    edited(scenario, folder, "odd.sumocfg", lambda t: t).rename(tmp_path / name)
    given = str(folder if by_folder else tmp_path / name)
    assert find(given).name == "odd"
    worlds, report = live(given, 0, 8)
    same(worlds, live(str(scenario), 0, 8)[0])
    assert "sumo_errors" not in report


@pytest.mark.parametrize(
    "location", ["", '<location netOffset="0,0" convBoundary="0,0,0,0" origBoundary="0,0,0,0" projParameter="!"/>']
)
def test_a_network_that_does_not_say_how_far_it_reaches(scenario, tmp_path, location):
    """Its bounds are those of its streets, of a road's width around the outermost nodes a, c and d."""
    config = edited(scenario, tmp_path, "odd net.net.xml", lambda t: re.sub(r"<location [^>]*/>", location, t))
    np.testing.assert_allclose(find(str(config)).bounds_m, (-9_000_000, 100, -8_999_200, 400), atol=15)
    worlds, _ = live(str(config), 0, 8)
    assert len(worlds[-1]) > 0


@pytest.mark.parametrize("file", ["-", slow("stdout"), slow("STDERR")])
def test_standard_output_belongs_to_the_command(scenario, tmp_path, file):
    """Additional files may name it as the place of their outputs."""
    edge_data = f'<additional><edgeData id="e" file="{file}" period="1"/></additional>'
    config = edited(scenario, tmp_path, "odd.add.xml", lambda _: edge_data)
    sets = (f"traffic.scenario={config}", "traffic.duration_s=5", "fleet.penetration_p=0", "sensing=false")
    done = cosim("run", *set_words(sets), "--out", str(tmp_path / "run"), "--json")
    assert done.returncode == 0 and json.loads(done.stdout)["summary"]["streets"], done.stdout[:200]
    assert "interval" not in done.stderr


def test_provenance_names_every_file_and_notices_a_change(scenario, tmp_path):
    config = edited(scenario, tmp_path, "odd.sumocfg", lambda t: t)
    before = find(str(config)).provenance()
    names = {key.removeprefix("sha256 ") for key in before if key.startswith("sha256 ")}
    assert names == {"odd.sumocfg", "odd net.net.xml", "odd.rou.xml", "odd.add.xml", "odd.poly.xml"}
    assert find(str(config)).changed_inputs(before) == []
    with (tmp_path / "odd.rou.xml").open("a") as file:
        file.write("\n")
    assert find(str(config)).changed_inputs(before) == ["odd.rou.xml"]


def test_a_run_is_replayed_from_elsewhere_and_a_changed_input_is_told(scenario, tmp_path):
    """The config names its scenario relatively; the run's own config drives it again from another folder."""
    city, elsewhere = tmp_path / "city", tmp_path / "elsewhere"
    city.mkdir(), elsewhere.mkdir()
    edited(scenario, city, "odd.sumocfg", lambda t: t)
    (tmp_path / "mine.toml").write_text('[traffic]\nscenario = "city"\nduration_s = 5\n[fleet]\npenetration_p = 0.0\n')
    done = cosim("run", "mine.toml", "--out", "one", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = cosim("run", str(tmp_path / "one" / "config.toml"), "--out", "two", cwd=elsewhere)
    assert done.returncode == 0, done.stderr
    with (city / "odd.poly.xml").open("a") as file:
        file.write("\n")
    done = cosim("run", "--set", f"traffic.scenario={tmp_path / 'one'}", "--set", "traffic.duration_s=5",
                 "--set", "fleet.penetration_p=0", "--out", "three", cwd=elsewhere)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "note: changed since the replayed run was recorded: odd.poly.xml." in done.stderr
    one, three = (read_manifest(folder / name)["summary"] for folder, name in ((tmp_path, "one"), (elsewhere, "three")))
    for what in ("vehicles_waiting_to_enter_at_end", "teleports"):
        assert three[what] == one[what]


def test_remarks_on_standing_and_waiting_vehicles():
    summary = {"vehicles_standing_p": 0.52, "vehicles_waiting_to_enter_at_end": 457, "vehicles_on_road_mean": 900.0}
    first, second = traffic_remarks(summary)
    assert first.startswith("note: 52 % of the vehicles stand") and "457 vehicles wait to enter" in second
    assert traffic_remarks(summary | {"vehicles_standing_p": 0.49, "vehicles_waiting_to_enter_at_end": 90}) == []
    two_buses_at_a_stop = {"vehicles_standing_p": 0.6, "vehicles_on_road_mean": 5.0}
    assert traffic_remarks(two_buses_at_a_stop) == []


def test_only_pedestrians_is_said_and_no_departure_is_advised(scenario, tmp_path):
    def walks(text):
        return '<routes><person id="w" depart="2"><walk edges="ab"/></person></routes>'

    config = edited(scenario, tmp_path, "odd.rou.xml", walks)
    sets = (f"traffic.scenario={config}", "traffic.duration_s=9", "sensing=false")
    done = cosim("run", *set_words(sets), "--out", str(tmp_path / "run"))
    assert done.returncode == 0 and "only pedestrians were on the road" in done.stderr, done.stderr
    assert "begin_s" not in done.stderr


def world_of(boxes, speed_mps, actor, shape=Shape.CAR):
    """These actors at step 0; nobody is equipped."""
    n = len(actor)
    nobody, key = np.zeros(n, bool), np.array(actor).astype(np.uint64)
    shape, speed_mps = np.broadcast_to(shape, n).astype(np.uint8), np.broadcast_to(speed_mps, n).astype(float)
    return World(0, np.array(actor), key, shape, boxes, speed_mps, nobody, nobody.astype(np.uint8))


def test_standing_vehicles_are_counted_by_hand():
    """Two cars and a pedestrian over two steps: 0.05, 5 and 0 m/s, then 0, 0 and 0: three of four stand.

    Both cars are at one point, four times in all: too few for a word.
    """
    counts = FlowCounts(0.5)
    for speeds in ([0.05, 5.0, 0.0], [0.0, 0.0, 0.0]):
        shape = [Shape.CAR, Shape.CAR, Shape.PEDESTRIAN]
        counts.add(world_of(boxes_at(np.zeros((3, 3))), speeds, np.arange(3), shape))
    assert counts.report() == {"vehicles_standing_p": 0.75}


def cars_at(*poses, length_m=4.0):
    """Cars of 2 m width at x, y, height of the road, heading in degrees."""
    x, y, z, yaw = np.array(poses, float).T
    return boxes_at(np.column_stack([x, y, z + 0.75]), (length_m, 2.0, 1.5), np.radians(yaw))


@pytest.mark.parametrize(
    ("other", "n"),
    [
        ((0.0, 0.9, 0, 0), 2),  # beside it, 1.1 m inside
        ((0.0, 1.1, 0, 0), 0),  # 0.9 m inside
        ((2.9, 0.0, 0, 0), 2),  # behind it, 1.1 m inside
        ((1.9, 0.0, 0, 90), 2),  # across: half a length and half a width reach 3 m
        ((2.1, 0.0, 0, 90), 0),
        ((0.0, 0.0, 4.5, 90), 0),  # on a bridge
        ((0.0, 0.0, 0.9, 90), 2),  # on a ramp: 0.6 m of height in common
    ],
)
def test_overlapping_vehicles_by_hand(other, n):
    assert overlapping(cars_at((0, 0, 0, 0), other, (50, 0, 0, 0))).tolist() == [0, 1][:n]


def test_traffic_that_no_vehicle_can_drive_is_noted():
    """Ten cars in each of two steps: four at two points, two that overlap, four apart."""
    apart = [(100.0 * k, 0, 0, 0) for k in range(1, 5)]
    boxes = cars_at((0, 0, 0, 0), (0, 0, 0, 90), (0, 50, 0, 0), (0, 50, 0, 0), (0, 80, 0, 0), (0.5, 80, 0, 90), *apart)
    counts = FlowCounts(0.5)
    for _ in range(3):
        counts.add(world_of(boxes, 9.0, np.arange(10)))
    told = counts.report()
    assert told == {"vehicles_standing_p": 0.0, "vehicles_at_one_point_p": 0.4, "vehicles_overlapping_p": 0.2}
    one, other = traffic_remarks(told)
    assert "40% of the vehicles are at the exact position" in one and 'stops with parking="true"' in one
    assert "20.00% of the vehicles overlap" in other
    assert traffic_remarks(told | {"vehicles_at_one_point_p": 0.01, "vehicles_overlapping_p": 0.002}) == []


def test_jumping_vehicles_by_hand():
    """At 10 and 20 m/s over 0.5 s a vehicle moves 10 m at most, and 5 m are granted: 14 m are possible, 16 m are not.

    The second car is new, and the last actor is a pedestrian.
    """

    def world(actors, x_m, speeds):
        shape = np.where(np.array(actors) == 9, Shape.PEDESTRIAN, Shape.CAR)
        return world_of(cars_at(*((x, 0, 0, 0) for x in x_m)), speeds, actors, shape)

    before = world([1, 3, 4, 9], [0.0, 50.0, 0.0, 0.0], [10.0, 20.0, 10.0, 1.0])
    now = world([1, 2, 3, 9], [14.0, 300.0, 66.0, 90.0], [20.0, 0.0, 10.0, 1.0])
    assert now.actor[jumping(before, now, 0.5)].tolist() == [3]
    (note,) = traffic_remarks({"vehicles_jumping_p": 0.007})
    assert "0.70% of the vehicles move farther within a step than their speed allows" in note
    assert traffic_remarks({"vehicles_jumping_p": 0.001}) == []


def test_a_trace_that_begins_in_the_middle_of_traffic_is_noted():
    """Where to begin is said, and not that streets were filling; a trace of empty streets is no such."""
    summary = {"vehicles_on_road_mean": 40.0, "vehicles_on_road_first": 0, "trace_begin_s": 0.2}
    (note,) = traffic_remarks(summary | {"actors_at_trace_begin": 38})
    assert "38 actors are on the road when the trace begins" in note and "Set traffic.begin_s = 0.2" in note
    (note,) = traffic_remarks(summary | {"actors_at_trace_begin": 3})
    assert "the streets were still filling" in note


def test_a_scenario_without_a_warm_up_is_noted(tmp_path):
    """Recording would begin on empty streets; a city has a warm-up of its own, and a set one, of 0 too, is meant."""

    def noted(*sets):
        config = load(None, [*sets])
        return bool(empty_streets(config, find(config.traffic.scenario, config.traffic.trace)))

    town = f"traffic.scenario={write_town(tmp_path / 'town')}"
    assert noted(town)
    assert not noted(town, "traffic.warmup_s=0") and not noted(town, "traffic.warmup_s=60")
    assert not noted()


def test_a_longer_step_of_a_scenario_is_noted(tmp_path):
    """SUMO drives otherwise in shorter steps. A scenario that states no step has lost none, and a set one is meant."""
    town = write_town(tmp_path / "town")

    def noted(*sets):
        config = load(None, [f"traffic.scenario={town}", *sets])
        return [note for note in keys_in_vain(config, find(str(town))) if "has steps of" in note]

    assert noted("preset=modern") == []
    town.write_text(town.read_text().replace("<time>", '<time><step-length value="0.5"/>'))
    (note,) = noted("preset=modern")
    assert "town.sumocfg has steps of 0.5 s" in note and "Set traffic.step_s = 0.5 to drive it as it is." in note
    assert noted("preset=modern", "traffic.step_s=0.5") == noted("preset=modern", "traffic.step_s=0.1") == []
    assert noted("preset=v0.2") == []


def test_the_sumocfg_of_a_city_is_not_the_city():
    """Without the 653 buildings and the warm-up of 600 s that belong to the folder."""
    config = load(None, [])
    city = find("helsinki")
    (note,) = [note for note in keys_in_vain(config, find(str(city.sumocfg))) if "buildings" in note]
    assert f"Set traffic.scenario = {city.sumocfg.parent}" in note
    assert not [note for note in keys_in_vain(config, city) if "buildings" in note]


def test_a_run_that_began_on_empty_streets_says_so():
    summary = {"vehicles_on_road_first": 3, "vehicles_on_road_mean": 41.2}
    (line,) = traffic_remarks(summary)
    assert line.startswith("note: 3 vehicles were on the road when recording began, and 41 on the mean")


def test_an_empty_road_is_told():
    report = FlowCounts(dt_s=1.0).report()
    (note,) = traffic_remarks(report)
    assert "nobody was on the road" in note
    (note,) = traffic_remarks(report | {"first_departure_s": 90.0})
    assert "departs at 90 s" in note
