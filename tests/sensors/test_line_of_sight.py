"""Line of sight against Shapely, by hand, and with remembered answers."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings

from sensors.boxes import Boxes
from sensors.line_of_sight import LosOfPlaces, WallIndex, los_between_actors
from sensors.scene import Scene
from tests.seeds import seeds
from tests.sensors.town import SIZE_M, blocks, car, lines_between, to_scene, traffic
from tests.solids import footprint

SQUARE = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
YARD = [SQUARE * 0.4 + 3.0]


def index_of(buildings, cell_m=4.0):
    """Of (outer ring, holes, base, top), with more behind."""
    rings = [[outer, *holes] for outer, holes, *_ in buildings]
    scene = Scene.from_footprints(
        rings, [building[2] for building in buildings], [building[3] for building in buildings]
    )
    return WallIndex.of(scene.buildings, cell_m)


def sees(walls, start, end) -> bool:
    xyz, one = np.array([start, end], float), np.array([0])
    return bool(walls.has_los(xyz, one, one + 1)[0])


def test_a_building_by_hand():
    building = index_of([(SQUARE, [], 0.0, 6.0)])
    assert not sees(building, (-5, 5, 1.5), (15, 5, 1.5))
    assert sees(building, (-5, 11, 1.5), (15, 11, 1.5))
    assert sees(building, (-5, 5, 7), (15, 5, 7))  # over the roof
    assert not sees(building, (-5, 5, 1.5), (15, 5, 7))  # through the first wall at 2.9 m
    assert sees(building, (-1, 5, 6.5), (-40, 5, 1.5))
    assert not sees(building, (5, 5, 1.5), (15, 5, 1.5))  # out of it
    assert not sees(building, (4, 5, 1.5), (6, 5, 1.5))  # within it
    assert sees(building, (500, 500, 1.5), (-500, 900, 1.5))  # both beyond the grid


def test_a_courtyard_is_outdoors_without_los_to_the_street():
    block = index_of([(SQUARE, YARD, 0.0, 6.0)])
    assert sees(block, (4, 4, 1.5), (6, 6, 1.5))
    assert not sees(block, (5, 5, 1.5), (15, 5, 1.5))


def test_los_below_an_elevated_building():
    bridge = index_of([(SQUARE, [], 4.0, 9.0)])
    assert sees(bridge, (-5, 5, 1.5), (15, 5, 1.5))
    assert sees(bridge, (5, 5, 1.5), (15, 5, 1.5))
    assert not sees(bridge, (-5, 5, 5), (15, 5, 5))


def test_walls_and_metres_by_hand():
    xyz = np.array([[-5, 5, 1.5], [15, 5, 1.5], [5, -5, 1.5], [1, 5, 1.5], [-5, 12, 1.5], [2, 5, 1.5]])
    a, b = np.int32([[0, 1, 0, 3, 0, 3], [1, 0, 3, 1, 4, 5]])
    for ring in (SQUARE, SQUARE[::-1]):
        for yard in (YARD[0], YARD[0][::-1]):  # the yard spans 3 ... 7 m
            n_walls, inside_m = index_of([(ring, [yard], 0.0, 6.0)], cell_m=3.0).walls_crossed(xyz, a, b)
            assert n_walls.tolist() == [4, 4, 1, 3, 0, 0]
            assert inside_m == pytest.approx([6, 6, 1, 5, 0, 1])


def test_walls_and_metres_agree_with_shapely():
    buildings, g = town(6), np.random.default_rng(8)
    xyz = np.column_stack([g.uniform(-60, 650, 2000), g.uniform(-60, 550, 2000), np.full(2000, 1.5)])
    a, b = np.arange(2000, dtype=np.int32).reshape(2, 1000)
    n_walls, inside_m = index_of(buildings).walls_crossed(xyz, a, b)
    city = shapely.union_all([shapely.Polygon(o, h) for o, h, *_ in buildings])
    lines = lines_between(xyz, a, b)
    assert inside_m == pytest.approx(shapely.length(shapely.intersection(lines, city)), abs=1e-6)
    cuts = shapely.intersection(lines, city.boundary)
    assert n_walls.tolist() == np.where(shapely.is_empty(cuts), 0, shapely.get_num_geometries(cuts)).tolist()


def test_walls_and_metres_are_the_same_from_either_end():
    """Antennas on walls and corners too, where rounding would else decide."""
    rng = np.random.default_rng(4)
    square = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [0.0, 100.0]])
    city = index_of([(square + 125.0 * np.array([i, j]), [], 0.0, 20.0) for i in range(3) for j in range(3)])
    xyz = np.column_stack([rng.choice([0.0, 50.0, 100.0, 112.5, 125.0, 225.0, 240.0], (60, 2)), np.full(60, 1.5)])
    a, b = (k.ravel() for k in np.meshgrid(np.arange(60), np.arange(60)))
    there, back = city.walls_crossed(xyz, a, b), city.walls_crossed(xyz, b, a)
    assert np.array_equal(there[0], back[0]) and np.array_equal(there[1], back[1])


def test_without_buildings_all_have_los():
    nothing = index_of([])
    assert sees(nothing, (0, 0, 1.5), (500, 20, 1.5))
    assert sees(LosOfPlaces(nothing), (0, 0, 1.5), (500, 20, 1.5))


def town(n, seed=1):
    g = np.random.default_rng(seed)
    buildings = []
    for x in range(n):
        for y in range(n):
            turn = g.uniform(-0.3, 0.3)
            turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            ring, yard = (((r - 5) * (7, 5)) @ turned.T + (110 * x, 90 * y) for r in (SQUARE, YARD[0]))
            buildings.append((ring, [yard] if g.random() < 0.5 else [], 0.0, g.uniform(4, 20)))
    return buildings


def by_shapely(buildings, xyz, a, b, z):
    tree = shapely.STRtree([shapely.Polygon(o, h) for o, h, base, top, *_ in buildings if base <= z <= top])
    lines = lines_between(xyz, a, b)
    clear = np.ones(len(a), bool)
    clear[tree.query(lines, predicate="intersects")[0]] = False
    return clear


@pytest.mark.parametrize("cell_m", [2.0, 4.0, 30.0])
def test_a_town_agrees_with_shapely(cell_m):
    buildings, g = town(8), np.random.default_rng(4)
    xyz = np.column_stack([g.uniform(-60, 850, 6000), g.uniform(-60, 700, 6000), np.full(6000, 1.5)])
    xyz[3000:4500, :2] = xyz[:1500, :2] + g.normal(0, 40, (1500, 2))
    a, b = np.arange(3000), np.arange(3000, 6000)
    assert np.array_equal(index_of(buildings, cell_m).has_los(xyz, a, b), by_shapely(buildings, xyz, a, b, 1.5))


def test_places_are_points_rounded():
    walls, g = index_of(town(6)), np.random.default_rng(6)
    xyz = np.column_stack([g.uniform(-60, 650, 400), g.uniform(-60, 550, 400), np.full(400, 1.5)])
    a, b = g.integers(0, 400, (2, 20_000))
    places = LosOfPlaces(walls)
    found = places.has_los(xyz, a, b)
    assert np.array_equal(places.has_los(xyz, b, a), found)  # a line has no direction
    snapped = places.snap(xyz)
    assert np.abs(snapped - xyz).max() <= 0.25
    assert np.array_equal(walls.has_los(snapped, a, b), found)


def test_faults_are_named():
    with pytest.raises(ValueError, match="cell_m"):
        index_of([], 0.0)
    with pytest.raises(ValueError, match="snap_m"):
        LosOfPlaces(index_of([]), snap_m=0.0)
    with pytest.raises(ValueError, match="too far from the buildings"):
        LosOfPlaces(index_of([])).has_los(np.array([[0, 0, 1.5], [1e9, 0, 1.5]]), np.array([0]), np.array([1]))


@settings(max_examples=10)
@given(seed=seeds)
def test_los_between_actors_equals_shapely(seed):
    rng = np.random.default_rng(seed)
    (boxes, shape), scene = traffic(rng, 40), blocks(rng)
    n = len(scene.footprints)
    tall = to_scene(scene.footprints, np.zeros(n), np.full(n, 50.0))
    a, b = np.meshgrid(np.arange(40), np.arange(40))
    a, b = a[a != b], b[a != b]
    roof = np.column_stack([boxes.xyz_m[:, :2], boxes.xyz_m[:, 2] + boxes.lwh_m[:, 2] / 2 + 0.23])
    lines = lines_between(roof, a, b)
    walls = shapely.union_all(tall.footprints).boundary
    blocked = shapely.intersects(lines, walls)
    index = WallIndex.of(tall.buildings)
    seen = los_between_actors(index, boxes, shape, a, b)
    sizes = np.column_stack([boxes.xyz_m[:, :2], boxes.lwh_m[:, :2], boxes.yaw_rad])
    body = [footprint(*size) for size in sizes]
    indoors = shapely.contains_xy(shapely.union_all(tall.footprints), *roof[:, :2].T)
    by_buildings = los_between_actors(index, boxes, shape, a, b, bodies=False)
    assert np.array_equal(by_buildings, ~blocked & ~indoors[a] & ~indoors[b]) and not (seen & ~by_buildings).any()
    for k in np.flatnonzero(~seen & by_buildings):  # what else stops a line is a third body that it passes over
        over = [o for o in range(40) if o not in (a[k], b[k]) and body[o].intersects(lines[k])]
        assert any(boxes.xyz_m[o, 2] + boxes.lwh_m[o, 2] / 2 > min(roof[a[k], 2], roof[b[k], 2]) for o in over)
    assert (seen == los_between_actors(index, boxes, shape, b, a)).all()
    none = np.zeros(0, int)
    assert len(los_between_actors(index, Boxes.concat([]), none.astype(np.uint8), none, none)) == 0


def test_los_between_actors_by_hand():
    # Roof sensors at 1.73 m. A 1.5 m high car between does not block, a 3.2 m bus does, a wall of 1 m does not, one of
    # 2 m does, one that floats from 2.5 m up (a passage) does not; inside a building there is no line of sight.
    ends = [car(0, 0), car(40, 0)]
    bus = Boxes(np.array([[20, 0, 1.6]]), SIZE_M[3:4], np.array([np.pi / 2]))

    def sees(middle, code, low=None, high=None, ring=((18, -5), (22, -5), (22, 5), (18, 5))):
        boxes = Boxes.concat([*ends, middle])
        scene = Scene.empty() if low is None else Scene.from_footprints([[ring]], [low], [high])
        return bool(
            los_between_actors(WallIndex.of(scene.buildings), boxes, np.array([0, 0, code], np.uint8), [0], [1])[0]
        )

    aside = car(20, 30)
    assert sees(car(20, 0), 0) and not sees(bus, 3)
    assert sees(aside, 0, 0.0, 1.0) and not sees(aside, 0, 0.0, 2.0) and sees(aside, 0, 2.5, 9.0)
    assert not sees(aside, 0, 0.0, 9.0, ((-9, -9), (49, -9), (49, 9), (-9, 9)))
