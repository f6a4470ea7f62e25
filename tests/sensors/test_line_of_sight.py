import numpy as np
import pytest
import shapely

from sensors.line_of_sight import LosCache, Walls
from sumo_nets import catalogue

SQUARE = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
YARD = [SQUARE * 0.4 + 3.0]


def sees(walls, start, end) -> bool:
    xyz, one = np.array([start, end], float), np.array([0])
    return bool(walls.clear(xyz, one, one + 1)[0])


def test_a_house_by_hand():
    house = Walls.of([(SQUARE, [], 0.0, 6.0)])
    assert not sees(house, (-5, 5, 1.5), (15, 5, 1.5))
    assert sees(house, (-5, 11, 1.5), (15, 11, 1.5))
    assert sees(house, (-5, 5, 7), (15, 5, 7))  # over the roof
    assert not sees(house, (-5, 5, 1.5), (15, 5, 7))  # through the first wall at 2.9 m
    assert sees(house, (-1, 5, 6.5), (-40, 5, 1.5))
    assert not sees(house, (5, 5, 1.5), (15, 5, 1.5))  # out of it
    assert not sees(house, (4, 5, 1.5), (6, 5, 1.5))  # within it
    assert sees(house, (500, 500, 1.5), (-500, 900, 1.5))  # both beyond the grid


def test_a_courtyard_is_outdoors_and_hidden():
    block = Walls.of([(SQUARE, YARD, 0.0, 6.0)])
    assert sees(block, (4, 4, 1.5), (6, 6, 1.5))
    assert not sees(block, (5, 5, 1.5), (15, 5, 1.5))


def test_a_bridge_house_lets_pass_below():
    bridge = Walls.of([(SQUARE, [], 4.0, 9.0)])
    assert sees(bridge, (-5, 5, 1.5), (15, 5, 1.5))
    assert sees(bridge, (5, 5, 1.5), (15, 5, 1.5))
    assert not sees(bridge, (-5, 5, 5), (15, 5, 5))


def test_walls_and_metres_by_hand():
    xyz = np.array([[-5, 5, 1.5], [15, 5, 1.5], [5, -5, 1.5], [1, 5, 1.5], [-5, 12, 1.5], [2, 5, 1.5]])
    a, b = np.array([0, 1, 0, 3, 0, 3]), np.array([1, 0, 3, 1, 4, 5])
    for ring in (SQUARE, SQUARE[::-1]):
        for yard in (YARD[0], YARD[0][::-1]):  # the yard spans 3 ... 7 m
            n_walls, inside_m = Walls.of([(ring, [yard], 0.0, 6.0)], cell_m=3.0).through(xyz, a, b)
            assert n_walls.tolist() == [4, 4, 1, 3, 0, 0]
            assert inside_m == pytest.approx([6, 6, 1, 5, 0, 1])


def test_walls_and_metres_agree_with_shapely():
    houses, g = town(6), np.random.default_rng(8)
    xyz = np.column_stack([g.uniform(-60, 650, 2000), g.uniform(-60, 550, 2000), np.full(2000, 1.5)])
    a, b = np.arange(1000), np.arange(1000, 2000)
    n_walls, inside_m = Walls.of(houses).through(xyz, a, b)
    city = shapely.union_all([shapely.Polygon(o, h) for o, h, _, _ in houses])
    lines = shapely.linestrings(np.stack([xyz[a, :2], xyz[b, :2]], axis=1))
    assert inside_m == pytest.approx(shapely.length(shapely.intersection(lines, city)), abs=1e-6)
    cuts = shapely.intersection(lines, city.boundary)
    assert n_walls.tolist() == np.where(shapely.is_empty(cuts), 0, shapely.get_num_geometries(cuts)).tolist()


def test_walls_and_metres_are_the_same_from_either_end():
    """Antennas on walls and corners too, where rounding would else decide."""
    rng = np.random.default_rng(4)
    square = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [0.0, 100.0]])
    city = Walls.of([(square + 125.0 * np.array([i, j]), [], 0.0, 20.0) for i in range(3) for j in range(3)])
    xyz = np.column_stack([rng.choice([0.0, 50.0, 100.0, 112.5, 125.0, 225.0, 240.0], (60, 2)), np.full(60, 1.5)])
    a, b = (k.ravel() for k in np.meshgrid(np.arange(60), np.arange(60)))
    there, back = city.through(xyz, a, b), city.through(xyz, b, a)
    assert np.array_equal(there[0], back[0]) and np.array_equal(there[1], back[1])


def test_without_houses_all_is_clear():
    nothing = Walls.of([])
    assert sees(nothing, (0, 0, 1.5), (500, 20, 1.5))
    assert sees(LosCache.of(nothing), (0, 0, 1.5), (500, 20, 1.5))


def town(n, seed=1):
    g = np.random.default_rng(seed)
    houses = []
    for x in range(n):
        for y in range(n):
            turn = g.uniform(-0.3, 0.3)
            turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            ring, yard = (((r - 5) * (7, 5)) @ turned.T + (110 * x, 90 * y) for r in (SQUARE, YARD[0]))
            houses.append((ring, [yard] if g.random() < 0.5 else [], 0.0, g.uniform(4, 20)))
    return houses


def by_shapely(houses, xyz, a, b, z):
    tree = shapely.STRtree([shapely.Polygon(o, h) for o, h, base, top in houses if base <= z <= top])
    lines = shapely.linestrings(np.stack([xyz[a, :2], xyz[b, :2]], axis=1))
    clear = np.ones(len(a), bool)
    clear[tree.query(lines, predicate="intersects")[0]] = False
    return clear


@pytest.mark.parametrize("cell_m", [2.0, 4.0, 30.0])
def test_a_town_agrees_with_shapely(cell_m):
    houses, g = town(8), np.random.default_rng(4)
    xyz = np.column_stack([g.uniform(-60, 850, 6000), g.uniform(-60, 700, 6000), np.full(6000, 1.5)])
    xyz[3000:4500, :2] = xyz[:1500, :2] + g.normal(0, 40, (1500, 2))
    a, b = np.arange(3000), np.arange(3000, 6000)
    assert np.array_equal(Walls.of(houses, cell_m).clear(xyz, a, b), by_shapely(houses, xyz, a, b, 1.5))


def test_helsinki_agrees_with_shapely_on_ten_thousand_pairs():
    net = catalogue.find("helsinki")
    houses, g = net.footprints(), np.random.default_rng(5)
    x0, y0, x1, y1 = net.bounds_m
    n = 10_000
    xyz = np.column_stack([g.uniform(x0, x1, 2 * n), g.uniform(y0, y1, 2 * n), np.full(2 * n, 1.5)])
    xyz[n:, :2] = xyz[:n, :2] + g.normal(0, 1, (n, 2)) * g.choice([10, 50, 200], n)[:, None]
    a, b = np.arange(n), np.arange(n, 2 * n)
    clear = Walls.of(houses).clear(xyz, a, b)
    assert 0.2 < clear.mean() < 0.8
    assert np.array_equal(clear, by_shapely(houses, xyz, a, b, 1.5))


def test_memory_changes_no_answer_and_forgetting_neither():
    walls, g = Walls.of(town(6)), np.random.default_rng(6)
    xyz = np.column_stack([g.uniform(-60, 650, 400), g.uniform(-60, 550, 400), np.full(400, 1.5)])
    a, b = g.integers(0, 400, (2, 20_000))
    large, small = LosCache.of(walls), LosCache.of(walls, n_remembered=256)  # far too few for these
    first = large.clear(xyz, a, b)
    assert np.array_equal(large.clear(xyz, a, b), first)
    assert np.array_equal(small.clear(xyz, a, b), first)
    assert np.array_equal(small.clear(xyz, b, a), first)  # a line has no direction
    snapped = large.snap(xyz)
    assert np.abs(snapped - xyz).max() <= 0.25
    assert np.array_equal(walls.clear(snapped, a, b), first)


def test_a_wall_never_opens_a_view():
    houses, g = town(5), np.random.default_rng(7)
    xyz = np.column_stack([g.uniform(-60, 550, 2000), g.uniform(-60, 450, 2000), g.uniform(1, 9, 2000)])
    a, b = np.arange(1000), np.arange(1000, 2000)
    fewer, more = Walls.of(houses[::2]).clear(xyz, a, b), Walls.of(houses).clear(xyz, a, b)
    assert np.all(fewer | ~more)


def test_faults_are_named():
    with pytest.raises(ValueError, match="buildings\\[0\\]: top_z = 0"):
        Walls.of([(SQUARE, [], 0.0, 0.0)])
    with pytest.raises(ValueError, match="a ring must be"):
        Walls.of([(SQUARE[:2], [], 0.0, 5.0)])
    with pytest.raises(ValueError, match="snap_m"):
        LosCache.of(Walls.of([]), snap_m=0.0)
    with pytest.raises(ValueError, match="too far from the buildings"):
        LosCache.of(Walls.of([])).clear(np.array([[0, 0, 1.5], [1e9, 0, 1.5]]), np.array([0]), np.array([1]))
