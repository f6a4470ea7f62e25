"""Places of roadside units: the greedy choice against all choices, and ages by hand."""

from itertools import combinations

import numpy as np
import pytest

from cosim.addons.law.placement import SiteCoverage, _Sights, greedy
from sensors.line_of_sight import WallIndex
from tests.drive import cosim
from tests.sensors.town import Scene


def random_coverage(rng, n_sites=7, n_elements=25, cap=10):
    rows = [np.flatnonzero(rng.random(n_elements) < 0.3) for _ in range(n_sites)]
    young = [rng.integers(1, cap + 1, len(row)).astype(np.uint16) for row in rows]
    ptr = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    return SiteCoverage(ptr, np.concatenate(rows), np.concatenate(young), rng.integers(0, 4, n_elements) * 1.0, cap)


def literal_value(coverage, chosen):
    """Sum over elements of the weight times the largest value that a chosen site gives it."""
    total = 0.0
    for e, weight in enumerate(coverage.weight.tolist()):
        best = 0
        for c in chosen:
            for row in range(coverage.ptr[c], coverage.ptr[c + 1]):
                if coverage.element[row] == e:
                    best = max(best, int(coverage.young[row]))
        total += weight * best
    return total


@pytest.mark.parametrize("seed", range(20))
def test_greedy_against_all_choices(seed):
    """At least 1 - 1/e of the best set, and the best single site; lazy counting equals counting everything anew."""
    coverage = random_coverage(np.random.default_rng(seed))
    for count in (1, 2, 3):
        chosen = greedy(coverage, count)
        best = max(literal_value(coverage, some) for some in combinations(range(7), count))
        reached = literal_value(coverage, chosen)
        assert reached == coverage.value(chosen)
        assert reached == best if count == 1 else reached >= (1 - 1 / np.e) * best
        for n in range(count):
            values = [literal_value(coverage, [*chosen[:n], c]) for c in range(7) if c not in chosen[:n]]
            assert literal_value(coverage, chosen[: n + 1]) == max(values)


def test_ages_by_hand():
    """A car drives along the x axis, 40 m per step, from 0; the sites are at 0 and 100 m and see 50 m far; cap 3.

    Positions 0, 40, 80, 120, 160, 200. Site 0 sees steps 0 and 1: ages 0 0 1 2 - -. Site 1 sees 80 and 120: steps 2
    and 3, ages - - 0 0 1 2. A second car stands at (0, 60), within 70 m of the first at step 0 and at step 1: hypot(40,
    60) = 72 m is too far, so each has one within radio range in step 0 alone, and the second is never seen. They are
    60 m apart then, farther than vehicles see.
    """
    sites = np.array([[0.0, 0.0, 6.0], [100.0, 0.0, 6.0]])
    sights = _Sights(sites, WallIndex.of(Scene.empty().buildings), 50.0, 70.0, 3)
    for step in range(6):
        sights.add(step, np.array([4, 2000]), np.array([[40.0 * step, 0.0, 1.5], [0.0, 60.0, 1.5]]))
    coverage = sights.coverage()
    young = np.zeros((2, 12), int)
    for c in range(2):
        rows = slice(coverage.ptr[c], coverage.ptr[c + 1])
        young[c, coverage.element[rows]] = coverage.young[rows]
    assert young[0, 0::2].tolist() == [3, 3, 2, 1, 0, 0] and young[1, 0::2].tolist() == [0, 0, 3, 3, 2, 1]
    assert not young[:, 1::2].any()
    assert coverage.weight[:4].tolist() == [1, 1, 0, 0]
    assert coverage.ages([0], [0.5, 1.0]) == [0.0, 3.0]  # of the two elements with weight, ages 0 and 3


def test_a_building_hides_a_vehicle():
    wall = Scene.from_footprints([[np.array([[20.0, -5.0], [25.0, -5.0], [25.0, 5.0], [20.0, 5.0]])]], [0.0], [20.0])
    sights = _Sights(np.array([[0.0, 0.0, 6.0]]), WallIndex.of(wall.buildings), 70.0, 70.0, 3)
    sights.add(0, np.array([0, 1]), np.array([[40.0, 0.0, 1.5], [0.0, 40.0, 1.5]]))
    assert sights.coverage().element.tolist() == [1]


def test_weight_counts_those_in_radio_range_that_do_not_see_the_vehicle():
    """Radio 100 m, sight 50 m, and a wall between the first and the third; the fifth is out of reach of all others.

    The first and second see each other, as do the second and third; the first and third (40 m) do not. The fourth hears
    the first three from 60 to 80 m and sees none.
    """
    wall = Scene.from_footprints([[np.array([[18.0, -5.0], [22.0, -5.0], [22.0, 5.0], [18.0, 5.0]])]], [0.0], [20.0])
    sights = _Sights(np.zeros((1, 3)), WallIndex.of(wall.buildings), 50.0, 100.0, 3)
    xy_m = np.array([[0.0, 0.0], [20.0, 20.0], [40.0, 0.0], [20.0, 80.0], [500.0, 0.0]])
    sights.add(0, np.arange(5), np.column_stack([xy_m, np.full(5, 1.5)]))
    assert sights.coverage().weight.tolist() == [2, 1, 2, 3, 0]


def test_units_of_the_config_do_not_count_and_that_is_said():
    words = ("place", "roadside", "--count", "1", "--set", "traffic.duration_s=4", "--set", "traffic.warmup_s=60")
    plain, beside = cosim(*words), cosim(*words, "--set", "roadside=[{junctions=2}]")
    assert plain.returncode == beside.returncode == 0, beside.stderr
    assert plain.stdout == beside.stdout
    assert "in place of [[roadside]]" in beside.stderr and "in place of" not in plain.stderr
