"""Kerbs, areas and trees of small files, by hand."""

import numpy as np
import pytest
import shapely

from sumo_nets.streetside import read_trees, street_space

NET = """<net version="1.20"><location convBoundary="0,0,100,0"/>
<edge id=":j_0" function="internal"><lane id=":j_0_0" index="0" length="8" shape="100,-1.6 108,-1.6"/></edge>
<edge id="east" from="a" to="j">
  <lane id="east_0" index="0" allow="pedestrian" width="2" shape="0,-4.2 100,-4.2"/>
  <lane id="east_1" index="1" disallow="pedestrian" shape="0,-1.6 100,-1.6"/>
  {param}</edge>
<edge id="path" from="a" to="j"><lane id="path_0" index="0" allow="bicycle" shape="0,20 100,20"/></edge>
<junction id="j" type="priority" x="100" y="0" incLanes="east_0" shape="100,-5 110,-5 110,5 100,5"/>
</net>"""


def net(folder, tag="", value=""):
    param = f'<param key="{tag}" value="{value}"/>' if tag else ""
    path = folder / "a.net.xml"
    path.write_text(NET.format(param=param))
    return path


def test_a_street_by_hand(tmp_path):
    """The kerb is that of the sidewalk, 5.2 m right of the axis. The cycle path has none, but takes its area:
    100 m x (2 + 3.2 + 3.2), and the junction 10 m x 10 m."""
    kerbs, areas = street_space(net(tmp_path))
    (kerb,) = kerbs
    assert kerb.edge == "east" and kerb.half_width_m == 1.0 and kerb.parking is None
    np.testing.assert_allclose(kerb.line_m, [[0, -4.2, 0], [100, -4.2, 0]])
    assert shapely.area(areas).sum() == pytest.approx(100 * (2 + 3.2 + 3.2) + 100)


def test_tags_of_parking(tmp_path):
    for tag, value, said in (
        ("parking:lane:right", "parallel", True),
        ("parking:both", "no", False),
        ("parking:lane:left", "parallel", None),
    ):
        assert street_space(net(tmp_path, tag, value))[0][0].parking is said


@pytest.mark.parametrize(
    ("edge", "is_left", "tag", "said"),
    [
        ("10", False, "parking:right", True), ("10", False, "parking:left", None),
        ("-10#1", False, "parking:left", True), ("-10#1", False, "parking:lane:right", None),
        ("10", True, "parking:lane:left", True), ("10", True, "parking:right", None),
        ("-10", True, "parking:right", True), ("-10", True, "parking:both", True),
    ],
)  # fmt: skip
def test_sides_of_a_way_are_those_of_its_own_direction(tmp_path, edge, is_left, tag, said):
    """Netconvert gives the tags of a way to both directions: the right of the way is the left of the other edge."""
    path = net(tmp_path, tag, "parallel")
    text = path.read_text().replace('id="east"', f'id="{edge}"')
    path.write_text(text.replace("<net ", '<net lefthand="true" ') if is_left else text)
    (kerb,) = street_space(path)[0]
    assert (kerb.edge, kerb.is_left, kerb.parking) == (edge, is_left, said)


def test_trees_of_a_map(tmp_path):
    path = tmp_path / "a.poly.xml"
    path.write_text("""<additional>
      <poi id="1" type="natural.tree" x="3" y="4"/><poi id="2" type="shop" x="5" y="5"/>
      <poi id="3" type="unknown" x="6" y="7"><param key="natural" value="tree"/></poi>
      <poi id="4" type="natural.tree" x="nan" y="4"/><poi id="5" type="natural.tree" lon="24.9" lat="60.1"/>
      <poly id="6" type="natural.tree_row" shape="0,0 25,0"/><poly id="7" type="building" shape="0,0 1,0 1,1"/>
    </additional>""")
    np.testing.assert_allclose(read_trees(path), [[3, 4], [6, 7], [0, 0], [10, 0], [20, 0]])
