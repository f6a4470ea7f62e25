"""The scene: bodies fill their boxes, footprints are valid or repaired and counted."""

import numpy as np
import pytest
import shapely

from sensors.boxes import Boxes
from sensors.scene import LABEL_OF_SHAPE, Hit, Scene, Shape, prisms, roof_triangles
from tests.sensors.town import SIZE_M, blocks, boxes_at, car, exact

SQUARE = [(0, 0), (10, 0), (10, 10), (0, 10)]


def test_every_body_keeps_just_inside_its_box():
    n = Shape.ROADSIDE_UNIT  # the last shape, which has no body
    assert n == len(Shape) - 1 and not len(prisms(np.array([n], np.uint8), car(0, 0)).x_m)
    boxes = Boxes(np.zeros((n, 3)), SIZE_M, np.zeros(n))
    bodies = prisms(np.arange(n, dtype=np.uint8), boxes)
    actor = np.repeat(np.arange(n), np.diff(bodies.ptr))
    half = SIZE_M[actor] / 2
    assert (np.abs(bodies.x_m) + bodies.half_l_m < half[:, 0]).all()
    assert (np.abs(bodies.y_m) + bodies.half_w_m < half[:, 1]).all()
    assert (bodies.bottom_m >= -half[:, 2]).all() and (bodies.top_m < half[:, 2]).all()
    top = np.maximum.reduceat(bodies.top_m, bodies.ptr[:-1])
    assert (top > 0.95 * SIZE_M[:, 2] / 2).all() and len(LABEL_OF_SHAPE) == len(Shape)


def test_unknown_shapes_are_refused():
    with pytest.raises(ValueError, match="no actor shape"):
        prisms(np.array([9], np.uint8), boxes_at((0.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match="one shape and one box per actor"):
        prisms(np.zeros(2, np.uint8), boxes_at((0.0, 0.0, 0.0)))


def test_footprints_are_repaired_and_those_without_area_are_left_out():
    bow_tie = [(20, 0), (30, 10), (30, 0), (20, 10)]
    line = [(0, 0), (1, 1), (2, 2)]
    clockwise_closed = [*SQUARE[::-1], SQUARE[-1]]
    scene = Scene.from_footprints([[SQUARE], [bow_tie], [line], [clockwise_closed]], [0] * 4, [5] * 4)
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


def tetrahedron():
    vertices = np.array([[10, -2, -1], [14, 0, -1], [10, 2, -1], [11.0, 0, 4]])
    return vertices, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


@pytest.mark.parametrize("engine", ["embree", "open3d"])
def test_a_mesh_is_cast_by_embree_and_open3d(engine):
    if engine == "open3d":
        pytest.importorskip("open3d")
    vertices, faces = tetrahedron()
    scene = blocks(np.random.default_rng(0)).with_mesh(vertices, faces)
    level = {"elevation_deg": (0.0,), "n_azimuths": 1, "fov_deg": 1.0}
    sweep = exact(car(0, 0), [0], [0], scene, engine=engine, **level)
    # The sensor is at 1.73 m. The face towards it runs from x = 10 at z = -1 to x = 11 at z = 4: 10 + 2.73 / 5.
    assert sweep.unrounded_m[0, 0, 0] == pytest.approx(10.546, abs=1e-5) and sweep.hit[0, 0, 0] == Hit.BUILDING
    with pytest.raises(ValueError, match="4 triangles"):
        exact(car(0, 0), [0], [0], scene, **level)


def test_two_meshes():
    vertices, faces = tetrahedron()
    scene = Scene.empty().with_mesh(vertices, faces).with_mesh(vertices + 20.0, faces)
    assert len(scene.triangles_m) == 8
    soup = vertices[faces].reshape(-1, 3)  # the same, corner by corner: equal places are one vertex
    assert len(Scene.empty().with_mesh(soup, np.arange(12).reshape(4, 3)).triangles_m) == 4


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda v, f: (v, f[:-1]), "3 open edges"),
        (lambda v, f: (v, np.vstack([f[:-1], f[-1, ::-1]])), "open edges"),
        (lambda v, f: (v, np.vstack([f, f[:1]])), "open edges"),
        (lambda v, f: (v, f + 1), "names three"),
        (lambda v, f: (v * np.nan, f), "finite"),
        (lambda v, f: (v, f[:0]), "0 faces"),
    ],
)
def test_invalid_meshes_are_refused(change, says):
    with pytest.raises(ValueError, match=says):
        Scene.empty().with_mesh(*change(*tetrahedron()))


def test_long_trucks_and_buses_have_two_parts():
    lwh = np.array([(8.0, 2.5, 3.5), (16.5, 2.55, 4.0), (12.0, 2.55, 3.2), (18.0, 2.55, 3.2)])
    boxes = Boxes(np.zeros((4, 3)), lwh, np.zeros(4))
    bodies = prisms(np.array([Shape.TRUCK, Shape.TRUCK, Shape.BUS, Shape.BUS], np.uint8), boxes)
    assert np.diff(bodies.ptr).tolist() == [2, 4, 1, 3]
    actor = np.repeat(np.arange(4), np.diff(bodies.ptr))
    assert (np.abs(bodies.x_m) + bodies.half_l_m < lwh[actor, 0] / 2).all()
    assert (bodies.half_w_m < lwh[actor, 1] / 2).all() and (bodies.top_m < lwh[actor, 2] / 2).all()
    assert (bodies.bottom_m >= -lwh[actor, 2] / 2).all()


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
def test_invalid_footprints_are_refused(rings, base, top, says):
    with pytest.raises(ValueError, match=says):
        Scene.from_footprints(rings, base, top)
