from decimal import Decimal

import numpy as np
import pandas as pd
import pytest

from cosim.radio import propagation as p
from cosim.radio.propagation import PropagationParams
from tests.cosim.radio import ns3

ONE = np.ones(1)


def test_by_hand():
    # 20 log(4 pi 5.9e9 / c) = 47.86 dB at 1 m, 20 dB per decade.
    assert p.free_space_db(np.array([1.0, 100.0])) == pytest.approx([47.86, 87.86], abs=0.01)
    # 27.5 dB per decade.
    assert p.log_distance_db(np.array([100.0])) == pytest.approx([47.86 + 55], abs=0.01)
    # 20 dB in the first decade pair up to 100 m (40), then 40 dB per decade.
    assert p.dual_slope_db(np.array([100.0, 1000.0])) == pytest.approx([87.86, 127.86], abs=0.01)
    # Cross-over of 1.5 m antennas at 556 m; beyond: 40 log 1000 - 40 log 1.5 = 120 - 7.04.
    assert p.two_ray_ground_db(np.array([500.0, 1000.0]), 1.5 * ONE, 1.5 * ONE) == pytest.approx(
        [101.84, 112.96], abs=0.01
    )
    # 52.80 + 16.7 log d and 51.42 + 30 log d at 5.9 GHz; highway 47.82 + 20 log d.
    d, los, nlos = np.array([100.0]), np.array([False]), np.array([True])
    assert p.tr37885_db(d, los, "urban") == pytest.approx([86.20], abs=0.01)
    assert p.tr37885_db(d, nlos, "urban") == pytest.approx([111.42], abs=0.01)
    assert p.tr37885_db(d, los, "highway") == pytest.approx([87.82], abs=0.01)


def test_two_ray_interference_has_fades_near_and_falls_with_the_fourth_power_far():
    d = np.arange(10.0, 500.0, 0.5)
    over_free_space = p.two_ray_interference_db(d, 1.5 * ONE, 1.5 * ONE) - p.free_space_db(d)
    assert over_free_space.max() > 3
    assert over_free_space.min() < -2
    far = p.two_ray_interference_db(np.array([5e3, 5e4]), 1.5 * ONE, 1.5 * ONE)
    assert far[1] - far[0] == pytest.approx(40, abs=0.3)


@pytest.mark.parametrize("scenario", ["urban", "highway"])
@pytest.mark.parametrize("condition", ["LOS", "NLOS", "NLOSv"])
def test_3gpp_losses_are_those_of_ns3(scenario, condition):
    rows = pd.read_csv(ns3.file("tr37885_pathloss_ns3.csv"))
    rows = rows[(rows.scenario == scenario) & (rows.condition == condition)]
    d = rows.d_m.to_numpy(float)
    mean = p.tr37885_db(d, np.full(len(d), condition == "NLOS"), scenario)
    if condition == "NLOSv":  # 400 samples per distance: 4.5 / 20 = 0.22 dB standard error of the mean
        normal = np.random.default_rng(0).standard_normal((20_000, 1))
        draws = p.blockage_db(normal, d, np.array([1.5]), np.array([1.5]))
        assert np.abs(mean + draws.mean(0) - rows.mean_pl_db).max() < 1.0
        assert draws.std(0).mean() == pytest.approx(rows.sd_pl_db.mean(), abs=0.2)
    else:
        assert mean == pytest.approx(rows.mean_pl_db.to_numpy(), abs=0.01)


def ns3_blockage(h_a_m, h_b_m, blocker_m):
    """Mean excess loss near the sender [dB] as ns-3 codes TR 37.885, pair by pair; heights in decimal arithmetic."""
    h_a, h_b, blocker = (round(Decimal(str(h)), 3) for h in (h_a_m, h_b_m, blocker_m))
    if min(h_a, h_b) > blocker:
        return 0.0
    if max(h_a, h_b) < blocker:
        return 9.0
    return 5.0


@pytest.mark.parametrize("blocker_m", [1.6, 3.0])
def test_blocked_pairs_by_class_are_those_of_ns3(blocker_m):
    """10,000 pairs of antennas on roofs of all usual heights, many of them exactly as high as the blocker."""
    g = np.random.default_rng(3)
    roof_m = g.choice([1.4, 1.45, 1.5, 1.55, 1.6, 2.0, 2.9, 3.0], (10_000, 2))
    h_a, h_b = (roof_m + g.choice([0.0, 0.05, 0.1, 0.15, 4.5], (10_000, 2))).T
    mean, _ = p.blockage_mean_db(np.full(10_000, 50.0), h_a, h_b, blocker_m)
    expected = [ns3_blockage(a, b, blocker_m) for a, b in zip(h_a.tolist(), h_b.tolist(), strict=True)]
    assert mean.tolist() == expected
    assert ((np.minimum(h_a, h_b) == blocker_m) & (mean == 5.0)).sum() > 100
    assert np.bincount(mean.astype(int))[[0, 5, 9]].min() > 100


def test_fading_gain_has_mean_one_and_the_shape_of_its_distance():
    table = p.fading_quantiles()
    assert table.mean(1) == pytest.approx(np.ones(len(table)), abs=0.003)
    near, far = p.fading_class(np.array([79.0, 81.0]), "nakagami")
    assert table[[near, far]].var(1) == pytest.approx([1 / 1.5, 1 / 0.75], rel=0.02)
    rayleigh = p.fading_class(np.array([50.0]), "rayleigh")[0]
    assert table[rayleigh] == pytest.approx(-np.log(1 - (np.arange(4096) + 0.5) / 4096), rel=1e-5)
    assert p.fading_class(np.array([3.0, 5.0, 20.0, 50.0, 100.0, 500.0]), "cheng").tolist() == list(range(4, 10))
    assert not p.fading_class(np.array([10.0]), "none").any()
    assert np.all(table[0] == 1)


def field_of(xy_a, xy_b, decorrelation_m, chance):
    n = len(xy_a)
    xy, a, b = np.concatenate([xy_a, xy_b]), np.arange(n), np.arange(n, 2 * n)
    return p.link_field(xy, a, b, np.linalg.norm(xy_a - xy_b, axis=1), decorrelation_m, np.uint64(chance))


def test_shadowing_is_standard_normal_and_decorrelates_as_asked():
    g = np.random.default_rng(2)
    a, b = g.uniform(0, 3000, (2, 400, 2))
    step = 10.0 * np.array([0.6, 0.8])
    here, one, both = [], [], []
    for chance in range(150):  # other waves each time
        here.append(field_of(a, b, 10.0, chance))
        one.append(field_of(a + step, b, 10.0, chance))
        both.append(field_of(a + step, b + step, 10.0, chance))
    here, one, both = (np.concatenate(x) for x in (here, one, both))
    assert here.mean() == pytest.approx(0, abs=0.03)
    assert here.std() == pytest.approx(1, abs=0.03)
    assert np.mean(np.abs(here) > 1.96) == pytest.approx(0.05, abs=0.01)
    assert np.corrcoef(here, one)[0, 1] == pytest.approx(np.exp(-1), abs=0.04)
    assert np.corrcoef(here, both)[0, 1] == pytest.approx(np.exp(-np.sqrt(2)), abs=0.04)


def test_shadowing_is_the_same_both_ways_and_for_close_pairs_no_wilder():
    g = np.random.default_rng(3)
    a = g.uniform(0, 3000, (300, 2))
    b = a + 0.5
    assert np.array_equal(field_of(a, b, 10.0, 1), field_of(b, a, 10.0, 1))
    close = np.concatenate([field_of(a, b, 10.0, chance) for chance in range(100)])
    assert close.std() == pytest.approx(1, abs=0.05)


def test_vehicles_get_in_the_way_more_in_dense_traffic():
    d = np.linspace(10, 1000, 100)
    for scenario in ("urban", "highway"):
        low, medium, high = (p.vehicle_blockage_p(d, scenario, t) for t in ("low", "medium", "high"))
        for q in (low, medium, high):
            assert np.all((q >= 0) & (q <= 1))
        if scenario == "highway":
            assert np.all(low <= medium)
            assert np.all(np.diff(high) >= 0)


def test_faults_are_named():
    with pytest.raises(ValueError, match=r"interference_range_m = 0\.3 m is shorter"):
        PropagationParams(interference_range_m=0.3)
