"""Speed limits by place."""

import numpy as np
import pytest

from cosim.traffic.limits import NO_LIMITS, SpeedLimits
from sumo_nets.network import Lane


def lane(ends_m, limit_mps, for_cars=True):
    return Lane(np.array([(*end, 0.0) for end in ends_m]), 3.2, for_cars, False, "edge", limit_mps=limit_mps)


def test_limits_are_known_near_lanes_only():
    """A motorway along y = 0, a street that crosses it at x = 50, a path for pedestrians, a lane without a length."""
    lanes = (lane([(-100, 0), (100, 0)], 30.0), lane([(50, -80), (50, 80)], 14.0),
             lane([(-100, 60), (100, 60)], 3.0, for_cars=False), lane([(0, 200), (0, 200)], 5.0))  # fmt: skip
    limits = SpeedLimits.of(lanes, (1000.0, -500.0))
    places = np.array([[-60, 3], [-60, -4.9], [50, 2], [54.9, 40], [-60, 60], [-60, 15], [1e6, -1e6], [3, 202]], float)
    expected = [30, 30, 30, 14, np.nan, np.nan, np.nan, 5]
    np.testing.assert_array_equal(limits.at(places - (1000.0, -500.0)), expected)
    assert np.isnan(NO_LIMITS.at(places)).all()


@pytest.mark.parametrize("limit_mps", [0.0, -5.0, 1e30, np.inf, np.nan])
def test_a_limit_that_is_none_is_unknown(limit_mps):
    limits = SpeedLimits.of((lane([(-100, 0), (100, 0)], limit_mps), lane([(50, -80), (50, 80)], 14.0)), (0.0, 0.0))
    np.testing.assert_array_equal(limits.at(np.array([[-60.0, 0.0], [50.0, 2.0]])), [np.nan, 14.0])


def test_a_lane_that_no_road_has_is_left_out():
    assert np.isnan(SpeedLimits.of([lane([(0, 0), (1.3e9, 0)], 14.0)], (0.0, 0.0)).at(np.zeros((1, 2)))).all()


def test_every_place_near_a_lane_has_a_limit():
    """A literal twin: no lane within 4.8 m is overlooked, and no limit is farther than a diagonal of two cells away."""
    rng = np.random.default_rng(4)
    ends = rng.uniform(-200, 200, (12, 2, 2))
    limits = SpeedLimits.of([lane(pair, 10.0) for pair in ends], (0.0, 0.0))
    places = rng.uniform(-220, 220, (2000, 2))
    a, b = ends[None, :, 0], ends[None, :, 1]
    share = np.clip(((places[:, None] - a) * (b - a)).sum(2) / ((b - a) ** 2).sum(2), 0, 1)
    away_m = np.hypot(*np.moveaxis(places[:, None] - a - share[..., None] * (b - a), 2, 0)).min(1)
    known = ~np.isnan(limits.at(places))
    assert known[away_m <= 4.8].all() and not known[away_m > 14.2].any()
