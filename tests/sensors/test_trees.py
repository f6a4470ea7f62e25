"""Trees in sweeps against Embree, and in lines of sight by hand and against Shapely."""

from dataclasses import replace

import numpy as np
import shapely

from sensors.boxes import Boxes
from sensors.line_of_sight import WallIndex, los_between_actors
from sensors.neighbours import neighbours
from sensors.scene import Hit, Scene, Shape
from sensors.trees import radius_m, tree_prisms, trees_near
from tests.sensors.test_raycast import compare
from tests.sensors.town import boxes_at, car, exact, lines_between, random_scene, traffic

ONE = tree_prisms(np.array([[20.0, 0.0, 0.0]]), 0.4, 3.0, 5.0, 10.0)


def test_a_tree_by_hand():
    """Straight ahead, a beam meets the trunk at 19.8 m; one that rises by 10 degrees meets the crown at 17.5 m, where
    it is 1.73 + 3.09 = 4.8 m high."""
    scene = replace(Scene.empty(), trees=ONE)
    sweep = exact(car(0.0, 0.0), [Shape.CAR], [0], scene, elevation_deg=(0.0, 10.0), n_azimuths=1, fov_deg=0.1)
    np.testing.assert_allclose(sweep.unrounded_m[0, 0], [19.8, 17.5 / np.cos(np.radians(10))], rtol=1e-5)
    assert (sweep.hit == Hit.BUILDING).all()


def test_trees_as_embree_casts_them():
    rng = np.random.default_rng(5)
    feet = np.column_stack([rng.uniform(-40, 40, (30, 2)), rng.uniform(-0.5, 0.5, 30)])
    scene = replace(random_scene(rng), trees=tree_prisms(feet, 0.5, 2.5, 4.0, 8.0))
    boxes, shape = traffic(rng, 12)
    compare("embree", boxes, shape, np.arange(3), scene, profile="vlp16")


def test_lines_of_sight_by_hand():
    """A trunk blocks a line through it, a crown one between tall vehicles; a line beside the trunk is clear."""
    city, walls = replace(Scene.empty(), trees=ONE), WallIndex.of(Scene.empty().buildings)
    at = np.array([[0, 0, 0.75], [40, 0, 0.75], [0, 1, 0.75], [40, 1, 0.75], [0, 2, 2.0], [40, 2, 2.0]])
    size = np.array([[4.5, 1.8, 1.5]] * 4 + [[8, 2.5, 4.0]] * 2)
    boxes, shape = Boxes(at, size, np.zeros(6)), np.zeros(6, np.uint8)
    a, b = np.array([0, 2, 4, 2]), np.array([1, 3, 5, 0])
    ask = lambda **k: los_between_actors(walls, boxes, shape, a, b, bodies=False, **k).tolist()  # noqa: E731
    assert ask() == [True] * 4
    assert ask(city=city) == [False, True, False, True]


def test_lines_of_sight_against_shapely():
    rng = np.random.default_rng(8)
    feet = np.column_stack([rng.uniform(-60, 60, (80, 2)), np.zeros(80)])
    city = replace(Scene.empty(), trees=tree_prisms(feet, 1.0, 3.0, 5.0, 10.0))
    at = np.column_stack([rng.uniform(-80, 80, (60, 2)), np.full(60, 0.75)])
    boxes = boxes_at(at, (4.5, 1.8, 1.5))
    a, b = np.triu_indices(60, 1)
    found = los_between_actors(
        WallIndex.of(city.buildings), boxes, np.zeros(60, np.uint8), a, b, bodies=False, city=city
    )
    trunks = shapely.union_all(shapely.box(*(feet[:, :2] - 0.5).T, *(feet[:, :2] + 0.5).T))
    lines = lines_between(at, a, b)
    assert np.array_equal(found, ~shapely.intersects(trunks, lines)) and 0.2 < found.mean() < 0.9


def test_near_trees_are_those_of_a_search_among_boxes():
    rng = np.random.default_rng(2)
    feet = np.column_stack([rng.uniform(-90, 90, (50, 2)), np.zeros(50)])
    trees = tree_prisms(feet, 0.4, 3.0, 5.0, 10.0)
    points = rng.uniform(-60, 60, (7, 2))
    boxes = boxes_at(feet, (5.0, 5.0, 10.0))
    expected = neighbours(points, boxes, 30.0 + radius_m(trees) - boxes.circumradius_m.max())
    found = trees_near(points, replace(Scene.empty(), trees=trees), 30.0)
    assert np.array_equal(found.ptr, expected.ptr) and np.array_equal(found.row, expected.row)
