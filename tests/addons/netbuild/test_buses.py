"""Bus lines on a straight street of two ways of 1,000 m, 7 and 8, which is driven in both directions."""

from types import SimpleNamespace

import pytest

from cosim.addons.netbuild.buses import lines_of, stops_xml
from sumo_nets import osm

PLACE = {1: (0, 0), 2: (1000, 0), 3: (2000, 0), 21: (250, -5), 22: (760, -5), 23: (790, -5), 24: (1500, 0)}
"""Ends of the ways, signs beside the southern lane, which leads east, and one in the middle of the street."""


class Part(SimpleNamespace):
    """An edge or a lane, as sumolib has it."""

    __hash__ = object.__hash__


def edge(name, *shape_m):
    """An edge with one lane."""
    lane = Part(
        getID=lambda: f"{name}_0", getShape=lambda: shape_m, allows=lambda kind: True,
        getParam=lambda key, other: name.lstrip("-"),
    )  # fmt: skip
    return Part(getID=lambda: name, getLength=lambda: 1000.0, getLanes=lambda: [lane], allows=lane.allows)


EDGES = {
    one.getID(): one
    for one in (
        edge("7", (0, -2), (1000, -2)), edge("8", (1000, -2), (2000, -2)),
        edge("-8", (2000, 2), (1000, 2)), edge("-7", (1000, 2), (0, 2)),
    )
}  # fmt: skip
NEXT = {("7", "8"), ("-8", "-7")}


def way(begin, end, **_):
    if (begin.getID(), end.getID()) in NEXT:
        return (begin, end), 2000.0
    return None, float("inf")


NET = SimpleNamespace(getEdges=lambda: list(EDGES.values()), getEdge=EDGES.get, getShortestPath=way)


def line(number, ref, ways, *signs):
    members = (*(("w", way, "") for way in ways), *(("n", sign, "stop") for sign in signs))
    return osm.Relation(number, members, {"route": "bus", "ref": ref})


def found(*lines):
    town = osm.Extract()
    town.place.update({node: (25 + x * 2 / 111_195, 60 + y / 111_195) for node, (x, y) in PLACE.items()})
    town.ways.update({7: osm.Way(7, (1, 2), {}), 8: osm.Way(8, (2, 3), {})})
    town.relations.update({one.id: one for one in lines})
    return lines_of(town, NET, lambda nodes: {node: PLACE[node] for node in nodes}, 500.0)


def test_a_bus_calls_at_all_stops_of_a_long_lane():
    # A stop has 22 m, half of them before its sign. The signs at 760 and 790 m are one stop: the smaller number.
    (one,), stops = found(line(1, "5", (7, 8), 23, 22, 21))
    assert one.stops == ("stop21", "stop22")
    assert [(stop.lane, stop.start_m, stop.end_m) for stop in stops] == [("7_0", 239, 261), ("7_0", 749, 771)]


def test_one_sign_for_both_directions_is_two_stops():
    lines, stops = found(line(1, "5", (7, 8), 24), line(2, "5", (8, 7), 24))
    assert {one.edges: one.stops for one in lines} == {("-8", "-7"): ("stop24",), ("7", "8"): ("stop24.1",)}
    assert [stop.lane for stop in stops] == ["-8_0", "8_0"]
    assert stops_xml(stops).count('id="stop24"') == 1


@pytest.mark.parametrize(("ref", "n"), [("9", 1), ("N", 0), ("9N", 0), ("N9", 0), ("N 19", 0), ("NW1", 1)])
def test_night_lines_do_not_drive_by_day(ref, n):
    assert len(found(line(1, ref, (7, 8)))[0]) == n
