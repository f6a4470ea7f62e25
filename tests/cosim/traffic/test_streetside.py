"""Parked cars and trees: where they stand, how many there are, and what a run makes of them."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from cosim.base.codes import PARKED
from cosim.config.config import load
from cosim.runs.check import check
from cosim.traffic.scenario import find
from cosim.traffic.streetside import ParkedParams, Streetside, TreeParams
from results.archive import open_run
from results.measure import measure
from sensors.scene import Scene
from sumo_nets.streetside import Kerb
from tests.cosim.traffic import crossing
from tests.drive import drive, noted
from tests.hostile.scenes import write_trace


def street(n=100, length_m=616.0, parking=None) -> Streetside:
    """Straight streets 50 m apart, each a lane of 3.2 m; 100 places for a car each: 8 m free at either end."""
    lines = [np.array([[0.0, 50.0 * k, 0.0], [length_m, 50.0 * k, 0.0]]) for k in range(n)]
    areas = np.array([shapely.LineString(line[:, :2]).buffer(1.6, cap_style="flat") for line in lines])
    kerbs = [Kerb(f"e{k}", line, 1.6, parking) for k, line in enumerate(lines)]
    return Streetside(kerbs, areas, (0.0, 0.0), 3)


def test_numbers_are_those_of_the_rates():
    """10,000 places of 6 m, of which 0.6 are taken at 10 per 100 m in half of the streets: 3,000, give or take the
    spread of 100 streets; one in ten is a van."""
    found = street().parked(Scene.empty(), ParkedParams(per_100_m=10, streets_p=0.5))
    assert len(found) == pytest.approx(3000, rel=0.25)
    edges = {name.split("/")[1] for name in found}
    assert len(found) / len(edges) == pytest.approx(60, rel=0.03)
    assert np.mean([one.vehicle_class == "van" for one in found.values()]) == pytest.approx(0.1, abs=0.02)


def test_a_higher_rate_adds_cars_and_moves_none():
    few, many = (
        street(20).parked(Scene.empty(), ParkedParams(per_100_m=r, streets_p=p)) for r, p in ((4, 0.5), (9, 1))
    )
    assert len(few) < len(many) and all(many[name] == few[name] for name in few)


def test_a_higher_rate_takes_no_car_away_where_kerbs_meet():
    """Twenty kerbs that lie upon one another: of two cars that overlap, the one stays that came at a lower rate. All
    that stay overlap none, and each that goes overlaps one that came before it."""
    line = np.array([[0.0, 0.0, 0.0], [616.0, 0.0, 0.0]])
    near = Streetside([Kerb(f"e{k}", line + [0.7 * k, 0, 0], 1.6, None) for k in range(20)], street(1).areas, (0, 0), 3)
    before: dict = {}
    for rate in (0.3, 1, 2, 4, 8, 16):
        found = near.parked(Scene.empty(), ParkedParams(per_100_m=rate, vans_p=0.0))
        assert before.items() <= found.items()
        x_m = np.sort([one.at_m[0] for one in found.values()])
        assert np.diff(x_m).min() > 4.5
        before = found
    assert len(before) > 616 / (4.5 * 2 + 1) and np.diff(x_m).max() < 2 * 4.5 + 0.7


def test_cars_stand_beside_the_lane_by_hand():
    """South of a street that leads east: lane 1.6 m, gap 0.3 m, half of the car 0.925 m. The first place is from 8 m
    to 14 m."""
    found = street(1).parked(Scene.empty(), ParkedParams(per_100_m=16, vans_p=0.0))
    at = np.array([one.at_m for one in found.values()])
    assert (at[:, 1] == pytest.approx(-2.825)) and np.allclose((at[:, 0] - 11) % 6 % 6, 0, atol=1e-9)
    assert at[:, 0].min() >= 11 and at[:, 0].max() <= 616 - 11
    assert {one.yaw_deg for one in found.values()} == {0.0}


def test_with_left_hand_traffic_cars_and_trees_stand_on_the_left_by_hand():
    """North of the same street; the draws are the same, so that it is the mirror image."""
    right, left = street(3), street(3)
    left = replace(left, kerbs=[kerb._replace(is_left=True) for kerb in left.kerbs])
    params = ParkedParams(per_100_m=9)
    here, there = (one.parked(Scene.empty(), params) for one in (right, left))
    assert here.keys() == there.keys() and len(here) > 100
    for name, car in here.items():
        row_m = 50.0 * round(car.at_m[1] / 50)
        assert there[name].at_m == (car.at_m[0], pytest.approx(2 * row_m - car.at_m[1]))
        assert there[name].yaw_deg == car.yaw_deg
    feet = (one.planted(Scene.empty(), TreeParams(per_100_m=9)) for one in (right, left))
    np.testing.assert_allclose(*(np.abs((foot[:, 1] + 25) % 50 - 25) for foot in feet))


LEFT = """<nodes><node id="a" x="0" y="0"/><node id="b" x="300" y="0"/>
<node id="c" x="300" y="60"/><node id="d" x="0" y="60"/></nodes>"""
BOTH_WAYS = """<edges><edge id="ab" from="a" to="b"/><edge id="ba" from="b" to="a"/>
<edge id="cd" from="c" to="d"/><edge id="dc" from="d" to="c"/></edges>"""


def test_a_left_hand_city_has_as_many_parked_cars_as_its_mirror_image(tmp_path):
    """Lanes of 3.2 m on either side of y = 0: the edge at 3.2 m, 0.3 m of gap, half a car of 1.85 m."""
    found = {}
    for name, flags in {"left": ("lefthand",), "right": ()}.items():
        (tmp_path / name).mkdir()
        scenario = find(str(crossing.write(tmp_path / name, *flags, nodes=LEFT, edges=BOTH_WAYS)))
        found[name] = scenario.parked(ParkedParams(per_100_m=10, vans_p=0.0), scenario.city(), 1)
    assert len(found["left"]) == len(found["right"]) > 80
    y_m = {"ab": 4.425, "ba": -4.425, "cd": 55.575, "dc": 64.425}
    for name, car in found["left"].items():
        assert car.at_m[1] == pytest.approx(y_m[name.split("/")[1]], abs=0.01)


def test_a_section_that_places_nothing_is_noted(tmp_path):
    """Blocks of houses stand beside all streets."""
    shape = "-400,-400 800,-400 800,800 -400,800"
    (tmp_path / "all.add.xml").write_text(f'<additional><poly id="b" type="building" shape="{shape}"/></additional>')
    config = crossing.write(tmp_path, files="all.add.xml")
    notes = noted(f"traffic.scenario={config}", "parked.per_100_m=5", "trees.per_100_m=5")
    assert any("[parked] places no car" in note for note in notes)
    assert any("[trees] places no tree" in note for note in notes)


def test_tags_decide_before_chance():
    assert not street(5, parking=False).parked(Scene.empty(), ParkedParams(per_100_m=9))
    assert street(5, parking=True).parked(Scene.empty(), ParkedParams(per_100_m=9, streets_p=0.0))


def test_nothing_stands_on_lanes_in_junctions_in_buildings_or_in_each_other():
    helsinki = find("helsinki")
    city = helsinki.city(TreeParams(per_100_m=8), 4)
    cars = helsinki.parked(ParkedParams(per_100_m=14), city, 4)
    beside = Streetside.of(helsinki.net, helsinki.origin_m, 4, "parked")
    x, y = np.array([one.at_m for one in cars.values()]).T
    length, width = np.array([one.lwh_m[:2] for one in cars.values()]).T
    yaw = np.radians([one.yaw_deg for one in cars.values()])
    east = np.array([1, -1, -1, 1]) * length[:, None] / 2, np.array([1, 1, -1, -1]) * width[:, None] / 2
    corner = x[:, None] + np.cos(yaw)[:, None] * east[0] - np.sin(yaw)[:, None] * east[1]
    other = y[:, None] + np.sin(yaw)[:, None] * east[0] + np.cos(yaw)[:, None] * east[1]
    body = shapely.polygons(np.stack([corner, other], axis=-1))
    first = city.trees.ptr[:-1]
    trunk = shapely.points(city.trees.x_m[first], city.trees.y_m[first])
    streets = shapely.transform(beside.areas, lambda xy: xy - np.array(helsinki.origin_m))
    assert len(body) > 1000 and len(trunk) > 1000
    for taken in (streets, city.footprints):
        tree = shapely.STRtree(taken)
        assert not tree.query(body, predicate="intersects").size and not tree.query(trunk, predicate="within").size
    tree = shapely.STRtree(body)
    one, another = tree.query(body, predicate="intersects")
    assert (one == another).all() and not tree.query(trunk, predicate="intersects").size
    assert helsinki.parked(ParkedParams(), city, 4) == {}


@pytest.mark.verify
def test_a_run_with_parked_cars(tmp_path):
    """They are actors that never move and are never equipped, and a replay of the run has its own.

    They are no traffic: encounters and the safety of driving are as without them.
    """
    common = (
        *("traffic.duration_s=8", "traffic.warmup_s=120", "attacks=[]", "sensing=false"),
        'encounters=[{pairs="all", pedestrians=true}]',
    )
    run = open_run(drive(tmp_path / "a", *common, "parked.per_100_m=4", "trees.per_100_m=4"))
    cars = run.vehicles[run.vehicles.sumo_id.str.startswith(PARKED)]
    assert len(cars) > 200 and not cars.equipped.any()
    poses = run.actors[run.actors.actor.isin(cars.vehicle)]
    assert (poses.speed_mps == 0).all() and (poses.groupby("actor").x_m.nunique() == 1).all()
    again = open_run(drive(tmp_path / "b", *common, "traffic.warmup_s=0", f"traffic.trace={run.path}"))
    assert set(again.vehicles.sumo_id) == set(run.vehicles.sumo_id) - set(cars.sumo_id)
    assert len(again.encounters) > 20
    wanted = ("encounters.n", "encounters.per_vehicle_h", "safety.travel_time.s_per_km", "safety.ttc.per_km")
    found = [measure(one).set_index("metric").value.loc[list(wanted)] for one in (run, again)]
    assert found[0].tolist() == found[1].tolist()


def test_what_cannot_be():
    with pytest.raises(ValueError, match=r"trees.height_m = 2 m is not above trees.crown_base_m = 3 m"):
        TreeParams(height_m=2)
    with pytest.raises(ValueError, match=r"\[parked\]: a trace without streets has no kerbs"):
        Streetside.of(None, (0.0, 0.0), 1, "parked")


@pytest.mark.parametrize("sets", [["parked.per_100_m=3"], ["trees.per_100_m=3"], ["trees.from_map=true"]])
def test_the_check_of_a_config_refuses_what_has_no_place(tmp_path, sets):
    words = [f"traffic.scenario={write_trace(tmp_path)}", *sets]
    with pytest.raises(ValueError, match="a trace without streets has no kerbs"):
        check(load(None, words))


def test_a_map_without_trees_is_refused_or_said():
    with pytest.raises(ValueError, match=r"trees.from_map = true: the polygon files of helsinki contain no trees"):
        check(load(None, ["trees.from_map=true"]))
    (note,) = noted("trees.from_map=true", "trees.per_100_m=3")
    assert note == "note: trees.from_map has no effect: the polygon files of helsinki contain no trees."
