"""The scene: bodies fill their boxes, footprints are sound or mended and counted."""

import numpy as np
import pytest
import shapely

from sensors.boxes import Boxes
from sensors.scene import LABEL_OF_SHAPE, Scene, Shape, prisms, roof_triangles
from tests.sensors.town import SIZE_M, blocks

SQUARE = [(0, 0), (10, 0), (10, 10), (0, 10)]


def test_every_body_keeps_just_inside_its_box():
    n = len(Shape)
    boxes = Boxes(np.zeros((n, 3)), SIZE_M, np.zeros(n))
    bodies = prisms(np.arange(n, dtype=np.uint8), boxes)
    actor = np.repeat(np.arange(n), np.diff(bodies.ptr))
    half = SIZE_M[actor] / 2
    assert (np.abs(bodies.x_m) + bodies.half_l_m < half[:, 0]).all()
    assert (np.abs(bodies.y_m) + bodies.half_w_m < half[:, 1]).all()
    assert (bodies.bottom_m >= -half[:, 2]).all() and (bodies.top_m < half[:, 2]).all()
    top = np.maximum.reduceat(bodies.top_m, bodies.ptr[:-1])
    assert (top > 0.95 * SIZE_M[:, 2] / 2).all() and len(LABEL_OF_SHAPE) == n


def test_unknown_shapes_are_refused():
    with pytest.raises(ValueError, match="no actor shape"):
        prisms(np.array([9], np.uint8), Boxes(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1)))
    with pytest.raises(ValueError, match="one of both"):
        prisms(np.zeros(2, np.uint8), Boxes(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1)))


def test_footprints_are_mended_and_counted():
    bow_tie = [(20, 0), (30, 10), (30, 0), (20, 10)]
    line = [(0, 0), (1, 1), (2, 2)]
    clockwise_closed = [*SQUARE[::-1], SQUARE[-1]]
    scene = Scene.from_footprints([[SQUARE], [bow_tie], [line], [clockwise_closed]], [0] * 4, [5] * 4)
    assert (scene.n_repaired, scene.n_dropped) == (1, 1)
    assert shapely.area(scene.footprints) == pytest.approx([100, 25, 25, 100])
    city = scene.buildings
    # outer rings run counter-clockwise whatever was given: the shoelace sum of every building is positive
    area = np.add.reduceat(city.ax_m * city.by_m - city.bx_m * city.ay_m, city.ptr[:-1]) / 2
    assert area == pytest.approx([100, 25, 25, 100])


def test_roofs_are_tiled():
    scene = blocks(np.random.default_rng(0))
    triangle, owner = roof_triangles(scene)
    a, b, c = triangle.transpose(1, 0, 2)
    area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert np.bincount(owner, area) == pytest.approx(shapely.area(scene.footprints))


@pytest.mark.parametrize(
    ("rings", "base", "top", "says"),
    [
        ([[SQUARE]], [5.0], [5.0], "not above"),
        ([[SQUARE]], [0.0], [np.nan], "not above"),
        ([[[(0, 0), (1, np.nan), (2, 2)]]], [0.0], [5.0], "no footprint"),
        ([[[(0, 0), (1, 1)]]], [0.0], [5.0], "no footprint"),
        ([[SQUARE]], [0.0, 1.0], [5.0], "one of each"),
    ],
)
def test_unsound_footprints_are_refused(rings, base, top, says):
    with pytest.raises(ValueError, match=says):
        Scene.from_footprints(rings, base, top)
