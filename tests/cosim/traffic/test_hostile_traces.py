"""Positions that cannot be: a trace or a run is refused in one line that names step, actor and value, or it runs."""

import gzip
import os

import numpy as np
import pytest

from cosim.traffic.frame import Frame, TrafficError
from cosim.traffic.params import TrafficParams
from cosim.traffic.scenario import find
from results.archive import open_run
from tests.cosim.traffic.worlds import collect, registry
from tests.drive import simulate

HEAD = "timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_z;vehicle_angle;vehicle_speed;vehicle_type\n"


def csv(folder, **bad):
    """Ten seconds of five cars in a row; the third is `bad` at 4 s."""
    rows = []
    for t in range(10):
        for k in range(5):
            row = {"x": 100.0 + 10 * t, "y": 100.0 + 8 * k, "z": 0.0, "angle": 90.0, "speed": 10.0}
            if (t, k) == (4, 2):
                row |= bad
            rows.append(f"{t};car{k};{row['x']};{row['y']};{row['z']};{row['angle']};{row['speed']};car\n")
    path = folder / "fcd.csv"
    path.write_text(HEAD + "".join(rows))
    return path


BAD = [("x", 3e8), ("y", -3e8), ("x", 1e300), ("x", -1e7), ("z", 1e6), ("angle", 1e300), ("speed", 1e30), ("x", 2e5)]


@pytest.mark.parametrize(("scenario", "column", "value"), [("helsinki", "x", 2e5), *((None, *bad) for bad in BAD)])
def test_one_position_that_cannot_be(tmp_path, scenario, column, value):
    path = csv(tmp_path, **{column: value})
    found = find(str(path)) if scenario is None else find(scenario, str(path))
    with pytest.raises(TrafficError, match=r"step 5: 'car2' has ") as caught:
        collect(found.traffic(TrafficParams(), registry()), 0, 10)
    assert "fcd.csv" in str(caught.value) and "\n" not in str(caught.value)
    if column in "xyz":
        assert f" {column} = " in str(caught.value)


def test_all_positions_elsewhere(tmp_path):
    path = tmp_path / "fcd.csv"
    path.write_text(HEAD + "".join(f"{t};a;{3e8 + t};0;0;90;1;car\n" for t in range(20)))
    with pytest.raises(TrafficError, match="no place on Earth"):
        find(str(path)).traffic(TrafficParams(), registry())


def test_projected_coordinates_get_an_origin_nearby(tmp_path):
    """UTM coordinates without a network: 1/256 m are kept, and the summary says where the origin is."""
    path = tmp_path / "fcd.csv"
    path.write_text(HEAD + "".join(f"{t};a;{385_123.5 + t};6672000.25;0;90;1;car\n" for t in range(20)))
    traffic = find(str(path)).traffic(TrafficParams(), registry())
    worlds = collect(traffic, 0, 20)
    assert traffic.report()["origin_m"] == [385_000.0, 6_672_000.0]
    front_m = worlds[1]["xyz_m"][0, 0] + worlds[1]["lwh_m"][0, 0] / 2
    assert front_m == pytest.approx(123.5, abs=1 / 256) and worlds[1]["xyz_m"][0, 1] == 0.25


def test_what_is_allowed_runs(tmp_path):
    """As far as a trace without a network may reach, with LiDARs, radio and trust."""
    path = csv(tmp_path, x=-99_000.0)
    sets = (f"traffic.scenario={path}", "fleet.penetration_p=1", "traffic.duration_s=8")
    actors = open_run(simulate(tmp_path / "run", *sets)).table("actors")
    assert (actors.groupby("step").size() == 5).all() and np.ptp(actors.x_m) > 90_000


def test_as_far_as_a_network_allows(tmp_path):
    path = csv(tmp_path, x=-9_900.0)
    sets = ("traffic.scenario=helsinki", f"traffic.trace={path}", "fleet.penetration_p=1", "traffic.duration_s=8",
            "traffic.warmup_s=0")  # fmt: skip
    actors = open_run(simulate(tmp_path / "run", *sets)).table("actors")
    assert (actors.groupby("step").size() == 5).all() and np.ptp(actors.x_m) > 9_000


def test_the_frame_by_hand():
    frame = Frame("traffic.trace = t", (1000.0, 0.0), (900.0, -50.0, 1100.0, 50.0))
    inside, zero = np.array([[10_099.0, 0.0, 0.0]]), np.zeros(1)
    frame.check(3, ["a"], np.array([0]), inside, zero, zero)
    with pytest.raises(
        TrafficError, match=r"traffic\.trace = t: step 3: 'a' has x = 11102 m\. Actors should be within"
    ):
        frame.check(3, ["a"], np.array([0]), inside + [3.0, 0.0, 0.0], zero, zero)


def test_two_columns_of_one_name(tmp_path):
    path = tmp_path / "fcd.csv"
    path.write_text(HEAD.replace("vehicle_speed", "vehicle_x") + "0;a;1;1;0;90;1;car\n")
    with pytest.raises(TrafficError, match="the column vehicle_x twice"):
        find(str(path)).traffic(TrafficParams(), registry())


@pytest.mark.parametrize("name", ["fcd.xml", "fcd.csv", "fcd.parquet", "fcd.xml.gz"])
def test_pipes_and_devices_are_no_traces(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(ValueError, match="folder or trace"):
        find(str(tmp_path / name))
    with pytest.raises(ValueError, match="neither a run folder nor a trace"):
        find("helsinki", str(tmp_path / name))
    with pytest.raises(ValueError, match="neither a run folder nor a trace"):
        find("helsinki", "/dev/zero")


@pytest.mark.parametrize("name", ["fcd.xml.gz", "fcd.csv.gz"])
def test_a_decompression_bomb_is_not_read_to_its_end(tmp_path, name):
    head = '<fcd-export><timestep time="0">' if "xml" in name else HEAD
    blanks = gzip.compress((b" " if "xml" in name else b"\n") * (1 << 20))
    (tmp_path / name).write_bytes(gzip.compress(head.encode()) + 400 * blanks)
    with pytest.raises(TrafficError, match="expands to more than 200 times its size"):
        find(str(tmp_path / name)).traffic(TrafficParams(), registry())


@pytest.mark.parametrize(("size", "says"), [('height="0"', "height = 0 m"), ('length="inf"', "length = inf m")])
def test_a_type_of_a_trace_has_a_size(tmp_path, size, says):
    from tests.cosim.traffic import mixed_scenario

    config = mixed_scenario.write(tmp_path)
    text = (tmp_path / "odd.rou.xml").read_text(encoding="utf-8")
    (tmp_path / "odd.rou.xml").write_text(text.replace('id="train"', f'id="train" {size}'), encoding="utf-8")
    with pytest.raises(ValueError, match=says):
        find(str(config))
