"""Form of the streets: a cross of streets by hand, and SUMO's own network of the shipped city."""

import numpy as np
import pytest

from sumo_nets import catalogue
from sumo_nets.morphology import around, read

CROSS = {"w": (-300, 0), "e": (300, 0), "s": (0, -300), "n": (0, 300), "m": (0, 0), "bend": (150, 0)}
WAYS = [("w", "m", 13.9), ("m", "bend", 13.9), ("bend", "e", 27.8), ("s", "m", 8.3), ("m", "n", 8.3)]


def cross(tmp_path, lane="", both=True, lights="traffic_light"):
    """Two roads that cross in `m`; the one to the east has a node `bend` where its speed limit changes."""
    edges = ""
    for a, b, speed in [*WAYS, *((b, a, v) for a, b, v in WAYS if both)]:
        (x0, y0), (x1, y1) = CROSS[a], CROSS[b]
        length = np.hypot(x1 - x0, y1 - y0)
        edges += (
            f'<edge id="{a}{b}" from="{a}" to="{b}"><lane id="{a}{b}_0" index="0" speed="{speed}" length="{length}" '
            f'{lane} shape="{x0},{y0} {x1},{y1}"/></edge>'
        )
    edges += '<edge id=":m_0" function="internal"><lane id=":m_0_0" speed="5" length="9" shape="0,0 1,1"/></edge>'
    nodes = "".join(
        f'<junction id="{name}" type="{lights if name == "m" else "priority"}" x="{x}" y="{y}" incLanes=""/>'
        for name, (x, y) in CROSS.items()
    )
    path = tmp_path / "cross.net.xml"
    path.write_text(f"<net>{edges}{nodes}</net>")
    return path


@pytest.mark.parametrize("lights", ["traffic_light", "priority"])
@pytest.mark.parametrize("both", [True, False])
def test_a_cross_by_hand(tmp_path, both, lights):
    streets = read(cross(tmp_path, both=both, lights=lights))
    assert streets.junction_m.tolist() == [[0, 0]] and streets.has_lights.tolist() == [lights == "traffic_light"]
    assert sorted(streets.length_m) == [300.0] * (8 if both else 4)  # the bend joins two edges of 150 m
    found = around(streets, np.array([[200.0, 5.0], [0.0, -100.0], [600.0, 0.0]]), 250.0)
    # One junction within 250 m of the first two: 1 / (pi 0.25^2) = 5.093 per square kilometre.
    np.testing.assert_allclose(found.junctions_per_km2, [5.0930, 5.0930, 0], atol=1e-3)
    np.testing.assert_allclose(found.lights_share, np.array([1, 1, 0]) * (lights == "traffic_light"))
    np.testing.assert_allclose(found.street_length_m, [300, 300, 300])
    np.testing.assert_allclose(found.speed_limit_mps, [(13.9 + 27.8) / 2, 8.3, (13.9 + 27.8) / 2])


def test_a_network_of_footways_is_told(tmp_path):
    with pytest.raises(ValueError, match="no street for motor vehicles"):
        read(cross(tmp_path, lane='allow="pedestrian"'))


def test_the_shipped_city_agrees_with_sumolib():
    """Junctions are the nodes with more than two neighbours by streets for cars."""
    sumolib = pytest.importorskip("sumolib")
    path = catalogue.find("helsinki").net_path
    net, streets = sumolib.net.readNet(str(path)), read(path)
    cars = [e for e in net.getEdges() if any(lane.allows("passenger") or lane.allows("bus") for lane in e.getLanes())]
    beside = {}
    for edge in cars:
        a, b = edge.getFromNode(), edge.getToNode()
        beside.setdefault(a.getID(), set()).add(b.getID())
        beside.setdefault(b.getID(), set()).add(a.getID())
    crossings = [net.getNode(name) for name, others in beside.items() if len(others) > 2]
    assert len(crossings) == len(streets.junction_m)
    assert sum(node.getType().startswith("traffic_light") for node in crossings) == streets.has_lights.sum()
    assert streets.length_m.sum() == pytest.approx(sum(edge.getLength() for edge in cars), rel=1e-3)
    points = np.array([node.getCoord()[:2] for node in crossings])
    assert (around(streets, points, 1.0).junctions_per_km2 > 0).all()
