"""Blockage by the bodies of traffic: against Shapely, by hand, and in a medium."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from cosim.radio.bodies import Bodies, tallest_blocker_m
from cosim.radio.link_budget import pairs
from cosim.radio.propagation import PropagationParams, blockage_mean_db
from tests.solids import footprint

PLAIN = PropagationParams(model="highway", shadowing=False, fading="none", blockage="bodies")


def bodies_of(xy_m, lwh_m, yaw_rad, own=()):
    lwh_m = np.asarray(lwh_m, float)
    xyz_m = np.column_stack([np.asarray(xy_m, float), lwh_m[:, 2] / 2])
    return Bodies(xyz_m, lwh_m, np.asarray(yaw_rad, float), np.asarray(own, np.int64))


def test_the_tallest_of_the_bodies_that_shapely_finds():
    g = np.random.default_rng(4)
    n, n_bodies = 120, 300
    xyz_m = np.column_stack([g.uniform(0, 400, (n, 2)), np.full(n, 1.6)])
    lwh_m = np.column_stack([g.uniform(3, 14, n_bodies), g.uniform(1.5, 2.6, n_bodies), g.uniform(1.4, 4, n_bodies)])
    bodies = bodies_of(g.uniform(0, 400, (n_bodies, 2)), lwh_m, g.uniform(-np.pi, np.pi, n_bodies), np.full(n, -1))
    a, b = (rows[g.permutation(len(rows))[:1500]] for rows in np.int32(np.triu_indices(n, 1)))
    keep = a != b
    found = tallest_blocker_m(xyz_m, a[keep], b[keep], bodies)
    boxes = [
        footprint(*at[:2], x, w, yaw) for at, (x, w, _), yaw in zip(bodies.xyz_m, lwh_m, bodies.yaw_rad, strict=True)
    ]
    tree = shapely.STRtree(boxes)
    expected = []
    for i, j in zip(a[keep], b[keep], strict=True):
        hit = tree.query(shapely.LineString([xyz_m[i, :2], xyz_m[j, :2]]), predicate="intersects")
        expected.append(lwh_m[hit, 2].max() if len(hit) else 0.0)
    assert np.mean(np.asarray(expected) > 0) > 0.3
    assert np.array_equal(found, expected)


def test_a_truck_between_two_cars_by_hand():
    """Two antennas at 1.6 m and 60 m apart: a truck of 3.5 m adds 9 dB on average, a car of 1.5 m nothing."""
    xyz_m = np.array([[0.0, 0, 1.6], [60.0, 0, 1.6]])
    cars = [[4.5, 1.8, 1.5], [4.5, 1.8, 1.5]]
    loss = {}
    for name, third in (("truck", [12, 2.5, 3.5]), ("car", [4.5, 1.8, 1.5]), ("aside", [12, 2.5, 3.5])):
        y = 4.0 if name == "aside" else 0.5
        bodies = bodies_of([[0, 0], [60, 0], [30, y]], [*cars, third], [0.0, 0, 0], [0, 1])
        found = pairs(xyz_m, PLAIN, np.uint64(1), above_street_m=np.full(2, 1.6), bodies=bodies)
        loss[name] = (found.loss_db[0], bool(found.nlosv[0]))
    clear = 32.4 + 20 * np.log10(60) + 20 * np.log10(5.9)
    assert loss["aside"] == (pytest.approx(clear), False)
    assert loss["car"] == (pytest.approx(clear), True)
    assert loss["truck"][0] > clear + 2 and loss["truck"][1]
    assert blockage_mean_db(np.array([60.0]), np.full(1, 1.6), np.full(1, 1.6), np.array([3.5]))[0][0] == 9.0


def test_the_bodies_of_the_two_ends_do_not_block_and_bridges_neither():
    xyz_m = np.array([[0.0, 0, 1.6], [60.0, 0, 1.6]])
    a, b = np.int32([[0], [1]])
    own = bodies_of([[0, 0], [60, 0]], [[12, 2.5, 3.0]] * 2, [0.0, 0.0], [0, 1])
    assert tallest_blocker_m(xyz_m, a, b, own)[0] == 0
    assert tallest_blocker_m(xyz_m, a, b, replace(own, own=np.array([-1, -1])))[0] == 3.0
    above = bodies_of([[30, 0]], [[12, 2.5, 3.0]], [0.0], [-1, -1])
    for height_m, expected in ((0.0, 3.0), (6.0, 0.0), (-8.0, 0.0)):
        moved = replace(above, xyz_m=above.xyz_m + [0, 0, height_m])
        assert tallest_blocker_m(xyz_m, a, b, moved)[0] == expected


def test_without_bodies_there_is_one_clear_line():
    with pytest.raises(ValueError, match="needs the bodies of the traffic"):
        pairs(np.array([[0.0, 0, 1.6], [60.0, 0, 1.6]]), PLAIN, np.uint64(1))
