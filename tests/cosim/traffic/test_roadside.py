"""Roadside units: where they stand, and that they are observers and no traffic."""

import numpy as np
import pytest

from cosim.traffic.actors import ActorRegistry
from cosim.traffic.fleet import FleetParams
from cosim.traffic.frame import Frame
from cosim.traffic.objects import ObjectParams, Placed, WithObjects
from cosim.traffic.roadside import NO_UNITS, RoadsideParams, drawn, place
from sensors.scene import Shape
from sumo_nets.network import Junction, Streets
from tests.cosim.traffic.test_objects import Parade
from tests.refusals import refused_in_one_line

JUNCTIONS = [
    Junction((100.0, 100.0, 7.0), 4, "a"), Junction((120.0, 100.0, 7.0), 9, "b"), Junction((500.0, 400.0, 2.0), 6, "c")
]  # fmt: skip
TOWN = Streets(JUNCTIONS, (0.0, 0.0, 1000.0, 500.0))
FRAME = Frame(bounds_m=(0.0, 0.0, 1000.0, 1000.0))


def test_places_by_hand():
    """One by its position, above the nearest street; one at a junction; the two busiest that are 100 m apart."""
    units = place(
        [RoadsideParams(at=(480.0, 380.0), heading_deg=90.0, height_m=4.0, sensor="vlp16", trusted=False)],
        TOWN, (10.0, 20.0), 4,
    )  # fmt: skip
    assert units.ground_m.tolist() == [[470, 360, 2]] and units.height_m.tolist() == [4.0]
    np.testing.assert_allclose(units.yaw_rad, np.pi / 2)
    assert units.sensor == ("vlp16",) and not units.trusted[0] and units.names == ("roadside/480.00/380.00",)
    assert place([RoadsideParams(at=(1020.0, 380.0))], TOWN, (0, 0), 4).ground_m[0, 0] == 1020, "beside the last street"
    assert place([RoadsideParams(junction="a")], TOWN, (0, 0), 4).ground_m.tolist() == [[100, 100, 7]]
    assert place([RoadsideParams(junctions=2)], TOWN, (0, 0), 4).ground_m[:, 0].tolist() == [120, 500]
    listed = RoadsideParams(junctions=2, choose="listed", listed=("c", "a", "b"))
    assert place([listed], TOWN, (0, 0), 4).ground_m[:, 0].tolist() == [500, 100]
    assert place([RoadsideParams(junctions=0)], TOWN, (0, 0), 4).ground_m.shape == NO_UNITS.ground_m.shape


def test_random_places_depend_on_names_and_seed_alone_and_more_add_to_fewer():
    orders = {tuple(j.name for j in drawn(TOWN, seed)) for seed in range(30)}
    assert len(orders) == 6  # every order of three occurs
    assert drawn(TOWN, 3) == drawn(Streets(JUNCTIONS[::-1], TOWN.bounds_m), 3)
    one, two = (
        place([RoadsideParams(junctions=n, choose="random")], TOWN, (0, 0), 3).names for n in (1, 2)
    )  # fmt: skip
    assert two[:1] == one and len(two) == 2


@pytest.mark.parametrize(
    ("params", "words"),
    [
        ({"at": (1200.0, 60.0)}, r"roadside\.0\.at = \[1200, 60\] m lies outside the network"),
        ({"junction": "nowhere"}, 'no junction "nowhere"'),
        ({"junctions": 3}, "only 2 junctions that are 100 m from each other"),
        ({"junctions": 4, "choose": "random"}, "only 3 junctions"),
        ({"junctions": 3, "choose": "listed", "listed": ("a", "b")}, r"only 2 junctions in roadside\.0\.listed"),
        ({}, "no place given"),
        ({"at": (1.0, 1.0), "junction": "a"}, "at and junction given"),
        ({"junctions": 1, "choose": "listed"}, "Set listed"),
    ],
)
def test_where_they_cannot_stand(params, words):
    with refused_in_one_line(words):
        place([RoadsideParams(**params)], TOWN, (0, 0), 4)


def test_two_at_one_place_are_refused():
    with pytest.raises(ValueError, match=r"two \[\[roadside\]\] units stand at 100\.00/100\.00"):
        place([RoadsideParams(junction="a"), RoadsideParams(at=(100.0, 100.0))], TOWN, (0, 0), 4)


def test_units_are_equipped_never_attack_and_leave_the_fleet_alone():
    """Nobody is drawn at penetration 0, and all who are drawn attack at a share of 1."""
    for penetration, expected in ((0.0, [False, False, True]), (1.0, [True, False, True])):
        registry = ActorRegistry(FleetParams(penetration_p=penetration), 1, (1.0,), {"roadside/100.00/100.00": 0})
        units = place([RoadsideParams(junction="a", height_m=5.0)], TOWN, (0, 0), 4)
        placed = Placed.of([ObjectParams(at_m=(50.0, 50.0))], FRAME, 1.0, units=units)
        world = WithObjects(Parade(registry), placed, registry, FRAME).advance()
        assert world.equipped.tolist() == expected and world.is_roadside.tolist() == [False, False, True]
        assert world.attack.tolist() == [int(penetration), 0, 0]
        assert world.shape[2] == Shape.ROADSIDE_UNIT and world.boxes.xyz_m[2].tolist() == [100, 100, 9.5]
        assert world.boxes.lwh_m[2, 2] == 5.0  # the sensor is on top of it, 5 m above the street at 7 m
