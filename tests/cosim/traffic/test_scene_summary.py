"""What is said of streets and buildings that are loaded, and of those that cannot be meant so."""

from xml.etree import ElementTree

import pytest
import shapely

from cosim.traffic.scenario import find
from cosim.traffic.scene_summary import scene_summary
from tests import SHARED
from tests.cosim.traffic import crossing
from tests.drive import cosim
from tests.processes import manifest_of, set_words
from tests.slow import slow

NETS = SHARED / "nets"


def of(folder, *flags, **given):
    return scene_summary(find(str(crossing.write(folder, *flags, **given))))


def test_the_lines_by_hand(tmp_path):
    """Two lanes of 2 x 200 m each way, and one of 2 x 150 m each way: 2.2 km less the crossing itself."""
    (tmp_path / "houses.add.xml").write_text(crossing.houses())
    found = of(tmp_path, files="houses.add.xml")
    length_km, rest = found.streets.split(" km of lanes in 8 streets, ")
    assert 2.0 < float(length_km) < 2.2 and rest == "right-hand traffic, all at height 0"
    assert found.buildings == "4; heights: 4 from the tag height" and found.notes == ()


def test_heights_in_a_file_may_be_guessed():
    """Helsinki's file has 653 heights, of which OpenStreetMap has 39."""
    assert scene_summary(find("helsinki")).buildings == "653; heights: 653 in the file, measured or guessed"


def test_no_buildings_are_said_in_the_line(tmp_path):
    found = of(tmp_path, "lefthand")
    assert found.buildings == "none: everybody sees everybody" and found.notes == ()
    assert "left-hand traffic" in found.streets


@pytest.mark.parametrize(("value", "n"), [("true", 1), ("1", 1), ("false", 0)])
@pytest.mark.parametrize("option", ["mesosim", "no-internal-links"])
def test_options_without_places_of_vehicles_are_noted(tmp_path, option, value, n):
    found = of(tmp_path, more=f'<{option} value="{value}"/>')
    assert len(found.notes) == n and all(f"city.sumocfg sets {option}: " in note for note in found.notes)


def test_a_network_without_ways_through_junctions_is_noted(tmp_path):
    (note,) = of(tmp_path, "no-internal-links").notes
    connections = ElementTree.parse(tmp_path / "city.net.xml").getroot().findall("connection")
    assert f"no ways through its junctions (0 for {len(connections)} connections)" in note


@pytest.mark.parametrize(
    ("projection", "times"),
    [("+proj=webmerc +datum=WGS84", 2.0), ("+proj=utm +zone=35 +units=us-ft", 3.3), ("+proj=utm +zone=35", None)],
)
def test_a_network_that_is_not_in_metres_is_noted(tmp_path, projection, times):
    """A crossing of 600 x 600 m at 60 degrees north: Mercator's scale is 1 / cos 60° = 2, and a metre is 3.28 feet."""
    at = {"w": (26.9946, 60), "c": (27, 60), "e": (27.0054, 60), "s": (27, 59.9973), "n": (27, 60.0027)}
    nodes = "".join(f'<node id="{name}" x="{lon}" y="{lat}"/>' for name, (lon, lat) in at.items())
    path = crossing.write(tmp_path, nodes=f"<nodes>{nodes}</nodes>", proj=projection)
    said = [note for note in scene_summary(find(str(path))).notes if "as long as on Earth" in note]
    assert said == [] if times is None else f"everything is {times:g} times" in said[0]


OVER = """<nodes><node id="w" x="0" y="200" z="{z}"/><node id="e" x="400" y="200" z="{z}"/>
<node id="s" x="200" y="0"/><node id="n" x="200" y="400"/></nodes>"""
ROADS = """<edges><edge id="we" from="w" to="e" numLanes="2"/><edge id="ew" from="e" to="w" numLanes="2"/>
<edge id="sn" from="s" to="n" numLanes="2"/><edge id="ns" from="n" to="s" numLanes="2"/></edges>"""


@pytest.mark.parametrize(("fall_m", "is_noted"), [(6, False), (12, True)])
def test_streets_on_a_hill_are_noted(tmp_path, fall_m, is_noted):
    """Half of the lanes fall by 6 or 12 m over 400 m, which is 1.5 % or 3 %."""
    nodes = OVER.format(z=0).replace('y="200" z="0"/>', f'y="200" z="{fall_m}"/>', 1)
    said = [note for note in of(tmp_path, nodes=nodes, edges=ROADS).notes if "is steeper than 2%" in note]
    assert len(said) == is_noted and all("50% of the length of the lanes" in note for note in said)


@pytest.mark.parametrize(("z", "n"), [(0, 16), (1.5, 16), (6, 0)])
def test_streets_over_streets_need_heights(tmp_path, z, n):
    """Four lanes cross four lanes: 16 places, unless the one street is above the roofs of cars on the other."""
    found = of(tmp_path, nodes=OVER.format(z=z), edges=ROADS)
    assert (f"in {n} places" in found.streets) == bool(n)
    assert len(found.notes) == bool(n) and all(f"in {n} places (100% of the lanes)" in note for note in found.notes)


def share_inside(folder, north_m):
    """Share of the lanes inside the blocks, by Shapely, of the network's own text."""
    blocks = shapely.union_all([
        shapely.box(x, y + north_m, x + 160, y + 110 + north_m) for x, y in crossing.BLOCKS
    ])  # fmt: skip
    lanes = [
        shapely.LineString([tuple(map(float, point.split(","))) for point in lane.get("shape").split()])
        for lane in ElementTree.parse(folder / "city.net.xml").getroot().iter("lane")
    ]
    return sum(lane.intersection(blocks).length for lane in lanes) / sum(lane.length for lane in lanes)


@pytest.mark.parametrize("north_m", [60, 25])
def test_buildings_on_the_streets_are_noted_with_their_share(tmp_path, north_m):
    (tmp_path / "houses.add.xml").write_text(crossing.houses(north_m=north_m))
    found = of(tmp_path, files="houses.add.xml")
    share = share_inside(tmp_path, north_m)
    assert share > 0.05
    (note,) = found.notes
    said = float(note.removeprefix("note: ").partition("%")[0]) / 100
    assert said == pytest.approx(share, abs=0.02) and "of the length of the lanes" in note and "houses.add.xml" in note


def test_buildings_with_another_offset_are_noted(tmp_path):
    """By 500 km east and 5,000 km north, as of UTM."""
    (tmp_path / "houses.add.xml").write_text(crossing.houses(east_m=5e5, north_m=5e6))
    (note,) = of(tmp_path, files="houses.add.xml").notes
    assert "none of the 4 buildings" in note and "they are 5,025 km away" in note


@pytest.mark.parametrize(
    ("kinds", "says"),
    [
        (("house", "Gebaeude", "commercial", "house"), "none of the 4 polygons of "),
        (("building", "house", "building", "house"), "2 polygons of "),
        (("house", "landuse.grass", "natural.water", "park"), "none of the 4 polygons of "),
        (("landuse.residential", "natural.water", "park", "forest"), ""),
        (("building.house", "Building", "landuse.forest", "water"), ""),
    ],
)
def test_polygons_that_look_like_buildings_are_noted(tmp_path, kinds, says):
    (tmp_path / "houses.add.xml").write_text(crossing.houses(kinds))
    notes = of(tmp_path, files="houses.add.xml").notes
    assert len(notes) == bool(says)
    assert all(says in note and "house " in note for note in notes)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_buildings_of_an_included_file_count_in_any_encoding(tmp_path, encoding):
    head = f'<?xml version="1.0" encoding="{encoding}"?>'
    (tmp_path / "houses.poly.xml").write_bytes((head + crossing.houses()).encode(encoding))
    (tmp_path / "all.add.xml").write_text('<additional><include href="houses.poly.xml"/></additional>')
    assert of(tmp_path, files="all.add.xml").buildings.startswith("4; ")
    assert len(find(str(tmp_path / "city.sumocfg")).city().footprints) == 4


def test_the_command_line_says_it(tmp_path):
    """The lines stand in the outputs, and the notes on standard error, by `check` and by `run`."""
    (tmp_path / "houses.add.xml").write_text(crossing.houses(("house",) * 4))
    config = crossing.write(tmp_path, files="houses.add.xml")
    sets = (f"traffic.scenario={config}", "traffic.duration_s=3", "sensing=false")
    words = set_words(sets)
    checked, ran = cosim("check", *words), cosim("run", *words, "--out", str(tmp_path / "run"))
    for done in (checked, ran):
        assert done.returncode == 0 and "none of the 4 polygons" in done.stderr, done.stderr
    summary = manifest_of(tmp_path / "run")["summary"]
    for said in (checked.stdout, summary["streets"] + summary["buildings"]):
        assert "none: everybody sees everybody" in said and " km of lanes in 8 streets" in said


@pytest.mark.parametrize("city", ["helsinki", "koenigs-wusterhausen", "bologna/run.sumocfg",
                                  slow("luxembourg/luxembourg.sumocfg")])  # fmt: skip
def test_cities_that_are_fine_get_no_note(city):
    if "/" in city and not (NETS / city).is_file():
        pytest.skip(f"{NETS / city} is not there")
    assert scene_summary(find(str(NETS / city) if "/" in city else city)).notes == ()


def test_a_changed_file_is_read_again(tmp_path):
    (tmp_path / "houses.add.xml").write_text(crossing.houses())
    config = crossing.write(tmp_path, files="houses.add.xml")
    assert scene_summary(find(str(config))).buildings.startswith("4; ")
    (tmp_path / "houses.add.xml").write_text("<additional/>" + " " * 99)
    assert scene_summary(find(str(config))).buildings.startswith("none")


SLOPE = """<nodes><node id="a" x="-150" y="0" z="0"/><node id="b" x="150" y="0" z="0"/>
<node id="c" x="-150" y="40" z="6"/><node id="d" x="150" y="40" z="6"/></nodes>"""
TERRACES = '<edges><edge id="ab" from="a" to="b"/><edge id="cd" from="c" to="d"/></edges>'


def with_house(folder, nodes, shape):
    """The scenario of two streets and a house of 10 m, and where its walls begin and end."""
    wall = f'<poly id="h" type="building" shape="{shape}"><param key="height" value="10"/></poly>'
    (folder / "house.add.xml").write_text(f"<additional>{wall}</additional>")
    scenario = find(str(crossing.write(folder, nodes=nodes, edges=TERRACES, files="house.add.xml")))
    walls = scenario.city().buildings
    return scenario, [walls.base_m[0], walls.top_m[0]]


def test_a_house_on_a_slope_reaches_down_to_the_lower_street(tmp_path):
    """It stands beside the upper street, at 6 m: its top is 10 m above that, its walls begin at the lower one."""
    _, heights_m = with_house(tmp_path, SLOPE, "-5,25 5,25 5,35 -5,35")
    assert heights_m == pytest.approx([0, 16], abs=0.01)


VIADUCT = """<nodes><node id="a" x="-150" y="0" z="0"/><node id="b" x="150" y="0" z="0"/>
<node id="c" x="-100" y="-100" z="12"/><node id="d" x="100" y="100" z="12"/></nodes>"""


@pytest.mark.parametrize("at", [(-45, 30), (30, -45)])
def test_a_house_beside_a_viaduct_stands_on_the_ground(tmp_path, at):
    """The viaduct crosses the street at the origin, and passes the house at 12 m, nearer than the street."""
    x, y = at
    shape = f"{x},{y} {x + 15},{y} {x + 15},{y + 15} {x},{y + 15}"
    _, heights_m = with_house(tmp_path, VIADUCT, shape)
    assert heights_m == pytest.approx([0, 10], abs=0.01)


def test_a_tunnel_below_a_building_stays_free(tmp_path):
    """The lower street, 12 m below the upper one, passes under the house, whose walls end 4.5 m above it."""
    nodes = SLOPE.replace('z="0"', 'z="-12"').replace('z="6"', 'z="0"').replace('y="40"', 'y="20"')
    scenario, heights_m = with_house(tmp_path, nodes, "-5,-5 5,-5 5,15 -5,15")
    assert heights_m == pytest.approx([-7.5, 10], abs=0.01)
    assert scene_summary(scenario).notes == ()
