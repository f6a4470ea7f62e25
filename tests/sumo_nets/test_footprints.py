"""Footprints: our own files come back as written, strangers' are read with care."""

import numpy as np
import pytest
from shapely import Polygon, box

from sumo_nets.footprints import footprint_of, pieces_of, read_footprints, read_polygons, write_footprints
from sumo_nets.ground import standing_on
from sumo_nets.heights import height_of, number
from sumo_nets.network import lanes

SQUARE = "0,0 10,0 10,10 0,10"


def polys(tmp_path, *polys):
    path = tmp_path / "x.poly.xml"
    path.write_text(f"<additional>{''.join(polys)}</additional>")
    return path


def test_what_is_written_comes_back(tmp_path):
    yard = box(0, 0, 20, 20).difference(box(5, 5, 8, 8)).difference(box(10, 10, 12, 15))
    (piece,) = pieces_of(yard)
    path = tmp_path / "y.poly.xml"
    write_footprints(path, [("a", footprint_of(piece, 3.5, 21.0))])
    (read,) = read_footprints(path)
    assert read.polygon.equals(yard)
    assert (read.base_z_m, read.top_z_m) == (3.5, 21.0)
    assert len(read.holes) == 2
    assert read.outer.dtype == np.float64
    assert (read.outer[0] == read.outer[-1]).all()


def test_openstreetmap_tags_of_a_stranger_give_heights(tmp_path):
    def poly(name, *tags):
        params = "".join(f'<param key="{key}" value="{value}"/>' for key, value in tags)
        return f'<poly id="{name}" type="building" shape="{SQUARE}">{params}</poly>'

    path = polys(
        tmp_path,
        poly("a", ("height", "12.5 m")),
        poly("b", ("building:levels", "4")),
        poly("c"),
        poly("d", ("height", "20"), ("min_height", "6")),
        f'<poly id="park" type="leisure.park" shape="{SQUARE}"/>',
        f'<poly id="e" type="unknown" shape="{SQUARE}"><param key="building" value="church"/></poly>',
        f'<poly id="f" type="building.yes" height="12.19" shape="{SQUARE}"/>',  # polyconvert, without --all-attributes
        poly("g", ("HEIGHT", "33.50")),  # polyconvert --shapefile.add-param
    )
    found = [(f.base_z_m, f.top_z_m) for f in read_footprints(path)]
    # 4 storeys x 3.5 m; 100 m² without a tag: a small house; a church without a height: 25 m
    assert found == [(0.0, 12.5), (0.0, 14.0), (0.0, 7.0), (6.0, 20.0), (0.0, 25.0), (0.0, 12.19), (0.0, 33.5)]


def test_what_is_gone_planned_or_underground_is_no_building(tmp_path):
    def poly(kind, *tags):
        params = "".join(f'<param key="{key}" value="{value}"/>' for key, value in tags)
        return f'<poly id="a" type="{kind}" shape="{SQUARE}">{params}</poly>'

    path = polys(
        tmp_path,
        poly("building", ("building", "no"), ("height", "9")),
        poly("building.demolished"),
        poly("landuse", ("building", "proposed")),
        poly("building", ("location", "underground"), ("building:levels", "2")),
        poly("building.parking", ("layer", "-1")),
        poly("landuse", ("building:part", "roof"), ("height", "9")),
    )
    found, others = read_polygons(path, None)
    assert [(f.base_z_m, f.top_z_m) for f in found] == [(4.5, 9.0)]  # the part, a roof on posts
    assert sum(of.n for of in others.values()) == 5 and not any(of.n_high for of in others.values())


def test_a_ring_that_crosses_itself_becomes_its_valid_pieces(tmp_path):
    path = polys(tmp_path, '<poly id="bow" type="building" shape="0,0 10,10 10,0 0,10"/>')
    pieces = read_footprints(path)
    assert sorted(p.polygon.area for p in pieces) == [25.0, 25.0]
    assert all(p.polygon.is_valid and p.polygon.exterior.is_ccw for p in pieces)


@pytest.mark.parametrize(
    ("shape", "params", "cause"),
    [
        ("0,0 1,x 2,2", "", "is not a list of x,y pairs"),
        ("0,0 nan,0 2,2 0,1", "", "is not a list of finite x,y pairs"),
        ("0,0 1 2,2", "", "is not a list of x,y pairs"),
        ("", "", "is not a list of finite x,y pairs"),
        (SQUARE, '<param key="top_z_m" value="tall"/>', "'tall' is not a height in metres"),
        (SQUARE, '<param key="top_z_m" value="-3"/>', "a building's top must lie above its base"),
        (SQUARE, '<param key="hole.0" value="1;1"/>', "is not a list of x,y pairs"),
    ],
)
def test_nonsense_is_refused_with_file_and_polygon(tmp_path, shape, params, cause):
    path = polys(tmp_path, f'<poly id="odd" type="building" shape="{shape}">{params}</poly>')
    with pytest.raises(ValueError, match=cause) as caught:
        read_footprints(path)
    assert "x.poly.xml" in str(caught.value)
    assert "'odd'" in str(caught.value)


def test_slivers_and_lines_are_left_out(tmp_path):
    two = '<poly id="a" type="building" shape="0,0 1,0"/><poly id="b" type="building" shape="5,5"/>'
    three = f'<poly id="c" type="building" shape="{SQUARE}"><param key="hole.0" value="1,1 2,2"/></poly>'
    (found,) = read_footprints(polys(tmp_path, two, three))
    assert found.polygon.equals(box(0, 0, 10, 10))
    sliver = '<poly id="d" type="building" shape="0,0 1,0 0.5,0.001"/>'
    assert read_footprints(polys(tmp_path, sliver)) == read_footprints(polys(tmp_path, two)) == []
    assert pieces_of(Polygon([(0, 0), (1, 0), (0.5, 0.001)])) == []
    assert pieces_of(box(0, 0, 2, 2).intersection(box(2, 0, 4, 2))) == []


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("12", 12.0),
        ("12,5 m", 12.5),
        ("40 ft", 12.192),
        ("40 feet", 12.192),
        ("40 FT", 12.192),
        ("40′", 12.192),
        ("7'6\"", 2.286),
        ("7 ft 6 in", 2.286),
        ("1250 cm", 12.5),
        ("12 storeys", 12.0),
        ("10-12", 10.0),
        ("high", None),
        (None, None),
        ("-3", None),
    ],
)
def test_numbers_of_tags(text, value):
    assert number(text) == (None if value is None else pytest.approx(value))


@pytest.mark.parametrize(
    ("tags", "area", "expected"),
    [
        ("building=yes height=22", 500, (0.0, 22.0, "measured")),
        ("building=yes building:levels=5 roof:levels=1", 500, (0.0, 21.0, "storeys")),
        ("building=yes building:levels=0 roof:levels=1", 500, (0.0, 3.5, "storeys")),
        ("building:part=yes building:levels=6 building:min_level=2", 500, (7.0, 21.0, "storeys")),
        ("building=roof", 500, (4.5, 5.5, "default")),
        ("building=carport", 30, (2.0, 3.0, "default")),
        ("building=warehouse", 5000, (0.0, 9.0, "default")),
        ("building=barn", 300, (0.0, 7.0, "default")),
        ("building=yes height=1234567", 500, (0.0, 17.5, "default")),
        ("building=yes building:levels=3000", 500, (0.0, 17.5, "default")),
        ("building=yes", 20, (0.0, 3.0, "default")),
        ("building=yes", 900, (0.0, 17.5, "default")),
    ],
)
def test_heights_by_hand(tags, area, expected):
    assert height_of(dict(tag.split("=") for tag in tags.split()), area) == expected


KM = 111.195  # of latitude in a degree

LAKE = (
    '<net version="0.27"><location netOffset="-500000.00,-5538630.70" convBoundary="0,0,1000,1000" '
    'origBoundary="9,50,9.1,50.1" projParameter="{}"/><edge id="e" from="a" to="b">'
    '<lane id="e_0" index="0" speed="13.9" length="1000" shape="0,0{} 1000,0{}"/></edge></net>'
)


def test_longitudes_and_latitudes_are_projected_as_the_network_is(tmp_path):
    """At the central meridian of UTM zone 32, 0.001 degrees of latitude are 111.2 m x 0.9996 further north."""
    net = tmp_path / "a.net.xml"
    net.write_text(LAKE.format("+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", "", ""))
    shape = "9.000,50.001 9.001,50.001 9.001,50.002 9.000,50.002"
    path = polys(
        tmp_path,
        f'<poly id="before" type="building" shape="{SQUARE}"/>',
        f'<poly id="house" type="building.house" geo="T" shape="{shape}"/>',
        f'<poly id="lake" type="natural.water" geo="true" shape="{shape}"/>',
    )
    before, house = read_footprints(path, net)
    assert before.polygon.equals(box(0, 0, 10, 10))
    (west, south), (_, north) = house.outer[:-1].min(axis=0), house.outer[:-1].max(axis=0)
    assert west == pytest.approx(0, abs=0.1) and north - south == pytest.approx(KM, abs=0.2)  # 111.2 m in 50 degrees
    assert south == pytest.approx(5538630.70 + KM - 5538630.70, abs=0.2)
    assert house.polygon.area == pytest.approx(KM * 71.7, rel=0.01)  # 111.3 m x cos(50 degrees) east
    net.write_text(LAKE.format("!", "", ""))
    with pytest.raises(ValueError, match=r"x\.poly\.xml: polygon 'house': geo=\"true\", but .*projection") as caught:
        read_footprints(path, net)
    assert "\n" not in str(caught.value) and "/tmp/sumo_nets" not in str(caught.value)


def test_houses_stand_on_the_hill(tmp_path):
    """A street climbs from 300 m to 400 m over a kilometre: a house beside its middle stands at 350 m.

    Its walls reach down to the street 300 m away, which is 30 m lower, or by a cell of 50 m more.
    """
    net = tmp_path / "a.net.xml"
    net.write_text(LAKE.format("!", ",300", ",400"))
    path = polys(tmp_path, '<poly id="a" type="building" shape="495,20 505,20 505,30 495,30"/>',
                 '<poly id="b" type="building" shape="-60,-5 -50,-5 -50,5 -60,5"/>')  # fmt: skip
    found = read_footprints(path)
    half_way, at_the_end = standing_on(found, lanes(net))
    assert 315 <= half_way.base_z_m <= 320 and half_way.top_z_m == 357.0
    assert (at_the_end.base_z_m, at_the_end.top_z_m) == (300.0, 307.0)
    net.write_text(LAKE.format("!", "", ""))
    assert standing_on(found, lanes(net)) == found
