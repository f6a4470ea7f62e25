"""Bus lines on a straight street of two ways of 1,000 m, 7 and 8, which is driven in both directions."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from math import hypot
from types import SimpleNamespace

import pytest

from cosim.addons.netbuild.buses import departures, lines_of, stops_xml
from sumo_nets import osm

PLACE = {1: (0, 0), 2: (1000, 0), 3: (2000, 0), 21: (250, -5), 22: (760, -5), 23: (790, -5), 24: (1500, 0)}
PLACE |= {4: (1000, 1000), 5: (3000, 0)}
"""Ends of the ways, signs beside the southern lane, which leads east, and one in the middle of the street."""


class Part(SimpleNamespace):
    """An edge or a lane, as sumolib has it."""

    __hash__ = object.__hash__


def edge(name, *shape_m, nodes=None, ways=None):
    """An edge with one lane of its own way, or of `ways`, between its ends on the axis of the street or nodes."""
    lane = Part(
        getID=lambda: f"{name}_0", getShape=lambda: shape_m, allows=lambda kind: True,
        getParam=lambda key, other: ways or name.lstrip("-").partition("#")[0],
    )  # fmt: skip
    begin, end = nodes or (shape_m[0][0], shape_m[-1][0])
    return Part(
        getID=lambda: name, getLength=lambda: hypot(*(a - b for a, b in zip(shape_m[0], shape_m[-1], strict=True))),
        getShape=lambda: shape_m, getLanes=lambda: [lane], allows=lane.allows, getFromNode=lambda: begin,
        getToNode=lambda: end,
    )  # fmt: skip


def net(*edges):
    """A network of edges, where nobody turns round."""
    for one in edges:
        onward = [o for o in edges if o.getFromNode() == one.getToNode() and o.getToNode() != one.getFromNode()]
        one.getAllowedOutgoing = lambda kind, onward=onward: dict.fromkeys(onward)

    def path(begin, end, **_):
        ways = [(begin,)]
        for way in ways:
            ways += [(*way, onward) for onward in way[-1].getAllowedOutgoing("bus") if onward not in way]
        found = [(sum(leg.getLength() for leg in way), way) for way in ways if way[-1] is end]
        metres, way = min(found, key=lambda one: one[0], default=(float("inf"), None))
        return way, metres

    by_name = {one.getID(): one for one in edges}
    return SimpleNamespace(getEdges=lambda: list(edges), getEdge=by_name.get, getShortestPath=path)


NET = net(
    edge("7", (0, -2), (1000, -2)), edge("8", (1000, -2), (2000, -2)),
    edge("-8", (2000, 2), (1000, 2)), edge("-7", (1000, 2), (0, 2)),
)  # fmt: skip


def line(number, ref, ways, *signs):
    ways = (way if isinstance(way, tuple) else (way, "") for way in ways)
    members = (*(("w", *way) for way in ways), *(("n", sign, "stop") for sign in signs))
    return osm.Relation(number, members, {"route": "bus", "ref": ref, "public_transport:version": "2"})


def found(*lines, net=NET, ways=((7, 1, 2), (8, 2, 3))):
    town = osm.Extract()
    town.place.update({node: (25 + x * 2 / 111_195, 60 + y / 111_195) for node, (x, y) in PLACE.items()})
    town.ways.update({number: osm.Way(number, tuple(nodes), {}) for number, *nodes in ways})
    town.relations.update({one.id: one for one in lines})
    recipe = {"at_least_m": 500.0, "whole_ways": True}
    return lines_of(town, net, lambda nodes: {node: PLACE[node] for node in nodes}, recipe)


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


@pytest.mark.parametrize(
    ("tags", "n_others", "edges"),
    [
        ({}, 0, {("7", "8"), ("-8", "-7")}),
        ({}, 1, {("7", "8")}),
        ({"roundtrip": "yes"}, 0, {("7", "8")}),
        ({"public_transport:version": "2"}, 0, {("7", "8")}),
    ],
)
def test_one_relation_for_both_directions_is_driven_in_both(tags, n_others, edges):
    """It is the only one of its number; others may be variants of a line. Stops of both sides are called at."""
    one = replace(line(1, "5", (7, 8), 24), tags={"route": "bus", "ref": "5", **tags})
    others = [replace(one, id=2)] * n_others
    lines, _ = found(one, *others)
    assert {each.edges for each in lines} == edges and all(each.stops for each in lines)


def test_a_line_in_a_circle_is_driven_once():
    sides = net(
        edge("7", (0, 0), (1000, 0), nodes=("a", "b")),
        edge("8", (1000, 0), (1000, 1000), nodes=("b", "c")),
        edge("9", (1000, 1000), (0, 0), nodes=("c", "a")),
    )
    one = replace(line(1, "5", (7, 8, 9)), tags={"route": "bus", "ref": "5"})
    lines, _ = found(one, net=sides, ways=((7, 1, 2), (8, 2, 4), (9, 4, 1)))
    assert [each.edges for each in lines] == [("7", "8", "9")]


def test_a_line_may_have_any_name():
    (one,), _ = found(line(1, 'A&B "<3>"', (7, 8)))
    recipe = {"per_hour_and_line": 2, "most_lines_alike": 3, "dwell_s": 18}
    (bus, *_) = departures([one], recipe, seed=1, end_s=7200)
    assert ET.fromstring(bus).get("line") == 'A&B "<3>"'


@pytest.mark.parametrize(("ref", "n"), [("9", 1), ("N", 0), ("9N", 0), ("N9", 0), ("N 19", 0), ("NW1", 1)])
def test_night_lines_do_not_drive_by_day(ref, n):
    assert len(found(line(1, ref, (7, 8)))[0]) == n


BLOCKS = net(*(
    edge(f"{sign}{way}#{k}", *ends[::step], nodes=ends[::step])
    for way, k, *ends in (
        (7, 0, (0, 0), (600, 0)), (7, 1, (600, 0), (1000, 0)), (8, 0, (1000, 0), (1000, 400)),
        (8, 1, (1000, 400), (1000, 1000)), (9, 0, (600, 0), (1000, 400)),
    )
    for sign, step in (("", 1), ("-", -1))
))  # fmt: skip
"""Way 7 leads 1,000 m east, way 8 from there 1,000 m north, and way 9 cuts the corner: 566 m instead of 800 m."""
CORNER = (7, 1, 2), (8, 2, 4)


@pytest.mark.parametrize(
    ("ways", "edges"),
    [
        ((7, 8), "7#0 7#1 8#0 8#1"), ((8, 7), "-8#1 -8#0 -7#1 -7#0"), ((7,), "7#0 7#1"),
        (((7, "forward"),), "7#0 7#1"), (((7, "backward"),), "-7#1 -7#0"),
    ],
)  # fmt: skip
def test_a_bus_drives_the_whole_ways_of_its_line(ways, edges):
    (one,), _ = found(line(1, "5", ways), net=BLOCKS, ways=CORNER)
    assert one.edges == tuple(edges.split())


def test_a_gap_in_a_line_is_bridged():
    # Way 7 is drawn to the west, the line leads east; the 1,000 m of way 8 in its middle are not in the relation.
    three = net(*(edge(f"{sign}{n}", *((x, 0), (x + 1000, 0))[::step]) for n, x in ((7, 0), (8, 1000), (9, 2000))
                  for sign, step in (("", -1), ("-", 1))))  # fmt: skip
    (one,), _ = found(line(1, "5", (7, 9)), net=three, ways=((7, 2, 1), (8, 2, 3), (9, 5, 3)))
    assert one.edges == ("-7", "-8", "-9")


@pytest.mark.parametrize(("ways", "edges"), [((7, 8), ("7",)), ((8, 7), ("-7",))])
def test_the_order_of_ways_tells_the_direction_also_within_an_edge(ways, edges):
    both = [edge(name, *ends, ways="7 8") for name, *ends in (("7", (0, 0), (2000, 0)), ("-7", (2000, 0), (0, 0)))]
    (one,), _ = found(line(1, "5", ways), net=net(*both))
    assert one.edges == edges


def test_a_bus_drives_a_roundabout_only_as_far_as_it_must():
    # The ring 8 is one-way: west, south, east, north and back to the west. The bus comes from the west and leaves east.
    corners = {"west": (600, 0), "south": (700, -100), "east": (800, 0), "north": (700, 100)}
    names = [*corners, "west"]
    ring = [edge(f"8#{k}", *(corners[c] for c in names[k : k + 2]), nodes=tuple(names[k : k + 2])) for k in range(4)]
    roads = edge("7", (0, 0), (600, 0), nodes=("start", "west")), edge("9", (800, 0), (1600, 0), nodes=("east", "end"))
    ways = (7, 1, 2), (8, 2, 3, 4, 2), (9, 3, 4)
    (one,), _ = found(line(1, "5", (7, 8, 9)), net=net(*roads, *ring), ways=ways)
    assert one.edges == ("7", "8#0", "8#1", "9")
