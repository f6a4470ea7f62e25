"""Through traffic at gates, and boxes cut out of extracts: rates and shares by hand."""

import gzip
import tomllib

import pytest

from cosim.addons.netbuild import gate_flows, osm_files
from cosim.addons.netbuild.build_from_osm import from_osm
from sumo_nets import catalogue, demand, density
from tests.addons.netbuild.test_build_from_osm import grid_town


def test_the_rates_by_hand():
    """51,900 vehicles a day, 1 / sum(BY_HOUR) = 7.4 % of them in the busiest hour, half each way, on 2.3 lanes."""
    busiest_p = 1 / sum(density.BY_HOUR)
    assert busiest_p == pytest.approx(0.074, abs=0.0005)
    assert gate_flows.PER_HOUR_AND_LANE["motorway"] == pytest.approx(51_900 * busiest_p / 2 / 2.3, rel=0.01)
    assert gate_flows.PER_HOUR_AND_LANE["trunk"] == pytest.approx(9_650 * busiest_p / 2, rel=0.01)
    assert gate_flows.HEAVY_P["motorway"] == pytest.approx(7010 / 47_100, abs=0.002)
    assert gate_flows.rates_at(3)["motorway"] == pytest.approx(830 * 0.06)


def street(name, start, end, middle, is_entry, is_exit):
    return demand.Street(name, start, end, "motorway", 500.0, middle, 2, is_entry, is_exit, False, False)


def test_departures_are_as_many_as_stated():
    """Two lanes at 830 an hour over ten hours: 16,600 within three standard deviations; 15 % trucks, 8 % vans."""
    entry, gate = street("in", "a", "b", (0, 0), True, False), street("out", "b", "c", (500, 0), False, True)
    trips = gate_flows.gate_trips([gate_flows.GateFlow(entry, 1660.0, ((gate, 1.0),))], 1, 36_000.0)
    assert len(trips) == pytest.approx(16_600, abs=3 * 16_600**0.5)
    assert sum('type="truck"' in trip for trip in trips) / len(trips) == pytest.approx(0.15, abs=0.01)
    assert all('from="in" to="out"' in trip for trip in trips)
    assert len({trip.split('"')[1] for trip in trips}) == len(trips)


def test_a_box_cut_out_of_an_extract(tmp_path):
    """Half of the grid town: its recipe names the box, and the network reaches as far."""
    path = tmp_path / "town.osm.gz"
    path.write_bytes(gzip.compress(grid_town().encode()))
    whole, half = osm_files.read(path), osm_files.read(path, (8.999, 49.999, 9.0030, 50.1))
    assert half.box == (8.999, 49.999, 9.0030, 50.1) and 0 < len(half.ways) < len(whole.ways)
    assert all(node in half.place for way in half.ways.values() for node in way.nodes)  # ways are whole
    from_osm(path, tmp_path / "half", density.Density(per_km=4.0), box=(8.999, 49.999, 9.0050, 50.1))
    recipe = tomllib.loads((tmp_path / "half" / "recipe.toml").read_text())
    assert recipe["source"]["box"] == [8.999, 49.999, 9.005, 50.1]
    assert catalogue.open_folder(tmp_path / "half").vehicles_per_hour > 0
    with pytest.raises(ValueError, match=r"has no ways in the box 7,50,8,51: .* The file reaches over 9,50"):
        osm_files.read(path, (7.0, 50.0, 8.0, 51.0))
