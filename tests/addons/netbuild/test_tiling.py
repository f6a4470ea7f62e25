"""A tiled city has what the city has, once per copy."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.addons.netbuild.tiling import tile
from cosim.traffic.fcd import is_observed, timesteps
from cosim.traffic.scenario import find
from sumo_nets.footprints import read_footprints
from sumo_nets.network import lanes
from tests.drive import assert_refused, cosim

TRACE = """timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehicle_speed
0.00;a&b;100.25;200.5;90;car;10
0.00;p;300;400;0;pedestrian;1
1.00;p;300;401;0;pedestrian;1
"""


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """Its network is in a folder with a comma, at which SUMO cuts lists."""
    folder = tmp_path_factory.mktemp("here, there")
    (folder / "fcd.csv").write_text(TRACE)
    found = find("helsinki", str(folder / "fcd.csv"))
    return replace(found, net=Path(shutil.copy(found.net, folder)))


def test_every_copy_has_all_streets_buildings_and_actors(city, tmp_path):
    assert tile(city, 1, 2, tmp_path / "two") == 4
    two = find(str(tmp_path / "two"), str(tmp_path / "two" / "fcd.parquet"))
    west, south, east, north = city.bounds_m
    by_m = np.ceil(north - south)
    assert two.name == "two" and two.bounds_m == pytest.approx((west, south, west + np.ceil(east - west), 2 * by_m))

    first, second = timesteps(two.trace)
    assert (first.time_s, second.time_s) == (0, 1) and second.names == ["0.p", "1.p"]
    assert first.names == ["0.a&b", "0.p", "1.a&b", "1.p"] and first.types == ["car", "pedestrian"] * 2
    assert first.front_m.tolist() == [
        [100.25, 200.5, 0],
        [300, 400, 0],
        [100.25, 200.5 + by_m, 0],
        [300, 400 + by_m, 0],
    ]

    old, new = lanes(city.net), lanes(two.net)
    assert len(new) == 2 * len(old)
    middle = np.array([lane.line_m.mean(axis=0)[1] for lane in new])
    assert (middle > by_m).sum() == pytest.approx(len(old), abs=3)

    one, both = ([f for path in of.buildings for f in read_footprints(path)] for of in (city, two))
    assert len(both) == 2 * len(one)
    assert np.allclose(both[-1].outer, one[-1].outer + [0, by_m], atol=0.006) and both[-1].top_z_m == one[-1].top_z_m
    types = (tmp_path / "two" / "vtypes.add.xml").read_text()
    assert types.count("<vType") == 2
    assert "OpenStreetMap" in (tmp_path / "two" / "ATTRIBUTION.txt").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("tiles", "says"),
    [
        ("1x1", "give 2 copies or more"),
        ("0x3", "give 2 copies"),
        ("x", "two numbers"),
        ("99x9", "65 km"),
        ("1000x1", "65 km"),
    ],
)
def test_what_cannot_be_tiled_is_said_in_one_line(tiles, says, city, tmp_path):
    words = ("nets", "tile", "helsinki", "--trace", str(city.trace), "--tiles", tiles, "--out", str(tmp_path / "out"))
    ended = cosim(*words)
    assert_refused(ended, says)
    assert not list(tmp_path.iterdir())


def test_a_trace_in_degrees_is_placed_by_the_projection(city, tmp_path):
    """A point of the city in degrees, by the inverse projection: it lies there in both copies, not at 25 and 60 m."""
    net = city.location()
    here = net.projection.of_world(np.array([[500.0, 800.0]]))
    row = f"1;{here.longitude_deg[0]:.8f};{here.latitude_deg[0]:.8f};90;car;10\n"
    (tmp_path / "geo.csv").write_text(TRACE.splitlines(keepends=True)[0] + "0.00;" + row + "1.00;" + row)
    tile(replace(city, trace=tmp_path / "geo.csv"), 2, 1, tmp_path / "two")
    west, _, east, _ = city.bounds_m
    for timestep in timesteps(tmp_path / "two" / "fcd.parquet"):
        wanted = [[500, 800], [500 + np.ceil(east - west), 800]]
        assert np.allclose(timestep.front_m[:, :2], wanted, atol=0.02)


def test_copies_of_recorded_positions_are_recorded_positions(city, tmp_path):
    """Their vehicles come into view and leave it, and do not enter and leave the road."""
    positions = tmp_path / "positions.csv"
    positions.write_text("id,time,x,y\na,0,100,200\na,1,110,200\n")
    assert cosim("trace", str(positions), "--out", str(tmp_path / "seen.parquet")).returncode == 0
    for trace, is_seen in ((tmp_path / "seen.parquet", True), (city.trace, False)):
        tile(replace(city, trace=trace), 1, 2, tmp_path / trace.stem)
        assert is_observed(tmp_path / trace.stem / "fcd.parquet") == is_seen


def test_an_empty_trace_is_not_tiled(city, tmp_path):
    (tmp_path / "fcd.csv").write_text(TRACE.splitlines(keepends=True)[0])
    with pytest.raises(ValueError, match="no actor is ever on the road"):
        tile(replace(city, trace=tmp_path / "fcd.csv"), 2, 1, tmp_path / "two")


def test_a_folder_that_cannot_be_made_is_said_before_the_work(city, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"cannot be made: .*file is no folder to write in"):
        tile(city, 2, 1, tmp_path / "file" / "new" / "two")


def test_a_run_is_no_trace_to_tile(city, tmp_path):
    with pytest.raises(ValueError, match="a trace of SUMO's"):
        tile(find("helsinki"), 2, 2, tmp_path / "out")
