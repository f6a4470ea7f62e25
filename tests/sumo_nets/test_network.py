"""check_for_cars: which files a simulation of cars may start from."""

import gzip

import pytest

from sumo_nets.network import check_for_cars, lanes


def net(*lanes, function=""):
    edge = "".join(f'<lane id="e_{i}" index="{i}" {lane}/>' for i, lane in enumerate(lanes))
    return f'<net version="1.20"><location/><edge id="e" {function}>{edge}</edge></net>'


@pytest.mark.parametrize(
    "lane",
    [
        "",
        'allow="passenger bus"',
        'allow="custom1"',
        'allow="all"',
        'disallow="passenger"',
        'disallow="tram"',
        'disallow=""',
    ],
)
@pytest.mark.parametrize("pack", [bytes, gzip.compress])
def test_a_lane_for_cars_is_enough(tmp_path, lane, pack):
    path = tmp_path / "a.net.xml"
    path.write_bytes(pack(net('allow="pedestrian"', lane).encode()))
    check_for_cars(path)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        (net('allow="pedestrian"', 'allow="rail bicycle"', 'disallow="all"'), "none of its 3 lanes lets motor"),
        (net("", function='function="internal"'), "it has no lane at all"),
        ("<net/>", "it has no lane at all"),
        ("<additional/>", "not a SUMO network: it starts with <additional>, a network starts with <net>"),
        ("<osm/>", "not a SUMO network: it starts with <osm>"),
    ],
)
def test_without_one_the_cause_is_named_in_one_line(tmp_path, text, cause):
    path = tmp_path / "b.net.xml"
    path.write_text(text)
    with pytest.raises(ValueError, match=cause) as caught:
        check_for_cars(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_lanes_are_those_of_the_road_also_across_junctions(tmp_path):
    path = tmp_path / "c.net.xml"
    edges = [
        ("", 'shape="0,0,5 9,0,7" width="3"'),
        ("", 'allow="pedestrian" shape="0,2 9,2"'),
        ("", 'allow="rail" shape="0,0 9,9"'),
        ("", 'allow="ship" shape="0,0 9,9"'),
        ('function="internal"', 'shape="9,0 12,0"'),
        ('function="crossing"', 'allow="pedestrian" shape="9,0 9,2"'),
        ('function="walkingarea"', 'allow="pedestrian" shape="9,0 9,2 8,1"'),
    ]
    path.write_text("<net>" + "".join(f"<edge {f}><lane {lane}/></edge>" for f, lane in edges) + "</net>")
    found = [(lane.line_m.tolist(), lane.width_m, lane.for_cars, lane.across) for lane in lanes(path)]
    assert found == [
        ([[0, 0, 5], [9, 0, 7]], 3.0, True, False),
        ([[0, 2, 0], [9, 2, 0]], 3.2, False, False),
        ([[9, 0, 0], [12, 0, 0]], 3.2, True, True),
    ]


def test_a_version_of_a_network_is_read_once(tmp_path):
    path = tmp_path / "d.net.xml"
    path.write_text('<net><edge><lane shape="0,0 9,0"/></edge></net>')
    found = lanes(path)
    assert lanes(str(path)) is found
    with pytest.raises(ValueError, match="read-only"):
        found[0].line_m[0, 0] = 1.0
    path.write_text('<net><edge><lane shape="0,0 10,0"/></edge></net>')
    assert lanes(path)[0].line_m.tolist() == [[0, 0, 0], [10, 0, 0]]


@pytest.mark.parametrize("shape", ["0,0", "0,0 9", "0,0 nan,0", "0,0 9,east"])
def test_a_lane_without_a_line_is_named(tmp_path, shape):
    path = tmp_path / "e.net.xml"
    path.write_text(f'<net><edge><lane id="a_0" shape="{shape}"/></edge></net>')
    with pytest.raises(ValueError, match="lane 'a_0' has no line of finite points, or no width"):
        lanes(path)
