"""OpenStreetMap XML as Overpass and JOSM write it: the same map in any form, or one line."""

import bz2
import re

import pytest

from cosim.addons.netbuild import osm_files
from cosim.addons.netbuild.build_from_osm import from_osm
from sumo_nets.density import Density
from tests.addons.netbuild.test_build_from_osm import grid_town

TOWN = grid_town()
HEAD, NODES, WAYS = re.fullmatch(r"(.*?<bounds[^>]*/>)((?:<node[^>]*/>)*)(.*)</osm>", TOWN).groups()
BOX = (8.9999, 49.9999, 9.0037, 50.0024)


def read(folder, text, name="a.osm", box=None):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return osm_files.read(path, box)


def ways_of(extract):
    """Tags of each way, and the places of its nodes."""
    return {way.id: (way.tags, [extract.place.get(node) for node in way.nodes]) for way in extract.ways.values()}


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    folder = tmp_path_factory.mktemp("usual")
    return {box: read(folder, TOWN, box=box) for box in (None, BOX)}


def with_places(text):
    """The town as `out geom` writes it: the places of nodes stand in the ways."""
    place = dict(re.findall(r'<node id="(\d+)" version="1" (lat="[^"]*" lon="[^"]*")/>', NODES))
    return re.sub(r'<nd ref="(\d+)"/>', lambda nd: f'<nd ref="{nd[1]}" {place[nd[1]]}/>', text)


FORMS = {
    "ways before nodes": HEAD + WAYS + NODES + "</osm>",
    "members repeated without tags": HEAD + NODES + WAYS + re.sub("<tag[^>]*/>", "", WAYS) + "</osm>",
    "tags before nodes": HEAD + re.sub("<nd[^>]*/>", "", WAYS) + re.sub("<tag[^>]*/>", "", WAYS) + NODES + "</osm>",
    "places in ways": HEAD + with_places(WAYS) + "</osm>",
    "an older copy at the end": HEAD + NODES + WAYS.replace('version="1"', 'version="2"')
    + '<way id="1" version="1"><nd ref="1"/><tag k="highway" v="steps"/></way></osm>',
    "a way without nodes": HEAD + NODES + WAYS + '<way id="9999"><tag k="building" v="yes"/></way></osm>',
}  # fmt: skip


@pytest.mark.parametrize("box", [None, BOX])
@pytest.mark.parametrize("form", FORMS)
def test_the_same_map_in_any_form(usual, tmp_path, form, box):
    assert ways_of(read(tmp_path, FORMS[form], box=box)) == ways_of(usual[box])


def test_what_an_editor_has_deleted_is_left_out(usual, tmp_path):
    """JOSM keeps it in the file until it is uploaded; a server says that it is not visible."""
    text = TOWN.replace('<way id="1" version="1">', '<way id="1" version="1" action="delete" visible="true">')
    text = text.replace('<way id="1000" version="1">', '<way id="1000" version="2" visible="false">')
    assert usual[None].ways.keys() - read(tmp_path, text).ways.keys() == {1, 1000}
    modified = TOWN.replace('<way id="1" version="1">', '<way id="1" version="1" action="modify">')
    assert ways_of(read(tmp_path, modified)) == ways_of(usual[None])


def test_new_ways_of_an_editor_are_members_of_relations(tmp_path):
    """JOSM numbers them below 0, and netconvert names a street's other direction with a minus."""
    line = '<relation id="-7"><member type="way" ref="-1" role=""/><member type="node" ref="-1" role=""/></relation>'
    new = re.sub(r'<way id="(\d+)"', r'<way id="-\1"', TOWN).replace("</osm>", line + "</osm>")
    found, usual = read(tmp_path, new), read(tmp_path, TOWN)
    assert {10**12 - number: way.nodes for number, way in found.ways.items()} == {
        number: way.nodes for number, way in usual.ways.items()
    }
    assert all(number == way.id for number, way in found.ways.items())
    assert found.relations[-7].members == (("w", 10**12 - 1, ""), ("n", -1, ""))


def test_a_map_over_180_degrees_is_cut_at_them_or_refused(tmp_path):
    """A street from 179.999 to -179.999 degrees."""
    nodes = "".join(f'<node id="{i}" lat="50" lon="{lon}"/>' for i, lon in enumerate((179.998, 179.999, -179.999)))
    street = '<way id="1"><nd ref="0"/><nd ref="1"/><nd ref="2"/><tag k="highway" v="primary"/></way>'
    for bounds in ("", '<bounds minlat="49" minlon="179" maxlat="51" maxlon="-179"/>'):
        with pytest.raises(ValueError, match=r"reaches over 180 degrees of longitude.*on one side with --bbox"):
            read(tmp_path, f"<osm>{bounds}{nodes}{street}</osm>")
    found = read(tmp_path, f"<osm>{nodes}{street}</osm>", box=(179.9, 49, 180, 51))
    assert found.place.keys() == {0, 1} and found.ways[1].nodes == (0, 1, 2)


def test_boxes_of_several_downloads_are_joined(tmp_path):
    west = '<bounds minlat="50" minlon="8.99" maxlat="50.001" maxlon="9"/>'
    assert read(tmp_path, TOWN.replace("<bounds", west + "<bounds", 1)).box == (8.99, 50.0, 9.0072, 50.004608)


def test_members_of_a_relation_may_have_their_places_only(tmp_path):
    """A house of 20 m in a relation, as `out geom` writes it, without a way of its own."""
    corners = [(50.0, 9.0), (50.0, 9.0003), (50.0002, 9.0003), (50.0, 9.0)]
    nds = "".join(f'<nd lat="{lat}" lon="{lon}"/>' for lat, lon in corners)
    wall = f'<member type="way" ref="70" role="outer">{nds}</member>'
    house = f'<relation id="7">{wall}<tag k="building" v="yes"/></relation>'
    found = read(tmp_path, HEAD + NODES + WAYS + house + "</osm>")
    assert [found.place[node] for node in found.ways[70].nodes] == [(lon, lat) for lat, lon in corners]


REFUSED = {
    "JSON": ('{"version": 0.6, "elements": []}', r"a\.osm is JSON\. Ask Overpass for XML"),
    "a web page": ("<!DOCTYPE html><html><body>busy</body></html>", "a web page, not an OpenStreetMap file"),
    "changes": ("<osmChange version='0.6'><create/></osmChange>", "starts with <osmChange>"),
    "differences": ("<osm><action type='delete'><old/></action></osm>", "it lists changes"),
    "half an answer": (TOWN.replace("</osm>", "<remark> runtime error: Query timed out </remark></osm>"),
                       r"Overpass gave up before its end \(runtime error: Query timed out\)"),
    "ways alone": (HEAD + WAYS + "</osm>", r"14 ways without the places of their nodes.*Ask Overpass for"),
    "tags alone": (HEAD + NODES + re.sub("<nd[^>]*/>", "", WAYS) + "</osm>", "without the places of their nodes"),
    "a place nowhere": (TOWN.replace('lat="50.000000"', 'lat="500"', 1), "lat = 500, .* is not on Earth"),
    "a number in words": (TOWN.replace('<way id="1"', '<way id="one"'), "line 1: invalid literal"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
@pytest.mark.parametrize("pack", [bytes, bz2.compress])
def test_what_is_no_map_gets_one_line(tmp_path, what, pack):
    text, says = REFUSED[what]
    (tmp_path / "a.osm").write_bytes(pack(text.encode()))
    with pytest.raises(ValueError, match=says) as caught:
        from_osm(tmp_path / "a.osm", tmp_path / "out", Density())
    assert "a.osm" in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()
