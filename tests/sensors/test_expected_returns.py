"""Expected returns by a few lines: by hand, against sweeps of the same scenes, and the laws of shadows."""

import numpy as np
import pytest

from sensors import evidence
from sensors.boxes import Boxes
from sensors.expected_returns import expected_returns
from sensors.lidar import LidarParams, beams, mount, scan
from sensors.line_of_sight import WallIndex
from sensors.neighbours import neighbours
from sensors.scene import Scene, Shape, prisms
from tests.sensors.town import blocks, boxes_at, car, traffic

PARAMS = LidarParams(range_sigma_m=0.0)


def returns_of(boxes, shape, observers, scene, params=PARAMS):
    poses = mount(boxes, observers, params)
    near = neighbours(poses.origin_m, boxes, params.max_range_m)
    walls, bodies = WallIndex.of(scene.buildings), prisms(shape, boxes)
    found = expected_returns(poses, observers, beams(params), near, boxes, bodies, walls, params.max_range_m)
    o = np.repeat(np.arange(len(observers)), np.diff(near.ptr))
    return o, near.row, found


def test_a_wall_of_steel_by_hand():
    # A bus (12 x 2.55 x 3.2 m) 30 m ahead, seen from 1.73 m: its rear face is 0.98 * 2.55 = 2.499 m wide and 24.06 m
    # away. Bearings are up to atan(1.2495 / 24.06) = 2.973 degrees either side, 5.946 degrees in all, and columns are
    # 90 / 520 degrees apart: 34.36 columns. All lines end on the rear face. Slopes are from -1.73 / 24.06 = -0.0719 to
    # (0.99 * 3.2 - 1.73) / 24.06 = 0.0598: -4.11 to 3.42 degrees. The 32 upper beams of the HDL-64E are 1/3 degree
    # apart from -8.33 to 2 degrees: 2 - k / 3 >= -4.11 holds for k <= 18. That makes 19 rows and 652.8 returns.
    boxes = Boxes.concat([car(0, 0), boxes_at((30, 0, 1.6), (12, 2.55, 3.2))])
    _, row, found = returns_of(boxes, np.array([Shape.CAR, Shape.BUS], np.uint8), np.array([0]), Scene.empty())
    assert found.n[row == 1] == pytest.approx(652.8, rel=2e-3)
    assert (found.n == found.n_unoccluded).all() and found.n[row == 0] == 0


@pytest.mark.parametrize("seed", range(3))
def test_seen_as_by_sweeps(seed):
    rng = np.random.default_rng(seed)
    scene, (boxes, shape) = blocks(rng), traffic(rng, 60)
    observers = np.arange(0, 60, 2)
    o, row, found = returns_of(boxes, shape, observers, scene)
    sweeps = scan(boxes, shape, observers, scene, PARAMS, np.arange(len(observers), dtype=np.uint64))
    truth = evidence.observability(sweeps, boxes, shape)
    n = np.zeros((len(observers), len(boxes)))
    n[truth.observer, truth.actor] = truth.n_returns
    seen = n[o, row] > 0
    assert found.seen_p[seen].sum() == pytest.approx(seen.sum(), rel=0.06)
    assert found.seen_p[~seen].sum() <= 0.05 * seen.sum()
    assert np.corrcoef(np.log1p(found.n), np.log1p(n[o, row]))[0, 1] > 0.97


def test_one_more_body_never_adds_returns_from_another():
    rng = np.random.default_rng(7)
    scene, (boxes, shape) = blocks(rng), traffic(rng, 40)
    observers = np.arange(20)
    for without in (21, 30, 39):
        kept = np.delete(np.arange(40), without)
        o, row, all_of_them = returns_of(boxes, shape, observers, scene)
        p, other, fewer = returns_of(boxes.take(kept), shape[kept], observers, scene)
        most = np.zeros((20, 40))
        most[p, kept[other]] = fewer.n
        there = row != without
        assert (all_of_them.n[there] <= most[o[there], row[there]] + 1e-9).all()
