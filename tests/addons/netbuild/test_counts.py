"""Traffic counts: the statistic by hand, places by the map's own nodes, and demand that follows them."""

import gzip
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from cosim.addons.netbuild import counts
from cosim.addons.netbuild.build_from_osm import from_osm
from sumo_nets import catalogue
from sumo_nets.density import Density
from tests.addons.netbuild.test_build_from_osm import grid_town


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    folder = tmp_path_factory.mktemp("counted")
    (folder / "town.osm").write_text(grid_town(), encoding="utf-8")
    from_osm(folder / "town.osm", folder / "town", Density(per_km=4.0))
    return catalogue.open_folder(folder / "town")


@pytest.fixture(scope="module")
def own(town):
    """Vehicles per hour of the town's own demand on its streets, where they are more than 60."""
    driven = counts.driven(town, counts._edges(town.net_path))
    return {edge: value for edge, value in driven.items() if value > 60}


def test_geh_by_hand():
    """120 beside 100: sqrt(2 * 400 / 220) = 1.907. 400 beside 500: sqrt(2 * 10000 / 900) = 4.714."""
    found = counts.geh(np.array([120.0, 400.0, 0.0]), np.array([100.0, 500.0, 0.0]))
    assert np.allclose(found, [1.907, 4.714, 0.0], atol=5e-4)
    said = counts.agreement({"a": 120.0, "b": 700.0, "c": 9.0}, {"a": 100.0, "b": 500.0})
    assert (said.places, said.good_share) == (2, 0.5) and said.ratio == pytest.approx(820 / 600)
    assert counts.agreement({}, {}).text == "no places"


def test_a_place_is_the_street_that_leads_in_its_direction(town, tmp_path):
    """The middle between two crossings of the map, with both directions; the edges start at the crossings' nodes."""
    import sumolib

    net = sumolib.net.readNet(str(town.net_path))
    step = 0.0018
    rows, wanted = [], []
    for i, j, di, dj, heading in ((2, 1, 0, 1, 90.0), (2, 1, 1, 0, 0.0), (2, 2, 0, -1, 270.0), (3, 2, -1, 0, 180.0)):
        lat, lon = 50 + (i + di / 2) * step * 0.64, 9 + (j + dj / 2) * step
        rows.append((lon, lat, heading, 100.0 + i))
        start, end = (str(1 + 5 * a + b) for a, b in ((i, j), (i + di, j + dj)))
        (edge,) = [e for e in net.getNode(start).getOutgoing() if e.getToNode().getID() == end]
        wanted.append(edge.getID())
    text = [",".join(map(str, row)) for row in [*rows, rows[0]]]  # two detectors on the first street
    (tmp_path / "c.csv").write_text("\n".join(["lon,lat,heading_deg,per_hour", *text, ""]))
    assert counts.read(tmp_path / "c.csv", town.net_path) == {
        wanted[0]: 204.0,
        wanted[1]: 102.0,
        wanted[2]: 102.0,
        wanted[3]: 103.0,
    }


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("edge,cars\na,1\n", "has no column per_hour"),
        ("lon,lat,per_hour\n9,50,1\n", "has no column heading_deg"),
        ("edge;per_hour\na;1\n", "It has: edge;per_hour. Separate columns with commas."),
        ("edge\tper_hour\na\t1\n", "Separate columns with commas."),
        ("edge,per_hour\n", "has no rows"),
        ("edge,per_hour\nnowhere,5\n", "line 2: the network has no street 'nowhere'"),
        ("edge,per_hour\nnowhere,-5\n", "line 2: per_hour = -5"),
        ("edge,per_hour\nnowhere,many\n", "line 2: per_hour = many"),
        ("lon,lat,heading_deg,per_hour\n9.002,50.002,45,inf\n", "line 2: per_hour = inf"),
        ("edge,per_hour\nnowhere,1e300\n", "line 2: per_hour = 1e300 is no number from 0 to 20000"),
        ("lon,lat,heading_deg,per_hour\n500,50,0,5\n", "line 2: lon = 500 is no number from -180 to 180"),
        ("lon,lat,heading_deg,per_hour\n9,95,0,5\n", "line 2: lat = 95 is no number from -90 to 90"),
        ("lon,lat,heading_deg,per_hour\n8,50,90,5\n", "line 2: no street that leads to 90 degrees within 30 m"),
        ("", "no rows"),
        ('edge,per_hour\n"a,5\n', "not a CSV file"),
        ("edge,per_hour\n\nnowhere,5\n", "line 3: the network has no street"),
        ("edge,per_hour,per_hour\na,1,2\n", "has two columns per_hour"),
        ("edge,per_hour\na,1,5\n", "line 2: more values than the header has columns"),
        ("edge,hour,per_hour\na,7,10\na,8,20\n", "hour differs between rows"),
        ("edge, per_hour\nnowhere, 5\n", "line 2: the network has no street 'nowhere'"),
        ("edge,per_hour\nnowhere\n", "line 2: per_hour = None"),
    ],
)
def test_a_file_that_cannot_be_used_gets_one_line(town, tmp_path, text, says):
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(ValueError, match=r"c\.csv") as error:
        counts.read(tmp_path / "c.csv", town.net_path)
    assert says in str(error.value) and "\n" not in str(error.value)


def test_places_that_are_kept_back():
    counted = {f"e{k}": float(k) for k in range(10)}
    assert len(counts.kept_back(counted, 0.2, 1)) == 2 and counts.kept_back(counted, 0.0, 1) == {}
    assert counts.kept_back(counted, 0.2, 1) == counts.kept_back(counted, 0.2, 1)
    assert counts.kept_back({"e0": 1.0}, 0.9, 1) == {}  # at least one place is fitted


def test_a_sumocfg_is_no_city_whose_demand_can_be_fitted(town):
    """A mistake of one line, without the name of an exception."""
    with pytest.raises(ValueError, match=r"\.sumocfg: not a city by name, and no folder that .* made\.$"):
        catalogue.open_folder(town.sumocfg_path)


def test_demand_follows_counts_and_what_is_not_motorised_stays(town, own, tmp_path):
    """The counts are a third more than what the town's own demand drives: its vehicles must become more."""
    counted = {edge: round(value * 4 / 3) for edge, value in own.items()}
    drawn = counts.fit(town, counted, tmp_path / "new", seed=1)
    new = catalogue.open_folder(tmp_path / "new")
    assert counts.agreement(drawn, counted).good_share > 0.85
    assert new.vehicles_per_hour > 1.1 * town.vehicles_per_hour
    assert new.pedestrians_per_hour == town.pedestrians_per_hour


def test_buses_are_among_the_vehicles_that_were_counted(tmp_path):
    """On three streets of Helsinki, a fifth of what passes are buses, and bicycles pass that no detector counts."""
    counted = {"17000556": 120.0, "4247501#0": 240.0, "34144204#2": 230.0}
    drawn = counts.fit(catalogue.find("helsinki"), counted, tmp_path / "new", seed=1)
    new = catalogue.open_folder(tmp_path / "new")
    passed = dict.fromkeys(counted, 0)
    for name in ("demand.rou.xml.gz", "buses.rou.xml.gz"):
        for vehicle in ET.fromstring(gzip.decompress((new.folder / name).read_bytes())).iter("vehicle"):
            if vehicle.get("type") != "bicycle":
                for edge in counted.keys() & set(vehicle.find("route").get("edges").split()):
                    passed[edge] += 1
    per_hour = {edge: n * 3600 / new.end_s for edge, n in passed.items()}
    assert per_hour == pytest.approx(drawn)
    assert per_hour == pytest.approx(counted, rel=0.03)


@pytest.mark.verify
def test_a_fit_is_repeated_and_a_fitted_city_is_fitted_anew(town, own, tmp_path):
    counted = {edge: round(value * 4 / 3) for edge, value in own.items()}
    drawn = counts.fit(town, counted, tmp_path / "new", seed=1)
    assert counts.fit(town, counted, tmp_path / "again", seed=1) == drawn
    assert (tmp_path / "again/SHA256SUMS").read_text() == (tmp_path / "new/SHA256SUMS").read_text()
    twice = counts.fit(catalogue.open_folder(tmp_path / "new"), counted, tmp_path / "twice", seed=1)
    assert counts.agreement(twice, counted).good_share > 0.85


def test_counts_where_no_vehicle_passes(town, tmp_path):
    with pytest.raises(ValueError, match="no vehicle of town passes"):
        counts.fit(town, {"elsewhere": 5.0}, tmp_path / "new", 1)
    assert not (tmp_path / "new").exists()


def test_added_vehicles_depart_at_any_time(town, own, tmp_path):
    """Three times the vehicles: half of them in each half of the time (0.5 with a standard deviation of 0.02 or so).

    `routeSampler` gives vehicles that it adds the late ones of its sorted times: 0.39 of all were in the first half.
    """
    counts.fit(town, {edge: 3 * value for edge, value in own.items()}, tmp_path / "new", seed=1)
    rows = ET.fromstring(gzip.decompress((tmp_path / "new/demand.rou.xml.gz").read_bytes())).iter("vehicle")
    times_s = [float(row.get("depart")) for row in rows if row.get("type") != "bicycle"]
    assert len(times_s) > 2 * town.vehicles_per_hour
    assert np.mean(np.array(times_s) < town.end_s / 2) == pytest.approx(0.5, abs=0.05)
