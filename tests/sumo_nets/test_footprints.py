"""Footprints: our own files come back as written, strangers' are read with care."""

import numpy as np
import pytest
from shapely import Polygon, box

from sumo_nets.footprints import footprint_of, pieces_of, read_footprints, write_footprints
from sumo_nets.heights import height_of, number

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
    )
    found = [(f.base_z_m, f.top_z_m) for f in read_footprints(path)]
    # 4 storeys x 3.5 m; 100 m² without a tag: a small house; a church without a height: 25 m
    assert found == [(0.0, 12.5), (0.0, 14.0), (0.0, 7.0), (6.0, 20.0), (0.0, 25.0)]


def test_a_ring_that_crosses_itself_becomes_its_valid_pieces(tmp_path):
    path = polys(tmp_path, '<poly id="bow" type="building" shape="0,0 10,10 10,0 0,10"/>')
    pieces = read_footprints(path)
    assert sorted(p.polygon.area for p in pieces) == [25.0, 25.0]
    assert all(p.polygon.is_valid and p.polygon.exterior.is_ccw for p in pieces)


@pytest.mark.parametrize(
    ("shape", "params", "cause"),
    [
        ("0,0 1,0", "", "a ring needs three different points, this one has 2"),
        ("0,0 1,x 2,2", "", "is not a list of x,y pairs"),
        ("0,0 nan,0 2,2 0,1", "", "is not a list of finite x,y pairs"),
        ("0,0 1 2,2", "", "is not a list of x,y pairs"),
        ("", "", "is not a list of finite x,y pairs"),
        (SQUARE, '<param key="top_z_m" value="tall"/>', "'tall' is not a height in metres"),
        (SQUARE, '<param key="top_z_m" value="-3"/>', "a building's top must lie above its base"),
        (SQUARE, '<param key="hole.0" value="1,1"/>', "a ring needs three different points"),
    ],
)
def test_nonsense_is_refused_with_file_and_polygon(tmp_path, shape, params, cause):
    path = polys(tmp_path, f'<poly id="odd" type="building" shape="{shape}">{params}</poly>')
    with pytest.raises(ValueError, match=cause) as caught:
        read_footprints(path)
    assert "x.poly.xml" in str(caught.value)
    assert "'odd'" in str(caught.value)


def test_slivers_and_lines_are_left_out():
    assert pieces_of(Polygon([(0, 0), (1, 0), (0.5, 0.001)])) == []
    assert pieces_of(box(0, 0, 2, 2).intersection(box(2, 0, 4, 2))) == []


@pytest.mark.parametrize(
    ("text", "value"), [("12", 12.0), ("12,5 m", 12.5), ("40 ft", 12.192), ("high", None), (None, None), ("-3", None)]
)
def test_numbers_of_tags(text, value):
    assert number(text) == (None if value is None else pytest.approx(value))


@pytest.mark.parametrize(
    ("tags", "area", "expected"),
    [
        ({"building": "yes", "height": "22"}, 500, (0.0, 22.0, "measured")),
        ({"building": "yes", "building:levels": "5", "roof:levels": "1"}, 500, (0.0, 21.0, "storeys")),
        ({"building:part": "yes", "building:levels": "6", "building:min_level": "2"}, 500, (7.0, 21.0, "storeys")),
        ({"building": "roof"}, 500, (4.5, 5.5, "default")),
        ({"building": "yes"}, 20, (0.0, 3.0, "default")),
        ({"building": "yes"}, 900, (0.0, 17.5, "default")),
    ],
)
def test_heights_by_hand(tags, area, expected):
    assert height_of(tags, area) == expected
