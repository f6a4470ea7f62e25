"""Vehicles on the road, before anything is simulated."""

import pytest

from cosim.config.config import load
from cosim.studies.density import departures, vehicles_on_road
from cosim.studies.estimate import estimate
from cosim.studies.plan import PlannedRun, StudyPlan
from tests.hostile.scenes import write_town, write_trace


@pytest.mark.verify
def test_cities_are_told_apart():
    """By the demand and the size of each: Koenigs Wusterhausen has 5,062 departures per hour, on 4,032 m instead of
    1,961 m: 200 x 5062 / 2820 x 4032 / 1961 = 738."""
    assert vehicles_on_road(load()) == pytest.approx(200, rel=0.01)
    assert vehicles_on_road(load(None, ["traffic.scale=0.5"])) == pytest.approx(100, rel=0.01)
    assert vehicles_on_road(load(None, ["traffic.scenario=koenigs-wusterhausen"])) == pytest.approx(738, rel=0.01)


def test_of_a_trace_and_of_flows(tmp_path):
    """The street has 8 cars and a person; the town's flows have periods of 2, 3 and 4 s: 13 vehicles in 12 s."""
    assert vehicles_on_road(load(None, [f"traffic.scenario={write_trace(tmp_path)}"])) == 9
    town = write_town(tmp_path / "town")
    assert departures((town.parent / "town.rou.xml",), 10.0, 22.0) == pytest.approx(13)
    assert 5 < vehicles_on_road(load(None, [f"traffic.scenario={town}", "traffic.warmup_s=30"])) < 60


def test_a_dense_city_takes_longer():
    def planned_s(city):
        config = load(None, [f"traffic.scenario={city}", "fleet.penetration_p=1"])
        return estimate([], StudyPlan((PlannedRun("one", config, (("one", "base"),), ""),), {}, ()), (), None).planned_s

    assert planned_s("koenigs-wusterhausen") > 2.5 * planned_s("helsinki")


def test_what_a_run_costs():
    """As `cosim.studies.estimate` measures it, by hand, for 60 equipped vehicles and 100 s after 600 s of warm-up.

    v0.2: 700 steps of traffic at 4 ms; 100 steps at 20 ms; 6,000 sweeps of 520 x 64 rays at 10 ns, and messages of a
    field of view of 90 degrees at a quarter of 1.2 ms. modern: steps of 0.2 s; 1800 x 64 rays all around.
    """
    start_s = 4.5 + 0.5
    v02_s = start_s + 700 * 0.004 + 100 * 0.02 + 6000 * (520 * 64 * 10e-9 + 1.2e-3 / 4)
    modern_s = start_s + 3500 * 0.004 + 500 * 0.02 + 6000 * (1800 * 64 * 10e-9 + 1.2e-3)
    for preset, want_s in (("v0.2", v02_s), ("modern", modern_s)):
        sets = ["traffic.duration_s=100", "traffic.warmup_s=600", "fleet.penetration_p=0.3"]
        config = load(None, [f"preset={preset}", *sets])
        plan = StudyPlan((PlannedRun("one", config, (("one", "base"),), ""),), {}, ())
        assert estimate([], plan, (), None).planned_s == pytest.approx(want_s, rel=0.01)
