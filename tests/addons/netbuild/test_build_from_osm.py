"""A town that nobody has looked at: from an OpenStreetMap file to traffic, or one line that says why not."""

import gzip
import re
import shutil
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest

from cosim.addons.netbuild import build, build_from_osm, flow, osm_files
from cosim.addons.netbuild.build_from_osm import from_osm
from cosim.addons.netbuild.streets import n_clockwise
from sumo_nets import catalogue, density, sumo_package_nets
from sumo_nets.density import Density
from sumo_nets.network import lanes
from sumo_nets.osm import Extract, Way
from sumo_nets.sumotools import projected
from tests import SHARED
from tests.refusals import refused_in_one_line
from tests.slow import slow

HERSFELD = SHARED / "nets" / "bad_hersfeld" / "osm_bbox.osm.xml.gz"


def grid_town(n: int = 5, step: float = 0.0018) -> str:
    """n x n crossings 200 m apart, streets named awkwardly, and a house in every block."""
    rows, ways = [], []
    for i in range(n):
        for j in range(n):
            lat, lon = 50 + i * step * 0.64, 9 + j * step
            rows.append(f'<node id="{1 + n * i + j}" version="1" lat="{lat:.6f}" lon="{lon:.6f}"/>')
    lines = [[1 + n * i + j for j in range(n)] for i in range(n)]
    lines += [[1 + n * i + j for i in range(n)] for j in range(n)]
    for k, nodes in enumerate(lines):
        refs = "".join(f'<nd ref="{node}"/>' for node in nodes)
        kind = "secondary" if k % 3 else "residential"
        tags = f'<tag k="highway" v="{kind}"/><tag k="name" v="&quot;Straße&quot; &lt;{k}/漢&gt;"/>'
        ways.append(f'<way id="{k + 1}" version="1">{refs}{tags}</way>')
    for b in range(n - 1):
        corners = [(0.4, 0.4), (0.4, 0.6), (0.6, 0.6), (0.6, 0.4)]
        first = 1000 + 10 * b
        for c, (dy, dx) in enumerate(corners):
            lat, lon = 50 + (b + dy) * step * 0.64, 9 + (b + dx) * step
            rows.append(f'<node id="{first + c}" version="1" lat="{lat:.6f}" lon="{lon:.6f}"/>')
        refs = "".join(f'<nd ref="{first + c % 4}"/>' for c in range(5))
        tags = f'<tag k="building" v="yes"/><tag k="height" v="{10 + b}"/>'
        ways.append(f'<way id="{1000 + b}" version="1">{refs}{tags}</way>')
    top = 50 + (n - 1) * step * 0.64
    bounds = f'<bounds minlat="50" minlon="9" maxlat="{top:.6f}" maxlon="{9 + (n - 1) * step:.6f}"/>'
    return f'<?xml version="1.0" encoding="UTF-8"?><osm version="0.6">{bounds}{"".join(rows + ways)}</osm>'


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("town")
    (folder / "my town.osm.gz").write_bytes(gzip.compress(grid_town().encode()))
    from_osm(folder / "my town.osm.gz", folder / "our 'town' ö", Density(per_km=4.0))
    return folder / "our 'town' ö"


def test_a_town_is_built_and_flows(built):
    net = catalogue.open_folder(built)
    assert net.name == "our-town-ö"
    assert [round(f.top_z_m) for f in net.footprints()] == [10, 11, 12, 13]
    flows = flow.measure(net, 300)
    # 10 streets of 4 x 129 m or so, both ways: 10 km; Little's law aims at 4 vehicles on each.
    assert 15 < flows.vehicles_mean < 90
    assert flows.teleports == 0 and flows.assessment == "it flows"


def test_as_many_vehicles_are_on_the_road_as_asked_for(tmp_path):
    """Half a vehicle on each of 37.3 km in Kotka, whose routes are 2.3 times the straight line; there were 31."""
    from_osm(catalogue.EXAMPLE_OSM, tmp_path / "kotka", Density(per_km=0.5))
    flows = flow.measure(catalogue.open_folder(tmp_path / "kotka"))
    assert flows.vehicles_mean == pytest.approx(0.5 * 37.3, rel=0.2)


def test_the_same_file_gives_the_same_town(built, tmp_path):
    from_osm(built.parent / "my town.osm.gz", tmp_path / built.name, Density(per_km=4.0))
    assert (tmp_path / built.name / "SHA256SUMS").read_text() == (built / "SHA256SUMS").read_text()


def test_its_recipe_builds_it_again(built, tmp_path):
    build.build(built / "recipe.toml", built.parent / "my town.osm.gz", tmp_path)
    assert (tmp_path / "SHA256SUMS").read_text() == (built / "SHA256SUMS").read_text()
    with pytest.raises(ValueError, match=r"made for my town\.osm\.gz"):
        build.build(built / "recipe.toml", None, tmp_path)


def test_traffic_keeps_to_the_left_where_it_is_told_to(built, tmp_path):
    """Who drives from west to east keeps south of the middle of the street, or north of it."""
    from_osm(built.parent / "my town.osm.gz", tmp_path / "left", Density(), left_hand=True)

    def eastward_m(folder: Path) -> float:
        """How far north they drive, on average."""
        ways = [lane.line_m for lane in lanes(folder / "net.net.xml.gz") if lane.for_cars and not lane.across]
        return float(np.mean([way[:, 1].mean() for way in ways if np.ptp(way[:, 1]) < 2 and way[-1, 0] > way[0, 0]]))

    assert 2 < eastward_m(tmp_path / "left") - eastward_m(built) < 8  # by the width of a lane or two


def test_roundabouts_tell_the_side_of_the_road():
    """A square east, north, west, south is driven against the clock."""
    place = {1: (0.0, 51.0), 2: (0.001, 51.0), 3: (0.001, 51.001), 4: (0.0, 51.001)}
    tags = {"highway": "primary", "junction": "roundabout"}
    right = Way(1, (1, 2, 3, 4, 1), tags)
    left = [Way(2, (1, 4, 3, 2, 1), tags), Way(3, (4, 3, 2, 1, 4), tags)]
    others = [Way(4, (1, 4, 3), tags), Way(5, (1, 4, 9, 1), tags), Way(6, (1, 4, 3, 2, 1), {"highway": "primary"})]
    extract = Extract(place=place, ways={way.id: way for way in (right, *left, *others)})
    assert n_clockwise(extract) == (2, 3)
    assert "2 of 3 roundabouts are driven clockwise" in build_from_osm._other_side(extract, left_hand=False)
    assert build_from_osm._other_side(extract, left_hand=True) == ""
    assert build_from_osm._other_side(Extract(), left_hand=False) == ""
    british = build_from_osm._other_side(Extract(place=place, ways={1: right}), left_hand=True)
    assert british.endswith("Build the city again without --left-hand.")


def test_a_name_names_files_in_the_folder(built, tmp_path):
    with pytest.raises(ValueError, match=r"--name \.\./evil: files are named after it"):
        from_osm(built.parent / "my town.osm.gz", tmp_path / "out", Density(), "../evil")
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="out cannot be made: Not a directory"):
        from_osm(built.parent / "my town.osm.gz", tmp_path / "file" / "out", Density())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("suffix", [".osm.pbf", *(slow(s) for s in (".osm.bz2", ".osm"))])
def test_the_same_town_from_whatever_it_is_packed_in(built, tmp_path, suffix):
    import osmium

    packed = tmp_path / f"a{suffix}"
    with osmium.SimpleWriter(packed) as writer:
        for item in osmium.FileProcessor(built.parent / "my town.osm.gz"):
            writer.add(item)
    from_osm(packed, tmp_path / built.name, Density(per_km=4.0))
    for name in ("net.net.xml.gz", "buildings.poly.xml.gz", "demand.rou.xml.gz"):
        assert (tmp_path / built.name / name).read_bytes() == (built / name).read_bytes(), name


def test_a_name_in_capitals_is_read_too(tmp_path):
    (tmp_path / "KOTKA.PBF").write_bytes(catalogue.EXAMPLE_OSM.read_bytes())
    assert osm_files.read(tmp_path / "KOTKA.PBF") == osm_files.read(catalogue.EXAMPLE_OSM)


def test_a_folder_may_have_commas_at_which_sumo_cuts_lists(built, tmp_path):
    city = catalogue.open_folder(Path(shutil.copytree(built, tmp_path / "here, there")))
    assert flow.measure(city, 60).trips >= 0
    ring = np.array([[9.0, 50.0], [9.001, 50.0], [9.0, 50.001]])
    assert np.allclose(projected([ring], city.net_path), projected([ring], built / city.net_path.name))


def test_night_is_quieter_than_the_afternoon(built, tmp_path):
    from_osm(built.parent / "my town.osm.gz", tmp_path / "night", Density(per_km=4.0, hour=3))
    night, day = catalogue.open_folder(tmp_path / "night"), catalogue.open_folder(built)
    assert night.vehicles_per_hour == pytest.approx(day.vehicles_per_hour * density.BY_HOUR[3], rel=0.03)
    buses = [
        re.findall("per_hour_and_line = ([0-9.]+)", (net.folder / "recipe.toml").read_text()) for net in (day, night)
    ]
    assert buses == [["2"], ["0.12"]]  # 6 % of the traffic of hour 16


ROADLESS = grid_town().replace('k="highway"', 'k="waterway"')

BAD = {
    "roadless.osm": (ROADLESS.encode(), "no connected network"),
    "torn.osm": (grid_town()[:3000].encode(), "not an OpenStreetMap file"),
    "torn.osm.gz": (gzip.compress(grid_town().encode())[:-30], "damaged gzip file|not an OpenStreetMap file"),
    "empty.osm": (b"", "not well-formed XML|not an OpenStreetMap"),
    "other.osm": (b"<routes/>", "not an OpenStreetMap file|has no ways"),
    "bomb.osm": (b'<!DOCTYPE a [<!ENTITY a "b">]><osm version="0.6">&a;</osm>', "declares a document type"),
    "noise.osm.pbf": (b"\x00\x00\x00\x0dnothing", "not an OpenStreetMap file"),
    "bare.osm": (b'<osm version="0.6"></osm>', "has no ways"),
    "paths.osm": (re.sub('v="(secondary|residential)"', 'v="footway"', grid_town()).encode(), "no connected network"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_gets_one_line(tmp_path, name):
    content, says = BAD[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=says) as caught:
        from_osm(tmp_path / name, tmp_path / "out", Density())
    assert name in str(caught.value) and "\n" not in str(caught.value).strip()
    assert not (tmp_path / "out").exists()


def test_offline_a_box_points_to_a_file(tmp_path, monkeypatch):
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")  # nobody listens there
    with refused_in_one_line(r"cannot be reached, or is busy .* --osm FILE"):
        build_from_osm.from_box("9.0,50.0,9.001,50.001", tmp_path / "out", Density())


@pytest.mark.verify
def test_a_city_of_the_wheel_is_made_once_and_always_alike(tmp_path, monkeypatch):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "one"))
    first = catalogue.find("koenigs-wusterhausen")
    assert catalogue.find("koenigs-wusterhausen") == first  # from the cache
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "two"))
    second = catalogue.find("koenigs-wusterhausen")
    assert second.folder != first.folder
    assert (second.folder / "SHA256SUMS").read_text() == (first.folder / "SHA256SUMS").read_text()
    assert len(first.footprints()) > 10 and "OpenStreetMap" in first.attribution


@pytest.mark.parametrize(
    "name",
    [name if name == "koenigs-wusterhausen" else slow(name)
     for name in sorted(sumo_package_nets.NETS)],
)  # fmt: skip
def test_what_is_said_of_a_city_before_it_is_made_is_what_it_then_is(name, tmp_path, monkeypatch):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    assert sumo_package_nets.made(name) is None
    said, made = sumo_package_nets.NETS[name], catalogue.find(name)
    assert sumo_package_nets.made(name) == made.folder
    assert said.km2 == pytest.approx(made.size_m[0] * made.size_m[1] / 1e6, abs=0.01)
    assert said.vehicles_per_hour == made.vehicles_per_hour
    assert said.pedestrians_per_hour == made.pedestrians_per_hour


def test_a_cache_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "file"))
    with pytest.raises(ValueError, match="Set COSIM_CACHE to a folder"):
        catalogue.find("braunschweig")


@pytest.mark.verify
@pytest.mark.parametrize("name", sorted(sumo_package_nets.NETS))
def test_the_cities_of_the_wheel_flow(name, tmp_path, monkeypatch):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    flows = flow.measure(catalogue.find(name), 1800)
    assert flows.assessment == "it flows" and flows.vehicles_mean > 30, flows


@pytest.mark.verify
def test_bad_hersfeld_in_two_minutes(tmp_path):
    if not HERSFELD.is_file():
        pytest.skip(f"{HERSFELD} is not there")
    begin = perf_counter()
    from_osm(HERSFELD, tmp_path / "hersfeld", Density())
    assert perf_counter() - begin < 120
    net = catalogue.open_folder(tmp_path / "hersfeld")
    assert len(net.footprints()) > 11_000
    flows = flow.measure(net)
    assert flows.assessment == "it flows" and flows.teleports == 0 and 500 < flows.vehicles_mean < 1500


def small(*elements):
    """A file with these nodes (number, latitude, longitude) and ways (number, nodes, tags)."""
    nodes = [one for one in elements if isinstance(one[1], float)]
    ways = [one for one in elements if not isinstance(one[1], float)]
    text = "".join(f'<node id="{node}" lat="{lat}" lon="{lon}"/>' for node, lat, lon in nodes)
    for way, refs, tags in ways:
        nds = "".join(f'<nd ref="{node}"/>' for node in refs)
        text += f'<way id="{way}">{nds}' + "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items()) + "</way>"
    return f'<osm version="0.6">{text}</osm>'


ENDS = [(1, 10.0, 20.0), (2, 10.0, 20.004)]
SQUARE = [(1, 10.0, 20.0), (2, 10.0, 20.0003), (3, 10.0003, 20.0003), (4, 10.0003, 20.0)]
SMALL = {
    "a street": small(*ENDS, (5, [1, 2], {"highway": "residential"})),
    "a one-way street": small(*ENDS, (5, [1, 2], {"highway": "primary", "oneway": "yes"})),
    "a block": small(*SQUARE, (5, [1, 2, 3, 4, 1], {"highway": "residential"})),
    "a street of one place": small((1, 10.0, 20.0), (2, 10.0, 20.0), (5, [1, 2], {"highway": "residential"})),
    "two islands": small(*ENDS, (3, 10.01, 20.0), (4, 10.01, 20.004), (5, [1, 2], {"highway": "residential"}),
                         (6, [3, 4], {"highway": "residential"})),
}  # fmt: skip


@pytest.mark.parametrize("what", SMALL)
def test_an_extract_that_is_too_small_gets_one_line_with_the_cause(tmp_path, what):
    (tmp_path / "small.osm").write_text(SMALL[what])
    with pytest.raises(
        ValueError, match=r"the extract is too small for traffic: .*Take a larger|netconvert failed"
    ) as it:
        from_osm(tmp_path / "small.osm", tmp_path / "out", Density())
    assert "small.osm: " in str(it.value) and "\n" not in str(it.value) and "/sumo_nets." not in str(it.value)
    assert not (tmp_path / "out").exists()


def across_town(gap: float) -> str:
    """The grid town, and a road of 1.4 km across it, cut off at both ends of the extract; on a bridge or not at all."""
    west, east, lat = 9.0 - 0.003, 9.0 + 4 * 0.0018 + 0.003, 50.0 + 0.0018 * 0.64 * 1.5
    nodes = "".join(
        f'<node id="{number}" lat="{lat:.6f}" lon="{lon:.6f}"/>'
        for number, lon in (
            (9001, west),
            (9002, (west + east) / 2 - gap),
            (9003, (west + east) / 2 + gap),
            (9004, east),
        )
    )
    ways = [(901, 9001, 9002), (902, 9003, 9004)] if gap else [(901, 9001, 9004)]
    road = "".join(
        f'<way id="{way}"><nd ref="{a}"/><nd ref="{b}"/><tag k="highway" v="motorway"/><tag k="oneway" v="yes"/></way>'
        for way, a, b in ways
    )
    bounds = f'minlon="{west:.6f}" maxlat'
    text = re.sub(r'minlon="9" maxlat', bounds, grid_town())
    text = re.sub(r'maxlon="[^"]*"', f'maxlon="{east:.6f}"', text, count=1)
    return text.replace("</osm>", nodes + road + "</osm>")


@pytest.mark.verify
def test_a_motorway_without_a_ramp_stays_and_what_is_left_out_is_said(tmp_path):
    """Only the outside connects it with the town. The road with a gap of 100 m is two pieces with a gate each."""
    for name, gap in (("whole", 0.0), ("gap", 0.0007)):
        (tmp_path / f"{name}.osm").write_text(across_town(gap))
        losses = from_osm(tmp_path / f"{name}.osm", tmp_path / name, Density(per_km=2.0))
        edges = {lane.edge: lane for lane in lanes(tmp_path / name / "net.net.xml.gz") if not lane.across}
        road = {edge for edge in edges if edge.startswith("90")}
        assert len(road) == (1 if gap == 0 else 2) and losses.streets == {} and losses.text == ""
    flows = flow.measure(catalogue.open_folder(tmp_path / "whole"), 300)
    assert flows.assessment == "it flows" and flows.trips > 0
    island = [(8001, 50.0021, 9.003), (8002, 50.0021, 9.0035)]
    text = small(*island, (801, [8001, 8002], {"highway": "residential"}))
    (tmp_path / "town.osm").write_text(grid_town().replace("</osm>", text.partition(">")[2]))
    losses = from_osm(tmp_path / "town.osm", tmp_path / "town", Density())
    assert losses.streets.keys() == {"residential"}
    assert losses.streets["residential"].left_m == pytest.approx(0.0005 * 111_195 * 0.6427, rel=0.01)  # cos 50 degrees
